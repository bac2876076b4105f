"""Linear albedo at the samples of a view.

The albedo comes from the mesh as it was loaded, or from a parameter that can be
differentiated. The parameter is one albedo per face, the texels of the
textures, or a color that is added to the faces. `with_added_albedo` writes an
attacked albedo into the colors and textures of a mesh.

Shapes use these letters: a mesh has F faces. A view has S covered samples, and
these samples show G of the F faces. A texture has C channels. The local name
`seen_faces` is the index in the mesh of each of the G faces, shape (G,).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from renderer.errors import require_bounded
from renderer.image import clamp, decode, encode, to_bytes
from renderer.mesh import NO_TEXTURE, Mesh
from renderer.visibility.fragments import Fragments, split_samples


@dataclass(frozen=True)
class Texture:
    """Texture with C channels, whose texels are looked up by index.

    Attributes:
        size: Height and width, the numbers of rows and columns. Row 0 is at the top.
        look_up: Function that takes the indices of N texels, shape (N,), and
            returns their linear values, shape (C, N). The index of a texel is
            row · width + column.
    """

    size: tuple[int, ...]
    look_up: Callable[[Tensor], Tensor]

    @staticmethod
    def from_values(values: Float[Tensor, "H W C"]) -> "Texture":
        """Create a texture from a tensor of linear values.

        The values that `look_up` returns are differentiable with respect to the
        tensor. NaN or infinite values raise `InputError`.
        """
        require_bounded(texture=values)
        # One row for each channel, with all texels in row-major order.
        return Texture(values.shape[:2], partial(torch.index_select, values.flatten(0, 1).T, 1))


def surface_albedo(
    mesh: Mesh, fragments: Fragments, encoding: str, given: Sequence[Tensor] = ()
) -> Float[Tensor, "S 3"]:
    """Compute the albedo of a mesh at the samples of a view that show the mesh.

    The albedo is the interpolated color of the face corners times the interpolated
    texture. Colors and texels are decoded to linear values before they are
    interpolated. `given` is one albedo per face (F, 3), or textures (rows, columns, 3) that replace
    those of the mesh. They are linear, and get a gradient. The result is linear, too.
    """
    if given and given[0].ndim == 2:
        return face_albedo(given[0], fragments)
    colors = _interpolated_colors(mesh, fragments, encoding)
    textures = [Texture.from_values(values) for values in given]
    textures = textures or mesh_textures(mesh, encoding, fragments.coverage)
    return colors * sample_textures(textures, mesh, fragments).T if textures else colors


def sample_textures(
    textures: Sequence[Texture], mesh: Mesh, fragments: Fragments
) -> Float[Tensor, "C S"]:
    """Look up the textures of a mesh at the samples of a view, with bilinear interpolation.

    The texture coordinates are u (to the right) and v (up). The texture covers
    [0, 1] in both and repeats beyond. The center of column i is at
    u = (i + 0.5) / width. Samples of faces without a texture have the value 1.
    `mesh.texture_ids` are indices into `textures`.
    """
    parts = list(_samples_of_textures(textures, mesh, fragments))
    blocks = [
        reduce(torch.add, [w * texture.look_up(i) for w, i in _surrounding_texels(texture, block)])
        for texture, _, uvs in parts
        # The points are processed in blocks to limit the memory.
        for (block,) in split_samples(uvs)
    ]
    # One row for each channel.
    values = torch.cat(blocks, dim=1)
    sample_count = len(fragments.sample_to_seen_face)
    # All faces of most meshes have the same texture.
    if len(parts) == 1 and values.shape[1] == sample_count:
        return values
    # Samples of faces without a texture keep the value 1.
    ones = values.new_ones(len(values), sample_count)
    return ones.index_copy(1, torch.cat([samples for _, samples, _ in parts]), values)


def _samples_of_textures(
    textures: Sequence[Texture], mesh: Mesh, fragments: Fragments
) -> Iterator[tuple[Texture, Int[Tensor, " N"], Float[Tensor, "2 N"]]]:
    """Yield each texture of a mesh, and the samples that show it with their texture coordinates."""
    corner_uvs = of_seen_faces(mesh.corner_uvs, fragments).to(fragments.coverage)
    sample_uvs = fragments.interpolate(corner_uvs).T
    texture_of_face = of_seen_faces(mesh.texture_ids, fragments)
    texture_of_sample = texture_of_face.index_select(0, fragments.sample_to_seen_face)
    for texture_id, texture in enumerate(textures):
        samples = torch.nonzero(texture_of_sample == texture_id).squeeze(1)
        has_all = len(samples) == len(texture_of_sample)
        yield texture, samples, sample_uvs if has_all else sample_uvs.index_select(1, samples)


def _surrounding_texels(texture: Texture, uvs: Float[Tensor, "2 N"]) -> list[tuple[Tensor, Tensor]]:
    """Find the four texels around each of N points, and their weights for interpolation.

    The pairs of weight and index (row · width + column) are for the upper left, upper right, lower
    left and lower right texel.
    """
    u, v = uvs
    height, width = texture.size
    # The coordinate v points up, but row 0 of the texture is at the top.
    columns = _neighbors(u, width)
    return [
        (row_weight * column_weight, (row * width + column).long())
        for row, row_weight in _neighbors(1 - v, height)
        for column, column_weight in columns
    ]


def _neighbors(coordinate: Float[Tensor, " N"], count: int) -> list[tuple[Tensor, Tensor]]:
    """Find (index in [0, count), weight) of the texel row or column before and after points."""
    # Position in units of lines. The center of line i has the position i.
    position = coordinate * count - 0.5
    before = position.floor()
    fraction = position - before
    # The texture repeats, so lines count modulo `count`.
    return [
        (line - count * (line / count).floor(), weight)
        for line, weight in ((before, 1 - fraction), (before + 1, fraction))
    ]


def mesh_textures(mesh: Mesh, encoding: str, like: Tensor) -> list[Texture]:
    """Convert the 8-bit textures of a mesh to `Texture` objects, which return linear values.

    The values get the device and dtype of `like`.
    """
    # A channel has only 256 possible values. A table with the linear value of each saves
    # decoding every texel.
    linear_values = decode(torch.arange(256, dtype=torch.float64) / 255, encoding)
    linear_values = linear_values.to(like, non_blocking=True)

    def look_up(all_texels: Tensor, texels: Tensor) -> Tensor:
        """Look up the linear values (3, N) of N texels (N,) of a texture with 8 bits."""
        eight_bit_values = all_texels.index_select(0, texels).int().flatten()
        return linear_values.index_select(0, eight_bit_values).view(-1, 3).T

    textures = (torch.from_numpy(texture).to(like.device) for texture in mesh.textures)
    return [Texture(each.shape[:2], partial(look_up, each.flatten(0, 1))) for each in textures]


def face_albedo(albedo: Float[Tensor, "F 3"], fragments: Fragments) -> Float[Tensor, "S 3"]:
    """Look up the albedo at the samples of a mesh with one albedo per face.

    The result is differentiable with respect to `albedo`.
    """
    require_bounded(albedo=albedo)
    columns = albedo.index_select(0, fragments.faces).T.contiguous()
    # Selecting columns of the transposed matrix takes half the time of selecting rows.
    return columns.index_select(1, fragments.sample_to_seen_face).T


def paint_faces(
    mesh: Mesh,
    fragments: Fragments,
    encoding: str,
    albedo_scale: float,
    added: Float[Tensor, "F 3"],
    hue: Float[Tensor, " F"] | None = None,
) -> Float[Tensor, "S 3"]:
    """Compute the albedo at samples after a change of the hue and color of each face.

    The albedo is scaled. Then the hue is rotated and a color is added at corners
    and texels (`changed_albedo`), before they are interpolated. The changed albedo
    can therefore be stored in image files (see `with_added_albedo`).
    The result is differentiable with respect to `added` and `hue`. `added` is linear, and
    `hue` is in degrees, or None for unchanged hues.
    """
    # Unlike `hue[faces]`, `index_select` adds up gradients in the same order for any number of
    # threads.
    given = [part for part in (added, hue) if part is not None]
    change_of_face = [part.index_select(0, fragments.faces) for part in given]
    # First, change the colors of the corners of faces and interpolate them, as if no face
    # had a texture. The three corners of a face have the same hue and added color.
    corner_albedo = _corner_albedo(mesh, fragments, encoding, added) * albedo_scale
    change_at_corners = (part[:, None] for part in change_of_face)
    albedo = fragments.interpolate(changed_albedo(corner_albedo, *change_at_corners))
    if not mesh.textures:
        return albedo

    # Then replace the albedo at samples of faces with a texture: change the texels of the
    # texture, and interpolate them.
    colors = (_interpolated_colors(mesh, fragments, encoding) * albedo_scale).to(added)
    face = fragments.sample_to_seen_face
    change_at_samples = [part.index_select(0, face) for part in change_of_face]
    textures = mesh_textures(mesh, encoding, added)
    for texture, samples, uvs in _samples_of_textures(textures, mesh, fragments):
        change_here = [part.index_select(0, samples) for part in change_at_samples]
        weighted_texels = []
        for weight, texel in _surrounding_texels(texture, uvs):
            texel_albedo = colors[samples] * texture.look_up(texel).T
            painted_texel = changed_albedo(texel_albedo, *change_here)
            weighted_texels.append(weight.to(added)[:, None] * painted_texel)
        albedo = albedo.index_copy(0, samples, reduce(torch.add, weighted_texels))
    return albedo


def changed_albedo(
    albedo: Float[Tensor, "... 3"], added: Tensor, hue: Float[Tensor, " ..."] | None = None
) -> Float[Tensor, "... 3"]:
    """Rotate the hue of an albedo, add a color, and clamp the sum.

    The hue is rotated about the gray axis of RGB space, which preserves the mean
    of the three channels (Haeberli 1993). A channel is clamped to [0, 1], or to
    [0, albedo] if its albedo is above 1. Hues are in degrees, and colors are linear.
    """
    rotated = albedo
    if hue is not None:
        angle = torch.deg2rad(hue)[..., None]
        gray = albedo.mean(-1, keepdim=True)
        # Cross product of the gray axis (1, 1, 1) / √3 and the albedo, for Rodrigues'
        # formula of the rotation about this axis.
        cross_product = (albedo.roll(1, -1) - albedo.roll(-1, -1)) / math.sqrt(3)
        rotated = gray + angle.cos() * (albedo - gray) + angle.sin() * cross_product
    return clamp(rotated + added, albedo.clamp(min=1))


def shared_albedo(mesh: Mesh, fragments: Fragments, encoding: str) -> Float[Tensor, " 3"] | None:
    """Return the albedo of the faces that a view shows if all of them have the same albedo.

    The result is linear. It is None if a texture or two colors prevent it, or if the view
    shows no face.
    """
    if mesh.textures:
        return None
    # One row for each corner of the seen faces, one column for each channel.
    albedo = _corner_albedo(mesh, fragments, encoding, fragments.coverage).flatten(0, 1)
    return albedo[0] if len(albedo) and bool((albedo == albedo[0]).all()) else None


def _interpolated_colors(mesh: Mesh, fragments: Fragments, encoding: str) -> Float[Tensor, "S 3"]:
    """Interpolate the linear corner colors of a mesh at the S covered samples of a view."""
    corner_albedo = _corner_albedo(mesh, fragments, encoding, fragments.coverage)
    if not mesh.one_color_per_face:
        return fragments.interpolate(corner_albedo)
    # All corners of a face have the same color, so take the first corner. One row for each
    # channel, one column for each seen face.
    face_colors = corner_albedo[:, 0].T.contiguous()
    # `gather` takes a third of the time of `index_select` in float64.
    return face_colors.gather(1, fragments.sample_to_seen_face.expand(3, -1)).T


def _corner_albedo(
    mesh: Mesh, fragments: Fragments, encoding: str, like: Tensor
) -> Float[Tensor, "G 3 3"]:
    """Decode the corner colors of the G faces that a view shows, in the dtype of `like`."""
    corner_colors = of_seen_faces(mesh.corner_colors, fragments).to(like)
    require_bounded(corner_colors=corner_colors)
    return decode(corner_colors, encoding)


def of_seen_faces(rows: np.ndarray, fragments: Fragments) -> Tensor:
    """Select the rows of the G faces that a view shows, on the device of the view."""
    faces = fragments.faces
    if faces.device.type != "cpu":
        return torch.from_numpy(rows).to(faces.device, non_blocking=True)[faces]
    return torch.from_numpy(rows.take(faces.numpy(), axis=0))


# Approximate limit for the number of texels of a new texture. If it would have more texels,
# its resolution is reduced.
MAX_TEXELS = 2**26
# Number of texels of a new texture that are computed at once. It limits the memory.
SHEET_BLOCK = 2**20
# Number of texels across a face whose corners differ by 1. With it, colors at the corners are off
# by at most 0.01.
TEXELS_PER_CHANGE = 32


def with_added_albedo(
    mesh: Mesh,
    added: Float[np.ndarray, "F 3"],
    encoding: str,
    albedo_scale: float = 1.0,
    hue: Float[np.ndarray, " F"] | None = None,
) -> tuple[Mesh, float]:
    """Return a copy of a mesh whose colors and textures hold the albedo after an attack.

    Any other renderer can then show the attacked mesh. With the albedo ρ of a corner or texel, the
    scale s and the added color d, the new mesh holds

        ρ' = clamp(rotate_hue(s ρ) + d, 0, max(1, s ρ)) / s'

    with float32 precision at corners, and with 8 bits in textures.
    The corners of faces with a texture become white, because texels hold the product. If all texels
    are equal, the corners hold it, and the texture becomes white. `added` is linear, and `hue` in
    degrees. The second result is the albedo scale s' for rendering the new
    mesh: 1, or the largest albedo above 1, because files store values up to 1.

    In a texture, neighboring faces with different colors d may share texels, and interpolation at
    the border of a face reads texels outside of the face. Each face therefore gets a chart: a copy
    of the rectangle of old texels that interpolation reads in this face, with ρ' of this face. All
    charts of an old texture lie on the new texture, and interpolation has the old weights. The old
    texture is first enlarged if that of the gloss is larger, or if colors change within few texels.
    """
    # In the encoding "linear", `decode` returns the colors of the mesh themselves.
    corner_albedo = decode(torch.from_numpy(mesh.corner_colors).float(), encoding).clone()
    # Linear value of each 8-bit value.
    albedo_of_byte = decode(torch.arange(256) / 255, encoding)
    # The largest corner color, times the largest texel if all faces have a texture.
    largest = albedo_scale * float(corner_albedo.max())
    if (mesh.texture_ids != NO_TEXTURE).all():
        largest *= float(albedo_of_byte[max(int(texture.max()) for texture in mesh.textures)])
    new_scale = max(1.0, largest)

    def paint(albedo: Float[Tensor, "N 3"], faces: Int[np.ndarray, " N"]) -> Tensor:
        """Change and encode the albedo at N points of faces."""
        given = [part[faces] for part in (added, hue) if part is not None]
        change = (torch.from_numpy(part).float() for part in given)
        changed = changed_albedo(albedo * albedo_scale, *change)
        return encode((changed / new_scale).clamp(max=1), encoding)

    even = [texture.size and (texture == texture[:1, :1]).all() for texture in mesh.textures]
    has_even = np.isin(mesh.texture_ids, np.flatnonzero(even))
    for number in np.flatnonzero(even):
        texel = torch.from_numpy(mesh.textures[number][0, 0]).long()
        corner_albedo[mesh.texture_ids == number] *= albedo_of_byte.take(texel)
    corner_faces = np.arange(len(mesh.faces)).repeat(3)
    colors = paint(corner_albedo.flatten(0, 1), corner_faces).view(-1, 3, 3).numpy()
    colors[(mesh.texture_ids != NO_TEXTURE) & ~has_even] = 1
    uvs = mesh.corner_uvs.copy()
    textures, gloss_textures = [], []
    for texture_id, texture in enumerate(mesh.textures):
        faces = np.flatnonzero(mesh.texture_ids == texture_id)
        gloss = mesh.gloss_textures[texture_id] if mesh.gloss_textures else texture[..., :0]
        if even[texture_id]:
            textures.append(np.full((1, 1, 3), 255, np.uint8))
            gloss_textures.append(gloss)
            continue
        change = np.ptp(corner_albedo[faces].numpy(), axis=1).max(1)
        factor = _enlargement(mesh.corner_uvs[faces], change, texture.shape, gloss.shape)
        size = [factor * side for side in texture.shape[:2]]
        texture = texture if factor == 1 else _resized(texture, size, encoding)
        if mesh.gloss_textures and gloss.shape[:2] != texture.shape[:2]:
            gloss = _resized(gloss, size, "linear")
        charts = _Charts(mesh.corner_uvs[faces], texture.shape[1::-1])
        new_texture = np.zeros((*charts.sheet_size[::-1], 3), np.uint8)
        new_gloss = np.zeros((*charts.sheet_size[::-1], gloss.shape[2]), np.uint8)
        for block in np.array_split(np.arange(len(faces)), 1 + charts.texel_count // SHEET_BLOCK):
            chart, on_sheet, center = charts.texels(block)
            albedo = albedo_of_byte.take(torch.from_numpy(_texels_at(center, texture)).long())
            if mesh.one_color_per_face:
                albedo *= corner_albedo[faces[chart], 0]
            else:
                corners = corner_albedo[faces[chart]]
                color = torch.einsum("nk,nkc->nc", charts.weights(chart, center), corners)
                # Texels outside of the face continue its colors, within the range of its corners.
                albedo *= color.clamp(corners.amin(1), corners.amax(1))
            new_texture.reshape(-1, 3)[on_sheet] = to_bytes(paint(albedo, faces[chart])).numpy()
            if mesh.gloss_textures:
                new_gloss.reshape(-1, gloss.shape[2])[on_sheet] = _texels_at(center, gloss)
        textures.append(new_texture)
        gloss_textures.append(new_gloss)
        uvs[faces] = charts.uvs
    sheets: dict[str, Any] = {"textures": tuple(textures)}
    sheets["gloss_textures"] = tuple(gloss_textures) if mesh.gloss_textures else ()
    return replace(mesh, corner_colors=colors, corner_uvs=uvs, **sheets), new_scale


def _enlargement(
    uvs: Float[np.ndarray, "N 3 2"],
    change: Float[np.ndarray, " N"],
    shape: tuple[int, ...],
    gloss_shape: tuple[int, ...],
) -> int:
    """Return the odd factor by which a texture is enlarged.

    The texture then has as many texels as that of the gloss, and TEXELS_PER_CHANGE across a face
    whose corners differ by a `change` of 1, if MAX_TEXELS permits.
    """
    across = (np.ptp(uvs, axis=1) * shape[1::-1]).max(1)
    # Faces within a texel have about one color, and would enlarge the texture without end.
    is_changing = (change > 0) & (across > 0.5)
    ratios = TEXELS_PER_CHANGE * change[is_changing] / across[is_changing]
    of_gloss = [gloss_shape[axis] / shape[axis] for axis in (0, 1)] if gloss_shape[2] else []
    needed = max([1.0, *of_gloss, *ratios.tolist()])
    texels = max((np.ptp(uvs, axis=1) * shape[1::-1] + 2).prod(1).sum(), shape[0] * shape[1])
    largest = max(int(math.sqrt(MAX_TEXELS / 4 / texels)), 1)
    # This is the smallest odd number that suffices, or the largest one that is permitted.
    return min(2 * math.ceil((needed - 1) / 2) + 1, largest - (largest + 1) % 2)


def _resized(
    texture: UInt8[np.ndarray, "rows columns C"], size: Sequence[int], encoding: str
) -> UInt8[np.ndarray, "_ _ C"]:
    """Resize a texture that repeats, by interpolation. An odd factor keeps the given texels."""
    linear = decode(torch.from_numpy(texture) / 255, encoding)
    for axis, count in enumerate(texture.shape[:2]):
        place = (torch.arange(size[axis]) + 0.5) * (count / size[axis]) - 0.5
        before = place.floor().long()
        part = (place - before)[:, None, None].transpose(0, axis)
        first, second = (linear.index_select(axis, (before + step) % count) for step in (0, 1))
        linear = torch.lerp(first, second, part)
    return to_bytes(encode(linear, encoding)).numpy()


def _texels_at(
    positions: Float[np.ndarray, "T 2"], texture: UInt8[np.ndarray, "rows columns C"]
) -> UInt8[np.ndarray, "T C"]:
    """Return the texels at positions (column, row), as fractions of the size of the texture."""
    rows, columns, channels = texture.shape
    # The texture repeats.
    column, row = np.floor(positions % 1 * (columns, rows)).astype(np.int64).T
    return texture.reshape(-1, channels).take(row * columns + column, axis=0)


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

    def texels(self, charts: Int[np.ndarray, " M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """List the T texels of some charts.

        The results are the chart of each texel (T,), its row-major index on the sheet (T,), and
        its center in the old texture as a fraction of the size (T, 2).
        """
        counts = self._size[charts].prod(axis=1)
        chart = charts.repeat(counts)
        number_in_chart = np.arange(len(chart)) - (counts.cumsum() - counts).repeat(counts)
        row, column = np.divmod(number_in_chart, self._size[chart, 0])
        place = np.stack([column, row], axis=1)
        # Center of each texel, relative to the corner of the old texture, in texels of the new one.
        center = self._first_texel[chart] + place + 0.5
        sheet_column, sheet_row = (self._corner[chart] + place).T
        return chart, sheet_row * self.sheet_size[0] + sheet_column, center / self._new_size

    def weights(
        self, chart: Int[np.ndarray, " T"], center: Float[np.ndarray, "T 2"]
    ) -> Float[Tensor, "T 3"]:
        """Compute the barycentric weights of T texels in the faces of their charts."""
        from_first_corner = center * self._new_size - self._positions[chart, 0]
        # Weights of the second and the third corner. The first has the rest to 1.
        last_weights = np.einsum("ni,nij->nj", from_first_corner, self._inverse_edges[chart])
        weights = np.column_stack([1 - last_weights.sum(axis=1), last_weights])
        return torch.from_numpy(weights).float()


def _pack(sizes: Int[np.ndarray, "N 2"]) -> tuple[np.ndarray, tuple[int, int]]:
    """Place N rectangles in rows on a sheet that is about square, the highest ones first.

    Sizes are (columns, rows). The results are the top left corners, and the size of the sheet.
    """
    order = np.argsort(-sizes[:, 1], kind="stable")
    widths, heights = sizes[order].T
    row_width = max(int(np.sqrt(sizes.prod(axis=1).sum())), 1)
    # A rectangle belongs to the row in which it begins, and may end beyond `row_width`.
    # All rectangles in one long line, which is broken after each `row_width` texels.
    row, column = np.divmod(widths.cumsum() - widths, row_width)
    row_heights = np.zeros(row.max(initial=0) + 1, dtype=np.int64)
    np.maximum.at(row_heights, row, heights)
    tops = row_heights.cumsum() - row_heights
    # Undo the sorting.
    corners = np.empty_like(sizes)
    corners[order] = np.stack([column, tops[row]], axis=1)
    sheet_width = int((column + widths).max(initial=1))
    return corners, (sheet_width, max(int(row_heights.sum()), 1))
