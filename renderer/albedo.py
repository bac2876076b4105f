"""The albedo at a view's samples, linear: of the mesh as it was loaded, or as a parameter per face or per texel."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from renderer.errors import require_bounded
from renderer.fragments import Fragments
from renderer.image import decode
from renderer.mesh import Mesh

Linear = Callable[[Tensor], Tensor]


def surface_albedo(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor:
    """(S, 3) float64 linear albedo at the samples: corner colour × texture, each decoded before it is interpolated."""
    decoded = decode(torch.arange(256, dtype=torch.float64) / 255, encoding).to(fragments.coverage)
    textures = [torch.from_numpy(texture).to(decoded.device) for texture in mesh.textures]
    return _albedo(mesh, fragments, textures, lambda texels: decoded[texels.long()], encoding)


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
    return albedo.index_select(0, fragments.faces).index_select(0, fragments.face)


def _albedo(mesh: Mesh, fragments: Fragments, textures: Sequence[Tensor], linear: Linear, encoding: str) -> Tensor:
    """Corner colour × texture at the samples. `linear` turns texels (N, 3), as they are stored, into linear albedo."""
    if mesh.one_color is not None:
        color = _linear_colors(mesh.one_color, fragments, encoding)
        return color.expand(len(fragments.face), 3)
    faces = fragments.faces.cpu().numpy()
    colors = _linear_colors(mesh.corner_colors[faces], fragments, encoding)
    if not textures and (colors == colors[:, :1]).all():  # one for each face
        return colors[:, 0].index_select(0, fragments.face)
    barycentric = fragments.barycentric()
    albedo = _interpolate(barycentric, colors, fragments.face)
    texture_ids = torch.from_numpy(mesh.texture_ids[faces]).to(fragments.face.device)[fragments.face]
    uvs = torch.from_numpy(mesh.corner_uvs[faces]).to(albedo)
    for index, texture in enumerate(textures):
        here = torch.nonzero(texture_ids == index).squeeze(1)
        value = _bilinear(texture, linear, _interpolate(barycentric[here], uvs, fragments.face[here]))
        albedo = albedo.index_copy(0, here, albedo[here] * value)
    return albedo


def _linear_colors(colors: np.ndarray, fragments: Fragments, encoding: str) -> Tensor:
    """Colours as authored to linear albedo, float64 on the fragments' device."""
    corner_colors = torch.from_numpy(colors).to(fragments.coverage)
    require_bounded(corner_colors=corner_colors)
    return decode(corner_colors, encoding)


def _interpolate(barycentric: Tensor, corners: Tensor, face: Tensor) -> Tensor:
    """Values (S, D) at samples of faces whose corners have values (G, 3, D)."""
    return torch.einsum("sc,scd->sd", barycentric, corners.index_select(0, face))


def _bilinear(texture: Tensor, linear: Linear, uvs: Tensor) -> Tensor:
    """(S, 3) linear albedo of a texture (H, W, 3) that repeats, at uvs (S, 2).

    Texel centres are at half-integers, v = 0 is the bottom row's lower edge.
    """
    height, width = texture.shape[:2]
    x, y = uvs[:, 0] * width - 0.5, (1 - uvs[:, 1]) * height - 0.5
    column, row = x.floor().long(), y.floor().long()
    texels, value = texture.flatten(0, 1), uvs.new_zeros(len(uvs), 3)
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (1 - (y - row - down).abs()) * (1 - (x - column - across).abs())
        tap = texels.index_select(0, (row + down) % height * width + (column + across) % width)
        value = value + weight[:, None] * linear(tap)
    return value
