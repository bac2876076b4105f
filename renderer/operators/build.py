"""Computes transfer operators from meshes and cameras: the box filter of matte and glossy surfaces.

Shapes use these letters: a view has S covered samples in P pixels, which show G
faces of the mesh. C is the number of channels, and K that of coefficients of the
light that reach a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from renderer.camera import Camera
from renderer.light import harmonics
from renderer.light.basis import HARMONICS, Basis, Harmonics
from renderer.mesh import Mesh
from renderer.operators.apply import COLORS, SparseTransfer, TransferOperator, concatenate_entries
from renderer.operators.rays import Rays, Surface, local_transfer
from renderer.operators.shadows import Transport, build_transport
from renderer.settings import ImageSettings
from renderer.surface.albedo import shared_albedo, surface_albedo
from renderer.surface.gloss import Gloss, SampleGloss, at_samples
from renderer.visibility import Rasterizer
from renderer.visibility.fragments import build_fragments, split_views, views_at_once

# Devices on which SciPy adds up samples. On a CPU, it takes a tenth of the time of torch.
SCIPY_DEVICES = ("cpu",)
# Number of pixels that `_box_filter` processes at once. Their values fit into the cache of
# the processor.
BLOCK = 2**12
# The transfer of a glossy surface is computed for this many pairs of a sample and an SH
# coefficient at once. It limits the memory.
GLOSSY_BLOCK = 2**20
# A matrix with a smaller fraction of nonzero entries is faster to multiply entry by entry
# than as a dense matrix.
SPARSE_FRACTION = 1 / 16
# A matrix with at most this many entries is always faster to multiply as a dense matrix.
SMALL_MATRIX_SIZE = 2**16


def build_operators(
    mesh: Mesh,
    cameras: Sequence[Camera],
    settings: ImageSettings,
    rasterizer: Rasterizer,
    albedo_scale: float = 1.0,
    basis: Basis = HARMONICS,
    dtype: torch.dtype = torch.float32,
    gloss: Gloss | None = None,
    device: torch.device | str = "cpu",
) -> list[TransferOperator]:
    """Compute the transfer operators of a mesh for several cameras.

    Surfaces are shaded on the side that the camera sees. A `gloss` of None is that of the
    mesh. A GPU computes those without rays, and many of them at once.
    """
    casts_rays = settings.global_illumination or bool(basis.local_lights)
    vertices: Any = mesh.vertices
    if not casts_rays and torch.device(device).type == "cuda":
        vertices = torch.from_numpy(vertices).to(device)
    shown = vertices, mesh.faces, cameras, settings, rasterizer, mesh.closed
    views = build_fragments(*shown, views_at_once(settings, torch.device(device), casts_rays))
    transport = build_transport(mesh, settings, albedo_scale, basis)
    rays = transport.rays if transport else Rays(mesh)
    surfaces = [Surface(mesh, fragments, settings, given_gloss=gloss) for fragments in views]
    built = [_build(surface, albedo_scale, basis, dtype, transport, rays) for surface in surfaces]
    return [operator.to(device) for operators in built for operator in operators]


def _build(
    surface: Surface,
    albedo_scale: float,
    basis: Basis,
    dtype: torch.dtype,
    transport: Transport | None,
    rays: Rays,
) -> list[TransferOperator]:
    """Compute the operator of each view. A transport of None has no shadows and bounces."""
    fragments = surface.fragments
    pixel_count = len(fragments.pixels)
    is_glossy = surface.gloss is not None
    # Three channels are needed if bounced light is colored. They are also needed for a glossy
    # mesh with shadows or local lights, because these add specular reflection, which has no
    # albedo, to the same channel.
    adds_gloss = is_glossy and (transport is not None or bool(basis.local_lights))
    needs_channels = adds_gloss or (transport is not None and transport.has_colored_light)
    albedo, pixel_albedo = _albedo(surface, albedo_scale, dtype, needs_channels)
    # Dense rows of the matrix, shape (C, K, P), after the indices of their coefficients.
    dense: list[tuple[Tensor, Tensor]] = []
    # Rows of the matrix as lists of their nonzero entries.
    sparse: list[SparseTransfer] = []
    for local_rows, local_basis in basis.local_lights:
        entries = local_transfer(rays, surface, albedo, local_basis)
        # Only basis functions that reach a pixel have rows in a dense matrix.
        functions, row_of_entry = entries.function.unique(return_inverse=True)
        dense_size = len(functions) * pixel_count
        if dense_size > SMALL_MATRIX_SIZE and len(entries.weight) < SPARSE_FRACTION * dense_size:
            weight = (entries.weight * pixel_albedo[entries.pixel]).to(dtype)
            # Number of the basis function among those of all lights.
            function = local_rows.start + entries.function
            sparse.append(SparseTransfer(function, entries.pixel, weight))
            continue
        # One row for each channel, which has all rows of the matrix after each other.
        zeros = entries.weight.new_zeros(albedo.shape[1], dense_size)
        flat_position = row_of_entry * pixel_count + entries.pixel
        transfer = zeros.index_copy_(1, flat_position, entries.weight.T).to(dtype)
        transfer = transfer.unflatten(1, (len(functions), pixel_count))
        dense.append((local_rows.start + functions, transfer))
    if basis.environment is not None:
        rows, sky = basis.environment
        coefficients, transfer = _environment_rows(surface, albedo, sky, dtype, transport)
        dense.append((rows.start + coefficients, transfer))
    if len(dense) != 1:
        # The rows of a single light are used as they are, because `cat` copies them.
        # Sort by the first coefficient of each part, and join the parts along the coefficients.
        dense.sort(key=lambda part: part[0][:1].tolist())
        channel_count = 2 if is_glossy and albedo.shape[1] == 1 else albedo.shape[1]
        empty = torch.empty(channel_count, 0, pixel_count, dtype=dtype)
        every = torch.cat([torch.arange(0), *(coefficients for coefficients, _ in dense)])
        dense = [(every, torch.cat([empty, *(transfer for _, transfer in dense)], dim=1))]
    [(nonzero, transfer)] = dense
    in_pixels = transfer, pixel_albedo.T.to(dtype), fragments.coverage.to(dtype)
    views = len(fragments.cameras), surface.settings.pixel_count
    return [
        TransferOperator(
            transfer=transfer,
            albedo=albedo.contiguous(),
            coverage=coverage,
            pixels=pixels,
            nonzero=nonzero.to(transfer.device),
            settings=surface.settings,
            basis=basis,
            sparse=concatenate_entries(sparse) if sparse else None,
        )
        for pixels, transfer, albedo, coverage in split_views(fragments.pixels, *views, *in_pixels)
    ]


def _albedo(
    surface: Surface, albedo_scale: float, dtype: torch.dtype, needs_channels: bool
) -> tuple[Float[Tensor, "S C"], Float[Tensor, "P 3"]]:
    """Choose the albedo that the transfer matrix includes, and that of pixels.

    If all samples of each pixel have the same albedo, the three colors can share one
    channel: the matrix is computed for the albedo 1 (C = 1), and the image is multiplied by
    the albedo of the pixels. Otherwise, the matrix includes the albedo of the samples (C = 3),
    and that of the pixels is 1.
    """
    mesh, fragments = surface.mesh, surface.fragments
    encoding = surface.settings.encoding
    pixel_count = len(fragments.pixels)
    ones = fragments.coverage.new_ones(1, 1).expand(len(fragments.sample_to_pixel), 1)
    color = None if needs_channels else shared_albedo(mesh, fragments, encoding)
    if color is not None:
        return ones, (color * albedo_scale).expand(pixel_count, COLORS)
    albedo = surface_albedo(mesh, fragments, encoding) * albedo_scale
    if not needs_channels:
        # Each pixel gets the albedo of one of its samples. The comparison shows whether its
        # other samples have the same albedo, up to the rounding errors of `dtype`.
        zeros = albedo.T.new_zeros(COLORS, pixel_count)
        pixel_albedo = zeros.index_copy(1, fragments.sample_to_pixel, albedo.T)
        # `gather` takes a third of the time of `index_select` in float64.
        of_samples = pixel_albedo.gather(1, fragments.sample_to_pixel.expand(COLORS, -1))
        if ((albedo.T - of_samples).abs_() <= torch.finfo(dtype).eps * albedo.T).all():
            return ones, pixel_albedo.T
    return albedo, albedo.new_ones(pixel_count, COLORS)


def _environment_rows(
    surface: Surface,
    albedo: Float[Tensor, "S C"],
    basis: Harmonics,
    dtype: torch.dtype,
    transport: Transport | None,
) -> tuple[Int[Tensor, " K"], Float[Tensor, "_ K P"]]:
    """Compute the coefficients and the transfer rows of environment light, shadows and bounces."""
    all_coefficients = torch.arange(basis.size)
    if surface.gloss is None:
        coefficients = basis.nonzero
        transfer = _box_filter(surface, albedo, basis, dtype)
    else:
        coefficients = all_coefficients
        transfer = _glossy_box_filter(surface, surface.gloss, albedo, basis, dtype)
    change = None if transport is None else transport.change(surface, albedo)
    if change is None:
        return coefficients, transfer
    # `change` has a row for every SH coefficient, and `transfer` only for `coefficients`.
    change.index_add_(1, coefficients, transfer.double())
    return all_coefficients, change.to(dtype)


def _box_filter(
    surface: Surface, albedo: Float[Tensor, "S C"], basis: Harmonics, dtype: torch.dtype
) -> Float[Tensor, "C K P"]:
    """Compute the transfer matrix of a matte surface under an open sky, without shadows.

    An entry for a pixel and an SH coefficient is the mean of albedo · A_l Y_lm(n) over the samples
    of the pixel (box filter). A_l is the factor of the coefficient in the irradiance
    (`harmonics.lambertian_factors`), Y_lm the harmonic, and n the normal of a sample. Sums are
    computed in float64. An albedo in a single channel is 1.
    """
    fragments = surface.fragments
    pixel_count = len(fragments.pixels)
    is_flat = surface.settings.normals == "flat"
    # The value of a pixel is a weighted sum of entries. With flat normals, all samples of the
    # same face in the pixel are one entry. With smooth normals, each sample is an entry.
    if is_flat:
        # Irradiance of each seen face from a light with a single coefficient of 1: one row for
        # each face, one column for each coefficient.
        face_values = basis.irradiance(surface.face_planes)
        entry_to_pixel = fragments.groups.group_to_pixel
        entry_to_face = fragments.groups.group_to_seen_face
        if albedo.shape[1] == 1:
            weights = fragments.groups.sample_count.double()[:, None] / fragments.samples**2
        else:
            # Sum of the albedo of the samples of an entry, divided by the samples of a pixel.
            weights = fragments.merge(albedo)
    else:
        entry_to_pixel = fragments.sample_to_pixel
        weights = albedo / fragments.samples**2
    entry_counts = torch.bincount(entry_to_pixel, minlength=pixel_count)
    if fragments.pixels.device.type not in SCIPY_DEVICES:
        values = face_values[entry_to_face] if is_flat else basis.irradiance(surface.normals)
        # The entries of a pixel follow each other, so each sum is over a segment.
        add_up = partial(torch.segment_reduce, reduce="sum", lengths=entry_counts, unsafe=True)
        return torch.stack([add_up(values * weight[:, None]) for weight in weights.T]).mT.to(dtype)
    transfer = torch.empty(weights.shape[1], len(basis.nonzero), pixel_count, dtype=dtype)
    # Pixel i has the entries from `entry_starts[i]` to `entry_starts[i + 1]` - 1.
    entry_starts = F.pad(entry_counts.cumsum(0), (1, 0))
    for first_pixel in range(0, pixel_count, BLOCK):
        starts = entry_starts[first_pixel : first_pixel + BLOCK + 1]
        entries = slice(int(starts[0]), int(starts[-1]))
        if is_flat:
            values = face_values
            entry_to_value = entry_to_face[entries]
        else:
            values = basis.irradiance(surface.normals[entries])
            entry_to_value = torch.arange(len(values))
        # The weights become a sparse matrix with one row for each pixel and one column for each
        # row of `values`, in the compressed format of SciPy.
        columns = entry_to_value.int().numpy()
        row_starts = (starts - starts[0]).int().numpy()
        shape = (len(starts) - 1, len(values))
        for channel, channel_weights in zip(transfer, weights[entries].T, strict=True):
            matrix = csr_array((channel_weights.numpy(), columns, row_starts), shape=shape)
            sums = torch.from_numpy(matrix @ values.numpy())
            channel[:, first_pixel : first_pixel + BLOCK] = sums.to(dtype).T
    return transfer


def _glossy_box_filter(
    surface: Surface, gloss: SampleGloss, albedo: Tensor, basis: Harmonics, dtype: torch.dtype
) -> Float[Tensor, "_ K P"]:
    """Compute the transfer matrix of a glossy surface under an open sky, without shadows.

    An albedo of shape (S, 1) means that all colors share a channel. The result then has two
    channels, of which the second is the specular reflection with the color of the light.
    """
    fragments = surface.fragments
    is_shared = albedo.shape[1] == 1
    shape = 2 if is_shared else COLORS, basis.size, len(fragments.pixels)
    transfer = torch.zeros(shape, dtype=dtype, device=albedo.device)
    # Index of the channels to which reflection with the color of the light is added.
    white_channels = 1 if is_shared else slice(None)
    weights = albedo / fragments.samples**2
    diffuse_degree = min(basis.degree, harmonics.DIFFUSE_DEGREE)
    pixels_per_block = max(1, GLOSSY_BLOCK // (basis.size * fragments.samples**2))
    for first_pixel in range(0, len(fragments.pixels), pixels_per_block):
        # Writing to this view of some columns fills the matrix.
        block_transfer = transfer[..., first_pixel : first_pixel + pixels_per_block]
        block_ends = fragments.pixels.new_tensor([first_pixel, first_pixel + pixels_per_block])
        samples = slice(*torch.searchsorted(fragments.sample_to_pixel, block_ends).tolist())
        pixels = fragments.sample_to_pixel[samples] - first_pixel
        sum_by_pixel = partial(_sum_by_pixel, pixels, block_transfer.shape[2])
        normals = surface.normals[samples]
        to_camera = at_samples(surface.toward, samples)
        block_gloss = gloss.at(samples)
        # The reflection of metals (colored) is multiplied by the albedo. All other specular
        # reflection (white) has the color of the light.
        colored, white, frame = block_gloss.specular_transfer(normals, to_camera, basis.degree)
        # The light passes the coat on its way to the diffuse layer below, and on its way back.
        below_coat = block_gloss.factors_below_coat(diffuse_degree).T
        irradiance = harmonics.basis(normals, diffuse_degree) * below_coat
        diffuse = irradiance * block_gloss.diffuse_factor((normals * to_camera).sum(1))[:, None]
        # If all colors share a channel, there is one weight, so the loop leaves out the
        # second channel.
        for channel, weight in zip(block_transfer, weights[samples].T, strict=False):
            channel[: diffuse.shape[1]] = sum_by_pixel(diffuse * weight[:, None]).to(dtype)
            if colored is not None:
                channel += frame.to_world(sum_by_pixel((colored * weight).T))
        white_sums = frame.to_world(sum_by_pixel(white.T)) / fragments.samples**2
        block_transfer[white_channels] += white_sums
    return transfer


def _sum_by_pixel(
    sample_to_pixel: Int[Tensor, " S"], pixel_count: int, rows: Float[Tensor, "S K"]
) -> Float[Tensor, "K P"]:
    """Add up values over the samples of each pixel."""
    return rows.new_zeros(pixel_count, rows.shape[1]).index_add_(0, sample_to_pixel, rows).T
