"""Write an albedo that an attack changed into the colors and textures of a mesh.

Any other renderer can then show the attacked mesh. The renderer scales the
albedo ρ of corners and texels by s. An attack rotates the hue and adds the color
d of the face (see `renderer.surface.albedo.changed_albedo`). The colors and
textures of the new mesh hold

    ρ' = clamp(rotate_hue(s ρ) + d, 0, max(1, s ρ)) / s'

with a new scale s', which brings the largest possible value to 1. The colors of
corners hold ρ' with float32 precision, and textures with 8 bits.

In a texture, neighboring faces with different colors d may share texels, and
interpolation at the border of a face reads texels outside of the face. Each face
therefore gets a chart: a copy of the rectangle of old texels that interpolation
reads in this face, with ρ' of this face. All charts of an old texture lie on the
new texture, and bilinear interpolation has the old weights.

Positions in a texture are pairs of column and row in texels, from the top left
corner.
"""

from dataclasses import replace

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

    The corners of faces with a texture become white, because texels hold the product. `added` is
    linear, and `hue` in degrees. The second result is the albedo scale for rendering the new mesh:
    1, or the largest albedo above 1, because files store values up to 1.
    """
    corner_albedo = decode(torch.from_numpy(mesh.corner_colors), encoding)
    # Linear value of each 8-bit value.
    albedo_of_byte = decode(torch.arange(CHANNEL_VALUES) / (CHANNEL_VALUES - 1), encoding)
    new_scale = max(1.0, albedo_scale * _largest_albedo(mesh, corner_albedo, albedo_of_byte))
    added_to_face = torch.from_numpy(added).float()
    hue_of_face = None if hue is None else torch.from_numpy(hue).float()

    def paint(albedo: Float[Tensor, "N 3"], faces: Int[np.ndarray, " N"]) -> Tensor:
        """Change and encode the albedo at N points of faces."""
        hue_at_points = None if hue_of_face is None else hue_of_face[faces]
        changed = changed_albedo(albedo * albedo_scale, hue_at_points, added_to_face[faces])
        return encode(changed / new_scale, encoding)

    corner_faces = np.arange(len(mesh.faces)).repeat(3)
    colors = paint(corner_albedo.flatten(0, 1), corner_faces).view(-1, 3, 3).numpy()
    colors[mesh.texture_ids >= 0] = 1
    uvs = mesh.corner_uvs.copy()
    textures = []
    gloss_textures = []
    for texture_id, texture in enumerate(mesh.textures):
        faces = np.flatnonzero(mesh.texture_ids == texture_id)
        gloss = mesh.gloss_textures[texture_id] if mesh.gloss_textures else texture[..., :0]
        charts = _Charts(mesh.corner_uvs[faces], texture.shape[1::-1])
        columns, rows = charts.sheet_size
        new_texture = np.zeros((rows, columns, 3), dtype=np.uint8)
        new_gloss = np.zeros((rows, columns, gloss.shape[2]), dtype=np.uint8)
        block_count = 1 + charts.texel_count // BLOCK
        for block in np.array_split(np.arange(len(faces)), block_count):
            chart, place, uv, weights = charts.texels(block)
            albedo = albedo_of_byte[torch.from_numpy(_nearest(texture, uv)).int()]
            albedo *= torch.einsum("nk,nkc->nc", weights, corner_albedo[faces[chart]])
            painted = to_bytes(paint(albedo, faces[chart])).numpy()
            new_texture[place[:, 1], place[:, 0]] = painted
            new_gloss[place[:, 1], place[:, 0]] = _nearest(gloss, uv)
        textures.append(new_texture)
        gloss_textures.append(new_gloss)
        uvs[faces] = charts.uvs
    baked = replace(
        mesh,
        corner_colors=colors,
        corner_uvs=uvs,
        textures=tuple(textures),
        gloss_textures=tuple(gloss_textures) if mesh.gloss_textures else (),
    )
    return baked, new_scale


def _largest_albedo(
    mesh: Mesh, corner_albedo: Float[Tensor, "F 3 3"], albedo_of_byte: Float[Tensor, " 256"]
) -> float:
    """Compute an upper bound of the linear albedo of a mesh.

    It is the largest corner color, times the largest texel if all faces have a texture.
    """
    largest = float(corner_albedo.max())
    if (mesh.texture_ids >= 0).all():
        largest *= max(float(albedo_of_byte[texture.max()]) for texture in mesh.textures)
    return largest


def _nearest(texture: np.ndarray, positions: Float[np.ndarray, "N 2"]) -> np.ndarray:
    """Look up the texels at positions (column, row) in [0, 1), beyond which the texture repeats."""
    size = texture.shape[1::-1]
    column, row = np.floor(positions % 1 * size).astype(np.int64).T
    return texture[row, column]


class _Charts:
    """Rectangles (charts) on a new texture (the sheet), one for each of N faces.

    Attributes:
        sheet_size: Number of columns and rows of the sheet.
        texel_count: Total number of texels of all charts.
        uvs: Texture coordinates on the sheet of the three corners of each face,
            shape (N, 3, 2).
    """

    def __init__(self, uvs: Float[np.ndarray, "N 3 2"], old_size: tuple[int, ...]) -> None:
        """Compute the rectangle of each face. `old_size` are columns and rows of the old texture.

        The texels of a reduced texture are larger than those of the old one.
        """
        # The texture coordinate v points up.
        old_positions = (uvs * [1.0, -1.0] + [0.0, 1.0]) * old_size
        # A chart is up to two texels wider and higher than its face.
        area = (np.ptp(old_positions, axis=1) + 2).prod(axis=1).sum()
        scale = min(1.0, np.sqrt(MAX_TEXELS / max(area, 1)))
        self._new_size = scale * np.array(old_size)
        self._positions = old_positions * scale
        # Bilinear interpolation also reads the texel whose center is to the left of, or above,
        # the position.
        self._first_texel = np.floor(self._positions.min(axis=1) - 0.5).astype(np.int64)
        last_texel = np.floor(self._positions.max(axis=1) - 0.5).astype(np.int64) + 1
        # Columns and rows of each chart.
        self._size = last_texel + 1 - self._first_texel
        self._corner, self.sheet_size = _pack(self._size)
        self.texel_count = int(self._size.prod(axis=1).sum())
        sheet_positions = self._positions + (self._corner - self._first_texel)[:, None]
        self.uvs = sheet_positions / self.sheet_size * [1, -1] + [0, 1]
        # A face without area in the texture has no inverse matrix, but a pseudoinverse.
        self._inverse_edges = np.linalg.pinv(self._positions[:, 1:] - self._positions[:, :1])

    def texels(
        self, charts: Int[np.ndarray, " M"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Tensor]:
        """List the T texels of some charts.

        The results are the chart of each texel (T,), its column and row on the sheet (T, 2), its
        center in the old texture as a fraction of the size (T, 2), and its barycentric weights
        (T, 3) in the face. Negative weights, which are outside of the face, are replaced by 0.
        """
        counts = self._size[charts].prod(axis=1)
        chart = charts.repeat(counts)
        number_in_chart = np.arange(len(chart)) - (counts.cumsum() - counts).repeat(counts)
        row, column = np.divmod(number_in_chart, self._size[chart, 0])
        place = np.stack([column, row], axis=1)
        center = self._first_texel[chart] + place + 0.5
        from_first_corner = center - self._positions[chart, 0]
        last = np.einsum("ni,nij->nj", from_first_corner, self._inverse_edges[chart])
        weights = np.column_stack([1 - last.sum(axis=1), last]).clip(min=0)
        weights /= weights.sum(axis=1, keepdims=True)
        return (
            chart,
            self._corner[chart] + place,
            center / self._new_size,
            torch.tensor(weights, dtype=torch.float32),
        )


def _pack(sizes: Int[np.ndarray, "N 2"]) -> tuple[np.ndarray, tuple[int, int]]:
    """Place N rectangles in rows on a sheet that is about square, the highest ones first.

    Sizes are columns and rows. The results are the column and row of the top left corner of each
    rectangle, and the columns and rows of the sheet.
    """
    order = np.argsort(-sizes[:, 1], kind="stable")
    widths, heights = sizes[order].T
    row_width = max(int(np.sqrt(sizes.prod(axis=1).sum())), 1)
    # A rectangle belongs to the row in which it begins, and may end beyond `row_width`.
    row, column = np.divmod(widths.cumsum() - widths, row_width)
    row_heights = np.zeros(row.max(initial=0) + 1, dtype=np.int64)
    np.maximum.at(row_heights, row, heights)
    tops = row_heights.cumsum() - row_heights
    corners = np.empty_like(sizes)
    corners[order] = np.stack([column, tops[row]], axis=1)
    sheet_width = int((column + widths).max(initial=1))
    return corners, (sheet_width, max(int(row_heights.sum()), 1))
