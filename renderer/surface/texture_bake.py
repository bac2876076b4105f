"""Meshes whose colors and textures hold the albedo that an attack changed.

Any other renderer can show such a mesh. The renderer scales the albedo ρ of
corners and texels by s. An attack rotates the hue and adds the color d of the
face (see `renderer.surface.albedo.changed_albedo`). The colors and textures of the new
mesh hold

    ρ' = clamp(rotate_hue(s ρ) + d, 0, max(1, s ρ)) / s'

with a new scale s', which brings the largest possible value to 1. Corners hold
ρ' with float32 precision.

In a texture, neighboring faces with different colors d may share texels, and
interpolation at the border of a face reads texels outside of it. Each face
therefore gets a chart. A chart is a copy of the rectangle of old texels that
the interpolation of the face reads, with ρ' for this face alone. Charts are
packed in rows of falling height on a sheet, which is the new texture. The
texture coordinates of the face are moved to its chart. Bilinear interpolation
then has the old weights and the new values.

Positions in a texture are pairs of column and row in texels, from the top left
corner.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from renderer.geometry.mesh import Mesh
from renderer.image import decode, encode, to_bytes
from renderer.surface.albedo import changed_albedo

# Largest number of texels of a new texture. If charts need more, they get a
# coarser grid.
MAX_TEXELS = 2**26
# Number of texels that are painted at once. It limits the memory.
BLOCK = 2**20
# Texels that packing may waste, as a factor for the area of the charts.
SHEET_MARGIN = 1.05
# Eight-bit values of a channel.
CHANNEL_VALUES = 256


def with_added_albedo(
    mesh: Mesh,
    added: np.ndarray,
    encoding: str,
    albedo_scale: float = 1.0,
    hue: np.ndarray | None = None,
) -> tuple[Mesh, float]:
    """Return a mesh whose own colors and textures hold a changed albedo.

    New textures have 8 bits per channel and contain the corner colors.

    Args:
        mesh: Mesh with F faces.
        added: Linear color that is added to each face, shape (F, 3).
        encoding: Encoding of colors and textures, "linear" or "srgb".
        albedo_scale: Factor s for the albedo of the mesh.
        hue: Hue rotation of each face in degrees, shape (F,). None leaves the
            hues unchanged.

    Returns:
        A tuple of
        - the mesh with changed colors and textures;
        - the albedo scale s' with which it must be rendered. It is at least 1,
          the largest value in files. It is not larger than the colors need,
          since it multiplies their rounding errors.
    """
    corner_albedo = decode(torch.from_numpy(mesh.corner_colors), encoding)
    eight_bit_values = torch.arange(CHANNEL_VALUES, dtype=torch.float32) / (CHANNEL_VALUES - 1)
    linear_values = decode(eight_bit_values, encoding)
    painter = _Painter(
        encoding=encoding,
        scale=albedo_scale,
        new_scale=max(1.0, albedo_scale * _largest_albedo(mesh, corner_albedo, linear_values)),
        added=torch.from_numpy(added).float(),
        hue=None if hue is None else torch.from_numpy(hue).float(),
    )

    # Faces with a texture get white corners.
    colors = np.ones_like(mesh.corner_colors)
    untextured = np.flatnonzero(mesh.texture_ids < 0)
    untextured_albedo = corner_albedo[untextured].flatten(0, 1)
    painted = painter.paint(untextured_albedo, untextured.repeat(3))
    colors[untextured] = painted.view(-1, 3, 3).numpy()

    uvs = mesh.corner_uvs.copy()
    textures = []
    gloss_textures = []
    for texture_id in range(len(mesh.textures)):
        faces = np.flatnonzero(mesh.texture_ids == texture_id)
        sheet = _TextureSheet(mesh, texture_id, faces)
        sheet.paint(painter, corner_albedo[faces], linear_values)
        textures.append(sheet.texture)
        gloss_textures.append(sheet.gloss_texture)
        uvs[faces] = sheet.charts.uvs
    baked = replace(
        mesh,
        corner_colors=colors,
        corner_uvs=uvs,
        textures=tuple(textures),
        gloss_textures=tuple(gloss_textures) if mesh.gloss_textures else (),
    )
    return baked, painter.new_scale


def _largest_albedo(mesh: Mesh, corner_albedo: Tensor, linear_values: Tensor) -> float:
    """Return an upper limit of the linear albedo of a mesh."""
    largest_corner = float(corner_albedo.max())
    if not (mesh.texture_ids >= 0).all():
        # A face without a texture has the full corner color.
        return largest_corner
    largest_texel = max(
        (float(linear_values[texture.max()]) for texture in mesh.textures), default=1.0
    )
    return largest_corner * largest_texel


@dataclass(frozen=True)
class _Painter:
    """Change of the albedo of F faces.

    Attributes:
        encoding: Encoding of the result.
        scale: Factor s for the original albedo.
        new_scale: Scale s' by which the result is divided.
        added: Linear color that is added to each face, float32, shape (F, 3).
        hue: Hue rotation of each face in degrees, float32, shape (F,). None
            leaves the hues unchanged.
    """

    encoding: str
    scale: float
    new_scale: float
    added: Tensor
    hue: Tensor | None

    def paint(self, albedo: Tensor, faces: np.ndarray) -> Tensor:
        """Change albedos and encode them.

        Args:
            albedo: Linear albedo of N points, shape (N, 3).
            faces: Index of the face of each point, shape (N,).

        Returns:
            Encoded albedo, shape (N, 3).
        """
        hue = None if self.hue is None else self.hue[faces]
        changed = changed_albedo(albedo * self.scale, hue, self.added[faces])
        return encode(changed / self.new_scale, self.encoding)


class _TextureSheet:
    """New texture with one chart for each of the N faces that have an old texture.

    Attributes:
        charts: Charts of the faces.
        texture: New texture, uint8, shape (H, W, 3).
        gloss_texture: New gloss texture, uint8, shape (H, W, 2), or (H, W, 0)
            if the mesh has none.
    """

    def __init__(self, mesh: Mesh, texture_id: int, faces: np.ndarray) -> None:
        """Place the charts.

        Args:
            mesh: Mesh with the old texture.
            texture_id: Index of the old texture.
            faces: Indices of the faces with this texture, shape (N,).
        """
        self._mesh = mesh
        self._faces = faces
        self._old_texture = mesh.textures[texture_id]
        self._old_gloss_texture = np.zeros((1, 1, 0), dtype=np.uint8)
        if mesh.gloss_textures:
            self._old_gloss_texture = mesh.gloss_textures[texture_id]
        self._old_size = self._old_texture.shape[1::-1]
        self.charts = _Charts(mesh.corner_uvs[faces], self._old_size)
        columns, rows = self.charts.sheet_size
        self.texture = np.zeros((rows, columns, 3), dtype=np.uint8)
        gloss_channels = self._old_gloss_texture.shape[2]
        self.gloss_texture = np.zeros((rows, columns, gloss_channels), dtype=np.uint8)

    def paint(self, painter: _Painter, corner_albedo: Tensor, linear_values: Tensor) -> None:
        """Fill the new textures.

        Args:
            painter: Change of the albedo.
            corner_albedo: Linear albedo of the corners of the N faces,
                shape (N, 3, 3).
            linear_values: Linear value of each 8-bit value, shape (256,).
        """
        block_count = 1 + self.charts.texel_count // BLOCK
        for charts in np.array_split(np.arange(len(self._faces)), block_count):
            texels = self.charts.texels(charts)
            old_position = texels.position / self.charts.scale
            # The old texture repeats.
            old_texel = np.floor(old_position).astype(np.int64) % self._old_size
            old_column, old_row = old_texel.T
            albedo = linear_values[torch.from_numpy(self._old_texture[old_row, old_column]).int()]
            self._multiply_by_colors(albedo, texels, corner_albedo)
            painted = painter.paint(albedo, self._faces[texels.chart])
            column, row = texels.sheet_position.T
            self.texture[row, column] = to_bytes(painted).numpy()
            # The gloss texture may have another size. The nearest texel is used.
            gloss_size = self._old_gloss_texture.shape[1::-1]
            gloss_position = old_position / self._old_size % 1 * gloss_size
            gloss_column, gloss_row = gloss_position.astype(np.int64).T
            self.gloss_texture[row, column] = self._old_gloss_texture[gloss_row, gloss_column]

    def _multiply_by_colors(self, albedo: Tensor, texels: "_Texels", corner_albedo: Tensor) -> None:
        """Multiply the albedo of texels (S, 3) by the interpolated corner colors, in place."""
        if not self._mesh.one_color_per_face:
            weights = torch.from_numpy(self.charts.weights(texels)).float()
            albedo *= torch.einsum("nk,nkc->nc", weights, corner_albedo[texels.chart])
        elif not (self._mesh.corner_colors[self._faces] == 1).all():
            albedo *= corner_albedo[texels.chart, 0]


class _Texels(NamedTuple):
    """S texels of charts.

    Attributes:
        chart: Index of the chart of each texel, shape (S,).
        sheet_position: Column and row of each texel on the sheet, shape (S, 2).
        position: Position of the center of each texel in the old texture, in
            units of new texels, shape (S, 2).
    """

    chart: np.ndarray
    sheet_position: np.ndarray
    position: np.ndarray


class _Charts:
    """Charts of N faces on a sheet.

    Attributes:
        scale: Number of new texels per old texel, along each axis.
        sheet_size: Number of columns and rows of the sheet.
        texel_count: Number of texels of all charts.
        uvs: Texture coordinates of the corners on the sheet, shape (N, 3, 2).
    """

    def __init__(self, uvs: np.ndarray, old_size: tuple[int, int]) -> None:
        """Place the charts.

        Args:
            uvs: Texture coordinates of the corners in the old texture,
                shape (N, 3, 2).
            old_size: Number of columns and rows of the old texture.
        """
        # v points up, and rows are counted from the top.
        old_positions = (uvs * [1.0, -1.0] + [0.0, 1.0]) * old_size
        area = (np.ptp(old_positions, axis=1) + 2).prod(axis=1).sum()
        self.scale = min(1.0, np.sqrt(MAX_TEXELS / max(area, 1)))
        # Positions of the corners in units of new texels, shape (N, 3, 2).
        self._positions = old_positions * self.scale
        # Interpolation reads the texels whose centers surround a position.
        self._first = np.floor(self._positions.min(axis=1) - 0.5).astype(np.int64)
        last = np.floor(self._positions.max(axis=1) - 0.5).astype(np.int64) + 1
        # Number of columns and rows of each chart, shape (N, 2).
        self._size = last + 1 - self._first
        self._corner, self.sheet_size = _pack(self._size)
        self.texel_count = int(self._size.prod(axis=1).sum())
        on_sheet = self._positions + (self._corner - self._first)[:, None]
        self.uvs = on_sheet / self.sheet_size * [1, -1] + [0, 1]

    def texels(self, charts: np.ndarray) -> _Texels:
        """List all texels of some charts.

        Args:
            charts: Indices of the charts.

        Returns:
            Texels in row-major order, chart by chart.
        """
        counts = self._size[charts].prod(axis=1)
        chart = np.repeat(charts, counts)
        texels_before_chart = counts.cumsum() - counts
        number = np.arange(len(chart)) - np.repeat(texels_before_chart, counts)
        row, column = np.divmod(number, self._size[chart, 0])
        in_chart = np.stack([column, row], axis=1)
        return _Texels(
            chart=chart,
            sheet_position=self._corner[chart] + in_chart,
            position=self._first[chart] + in_chart + 0.5,
        )

    def weights(self, texels: _Texels) -> np.ndarray:
        """Compute the barycentric weights of texels in the faces of their charts.

        Args:
            texels: S texels.

        Returns:
            Weights of the three corners, clipped to the face, shape (S, 3).
        """
        edges = self._positions[:, 1:] - self._positions[:, :1]
        # A face without area in the texture has only a pseudoinverse.
        inverse = np.linalg.pinv(edges)
        from_first_corner = texels.position - self._positions[texels.chart, 0]
        last_two = np.einsum("ni,nij->nj", from_first_corner, inverse[texels.chart])
        first = 1 - last_two.sum(axis=1, keepdims=True)
        weights = np.concatenate([first, last_two], axis=1).clip(min=0)
        return weights / weights.sum(axis=1, keepdims=True)


def _pack(sizes: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Pack rectangles on a sheet, in rows of falling height.

    Args:
        sizes: Number of columns and rows of N rectangles, shape (N, 2).

    Returns:
        A tuple of
        - the column and row of the top left corner of each rectangle,
          shape (N, 2);
        - the number of columns and rows of the sheet.
    """
    area = sizes.prod(axis=1).sum()
    widest = int(sizes[:, 0].max(initial=1))
    sheet_width = max(int(np.sqrt(area * SHEET_MARGIN)), widest)
    corners = np.empty_like(sizes)
    column = 0
    row = 0
    # First row below the rectangles so far.
    next_row = 0
    by_falling_height = np.argsort(-sizes[:, 1], kind="stable")
    for index in by_falling_height:
        width, height = sizes[index]
        if column + width > sheet_width:
            column = 0
            row = next_row
        corners[index] = (column, row)
        column += width
        next_row = max(next_row, row + height)
    return corners, (sheet_width, max(next_row, 1))
