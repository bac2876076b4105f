"""Write an albedo that an attack changed into the colors and textures of a mesh.

Any other renderer can then show the attacked mesh. The renderer scales the
albedo ρ of corners and texels by s. An attack rotates the hue and adds the color
d of the face (see `renderer.surface.albedo.changed_albedo`). The colors and
textures of the new mesh hold

    ρ' = clamp(rotate_hue(s ρ) + d, 0, max(1, s ρ)) / s'

with a new scale s', which brings the largest possible value to 1. The colors of
corners hold ρ' with float32 precision.

In a texture, neighboring faces with different colors d may share texels. Also,
bilinear interpolation at the border of a face reads texels outside of the face.
Each face with a texture therefore gets a chart. The chart of a face is a copy of
the rectangle of old texels that interpolation reads in this face, with ρ' of
this face. All charts of an old texture are packed on a sheet, which is the new
texture, in rows of falling height. The texture coordinates of the face are moved
to its chart. Bilinear interpolation then has the old weights and the new values.

Positions in a texture are pairs of column and row in texels, from the top left
corner.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from renderer.image import decode, encode, to_bytes
from renderer.mesh import Mesh
from renderer.surface.albedo import changed_albedo

# Approximate limit for the number of texels of a new texture. If it would have more texels,
# its resolution is reduced.
MAX_TEXELS = 2**26
# Number of texels of a new texture that are computed at once. It limits the memory.
BLOCK = 2**20
# Rectangles on a new texture leave gaps. A square with this many times their total area is
# expected to hold them.
SHEET_MARGIN = 1.05
# Number of values of a channel with eight bits.
CHANNEL_VALUES = 256


def with_added_albedo(
    mesh: Mesh,
    added: Float[np.ndarray, "F 3"],
    encoding: str,
    albedo_scale: float = 1.0,
    hue: Float[np.ndarray, " F"] | None = None,
) -> tuple[Mesh, float]:
    """Return a copy of a mesh whose colors and textures hold the albedo after an attack.

    An attack rotates the hue of each face and adds a color to it. New textures
    have 8 bits per channel. They hold the product of the old texture and the
    corner colors, so faces with a texture get white corners. `added` is linear, and `hue`
    in degrees. The second result is the albedo scale for rendering the new mesh: 1, or the
    largest albedo above 1, because files store values up to 1.
    """
    corner_albedo = decode(torch.from_numpy(mesh.corner_colors), encoding)
    eight_bit_values = torch.arange(CHANNEL_VALUES, dtype=torch.float32) / (CHANNEL_VALUES - 1)
    # Table of the linear values that belong to the 256 values of an 8-bit texel.
    linear_values = decode(eight_bit_values, encoding)
    painter = _Painter(
        encoding=encoding,
        scale=albedo_scale,
        new_scale=max(1.0, albedo_scale * _largest_albedo(mesh, corner_albedo, linear_values)),
        added=torch.from_numpy(added).float(),
        hue=None if hue is None else torch.from_numpy(hue).float(),
    )

    # White corners for faces with a texture. Those of other faces are replaced below.
    colors = np.ones_like(mesh.corner_colors)
    untextured_faces = np.flatnonzero(mesh.texture_ids < 0)
    # One row for each of the three corners of each face, one column for each channel.
    untextured_albedo = corner_albedo[untextured_faces].flatten(0, 1)
    painted = painter.paint(untextured_albedo, untextured_faces.repeat(3))
    colors[untextured_faces] = painted.view(-1, 3, 3).numpy()

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


def _largest_albedo(
    mesh: Mesh, corner_albedo: Float[Tensor, "F 3 3"], linear_values: Float[Tensor, " 256"]
) -> float:
    """Compute an upper bound of the linear albedo of a mesh.

    It is the largest corner color, times the largest texel if all faces have a texture.
    """
    largest_corner = float(corner_albedo.max())
    if not (mesh.texture_ids >= 0).all():
        return largest_corner
    largest_texel = max(
        (float(linear_values[texture.max()]) for texture in mesh.textures), default=1.0
    )
    return largest_corner * largest_texel


@dataclass(frozen=True)
class _Painter:
    """Change of the albedo of F faces by an attack: a rotation of the hue and an added color.

    Attributes:
        encoding: Encoding of the changed albedo, "linear" or "srgb".
        scale: Factor s for the original albedo.
        new_scale: Number s' by which the changed albedo is divided.
        added: Linear color that is added to each face, float32, shape (F, 3).
        hue: Hue rotation of each face in degrees, float32, shape (F,). None
            leaves the hues unchanged.
    """

    encoding: str
    scale: float
    new_scale: float
    added: Float[Tensor, "F 3"]
    hue: Float[Tensor, " F"] | None

    def paint(
        self, albedo: Float[Tensor, "N 3"], faces: Int[np.ndarray, " N"]
    ) -> Float[Tensor, "N 3"]:
        """Rotate the hue of the albedo at N points, add the color of the face, and encode it.

        The changed albedo is divided by `new_scale` before it is encoded.
        """
        hue_at_points = None if self.hue is None else self.hue[faces]
        changed = changed_albedo(albedo * self.scale, hue_at_points, self.added[faces])
        return encode(changed / self.new_scale, self.encoding)


class _TextureSheet:
    """New texture that replaces one texture of a mesh, with its own texels for each face.

    N faces of the mesh have the old texture. A chart is the rectangle of the new
    texture that belongs to one face. The new texture has H rows and W columns.

    Attributes:
        charts: Charts of the N faces.
        texture: New texture, uint8, shape (H, W, 3). It is black before `paint`.
        gloss_texture: New gloss texture, uint8, shape (H, W, 2), or (H, W, 0) if
            the mesh has no gloss textures. It is 0 before `paint`.
    """

    def __init__(self, mesh: Mesh, texture_id: int, faces: Int[np.ndarray, " N"]) -> None:
        """Place a rectangle (chart) for each of N faces on the new texture."""
        self._mesh = mesh
        self._faces = faces
        self._old_texture = mesh.textures[texture_id]
        # An image with 0 channels is used if the mesh has no gloss textures.
        self._old_gloss_texture = np.zeros((1, 1, 0), dtype=np.uint8)
        if mesh.gloss_textures:
            self._old_gloss_texture = mesh.gloss_textures[texture_id]
        old_height, old_width, _ = self._old_texture.shape
        self._old_size = (old_width, old_height)
        self.charts = _Charts(mesh.corner_uvs[faces], self._old_size)
        columns, rows = self.charts.sheet_size
        self.texture = np.zeros((rows, columns, 3), dtype=np.uint8)
        gloss_channels = self._old_gloss_texture.shape[2]
        self.gloss_texture = np.zeros((rows, columns, gloss_channels), dtype=np.uint8)

    def paint(
        self,
        painter: _Painter,
        corner_albedo: Float[Tensor, "N 3 3"],
        linear_values: Float[Tensor, " 256"],
    ) -> None:
        """Fill `texture` with the changed albedo, and `gloss_texture` with the old gloss.

        `linear_values` has the linear value of each 8-bit value.
        """
        block_count = 1 + self.charts.texel_count // BLOCK
        for charts in np.array_split(np.arange(len(self._faces)), block_count):
            texels = self.charts.texels(charts)
            old_position = texels.position / self.charts.scale
            # Column and row in the old texture. The modulo is there because the texture
            # repeats.
            old_texel = np.floor(old_position).astype(np.int64) % self._old_size
            old_column, old_row = old_texel.T
            albedo = linear_values[torch.from_numpy(self._old_texture[old_row, old_column]).int()]
            self._multiply_by_colors(albedo, texels, corner_albedo)
            face_of_texel = self._faces[texels.chart]
            painted = painter.paint(albedo, face_of_texel)
            column, row = texels.sheet_position.T
            self.texture[row, column] = to_bytes(painted).numpy()
            gloss_height, gloss_width, _ = self._old_gloss_texture.shape
            # The old gloss texture may have another size than the old texture, so scale the
            # position.
            gloss_position = old_position / self._old_size % 1 * (gloss_width, gloss_height)
            gloss_column, gloss_row = gloss_position.astype(np.int64).T
            self.gloss_texture[row, column] = self._old_gloss_texture[gloss_row, gloss_column]

    def _multiply_by_colors(
        self, albedo: Float[Tensor, "T 3"], texels: "_Texels", corner_albedo: Float[Tensor, "N 3 3"]
    ) -> None:
        """Multiply albedo of texels in place by the interpolated corner colors of their faces."""
        if not self._mesh.one_color_per_face:
            weights = torch.from_numpy(self.charts.weights(texels)).float()
            # Weighted sum over the three corners k, for each texel n and channel c.
            albedo *= torch.einsum("nk,nkc->nc", weights, corner_albedo[texels.chart])
        elif not (self._mesh.corner_colors[self._faces] == 1).all():
            # All corners of a face have the same color, so take the first corner.
            albedo *= corner_albedo[texels.chart, 0]


class _Texels(NamedTuple):
    """T texels of a new texture, and where they lie in the old texture.

    The new texture has a rectangle (chart) for each face with the old texture.

    Attributes:
        chart: Index of the chart of each texel, shape (T,). Chart i belongs to
            face i of the faces with the old texture.
        sheet_position: Column and row of each texel in the new texture,
            shape (T, 2).
        position: Position of the center of each texel in the old texture,
            shape (T, 2). The unit is a texel of the new texture, which may be
            larger than a texel of the old texture.
    """

    chart: Int[np.ndarray, " T"]
    sheet_position: Int[np.ndarray, "T 2"]
    position: Float[np.ndarray, "T 2"]


class _Charts:
    """Rectangles (charts) on a new texture (the sheet), one for each of N faces.

    Attributes:
        scale: Number of new texels per old texel along each axis, at most 1.
        sheet_size: Number of columns and rows of the sheet.
        texel_count: Total number of texels of all charts.
        uvs: Texture coordinates on the sheet of the three corners of each face,
            shape (N, 3, 2).
    """

    def __init__(self, uvs: Float[np.ndarray, "N 3 2"], old_size: tuple[int, int]) -> None:
        """Compute the size of the rectangle of each face, and place it on the new texture.

        `old_size` are the columns and rows of the old texture.
        """
        # Positions of the corners as pairs of column and row, counted from the top. The
        # texture coordinate v points up.
        old_positions = (uvs * [1.0, -1.0] + [0.0, 1.0]) * old_size
        # Total area of the charts, in old texels. A chart is up to two texels wider and
        # higher than its face.
        area = (np.ptp(old_positions, axis=1) + 2).prod(axis=1).sum()
        self.scale = min(1.0, np.sqrt(MAX_TEXELS / max(area, 1)))
        # The same positions in units of new texels. Axes: face, corner, column or row.
        self._positions = old_positions * self.scale
        # First column and row of each chart: bilinear interpolation also reads the texel
        # whose center is to the left of, or above, the position.
        self._first_texel = np.floor(self._positions.min(axis=1) - 0.5).astype(np.int64)
        last_texel = np.floor(self._positions.max(axis=1) - 0.5).astype(np.int64) + 1
        # Number of columns and rows of each chart, one row for each chart.
        self._size = last_texel + 1 - self._first_texel
        # Column and row on the sheet of the top left texel of each chart.
        self._sheet_corner, self.sheet_size = _pack(self._size)
        self.texel_count = int(self._size.prod(axis=1).sum())
        # Positions of the corners on the sheet: each face moves with its chart.
        sheet_positions = self._positions + (self._sheet_corner - self._first_texel)[:, None]
        self.uvs = sheet_positions / self.sheet_size * [1, -1] + [0, 1]

    def texels(self, charts: Int[np.ndarray, " M"]) -> _Texels:
        """List all texels of some charts, chart by chart in row-major order."""
        texels_per_chart = self._size[charts].prod(axis=1)
        chart_of_texel = np.repeat(charts, texels_per_chart)
        texels_before_chart = texels_per_chart.cumsum() - texels_per_chart
        all_numbers = np.arange(len(chart_of_texel))
        # Row-major index of each texel within its chart.
        number_in_chart = all_numbers - np.repeat(texels_before_chart, texels_per_chart)
        columns_of_chart = self._size[chart_of_texel, 0]
        row, column = np.divmod(number_in_chart, columns_of_chart)
        position_in_chart = np.stack([column, row], axis=1)
        return _Texels(
            chart=chart_of_texel,
            sheet_position=self._sheet_corner[chart_of_texel] + position_in_chart,
            # The center of a texel is half a texel from its top left corner.
            position=self._first_texel[chart_of_texel] + position_in_chart + 0.5,
        )

    def weights(self, texels: _Texels) -> Float[np.ndarray, "T 3"]:
        """Compute the barycentric weights of T texels in the faces to which they belong.

        A texel outside of its face has a negative weight, which is set to 0. The
        other weights are then scaled to the sum 1.
        """
        # Vectors from the first corner to the second and the third corner. Axes: face,
        # vector, column or row.
        edges = self._positions[:, 1:] - self._positions[:, :1]
        # A face without area in the texture has no inverse matrix, but a pseudoinverse.
        inverse_edges = np.linalg.pinv(edges)
        from_first_corner = texels.position - self._positions[texels.chart, 0]
        # Weights of the second and the third corner, one row for each texel.
        last_weights = np.einsum("ni,nij->nj", from_first_corner, inverse_edges[texels.chart])
        first_weight = 1 - last_weights.sum(axis=1, keepdims=True)
        weights = np.concatenate([first_weight, last_weights], axis=1).clip(min=0)
        return weights / weights.sum(axis=1, keepdims=True)


def _pack(sizes: Int[np.ndarray, "N 2"]) -> tuple[np.ndarray, tuple[int, int]]:
    """Pack N rectangles on a sheet that is about square.

    The rectangles are placed from left to right in rows, the highest rectangle
    first. Sizes are columns and rows. The results are the column and row of the top left
    corner of each rectangle, and the columns and rows of the sheet.
    """
    area = sizes.prod(axis=1).sum()
    widest = int(sizes[:, 0].max(initial=1))
    sheet_width = max(int(np.sqrt(area * SHEET_MARGIN)), widest)
    corners = np.empty_like(sizes)
    column = 0
    row = 0
    # First row of the sheet below all rectangles that have been placed.
    free_row = 0
    by_falling_height = np.argsort(-sizes[:, 1], kind="stable")
    for index in by_falling_height:
        width, height = sizes[index]
        if column + width > sheet_width:
            column = 0
            row = free_row
        corners[index] = (column, row)
        column += width
        free_row = max(free_row, row + height)
    return corners, (sheet_width, max(free_row, 1))
