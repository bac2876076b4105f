"""Computes transfer operators from meshes and cameras: the box filter of matte and glossy surfaces.

Shapes use these letters: a view has S covered samples in P pixels, which show G
faces of the mesh. C is the number of channels, and K that of coefficients of the
light that reach a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from renderer.camera import Camera
from renderer.errors import require_bounded
from renderer.light import harmonics
from renderer.light.basis import HARMONICS, Basis, EnvironmentPart, Harmonics, LocalPart
from renderer.mesh import Mesh
from renderer.operators.apply import COLORS, TransferOperator
from renderer.operators.lamp_paths import local_transfer
from renderer.operators.rays import Rays, Surface
from renderer.operators.shadows import Transport, build_transport
from renderer.operators.sparse import SparseTransfer, concatenate_entries
from renderer.settings import ImageSettings
from renderer.surface.albedo import shared_albedo, surface_albedo
from renderer.surface.gloss import Gloss, SampleGloss, at_samples
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizer import Rasterizer

# Number of pixels that `_box_filter` processes at once. Their values fit into the cache of
# the processor.
BLOCK = 2**12
# The transfer of a glossy surface is computed for this many pairs of a sample and an SH
# coefficient at once. It limits the memory.
GLOSSY_BLOCK = 2**20


def build_operators(
    mesh: Mesh,
    cameras: Sequence[Camera],
    settings: ImageSettings,
    rasterizer: Rasterizer,
    albedo_scale: float = 1.0,
    basis: Basis = HARMONICS,
    dtype: torch.dtype = torch.float32,
    gloss: Gloss | None = None,
) -> list[TransferOperator]:
    """Compute the transfer operators of a mesh for several cameras.

    Surfaces are shaded on the side that the camera sees. A `gloss` of None is that of the
    mesh.
    """
    require_bounded(albedo_scale=torch.tensor(float(albedo_scale)))
    views = build_fragments(
        mesh.vertices, mesh.faces, cameras, settings, rasterizer, closed=mesh.closed
    )
    transport = build_transport(mesh, settings, albedo_scale, basis)
    builder = _OperatorBuilder(
        mesh=mesh,
        settings=settings,
        albedo_scale=albedo_scale,
        basis=basis,
        dtype=dtype,
        gloss=gloss,
        transport=transport,
        rays=transport.rays if transport else Rays(mesh),
    )
    return [builder.build(fragments) for fragments in views]


class _Channels(NamedTuple):
    """Number of channels of a transfer matrix, and the albedo with which it is computed.

    If each color has a channel, the matrix includes the albedo of the S samples.
    If all colors share a channel, the matrix is computed for the albedo 1, and the
    image is multiplied by the albedo of the P pixels later.

    Attributes:
        number: Number C of channels: 3 if each color has a channel, 1 if the
            colors share a channel, and 2 if a channel of specular reflection
            follows the shared channel.
        is_shared: True if the colors share a channel.
        sample_albedo: Albedo that the transfer includes, shape (S, 3), or ones of
            shape (S, 1) if the colors share a channel.
        pixel_albedo: Albedo that is multiplied later, shape (P, 3). Ones if each
            color has a channel.
    """

    number: int
    is_shared: bool
    sample_albedo: Tensor
    pixel_albedo: Float[Tensor, "P 3"]


class _DenseRows(NamedTuple):
    """Rows of a transfer matrix for some of the coefficients of a light.

    Attributes:
        transfer: Radiance of the P pixels per unit of each of K coefficients, in C
            channels, shape (C, K, P).
        coefficients: Indices of the K coefficients among all coefficients of the
            light, shape (K,).
    """

    transfer: Float[Tensor, "C K P"]
    coefficients: Int[Tensor, " K"]


@dataclass(frozen=True)
class _OperatorBuilder:
    """Computes the transfer operators of the views of one mesh.

    Attributes:
        mesh: Mesh that the views show.
        settings: Settings of the images.
        albedo_scale: Factor for the albedo.
        basis: Basis of the lights.
        dtype: Data type of the operators.
        gloss: Gloss to use instead of the gloss of the mesh, or None.
        transport: Shadows and bounces of environment light, or None without
            shadows and bounces.
        rays: Rays among the faces of the mesh.
    """

    mesh: Mesh
    settings: ImageSettings
    albedo_scale: float
    basis: Basis
    dtype: torch.dtype
    gloss: Gloss | None
    transport: Transport | None
    rays: Rays

    def build(self, fragments: Fragments) -> TransferOperator:
        """Compute the operator of one view."""
        surface = Surface(self.mesh, fragments, self.settings, given_gloss=self.gloss)
        channels = self._channels(surface)
        albedo = channels.pixel_albedo.T.to(self.dtype).contiguous()
        # Rows of the matrix as dense tensors.
        dense = []
        # Rows of the matrix as lists of their nonzero entries.
        sparse = []
        for local_light in self.basis.local_lights:
            entries = self._local_entries(local_light, surface, channels)
            if entries.is_sparse(len(fragments.pixels)):
                sparse.append(self._sparse_rows(local_light, entries, channels))
            else:
                dense.append(self._local_rows(local_light, entries, surface))
        if self.basis.environment is not None:
            dense.append(self._environment_rows(self.basis.environment, surface, channels))
        all_rows = self._concatenate(dense, channels.number, len(fragments.pixels))
        return TransferOperator(
            transfer=all_rows.transfer,
            albedo=albedo,
            coverage=fragments.coverage.to(self.dtype),
            pixels=fragments.pixels,
            nonzero=all_rows.coefficients,
            settings=self.settings,
            basis=self.basis,
            sparse=concatenate_entries(sparse),
        )

    def _channels(self, surface: Surface) -> _Channels:
        """Choose how many channels the transfer matrix of a view needs.

        If all samples of each pixel have the same albedo, the three colors can
        share one channel: the matrix is computed for the albedo 1, and the images
        are multiplied by the albedo of the pixels.
        """
        fragments = surface.fragments
        pixel_count = len(fragments.pixels)
        is_glossy = surface.gloss is not None
        pixel_albedo = None
        sample_albedo = None
        if self._needs_three_channels(is_glossy):
            sample_albedo = self._surface_albedo(fragments)
        else:
            color = shared_albedo(self.mesh, fragments, self.settings.encoding)
            if color is not None:
                pixel_albedo = (color * self.albedo_scale).expand(pixel_count, 3)
            else:
                sample_albedo = self._surface_albedo(fragments)
                pixel_albedo = _pixel_albedo(fragments, sample_albedo, self.dtype)
        if pixel_albedo is None:
            assert sample_albedo is not None
            # The three channels include the albedo of the samples, so the image is multiplied
            # by 1 instead of the albedo of the pixels.
            return _Channels(
                number=COLORS,
                is_shared=False,
                sample_albedo=sample_albedo,
                pixel_albedo=torch.ones(pixel_count, COLORS),
            )
        ones = torch.ones(1, 1, dtype=torch.float64).expand(len(fragments.sample_to_pixel), 1)
        return _Channels(
            number=2 if is_glossy else 1,
            is_shared=True,
            sample_albedo=ones,
            pixel_albedo=pixel_albedo,
        )

    def _needs_three_channels(self, is_glossy: bool) -> bool:
        """Tell whether each color needs its own channel of the transfer matrix.

        Otherwise, all colors share a channel, which is multiplied by the albedo of
        the pixels. This is not possible if bounced light is colored. It is also
        not possible for a glossy mesh with shadows or local lights, because they
        add specular reflection, which has no albedo, to the same channel.
        """
        if self.transport is not None and self.transport.has_colored_light:
            return True
        return is_glossy and (self.transport is not None or bool(self.basis.local_lights))

    def _surface_albedo(self, fragments: Fragments) -> Tensor:
        """Compute the scaled linear albedo at the S samples of a view, shape (S, 3)."""
        return surface_albedo(self.mesh, fragments, self.settings.encoding) * self.albedo_scale

    def _environment_rows(
        self,
        environment: EnvironmentPart,
        surface: Surface,
        channels: _Channels,
    ) -> _DenseRows:
        """Compute the rows of the transfer matrix for environment light, shadows and bounces."""
        harmonics_basis = environment.basis
        all_coefficients = torch.arange(harmonics_basis.size)
        if surface.gloss is None:
            weights = None if channels.is_shared else channels.sample_albedo
            transfer = _box_filter(surface, weights, harmonics_basis, self.dtype)
            coefficients = harmonics_basis.nonzero
        else:
            albedo = channels.sample_albedo
            transfer = _glossy_box_filter(
                surface, surface.gloss, albedo, harmonics_basis, self.dtype
            )
            coefficients = all_coefficients
        change = None
        if self.transport is not None:
            change = self.transport.change(surface, channels.sample_albedo)
        if change is not None:
            # `change` has a row for every SH coefficient, and `transfer` only for those in
            # `coefficients`.
            transfer = change.index_add_(1, coefficients, transfer.double())
            coefficients = all_coefficients
        return _DenseRows(transfer.to(self.dtype), environment.rows.start + coefficients)

    def _local_entries(
        self, local_light: LocalPart, surface: Surface, channels: _Channels
    ) -> SparseTransfer:
        """Compute the nonzero entries of the transfer matrix for a lamp or a projector.

        Its basis functions (lamps, or pixels of a projector) are counted from the first one
        of this light.
        """
        return local_transfer(self.rays, surface, channels.sample_albedo, local_light.basis)

    def _local_rows(
        self, local_light: LocalPart, entries: SparseTransfer, surface: Surface
    ) -> _DenseRows:
        """Write the transfer matrix of a lamp or projector (a local light) as dense rows.

        Only basis functions that reach a pixel have rows.
        """
        transfer, coefficients = entries.dense(len(surface.fragments.pixels))
        return _DenseRows(transfer.to(self.dtype), local_light.rows.start + coefficients)

    def _sparse_rows(
        self, local_light: LocalPart, entries: SparseTransfer, channels: _Channels
    ) -> SparseTransfer:
        """Convert the nonzero entries of a local light to three channels with the albedo.

        The result counts basis functions among all coefficients, and `entries` from the
        first function of the light.
        """
        weight = (entries.weight * channels.pixel_albedo[entries.pixel]).to(self.dtype)
        return SparseTransfer(local_light.rows.start + entries.function, entries.pixel, weight)

    def _concatenate(
        self, parts: list[_DenseRows], channel_count: int, pixel_count: int
    ) -> _DenseRows:
        """Concatenate the rows of several lights in the order of their coefficients.

        The two numbers are needed if there are no rows.
        """
        if len(parts) == 1:
            # The rows of a single light are returned as they are, because `cat` copies them.
            return parts[0]
        empty = torch.empty(channel_count, 0, pixel_count, dtype=self.dtype)
        ordered = sorted(parts, key=_first_coefficient)
        transfer = torch.cat([empty, *(part.transfer for part in ordered)], dim=1)
        coefficients = [torch.arange(0), *(part.coefficients for part in ordered)]
        return _DenseRows(transfer, torch.cat(coefficients))


def _first_coefficient(rows: _DenseRows) -> int:
    """Return the index of the coefficient of the first row, or 0 if there are no rows."""
    return int(rows.coefficients[0]) if len(rows.coefficients) else 0


def _pixel_albedo(
    fragments: Fragments, albedo: Float[Tensor, "S 3"], dtype: torch.dtype
) -> Float[Tensor, "P 3"] | None:
    """Return the albedo of each pixel if all samples of each pixel have the same albedo.

    Differences below the rounding errors of `dtype` are ignored. None means that two
    samples of a pixel differ.
    """
    sample_albedo = albedo.T
    zeros = sample_albedo.new_zeros(COLORS, len(fragments.pixels))
    # Each pixel gets the albedo of one of its samples. The comparison below shows whether
    # its other samples have the same albedo.
    pixel_albedo = zeros.index_copy(1, fragments.sample_to_pixel, sample_albedo)
    # `gather` takes a third of the time of `index_select` in float64.
    sample_to_pixel = fragments.sample_to_pixel.expand(COLORS, -1)
    difference = (sample_albedo - pixel_albedo.gather(1, sample_to_pixel)).abs_()
    is_equal = difference <= torch.finfo(dtype).eps * sample_albedo
    return pixel_albedo.T if is_equal.all() else None


def _box_filter(
    surface: Surface,
    albedo: Float[Tensor, "S C"] | None,
    basis: Harmonics,
    dtype: torch.dtype,
) -> Float[Tensor, "C K P"]:
    """Compute the transfer matrix of a matte surface under an open sky, without shadows.

    An entry for a pixel and an SH coefficient is the mean of albedo · A_l Y_lm(n) over the samples
    of the pixel (box filter). A_l is the factor of the coefficient in the irradiance
    (`harmonics.lambertian_factors`), Y_lm the harmonic, and n the normal of a sample. Sums are
    computed in float64. An `albedo` of None is 1 in a single channel.
    """
    fragments = surface.fragments
    pixel_count = len(fragments.pixels)
    is_flat = surface.settings.normals == "flat"
    if is_flat:
        # Irradiance of each seen face from a light with a single coefficient of 1: one row for
        # each face, one column for each coefficient.
        face_values = basis.irradiance(surface.face_planes)
        # The value of a pixel is a weighted sum of entries. With flat normals, all samples of
        # the same face in the pixel are one entry.
        entry_to_pixel, entry_to_face, weights = _group_weights(fragments, albedo)
    else:
        # The value of a pixel is a weighted sum of entries. With smooth normals, each sample is
        # an entry.
        entry_to_pixel = fragments.sample_to_pixel
        weights = _sample_weights(fragments, albedo)
    transfer = torch.empty(weights.shape[1], len(basis.nonzero), pixel_count, dtype=dtype)
    entry_starts = _row_starts(torch.bincount(entry_to_pixel, minlength=pixel_count))
    for first_pixel in range(0, pixel_count, BLOCK):
        pixels = slice(first_pixel, first_pixel + BLOCK)
        block_starts = entry_starts[first_pixel : first_pixel + BLOCK + 1]
        entries = slice(int(block_starts[0]), int(block_starts[-1]))
        if is_flat:
            values = face_values
            entry_to_value = entry_to_face[entries]
        else:
            values = basis.irradiance(surface.normals[entries])
            entry_to_value = torch.arange(len(values))
        for channel, channel_weights in zip(transfer, weights[entries].T, strict=True):
            sums = _weighted_row_sums(channel_weights, entry_to_value, block_starts, values)
            channel[:, pixels] = sums.to(dtype).T
    return transfer


def _row_starts(counts: Int[Tensor, " N"]) -> Int[Tensor, " starts"]:
    """Compute where each row begins in a list of the entries of all rows.

    For example, rows with 2 and 3 entries give 0, 2, 5.
    """
    starts = counts.new_zeros(len(counts) + 1)
    torch.cumsum(counts, 0, out=starts[1:])
    return starts


def _weighted_row_sums(
    weights: Float[Tensor, " E"],
    entry_to_value: Int[Tensor, " E"],
    entry_starts: Int[Tensor, " starts"],
    values: Float[Tensor, "M K"],
) -> Float[Tensor, "N K"]:
    """Compute N weighted sums of rows of a matrix.

    Each sum has several entries, and an entry is a weight and a row of the matrix.
    Sum i has the entries from `entry_starts[i]` to `entry_starts[i + 1]` - 1. The first
    entry in `weights` has the number `entry_starts[0]`.
    """
    # The weights become a sparse matrix with one row for each sum and one column for each
    # row of `values`, in the compressed format of SciPy.
    columns = entry_to_value.int().numpy()
    starts = (entry_starts - entry_starts[0]).int().numpy()
    shape = (len(entry_starts) - 1, len(values))
    weight_matrix = csr_array((weights.numpy(), columns, starts), shape=shape)
    return torch.from_numpy(weight_matrix @ values.numpy())


def _group_weights(
    fragments: Fragments, albedo: Float[Tensor, "S C"] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute how much each face that a pixel shows contributes to the mean of the pixel.

    A group is all samples of one face in a pixel. The results are, for each group, the
    index into `fragments.pixels`, the index into `fragments.faces`, and the sum of the
    albedo divided by the number of samples of a pixel.
    """
    if albedo is not None:
        return fragments.merge(albedo)
    groups = fragments.groups
    weights = groups.sample_count.double() / fragments.samples**2
    return groups.group_to_pixel, groups.group_to_seen_face, weights[:, None]


def _sample_weights(
    fragments: Fragments, albedo: Float[Tensor, "S C"] | None
) -> Float[Tensor, "S C"]:
    """Divide the albedo of each sample (1 if None) by the number of samples of a pixel."""
    if albedo is None:
        albedo = torch.ones(1, 1, dtype=torch.float64).expand(len(fragments.sample_to_pixel), 1)
    return albedo / fragments.samples**2


def _glossy_box_filter(
    surface: Surface, gloss: SampleGloss, albedo: Tensor, basis: Harmonics, dtype: torch.dtype
) -> Float[Tensor, "_ K P"]:
    """Compute the transfer matrix of a glossy surface under an open sky, without shadows.

    An albedo of shape (S, 1) means that all colors share a channel. The result then has two
    channels, of which the second is the specular reflection with the color of the light.
    """
    fragments = surface.fragments
    color_count = albedo.shape[1]
    channel_count = 2 if color_count == 1 else color_count
    transfer = torch.zeros(channel_count, basis.size, len(fragments.pixels), dtype=dtype)
    # Index of the channels to which reflection with the color of the light is added: the
    # second one if colors share a channel, and otherwise all.
    white_channels = 1 if color_count == 1 else slice(None)
    weights = albedo / fragments.samples**2
    diffuse_degree = min(basis.degree, harmonics.DIFFUSE_DEGREE)
    pixels_per_block = max(1, GLOSSY_BLOCK // (basis.size * fragments.samples**2))
    for block in _blocks(fragments.sample_to_pixel, transfer, pixels_per_block):
        normals = surface.normals[block.samples]
        to_camera = at_samples(surface.toward, block.samples)
        block_gloss = gloss.at(block.samples)
        # The reflection of metals (colored) is multiplied by the albedo. All other specular
        # reflection (white) has the color of the light.
        colored, white, frame = block_gloss.specular_transfer(normals, to_camera, basis.degree)
        diffuse = _diffuse_transfer(block_gloss, normals, to_camera, diffuse_degree)
        # If all colors share a channel, there is one weight, so the loop leaves out the
        # second channel.
        for channel, weight in zip(block.transfer, weights[block.samples].T, strict=False):
            channel[: diffuse.shape[1]] = block.sum_by_pixel(diffuse * weight[:, None]).to(dtype)
            if colored is not None:
                channel += frame.to_world(block.sum_by_pixel((colored * weight).T))
        white_sums = frame.to_world(block.sum_by_pixel(white.T)) / fragments.samples**2
        block.transfer[white_channels] += white_sums
    return transfer


def _diffuse_transfer(
    gloss: SampleGloss, normals: Float[Tensor, "S 3"], to_camera: Tensor, degree: int
) -> Float[Tensor, "S K"]:
    """Compute the diffuse radiance of S samples with a transparent coat, for an albedo of 1.

    The light passes the coat on its way to the diffuse layer below, and on its way back.
    """
    # Irradiance below the coat: one row for each sample, one column for each coefficient.
    irradiance = harmonics.basis(normals, degree) * gloss.factors_below_coat(degree).T
    return irradiance * gloss.diffuse_factor(normals, to_camera)[:, None]


class _Block(NamedTuple):
    """B successive pixels of a view, with their S samples.

    Attributes:
        samples: Slice that selects these samples from all samples of the view.
        sample_to_pixel: Pixel of each of these samples, counted from the first
            pixel of the block, shape (S,).
        transfer: Columns of the transfer matrix that belong to these pixels, in C
            channels for K coefficients, shape (C, K, B). Writing to this tensor
            fills the matrix.
    """

    samples: slice
    sample_to_pixel: Int[Tensor, " S"]
    transfer: Float[Tensor, "C K B"]

    def sum_by_pixel(self, rows: Float[Tensor, "S K"]) -> Float[Tensor, "K B"]:
        """Add up values over the samples of each pixel."""
        zeros = rows.new_zeros(self.transfer.shape[2], rows.shape[1])
        return zeros.index_add_(0, self.sample_to_pixel, rows).T


def _blocks(
    sample_to_pixel: Int[Tensor, " S"], transfer: Float[Tensor, "C K P"], size: int
) -> Iterator[_Block]:
    """Split the P pixels of a view into blocks of successive pixels.

    `sample_to_pixel` is ascending, and writing to `_Block.transfer` fills `transfer`.
    """
    first_sample = 0
    for first_pixel in range(0, transfer.shape[-1], size):
        end_sample = int(torch.searchsorted(sample_to_pixel, first_pixel + size))
        samples = slice(first_sample, end_sample)
        yield _Block(
            samples=samples,
            sample_to_pixel=sample_to_pixel[samples] - first_pixel,
            transfer=transfer[..., first_pixel : first_pixel + size],
        )
        first_sample = end_sample
