"""A mesh whose own colors and textures hold what was added to its albedo, so that any renderer shows it."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from renderer.image import decode, encode, to_bytes
from renderer.mesh import Mesh

MOST_TEXELS = 2**26  # of a painted texture: beyond it, faces get fewer texels than they had
BLOCK = 2**20  # texels at a time


def with_added_albedo(mesh: Mesh, added: np.ndarray, encoding: str, albedo_scale: float = 1.0) -> tuple[Mesh, float]:
    """(mesh, gain) that show the albedo times the gain plus `added`, within [0, 1] or up to what it was beyond.

    added: (F, 3) linear, per face. The colors of corners hold the sum to float32. Textures hold it to 8 bits: each
    face gets texels of its own, in the grid that it had, so that interpolation finds what it found before; the colors
    of its corners are painted into them. The new gain is at least 1, since colors in files end there, and no larger
    than the colors need, since it multiplies what 8 bits round off.
    """
    of_corners = decode(torch.from_numpy(mesh.corner_colors), encoding)
    decoded = decode(torch.arange(256, dtype=torch.float32) / 255, encoding)
    lightest = max((float(decoded[texture.max()]) for texture in mesh.textures), default=1.0)
    largest = float(of_corners.max()) * (lightest if (mesh.texture_ids >= 0).all() else 1.0)
    ceiling, offset = max(1.0, albedo_scale * largest), torch.from_numpy(added).float()

    def painted(albedo: Tensor, faces: np.ndarray) -> Tensor:
        """Linear albedo (N, 3) of faces (N,), changed and encoded."""
        bright = albedo * albedo_scale
        return encode((bright + offset[faces]).clamp(min=0).minimum(bright.clamp(min=1)) / ceiling, encoding)

    colors, uvs, textures = np.ones_like(mesh.corner_colors), mesh.corner_uvs.copy(), []
    plain = np.flatnonzero(mesh.texture_ids < 0)
    colors[plain] = painted(of_corners[plain].flatten(0, 1), plain.repeat(3)).view(-1, 3, 3).numpy()
    for index, source in enumerate(mesh.textures):
        faces = np.flatnonzero(mesh.texture_ids == index)
        charts = _Charts(mesh.corner_uvs[faces], source.shape[1::-1])
        texture = np.zeros((*charts.sheet[::-1], 3), dtype=np.uint8)
        for owners in np.array_split(np.arange(len(faces)), 1 + charts.texels // BLOCK):
            owner, texel = charts.grid(owners)
            column, row = charts.source(owner, texel).T
            albedo = decoded[torch.from_numpy(source[row, column]).int()]
            if not mesh.one_color_per_face:
                shares = torch.from_numpy(charts.shares(owner, texel)).float()
                albedo *= torch.einsum("nk,nkc->nc", shares, of_corners[faces[owner]])
            elif not (mesh.corner_colors[faces] == 1).all():
                albedo *= of_corners[faces[owner], 0]
            columns, rows = (charts.corner[owner] + texel).T
            texture[rows, columns] = to_bytes(painted(albedo, faces[owner])).numpy()
        textures.append(texture)
        uvs[faces] = charts.uvs
    return replace(mesh, corner_colors=colors, corner_uvs=uvs, textures=tuple(textures)), ceiling


class _Charts:
    """Rectangles of texels, one for each of N faces, side by side in a new texture; it holds all texels between which
    a place of its face is interpolated. Columns and rows, from the top left, are in this order throughout.

    corner: (N, 2), where each lies. sheet: the size of the new texture. texels: of all. uvs: (N, 3, 2) of the faces.
    """

    def __init__(self, uvs: np.ndarray, size: tuple[int, int]):
        """uvs: (N, 3, 2) of the faces in the old texture, which has so many columns and rows."""
        places = (uvs * [1.0, -1.0] + [0.0, 1.0]) * size
        area = (np.ptp(places, axis=1) + 2).prod(axis=1).sum()
        self._old, self._scale = np.array(size), min(1.0, np.sqrt(MOST_TEXELS / max(area, 1)))
        self._places = places * self._scale
        self._first = np.floor(self._places.min(axis=1) - 0.5).astype(np.int64)
        self._size = np.floor(self._places.max(axis=1) - 0.5).astype(np.int64) + 2 - self._first
        self.corner, self.sheet = _on_shelves(self._size)
        self.texels = int(self._size.prod(axis=1).sum())

    @property
    def uvs(self) -> np.ndarray:
        inside = self._places + (self.corner - self._first)[:, None]
        return inside / self.sheet * [1, -1] + [0, 1]

    def grid(self, owners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S,) whose, and (S, 2) column and row within its rectangle, of all texels of some."""
        count = self._size[owners].prod(axis=1)
        owner = np.repeat(owners, count)
        number = np.arange(len(owner)) - np.repeat(count.cumsum() - count, count)
        return owner, np.stack(np.divmod(number, self._size[owner, 0])[::-1], axis=1)

    def source(self, owner: np.ndarray, texel: np.ndarray) -> np.ndarray:
        """(S, 2) columns and rows in the old texture, which repeats."""
        center = self._first[owner] + texel + 0.5
        return np.floor(center / self._scale).astype(np.int64) % self._old

    def shares(self, owner: np.ndarray, texel: np.ndarray) -> np.ndarray:
        """(S, 3) barycentric coordinates, those of the nearest place within the face where a texel lies beyond."""
        edges = self._places[:, 1:] - self._places[:, :1]
        inverse = np.linalg.pinv(edges)  # a face without area in the texture has no other
        within = self._first[owner] + texel + 0.5 - self._places[owner, 0]
        second_third = np.einsum("ni,nij->nj", within, inverse[owner])
        weights = np.concatenate([1 - second_third.sum(axis=1, keepdims=True), second_third], axis=1).clip(min=0)
        return weights / weights.sum(axis=1, keepdims=True)


def _on_shelves(size: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Where rectangles (N, 2), columns and rows, lie in rows of falling height, (N, 2), and the size of it all."""
    width = max(int(np.sqrt(size.prod(axis=1).sum() * 1.05)), int(size[:, 0].max(initial=1)))
    corner = np.empty_like(size)
    column = row = below = 0
    for index in np.argsort(-size[:, 1], kind="stable"):
        if column + size[index, 0] > width:
            column, row = 0, below
        corner[index] = column, row
        column, below = column + size[index, 0], max(below, row + size[index, 1])
    return corner, (width, max(below, 1))
