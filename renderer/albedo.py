"""The albedo at a view's samples, linear: of the mesh as it was loaded, or as a parameter per face or per texel."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from renderer.errors import require_bounded
from renderer.fragments import BLOCK, Fragments
from renderer.image import decode
from renderer.mesh import Mesh

Linear = Callable[[Tensor], Tensor]


def surface_albedo(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor:
    """(S, 3) float64 linear albedo at the samples: corner colour × texture, each decoded before it is interpolated."""
    decoded = decode(torch.arange(256, dtype=torch.float64) / 255, encoding).to(fragments.coverage)
    textures = [torch.from_numpy(texture).to(decoded.device) for texture in mesh.textures]
    return _albedo(mesh, fragments, textures, lambda texels: decoded.index_select(0, texels.long()), encoding)


def textured_albedo(mesh: Mesh, fragments: Fragments, textures: Sequence[Tensor], encoding: str) -> Tensor:
    """`surface_albedo` with other textures in place of the mesh's: linear albedo (H, W, 3), float, each.

    Differentiable in them. InputError: NaN.
    """
    for texture in textures:
        require_bounded(texture=texture)
    return _albedo(mesh, fragments, textures, lambda texels: texels, encoding)


def face_albedo(albedo: Tensor, fragments: Fragments) -> Tensor:
    """(S, 3) linear albedo at the samples, of one per face of the mesh (F, 3); differentiable. InputError: NaN."""
    require_bounded(albedo=albedo)
    return _of_faces(albedo.index_select(0, fragments.faces), fragments)


def _albedo(mesh: Mesh, fragments: Fragments, textures: Sequence[Tensor], linear: Linear, encoding: str) -> Tensor:
    """Corner colour × texture at the samples. `linear` turns texels (N,), as they are stored, into linear albedo."""
    if mesh.one_color is not None:
        color = _linear_colors(mesh.one_color, fragments, encoding)
        return color[:, None].expand(3, len(fragments.face)).T
    faces = fragments.faces.cpu().numpy()
    colors = _linear_colors(mesh.corner_colors.take(faces, axis=0), fragments, encoding)
    one_per_face = (colors == colors[:, :1]).all()
    albedo = _of_faces(colors[:, 0], fragments) if one_per_face else fragments.interpolate(colors)
    if not textures:
        return albedo
    uvs = fragments.interpolate(torch.from_numpy(mesh.corner_uvs.take(faces, axis=0)).to(albedo)).T
    texture_ids = torch.from_numpy(mesh.texture_ids[faces]).to(fragments.face.device).index_select(0, fragments.face)
    albedo = albedo.T
    for index, texture in enumerate(textures):
        here = torch.nonzero(texture_ids == index).squeeze(1)
        value = _bilinear(texture, linear, uvs.index_select(1, here))
        albedo = albedo.index_copy(1, here, albedo.index_select(1, here) * value)
    return albedo.T


def _of_faces(values: Tensor, fragments: Fragments) -> Tensor:
    """Values (S, D) at samples of faces (G, D)."""
    return values.T.contiguous().index_select(1, fragments.face).T  # by rows: it takes half as long


def _linear_colors(colors: np.ndarray, fragments: Fragments, encoding: str) -> Tensor:
    """Colours as authored to linear albedo, float64 on the fragments' device."""
    corner_colors = torch.from_numpy(colors).to(fragments.coverage)
    require_bounded(corner_colors=corner_colors)
    return decode(corner_colors, encoding)


def _bilinear(texture: Tensor, linear: Linear, uvs: Tensor) -> Tensor:
    """(3, S) linear albedo of a texture (H, W, 3) that repeats, at uvs (2, S).

    Texel centres are at half-integers, v = 0 is the bottom row's lower edge.
    """
    (height, width), texels = texture.shape[:2], texture.flatten()
    channels = torch.arange(3, device=uvs.device)[:, None]
    blocks = []
    for u, v in (block.unbind() for block in uvs.split(BLOCK, dim=1)):
        columns, rows = _neighbours(u, width), _neighbours(1 - v, height)
        taps = [(down * across, row * width + column) for row, down in rows for column, across in columns]
        values = [linear(texels.index_select(0, (3 * tap.long() + channels).flatten())) for _, tap in taps]
        blocks.append(sum(weight * value.view(3, -1) for (weight, _), value in zip(taps, values, strict=True)))
    return torch.cat(blocks, dim=1)


def _neighbours(along: Tensor, count: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """(index, weight) of the texels before and after places (S,), in a texture that repeats from 0 to 1."""
    place = along * count - 0.5
    first = place.floor()
    share = place - first
    first, second = (index - count * (index / count).floor() for index in (first, first + 1))  # the remainder
    return (first, 1 - share), (second, share)
