"""A mesh whose own colors and textures hold an albedo that an attack changed, so that any renderer shows it.

With the scale s, the albedo ρ of corners and texels, the turn of hue h and the offset d of the face, files are to hold

    ρ' = clamp(h(s ρ) + d, 0, max(1, s ρ)) / s',

encoded, with one new scale s' that brings the largest value to 1. Corners hold ρ' to float32. In a texture, neighboring
faces with different offsets may share texels, and interpolation at a face's border reads texels outside of it. So each
face gets a chart: a copy of the rectangle of old texels that its interpolation reads, with ρ' for this face alone, on
the same grid. Charts are packed in rows of falling height, and the face's texture coordinates are moved to its chart:
bilinear interpolation then has the old weights and the new values.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from renderer.geometry.mesh import Mesh
from renderer.image import decode, encode, to_bytes
from renderer.surface.albedo import changed_albedo

MOST_TEXELS = 2**26  # of a painted texture; where more are needed, charts have a coarser grid
BLOCK = 2**20  # texels at a time


def with_added_albedo(
    mesh: Mesh, added: np.ndarray, encoding: str, albedo_scale: float = 1.0, hue: np.ndarray | None = None
) -> tuple[Mesh, float]:
    """(mesh, s') that show the scaled albedo, turned in `hue` (F,) radians, plus `added`, (F, 3) linear, per face.

    Textures hold it to 8 bits, with the colors of corners multiplied in. The new scale is at least 1, the largest value
    in files, and no larger than the colors need, since it multiplies the rounding to 8 bits.
    """
    corner_albedo = decode(torch.from_numpy(mesh.corner_colors), encoding)
    decoded = decode(torch.arange(256, dtype=torch.float32) / 255, encoding)
    lightest = max((float(decoded[texture.max()]) for texture in mesh.textures), default=1.0)
    largest = float(corner_albedo.max()) * (lightest if (mesh.texture_ids >= 0).all() else 1.0)
    ceiling, offset = max(1.0, albedo_scale * largest), torch.from_numpy(added).float()
    angles = None if hue is None else torch.from_numpy(hue).float()

    def painted(albedo: Tensor, faces: np.ndarray) -> Tensor:
        """Linear albedo (N, 3) of faces (N,), changed and encoded."""
        turn = None if angles is None else angles[faces]
        return encode(changed_albedo(albedo * albedo_scale, turn, offset[faces]) / ceiling, encoding)

    colors, uvs, textures, gloss_textures = np.ones_like(mesh.corner_colors), mesh.corner_uvs.copy(), [], []
    plain = np.flatnonzero(mesh.texture_ids < 0)
    colors[plain] = painted(corner_albedo[plain].flatten(0, 1), plain.repeat(3)).view(-1, 3, 3).numpy()
    for index, source in enumerate(mesh.textures):
        faces = np.flatnonzero(mesh.texture_ids == index)
        charts = _Charts(mesh.corner_uvs[faces], source.shape[1::-1])
        texture = np.zeros((*charts.sheet[::-1], 3), dtype=np.uint8)
        factors = mesh.gloss_textures[index] if mesh.gloss_textures else np.zeros((1, 1, 0), dtype=np.uint8)
        gloss = np.zeros((*texture.shape[:2], factors.shape[2]), dtype=np.uint8)
        for owners in np.array_split(np.arange(len(faces)), 1 + charts.texels // BLOCK):
            owner, texel, center = charts.grid(owners)
            column, row = (np.floor(center / charts.scale).astype(np.int64) % source.shape[1::-1]).T  # it repeats
            albedo = decoded[torch.from_numpy(source[row, column]).int()]
            if not mesh.one_color_per_face:
                weights = torch.from_numpy(charts.weights(owner, center)).float()
                albedo *= torch.einsum("nk,nkc->nc", weights, corner_albedo[faces[owner]])
            elif not (mesh.corner_colors[faces] == 1).all():
                albedo *= corner_albedo[faces[owner], 0]
            columns, rows = (charts.corner[owner] + texel).T
            texture[rows, columns] = to_bytes(painted(albedo, faces[owner])).numpy()
            across, down = (center / charts.scale / source.shape[1::-1] % 1 * factors.shape[1::-1]).astype(np.int64).T
            gloss[rows, columns] = factors[down, across]  # the nearest
        textures.append(texture)
        gloss_textures.append(gloss)
        uvs[faces] = charts.uvs
    baked = replace(mesh, corner_colors=colors, corner_uvs=uvs, textures=tuple(textures))
    return replace(baked, gloss_textures=tuple(gloss_textures) if mesh.gloss_textures else ()), ceiling


class _Charts:
    """The charts of N faces in a new texture. Columns and rows, from the top left, are in this order throughout.

    corner: (N, 2), the top left of each. sheet: size of the new texture. texels: of all charts. uvs: (N, 3, 2). scale:
    new texels per old one.
    """

    def __init__(self, uvs: np.ndarray, size: tuple[int, int]):
        """uvs: (N, 3, 2) of the faces in the old texture, which has so many columns and rows."""
        positions = (uvs * [1.0, -1.0] + [0.0, 1.0]) * size
        area = (np.ptp(positions, axis=1) + 2).prod(axis=1).sum()
        self.scale = min(1.0, np.sqrt(MOST_TEXELS / max(area, 1)))
        self._positions = positions * self.scale
        self._first = np.floor(self._positions.min(axis=1) - 0.5).astype(np.int64)
        self._size = np.floor(self._positions.max(axis=1) - 0.5).astype(np.int64) + 2 - self._first
        self.corner, self.sheet = _on_shelves(self._size)
        self.texels = int(self._size.prod(axis=1).sum())
        self.uvs = (self._positions + (self.corner - self._first)[:, None]) / self.sheet * [1, -1] + [0, 1]

    def grid(self, owners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(owner (S,), column and row in its chart (S, 2), position (S, 2)) of all texels of some owners' charts."""
        count = self._size[owners].prod(axis=1)
        owner = np.repeat(owners, count)
        number = np.arange(len(owner)) - np.repeat(count.cumsum() - count, count)
        texel = np.stack(np.divmod(number, self._size[owner, 0])[::-1], axis=1)
        return owner, texel, self._first[owner] + texel + 0.5

    def weights(self, owner: np.ndarray, center: np.ndarray) -> np.ndarray:
        """(S, 3) barycentric coordinates of positions (S, 2), clipped into the face."""
        edges = self._positions[:, 1:] - self._positions[:, :1]
        inverse = np.linalg.pinv(edges)  # a face without area in the texture has no other
        second_third = np.einsum("ni,nij->nj", center - self._positions[owner, 0], inverse[owner])
        weights = np.concatenate([1 - second_third.sum(axis=1, keepdims=True), second_third], axis=1).clip(min=0)
        return weights / weights.sum(axis=1, keepdims=True)


def _on_shelves(size: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """(top left corners (N, 2), size of the sheet) of rectangles (N, 2) packed in rows of falling height."""
    width = max(int(np.sqrt(size.prod(axis=1).sum() * 1.05)), int(size[:, 0].max(initial=1)))
    corner = np.empty_like(size)
    column = row = below = 0
    for index in np.argsort(-size[:, 1], kind="stable"):
        if column + size[index, 0] > width:
            column, row = 0, below
        corner[index] = column, row
        column, below = column + size[index, 0], max(below, row + size[index, 1])
    return corner, (width, max(below, 1))
