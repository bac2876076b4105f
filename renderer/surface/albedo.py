"""Linear albedo at the samples of a view.

The albedo comes from the mesh as it was loaded, or from a parameter that can be
differentiated. The parameter is one albedo per face, the texels of the
textures, or a color that is added to the faces.

Shapes use these letters: a mesh has F faces, a view sees G of them in S
samples, and a texture has C channels. The two index arrays of `Fragments` have
longer names in this module:

- `seen_faces` is `fragments.faces`, the index in the mesh of each face that the
  view sees, shape (G,). It is a NumPy array if it selects from arrays of the
  mesh, and a tensor otherwise.
- `sample_to_seen_face` is `fragments.face`, the index in `seen_faces` of the
  face at each sample, shape (S,).
"""

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

# Value in `Mesh.texture_ids` for faces without a texture.
NO_TEXTURE = -1
# Value in `Mesh.texture_ids` for faces with the first texture of the mesh.
FIRST_TEXTURE = 0


@dataclass(frozen=True)
class Texture:
    """Texture whose texels are looked up by index.

    Attributes:
        height: Number of rows. Row 0 is at the top.
        width: Number of columns.
        look_up: Function that returns the linear values of texels, shape
            (C, N). Its argument is the row-major index of each texel,
            row · width + column, shape (N,).
    """

    height: int
    width: int
    look_up: Callable[[Tensor], Tensor]

    @staticmethod
    def from_values(values: Tensor) -> "Texture":
        """Create a texture from linear values, in which lookups are differentiable.

        Args:
            values: Linear values of the texels, floating point,
                shape (H, W, C).

        Returns:
            Texture with H rows and W columns.

        Raises:
            InputError: If `values` is not floating point, or has NaN or
                infinite values.
        """
        require_bounded(texture=values)
        height = values.shape[0]
        width = values.shape[1]
        # Shape (C, H · W).
        channels = values.flatten(0, 1).T
        look_up = partial(torch.index_select, channels, 1)
        return Texture(height=height, width=width, look_up=look_up)


def surface_albedo(
    mesh: Mesh, fragments: Fragments, encoding: str, textures: Sequence[Tensor] | None = None
) -> Tensor:
    """Compute the albedo of a mesh: the interpolated corner color times the texture.

    Colors and texels are decoded before they are interpolated.

    Args:
        mesh: Mesh that the view shows.
        fragments: Visible samples of the view.
        encoding: Encoding of the colors and textures of the mesh, "linear" or
            "srgb".
        textures: Linear albedo that replaces the textures of the mesh, shape
            (H, W, 3) each. The result is differentiable with respect to it.
            None uses the textures of the mesh.

    Returns:
        Linear albedo at the samples, float64, shape (S, 3).

    Raises:
        InputError: If a color or texture has NaN or infinite values.
    """
    colors = _interpolated_colors(mesh, fragments, encoding)
    used_textures: list[Texture] = []
    if textures is not None:
        used_textures = [Texture.from_values(values) for values in textures]
    elif mesh.packed_textures:
        used_textures = mesh_textures(mesh, encoding, fragments.coverage)
    if not used_textures:
        return colors
    return colors * sample_textures(used_textures, mesh, fragments).T


def sample_textures(textures: Sequence[Texture], mesh: Mesh, fragments: Fragments) -> Tensor:
    """Interpolate the textures of a mesh at the samples of a view.

    Args:
        textures: Textures of the mesh. `mesh.texture_ids` holds the index in
            this sequence for each face.
        mesh: Mesh that the view shows. It provides the texture coordinates.
        fragments: Visible samples of the view.

    Returns:
        Linear values at the samples, shape (C, S). Samples of faces without a
        texture have the value 1.
    """
    sample_uvs = _interpolated_uvs(mesh, fragments)
    texture_of_face = _texture_of_seen_face(mesh, fragments)
    # Most meshes have a single texture, which covers all faces. Then no samples
    # need to be selected.
    if len(textures) == 1 and bool((texture_of_face == FIRST_TEXTURE).all()):
        return interpolate_texture(textures[0], sample_uvs)
    sample_to_seen_face = fragments.face
    texture_of_sample = texture_of_face.index_select(0, sample_to_seen_face)
    samples_by_texture = []
    values_by_texture = []
    for texture_id, texture in enumerate(textures):
        samples = torch.nonzero(texture_of_sample == texture_id).squeeze(1)
        samples_by_texture.append(samples)
        uvs = sample_uvs.index_select(1, samples)
        values_by_texture.append(interpolate_texture(texture, uvs))
    textured_samples = torch.cat(samples_by_texture)
    # Shape (C, number of textured samples).
    textured_values = torch.cat(values_by_texture, 1)
    # Samples with NO_TEXTURE keep the value 1.
    values = textured_values.new_ones(len(textured_values), len(texture_of_sample))
    return values.index_copy(1, textured_samples, textured_values)


def interpolate_texture(texture: Texture, uvs: Tensor) -> Tensor:
    """Interpolate a texture bilinearly at points.

    The texture repeats beyond [0, 1]. Texel centers are at half-integers of
    width and height, and v = 0 is the lower edge of the bottom row.

    Args:
        texture: Texture to interpolate.
        uvs: Texture coordinates u and v of N points, shape (2, N).

    Returns:
        Interpolated linear values, shape (C, N).
    """
    blocks = []
    # Blocks of BLOCK points limit the memory.
    for block in uvs.split(BLOCK, dim=1):
        weighted = [
            weight * texture.look_up(texel) for weight, texel in _surrounding_texels(texture, block)
        ]
        blocks.append(reduce(torch.add, weighted))
    return torch.cat(blocks, dim=1)


def _surrounding_texels(texture: Texture, uvs: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Find the four texels around each of N points, and their weights.

    Args:
        texture: Texture with the texels.
        uvs: Texture coordinates u and v of the points, shape (2, N).

    Returns:
        Four pairs of a weight and a row-major texel index, shape (N,) each. The
        weights of a point add up to 1.
    """
    u, v = uvs
    # v points up, but row 0 is at the top.
    rows = _neighbors(1 - v, texture.height)
    columns = _neighbors(u, texture.width)
    texels = []
    for row, row_weight in rows:
        for column, column_weight in columns:
            texel = (row * texture.width + column).long()
            texels.append((row_weight * column_weight, texel))
    return texels


def _neighbors(coordinate: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    """Find the two rows, or the two columns, between which each of N points lies.

    Args:
        coordinate: Coordinate of the points in a texture that repeats from 0 to
            1, shape (N,).
        count: Number of rows or columns of the texture.

    Returns:
        Two pairs, for the row or column before the point and the one after it.
        A pair has an index, a whole floating-point number in [0, count), and a
        weight, shape (N,) each.
    """
    position = coordinate * count - 0.5
    first = position.floor()
    fraction = position - first
    return [(_modulo(first, count), 1 - fraction), (_modulo(first + 1, count), fraction)]


def _modulo(index: Tensor, count: int) -> Tensor:
    """Compute the remainder of whole floating-point numbers in the division by `count`."""
    return index - count * (index / count).floor()


def mesh_textures(mesh: Mesh, encoding: str, like: Tensor) -> list[Texture]:
    """Return the textures of a mesh as `Texture` objects with linear values.

    Args:
        mesh: Mesh with textures of eight bits per channel.
        encoding: Encoding of the texels, "linear" or "srgb".
        like: Tensor with the device and dtype of the linear values.

    Returns:
        Textures with three channels of linear albedo.
    """
    # A channel has only 256 possible values, so they are decoded once.
    eight_bit_values = torch.arange(256, dtype=torch.float64) / 255
    linear_values = decode(eight_bit_values, encoding).to(like)
    textures = []
    for packed_texture in mesh.packed_textures:
        height, width = packed_texture.shape
        packed_texels = torch.from_numpy(packed_texture).to(like.device).flatten()
        look_up = partial(_look_up_packed, packed_texels, linear_values)
        textures.append(Texture(height=height, width=width, look_up=look_up))
    return textures


def _look_up_packed(packed_texels: Tensor, linear_values: Tensor, texels: Tensor) -> Tensor:
    """Return the linear values of texels that hold their three channels in one integer.

    Args:
        packed_texels: Texels of one of `Mesh.packed_textures` in row-major
            order, int32, shape (H · W,). Bits 0 to 7 are red, 8 to 15 green and
            16 to 23 blue.
        linear_values: Linear value for each of the 256 values of a channel,
            shape (256,).
        texels: Indices of the texels to look up, shape (N,).

    Returns:
        Linear red, green and blue, shape (3, N).
    """
    first_bits = torch.tensor([[0], [8], [16]], dtype=torch.int32, device=packed_texels.device)
    # Eight-bit values, shape (3, N).
    channels = (packed_texels.index_select(0, texels) >> first_bits) & 255
    return linear_values.index_select(0, channels.long().flatten()).view(3, -1)


def face_albedo(albedo: Tensor, fragments: Fragments) -> Tensor:
    """Return, for each sample, the albedo of the face that it shows.

    The result is differentiable with respect to `albedo`.

    Args:
        albedo: Linear albedo of the F faces of the mesh, shape (F, 3).
        fragments: Visible samples of the view.

    Returns:
        Linear albedo at the samples, shape (S, 3).

    Raises:
        InputError: If `albedo` is not floating point, or has NaN or infinite
            values.
    """
    require_bounded(albedo=albedo)
    seen_faces = fragments.faces
    return _at_samples(albedo.index_select(0, seen_faces), fragments)


def paint_faces(
    mesh: Mesh,
    fragments: Fragments,
    encoding: str,
    albedo_scale: float,
    added: Tensor,
    hue: Tensor | None = None,
) -> Tensor:
    """Compute the albedo of a mesh whose faces have a rotated hue and an added color.

    The scaled albedo of the mesh is changed at corners and texels, as in
    `changed_albedo`, and interpolated afterwards. Image files can therefore
    store the changed albedo (see `renderer.surface.texture_bake`). The result is
    differentiable with respect to `added` and `hue`.

    Args:
        mesh: Mesh that the view shows.
        fragments: Visible samples of the view.
        encoding: Encoding of the colors and textures of the mesh, "linear" or
            "srgb".
        albedo_scale: Factor for the albedo of the mesh.
        added: Linear color that is added to each face, shape (F, 3).
        hue: Hue rotation of each face in degrees, shape (F,). None leaves the
            hues unchanged.

    Returns:
        Linear albedo at the samples in the dtype of `added`, shape (S, 3).

    Raises:
        InputError: If `added` or a color of the mesh has NaN or infinite
            values.
    """
    sample_to_seen_face = fragments.face
    added_at_samples = face_albedo(added, fragments)
    added_to_face = added.index_select(0, fragments.faces)
    hue_of_face = None
    hue_at_samples = None
    if hue is not None:
        # The gradient of index_select adds up in the same order on any number
        # of threads. The gradient of indexing with brackets does not.
        hue_of_face = hue.index_select(0, fragments.faces)
        hue_at_samples = hue_of_face.index_select(0, sample_to_seen_face)

    seen_faces = fragments.faces.cpu().numpy()
    corner_colors = torch.from_numpy(mesh.corner_colors.take(seen_faces, axis=0)).to(added)
    # Shape (G, 3, 3), for three corners and three channels.
    corner_albedo = decode(corner_colors, encoding) * albedo_scale
    # The three corners of a face share its hue and its added color.
    corner_hue = None if hue_of_face is None else hue_of_face[:, None]
    painted_corners = changed_albedo(corner_albedo, corner_hue, added_to_face[:, None])
    albedo = fragments.interpolate(painted_corners)
    if not mesh.textures:
        return albedo

    # Textured samples interpolate painted texels instead of painted corners.
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
    texture: Texture, uvs: Tensor, colors: Tensor, hue: Tensor | None, added: Tensor
) -> Tensor:
    """Rotate the hue of the four texels around each point, add a color, and interpolate them.

    Args:
        texture: Texture with three channels.
        uvs: Texture coordinates u and v of N points, shape (2, N).
        colors: Linear color that multiplies the texels around each point,
            shape (N, 3).
        hue: Hue rotation at each point in degrees, shape (N,). None leaves the
            hue unchanged.
        added: Linear color that is added at each point, shape (N, 3).

    Returns:
        Linear albedo of the points, shape (N, 3).
    """
    weighted = []
    for weight, texel in _surrounding_texels(texture, uvs):
        texel_albedo = colors * texture.look_up(texel).T
        painted = changed_albedo(texel_albedo, hue, added)
        weighted.append(weight.to(added)[:, None] * painted)
    return reduce(torch.add, weighted)


def changed_albedo(albedo: Tensor, hue: Tensor | None, added: Tensor) -> Tensor:
    """Return an albedo with rotated hue and an added color, clamped.

    The hue is rotated about the gray axis, which preserves the mean of the
    channels (Haeberli 1993). The sum is clamped to [0, 1], or to [0, albedo]
    for an albedo above 1.

    Args:
        albedo: Linear albedo, shape (..., 3).
        hue: Rotation angle in degrees, shape (...). None leaves the hue
            unchanged.
        added: Linear color to add, shape (..., 3).

    Returns:
        Changed linear albedo, shape (..., 3).
    """
    rotated = albedo
    if hue is not None:
        angle = torch.deg2rad(hue)[..., None]
        gray = albedo.mean(-1, keepdim=True)
        # This is Rodrigues' rotation formula. The cross product of the albedo
        # with the gray axis, (1, 1, 1) / √3, is a difference of permuted
        # channels.
        cross_product = (albedo.roll(1, -1) - albedo.roll(-1, -1)) / math.sqrt(3)
        rotated = gray + angle.cos() * (albedo - gray) + angle.sin() * cross_product
    return clamp(rotated + added, albedo.clamp(min=1))


def shared_albedo(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor | None:
    """Return the albedo that all seen faces share, if they share one.

    Args:
        mesh: Mesh that the view shows.
        fragments: Visible samples of the view.
        encoding: Encoding of the colors of the mesh, "linear" or "srgb".

    Returns:
        Linear albedo, float64, shape (3,). None if the mesh has a texture, if
        two corners of seen faces differ in color, or if the view sees no face.

    Raises:
        InputError: If a color has NaN or infinite values.
    """
    if mesh.packed_textures:
        return None
    # Shape (3 G, 3), for the corners of the seen faces and three channels.
    albedo = _corner_albedo(mesh, fragments, encoding).flatten(0, 1)
    if len(albedo) == 0:
        return None
    first_albedo = albedo[0]
    if not (albedo == first_albedo).all():
        return None
    return first_albedo


def _interpolated_colors(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor:
    """Interpolate the decoded corner colors at the samples, float64, shape (S, 3)."""
    corner_albedo = _corner_albedo(mesh, fragments, encoding)
    if not mesh.one_color_per_face:
        return fragments.interpolate(corner_albedo)
    # All corners of a face have the color of its first corner, shape (3, G).
    face_colors = corner_albedo[:, 0].T.contiguous()
    sample_to_seen_face = fragments.face
    # gather takes a third of the time of index_select in float64.
    return face_colors.gather(1, sample_to_seen_face.expand(3, -1)).T


def _corner_albedo(mesh: Mesh, fragments: Fragments, encoding: str) -> Tensor:
    """Decode the three corner colors of each seen face, float64, shape (G, 3, 3)."""
    seen_faces = fragments.faces.cpu().numpy()
    corner_colors = torch.from_numpy(mesh.corner_colors.take(seen_faces, axis=0))
    corner_colors = corner_colors.to(fragments.coverage)
    require_bounded(corner_colors=corner_colors)
    return decode(corner_colors, encoding)


def _interpolated_uvs(mesh: Mesh, fragments: Fragments) -> Tensor:
    """Interpolate the texture coordinates u and v at the samples, float64, shape (2, S)."""
    seen_faces = fragments.faces.cpu().numpy()
    corner_uvs = torch.from_numpy(mesh.corner_uvs.take(seen_faces, axis=0))
    return fragments.interpolate(corner_uvs.to(fragments.coverage)).T


def _texture_of_seen_face(mesh: Mesh, fragments: Fragments) -> Tensor:
    """Return the texture index of each seen face, or NO_TEXTURE, shape (G,)."""
    seen_faces = fragments.faces.cpu().numpy()
    texture_ids = torch.from_numpy(mesh.texture_ids.take(seen_faces))
    return texture_ids.to(fragments.face.device)


def _at_samples(values: Tensor, fragments: Fragments) -> Tensor:
    """Return, for each sample, the values of the face that it shows.

    Args:
        values: D values for each of the G seen faces, shape (G, D).
        fragments: Visible samples of the view.

    Returns:
        Values at the samples, shape (S, D).
    """
    sample_to_seen_face = fragments.face
    # Selecting columns of contiguous rows takes half as long as selecting rows
    # of D values.
    return values.T.contiguous().index_select(1, sample_to_seen_face).T
