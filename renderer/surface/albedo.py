"""Linear albedo at the samples of a view.

The albedo comes from the mesh as it was loaded, or from a parameter that can be
differentiated. The parameter is one albedo per face, the texels of the
textures, or a color that is added to the faces.

Shapes use these letters: a mesh has F faces. A view has S covered samples, and
these samples show G of the F faces. A texture has C channels. The local name
`seen_faces` is the index in the mesh of each of the G faces, shape (G,).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, reduce

import torch
from jaxtyping import Float, Int
from torch import Tensor

from renderer.errors import require_bounded
from renderer.image import clamp, decode
from renderer.mesh import Mesh
from renderer.visibility.fragments import BLOCK, Fragments

# Value of `Mesh.texture_ids` for a face without a texture.
NO_TEXTURE = -1
# Value of `Mesh.texture_ids` for a face with the first texture of the mesh.
FIRST_TEXTURE = 0


@dataclass(frozen=True)
class Texture:
    """Texture with C channels, whose texels are looked up by index.

    Attributes:
        height: Number of rows. Row 0 is at the top.
        width: Number of columns.
        look_up: Function that takes the indices of N texels, shape (N,), and
            returns their linear values, shape (C, N). The index of a texel is
            row · width + column.
    """

    height: int
    width: int
    look_up: Callable[[Tensor], Tensor]

    @staticmethod
    def from_values(values: Float[Tensor, "H W C"]) -> "Texture":
        """Create a texture from a tensor of linear values.

        The values that `look_up` returns are differentiable with respect to the
        tensor. NaN or infinite values raise `InputError`.
        """
        require_bounded(texture=values)
        height = values.shape[0]
        width = values.shape[1]
        # One row for each channel, with all texels in row-major order.
        channels = values.flatten(0, 1).T
        look_up = partial(torch.index_select, channels, 1)
        return Texture(height=height, width=width, look_up=look_up)


def surface_albedo(
    mesh: Mesh, fragments: Fragments, encoding: str, textures: Sequence[Tensor] | None = None
) -> Float[Tensor, "S 3"]:
    """Compute the albedo of a mesh at the samples of a view that show the mesh.

    The albedo is the interpolated color of the face corners times the interpolated
    texture. Colors and texels are decoded to linear values before they are
    interpolated. `textures` are linear, replace those of the mesh, and get a gradient. The
    result is linear, too.
    """
    colors = _interpolated_colors(mesh, fragments, encoding)
    textures_to_sample: list[Texture] = []
    if textures is not None:
        textures_to_sample = [Texture.from_values(values) for values in textures]
    elif mesh.packed_textures:
        textures_to_sample = mesh_textures(mesh, encoding, fragments.coverage)
    if not textures_to_sample:
        return colors
    return colors * sample_textures(textures_to_sample, mesh, fragments).T


def sample_textures(
    textures: Sequence[Texture], mesh: Mesh, fragments: Fragments
) -> Float[Tensor, "C S"]:
    """Look up the textures of a mesh at the samples of a view, with interpolation.

    Samples of faces without a texture have the value 1. `mesh.texture_ids` are
    indices into `textures`.
    """
    sample_uvs = _interpolated_uvs(mesh, fragments)
    texture_of_face = _texture_of_seen_face(mesh, fragments)
    # All faces of most meshes have the same texture. Then it is looked up at all samples.
    if len(textures) == 1 and bool((texture_of_face == FIRST_TEXTURE).all()):
        return interpolate_texture(textures[0], sample_uvs)
    sample_to_seen_face = fragments.sample_to_seen_face
    texture_of_sample = texture_of_face.index_select(0, sample_to_seen_face)
    # Indices of the samples that show each texture.
    samples_by_texture = []
    # Values of each texture at these samples.
    values_by_texture = []
    for texture_id, texture in enumerate(textures):
        samples = torch.nonzero(texture_of_sample == texture_id).squeeze(1)
        samples_by_texture.append(samples)
        uvs = sample_uvs.index_select(1, samples)
        values_by_texture.append(interpolate_texture(texture, uvs))
    textured_samples = torch.cat(samples_by_texture)
    # One row for each channel, one column for each sample in `textured_samples`.
    textured_values = torch.cat(values_by_texture, 1)
    channel_count = len(textured_values)
    # Samples of faces without a texture keep the value 1.
    values = textured_values.new_ones(channel_count, len(texture_of_sample))
    return values.index_copy(1, textured_samples, textured_values)


def interpolate_texture(texture: Texture, uvs: Float[Tensor, "2 N"]) -> Float[Tensor, "C N"]:
    """Interpolate a texture bilinearly at N points.

    The texture coordinates are u (to the right) and v (up). The texture covers
    [0, 1] in both and repeats beyond. The center of column i is at
    u = (i + 0.5) / width.
    """
    values_by_block = []
    # The points are processed in blocks to limit the memory.
    for block_uvs in uvs.split(BLOCK, dim=1):
        weighted_texels = [
            weight * texture.look_up(texel)
            for weight, texel in _surrounding_texels(texture, block_uvs)
        ]
        # Add up the weighted values of the four texels around each point.
        values_by_block.append(reduce(torch.add, weighted_texels))
    return torch.cat(values_by_block, dim=1)


def _surrounding_texels(texture: Texture, uvs: Float[Tensor, "2 N"]) -> list[tuple[Tensor, Tensor]]:
    """Find the four texels around each of N points, and their weights for interpolation.

    The pairs of weight and index (row · width + column) are for the upper left, upper
    right, lower left and lower right texel.
    """
    u, v = uvs
    # The coordinate v points up, but row 0 of the texture is at the top.
    rows = _neighbors(1 - v, texture.height)
    columns = _neighbors(u, texture.width)
    texels = []
    for row, row_weight in rows:
        for column, column_weight in columns:
            texel = (row * texture.width + column).long()
            texels.append((row_weight * column_weight, texel))
    return texels


def _neighbors(coordinate: Float[Tensor, " N"], count: int) -> list[tuple[Tensor, Tensor]]:
    """Find the two columns of texels, or the two rows, between which each of N points lies.

    Columns and rows are both called lines. The pairs of index and weight are for the line
    before and the line after a point. Indices are whole floating-point numbers in [0,
    count).
    """
    # Position in units of lines. The center of line i has the position i.
    position = coordinate * count - 0.5
    line_before = position.floor()
    fraction = position - line_before
    return [
        (_modulo(line_before, count), 1 - fraction),
        (_modulo(line_before + 1, count), fraction),
    ]


def _modulo(index: Float[Tensor, " N"], count: int) -> Float[Tensor, " N"]:
    """Compute `index` modulo `count`, a number in [0, count)."""
    return index - count * (index / count).floor()


def mesh_textures(mesh: Mesh, encoding: str, like: Tensor) -> list[Texture]:
    """Convert the 8-bit textures of a mesh to `Texture` objects, which return linear values.

    The values get the device and dtype of `like`.
    """
    # A channel has only 256 possible values. A table with the linear value of each saves
    # decoding every texel.
    eight_bit_values = torch.arange(256, dtype=torch.float64) / 255
    linear_values = decode(eight_bit_values, encoding).to(like)
    textures = []
    for packed_texture in mesh.packed_textures:
        height, width = packed_texture.shape
        packed_texels = torch.from_numpy(packed_texture).to(like.device).flatten()
        look_up = partial(_look_up_packed, packed_texels, linear_values)
        textures.append(Texture(height=height, width=width, look_up=look_up))
    return textures


def _look_up_packed(
    packed_texels: Int[Tensor, " _"],
    linear_values: Float[Tensor, " 256"],
    texels: Int[Tensor, " N"],
) -> Float[Tensor, "3 N"]:
    """Look up the linear values of N texels of a texture with one integer per texel.

    Bits 0 to 7 of a texel are red, 8 to 15 green and 16 to 23 blue.
    """
    first_bits = torch.tensor([[0], [8], [16]], dtype=torch.int32, device=packed_texels.device)
    # Values from 0 to 255: one row for each color, one column for each texel.
    eight_bit_values = (packed_texels.index_select(0, texels) >> first_bits) & 255
    return linear_values.index_select(0, eight_bit_values.long().flatten()).view(3, -1)


def face_albedo(albedo: Float[Tensor, "F 3"], fragments: Fragments) -> Float[Tensor, "S 3"]:
    """Look up the albedo at the samples of a mesh with one albedo per face.

    The result is differentiable with respect to `albedo`.
    """
    require_bounded(albedo=albedo)
    seen_faces = fragments.faces
    return _at_samples(albedo.index_select(0, seen_faces), fragments)


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
    can therefore be stored in image files (see `renderer.surface.texture_bake`).
    The result is differentiable with respect to `added` and `hue`. `added` is linear, and
    `hue` is in degrees, or None for unchanged hues.
    """
    sample_to_seen_face = fragments.sample_to_seen_face
    added_at_samples = face_albedo(added, fragments)
    added_to_face = added.index_select(0, fragments.faces)
    hue_of_face = None
    hue_at_samples = None
    if hue is not None:
        # Unlike `hue[faces]`, `index_select` adds up gradients in the same order for any
        # number of threads.
        hue_of_face = hue.index_select(0, fragments.faces)
        hue_at_samples = hue_of_face.index_select(0, sample_to_seen_face)

    # First, change the colors of the corners of faces and interpolate them, as if no face
    # had a texture.
    seen_faces = fragments.faces.cpu().numpy()
    corner_colors = torch.from_numpy(mesh.corner_colors.take(seen_faces, axis=0)).to(added)
    # Axes: seen face, corner, channel.
    corner_albedo = decode(corner_colors, encoding) * albedo_scale
    # A new axis for the corners, because the three corners of a face have the same hue.
    corner_hue = None if hue_of_face is None else hue_of_face[:, None]
    painted_corners = changed_albedo(corner_albedo, corner_hue, added_to_face[:, None])
    albedo = fragments.interpolate(painted_corners)
    if not mesh.textures:
        return albedo

    # Then replace the albedo at samples of faces with a texture: change the texels of the
    # texture, and interpolate them.
    colors = _interpolated_colors(mesh, fragments, encoding)
    scaled_colors = (colors * albedo_scale).to(added)
    sample_uvs = _interpolated_uvs(mesh, fragments)
    texture_of_face = _texture_of_seen_face(mesh, fragments)
    texture_of_sample = texture_of_face[sample_to_seen_face]
    for texture_id, texture in enumerate(mesh_textures(mesh, encoding, added)):
        samples = torch.nonzero(texture_of_sample == texture_id).squeeze(1)
        hue_at_textured = None
        if hue_at_samples is not None:
            hue_at_textured = hue_at_samples.index_select(0, samples)
        textured_albedo = _interpolate_painted_texels(
            texture,
            sample_uvs[:, samples],
            colors=scaled_colors[samples],
            hue=hue_at_textured,
            added=added_at_samples.index_select(0, samples),
        )
        albedo = albedo.index_copy(0, samples, textured_albedo)
    return albedo


def _interpolate_painted_texels(
    texture: Texture,
    uvs: Float[Tensor, "2 N"],
    colors: Float[Tensor, "N 3"],
    hue: Float[Tensor, " N"] | None,
    added: Float[Tensor, "N 3"],
) -> Float[Tensor, "N 3"]:
    """Interpolate a texture at N points after a change of the hue and color of its texels."""
    weighted_texels = []
    for weight, texel in _surrounding_texels(texture, uvs):
        texel_albedo = colors * texture.look_up(texel).T
        painted_texel = changed_albedo(texel_albedo, hue, added)
        weighted_texels.append(weight.to(added)[:, None] * painted_texel)
    return reduce(torch.add, weighted_texels)


def changed_albedo(
    albedo: Float[Tensor, "... 3"], hue: Float[Tensor, " ..."] | None, added: Float[Tensor, "... 3"]
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
    if mesh.packed_textures:
        return None
    # One row for each corner of the seen faces, one column for each channel.
    albedo = _corner_albedo(mesh, fragments, encoding).flatten(0, 1)
    if len(albedo) == 0:
        return None
    first_albedo = albedo[0]
    if not (albedo == first_albedo).all():
        return None
    return first_albedo


def _interpolated_colors(mesh: Mesh, fragments: Fragments, encoding: str) -> Float[Tensor, "S 3"]:
    """Interpolate the linear corner colors of a mesh at the S covered samples of a view."""
    corner_albedo = _corner_albedo(mesh, fragments, encoding)
    if not mesh.one_color_per_face:
        return fragments.interpolate(corner_albedo)
    # All corners of a face have the same color, so take the first corner. One row for each
    # channel, one column for each seen face.
    face_colors = corner_albedo[:, 0].T.contiguous()
    sample_to_seen_face = fragments.sample_to_seen_face
    # `gather` takes a third of the time of `index_select` in float64.
    return face_colors.gather(1, sample_to_seen_face.expand(3, -1)).T


def _corner_albedo(mesh: Mesh, fragments: Fragments, encoding: str) -> Float[Tensor, "G 3 3"]:
    """Decode the corner colors of the G faces that a view shows."""
    seen_faces = fragments.faces.cpu().numpy()
    corner_colors = torch.from_numpy(mesh.corner_colors.take(seen_faces, axis=0))
    corner_colors = corner_colors.to(fragments.coverage)
    require_bounded(corner_colors=corner_colors)
    return decode(corner_colors, encoding)


def _interpolated_uvs(mesh: Mesh, fragments: Fragments) -> Float[Tensor, "2 S"]:
    """Interpolate the texture coordinates of a mesh at the S covered samples of a view."""
    seen_faces = fragments.faces.cpu().numpy()
    # Axes: seen face, corner, texture coordinate (u or v).
    corner_uvs = torch.from_numpy(mesh.corner_uvs.take(seen_faces, axis=0))
    return fragments.interpolate(corner_uvs.to(fragments.coverage)).T


def _texture_of_seen_face(mesh: Mesh, fragments: Fragments) -> Int[Tensor, " G"]:
    """Return the index of the texture of each of the G faces that a view shows, or `NO_TEXTURE`."""
    seen_faces = fragments.faces.cpu().numpy()
    texture_ids = torch.from_numpy(mesh.texture_ids.take(seen_faces))
    return texture_ids.to(fragments.sample_to_seen_face.device)


def _at_samples(face_values: Float[Tensor, "G D"], fragments: Fragments) -> Float[Tensor, "S D"]:
    """Look up the values of the face that each sample shows."""
    sample_to_seen_face = fragments.sample_to_seen_face
    # Selecting columns of the transposed matrix takes half the time of selecting rows.
    return face_values.T.contiguous().index_select(1, sample_to_seen_face).T
