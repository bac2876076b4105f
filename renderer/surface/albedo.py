"""The albedo at a view's samples, linear: of the mesh as it was loaded, or as a parameter per face or per texel."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, reduce

import torch
from torch import Tensor

from renderer.errors import require_bounded
from renderer.geometry.mesh import Mesh
from renderer.image import clamp, decode
from renderer.visibility.fragments import BLOCK, Fragments


@dataclass(frozen=True)
class Texture:
    """texels: row-major indices (S,) → linear values (C, S)."""

    height: int
    width: int
    texels: Callable[[Tensor], Tensor]

    @staticmethod
    def of(values: Tensor) -> "Texture":
        """Of linear values (H, W, C). InputError: NaN."""
        require_bounded(texture=values)
        return Texture(values.shape[0], values.shape[1], partial(torch.index_select, values.flatten(0, 1).T, 1))


def surface_albedo(mesh: Mesh, fragments: Fragments, encoding: str, textures: Sequence[Tensor] | None = None) -> Tensor:
    """(S, 3) float64 linear albedo at the samples: corner color × texture, each decoded before it is interpolated.
    textures: in place of the mesh's: linear albedo (H, W, 3), float; differentiable in them. InputError: NaN."""
    albedo = _colors(mesh, fragments, encoding)
    if textures is None:
        sources = mesh_textures(mesh, encoding, fragments.coverage) if mesh.packed_textures else []
    else:
        sources = [Texture.of(texture) for texture in textures]
    return albedo * sample_textures(sources, mesh, fragments).T if sources else albedo


def sample_textures(textures: Sequence[Texture], mesh: Mesh, fragments: Fragments) -> Tensor:
    """(C, S) at the samples, each of the texture of its face, or 1 where a face has none."""
    faces = fragments.faces.cpu().numpy()
    uvs = fragments.interpolate(torch.from_numpy(mesh.corner_uvs.take(faces, axis=0)).to(fragments.coverage)).T
    texture_ids = torch.from_numpy(mesh.texture_ids.take(faces)).to(fragments.face.device)
    if len(textures) == 1 and not texture_ids.any():
        return bilinear(textures[0], uvs)
    texture_ids = texture_ids.index_select(0, fragments.face)
    here = [torch.nonzero(texture_ids == index).squeeze(1) for index in range(len(textures))]
    values = [bilinear(texture, uvs.index_select(1, at)) for texture, at in zip(textures, here, strict=True)]
    ones = values[0].new_ones(len(values[0]), len(texture_ids))
    return ones.index_copy(1, torch.cat(here), torch.cat(values, 1))


def mesh_textures(mesh: Mesh, encoding: str, like: Tensor) -> list[Texture]:
    """The mesh's own textures, eight bits a channel, decoded to the dtype and device of `like`."""
    decoded = decode(torch.arange(256, dtype=torch.float64) / 255, encoding).to(like)
    bits = torch.tensor([[0], [8], [16]], dtype=torch.int32, device=like.device)

    def texels(packed: Tensor, index: Tensor) -> Tensor:
        channels = (packed.index_select(0, index) >> bits) & 255
        return decoded.index_select(0, channels.long().flatten()).view(3, -1)

    packed = [torch.from_numpy(texture).to(like.device) for texture in mesh.packed_textures]
    return [Texture(texture.shape[0], texture.shape[1], partial(texels, texture.flatten())) for texture in packed]


def face_albedo(albedo: Tensor, fragments: Fragments) -> Tensor:
    """(S, 3) linear albedo at the samples, of one per face of the mesh (F, 3); differentiable. InputError: NaN."""
    require_bounded(albedo=albedo)
    return _of_faces(albedo.index_select(0, fragments.faces), fragments)


def painted_albedo(
    mesh: Mesh, fragments: Fragments, encoding: str, albedo_scale: float, added: Tensor, hue: Tensor | None = None
) -> Tensor:
    """(S, 3) at the samples: the scaled albedo, turned in `hue` by an angle per face (F,), plus `added`, (F, 3) per
    face, clamped to [0, 1], or to the scaled albedo where that is larger; differentiable in both. InputError: NaN.

    Corners and texels are clamped before they are interpolated, so that files can hold them: see
    `renderer.io.texture_bake`.
    """
    offset, faces = face_albedo(added, fragments), fragments.faces.cpu().numpy()
    angles = None if hue is None else hue.index_select(0, fragments.faces)
    # The gradient of index_select adds in the same order on any number of threads. That of brackets does not.
    of_corners = None
    of_samples = None
    if angles is not None:
        of_corners = angles[:, None]
        of_samples = angles.index_select(0, fragments.face)
    corners = decode(torch.from_numpy(mesh.corner_colors.take(faces, axis=0)).to(added), encoding) * albedo_scale
    albedo = fragments.interpolate(changed_albedo(corners, of_corners, added.index_select(0, fragments.faces)[:, None]))
    if not mesh.textures:
        return albedo
    colors = (_colors(mesh, fragments, encoding) * albedo_scale).to(added)
    uvs = fragments.interpolate(torch.from_numpy(mesh.corner_uvs.take(faces, axis=0)).to(fragments.coverage)).T
    texture_ids = torch.from_numpy(mesh.texture_ids.take(faces)).to(fragments.face.device)[fragments.face]
    for index, texture in enumerate(mesh_textures(mesh, encoding, added)):
        here = torch.nonzero(texture_ids == index).squeeze(1)
        taps = _taps(texture, uvs[:, here])
        turn = None if of_samples is None else of_samples.index_select(0, here)
        painted = offset.index_select(0, here)
        texels = [(weight.to(added), colors[here] * texture.texels(at).T) for weight, at in taps]
        changed = (weight[:, None] * changed_albedo(texel, turn, painted) for weight, texel in texels)
        albedo = albedo.index_copy(0, here, reduce(torch.add, changed))
    return albedo


def changed_albedo(albedo: Tensor, hue: Tensor | None, added: Tensor) -> Tensor:
    """(..., 3) linear albedo, turned about the gray axis by angles (...) in radians, which keeps the mean of the
    channels (Haeberli 1993), plus `added`; clamped to [0, 1], or to the albedo where that is larger."""
    changed = albedo
    if hue is not None:
        gray, hue = albedo.mean(-1, keepdim=True), hue[..., None]
        across = (albedo.roll(1, -1) - albedo.roll(-1, -1)) / math.sqrt(3)
        changed = gray + hue.cos() * (albedo - gray) + hue.sin() * across
    return clamp(changed + added, albedo.clamp(min=1))


def shared_albedo(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor | None:
    """Return the linear albedo (3,), float64, if all visible faces share one, else None.

    Args:
        mesh: Its corner colors are as authored for display.
        fragments: The visible faces of the mesh.
        encoding: By which colors are decoded, "linear" or "srgb".

    Raises:
        InputError: A color is NaN.
    """
    if mesh.packed_textures:
        return None
    colors = _corner_colors(mesh, fragments, encoding).flatten(0, 1)
    if not len(colors) or not (colors == colors[0]).all():
        return None
    return colors[0]


def _colors(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor:
    """(S, 3) linear albedo of the corners' colors at the samples, float64 on the fragments' device."""
    corner_colors = _corner_colors(mesh, fragments, encoding)
    if mesh.one_color_per_face:
        by_channel = corner_colors[:, 0].T.contiguous()
        # In float64, index_select takes three times as long.
        return by_channel.gather(1, fragments.face.expand(3, -1)).T
    return fragments.interpolate(corner_colors)


def _corner_colors(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor:
    """(G, 3, 3) linear albedo at the corners of the visible faces."""
    faces = fragments.faces.cpu().numpy()
    corner_colors = torch.from_numpy(mesh.corner_colors.take(faces, axis=0)).to(fragments.coverage)
    require_bounded(corner_colors=corner_colors)
    return decode(corner_colors, encoding)


def _of_faces(values: Tensor, fragments: Fragments) -> Tensor:
    """Values (S, D) at samples of faces (G, D)."""
    return values.T.contiguous().index_select(1, fragments.face).T  # by rows: it takes half as long


def bilinear(texture: Texture, uvs: Tensor) -> Tensor:
    """(3, S) linear albedo of a texture that repeats, at uvs (2, S).
    Texel centers are at half-integers, v = 0 is the bottom row's lower edge."""
    blocks = []
    for block in uvs.split(BLOCK, dim=1):
        blocks.append(reduce(torch.add, (weight * texture.texels(index) for weight, index in _taps(texture, block))))
    return torch.cat(blocks, dim=1)


def _taps(texture: Texture, uvs: Tensor) -> list[tuple[Tensor, Tensor]]:
    """(weight, row-major index) of the four texels around texture coordinates (2, S)."""
    columns, rows = _neighbors(uvs[0], texture.width), _neighbors(1 - uvs[1], texture.height)
    return [(down * across, (row * texture.width + column).long()) for row, down in rows for column, across in columns]


def _neighbors(along: Tensor, count: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """(index, weight) of the texels before and after coordinates (S,), in a texture that repeats from 0 to 1."""
    position = along * count - 0.5
    first = position.floor()
    fraction = position - first
    first, second = (index - count * (index / count).floor() for index in (first, first + 1))  # the remainder
    return (first, 1 - fraction), (second, fraction)
