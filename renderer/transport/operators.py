"""A scene as a linear operator on its light: (mesh, camera) → T, rasterized once and multiplied for every light.

Before clamping, every pixel is linear in the lighting coefficients U (the paper's appendix B.2):
radiance = Uᵀ T. The box filter, the texture and the albedo fold into T exactly, and so do gloss
(`renderer.surface.gloss`), shadows and bounces (package `renderer.transport`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

from renderer.camera import Camera
from renderer.errors import LARGEST, InputError, as_device, require_bounded
from renderer.geometry.mesh import Mesh
from renderer.image import as_background, background_term, composite, encode, encode_gradient
from renderer.light import harmonics
from renderer.light.basis import HARMONICS, Basis, EnvironmentPart, Harmonics, LocalPart
from renderer.settings import ImageSettings
from renderer.surface.albedo import shared_albedo, surface_albedo
from renderer.surface.gloss import Gloss, SampleGloss, at_samples
from renderer.transport.lamp_paths import SparseTransfer, joined, local_transfer
from renderer.transport.precomputed import Transport, build_transport
from renderer.transport.rays import Rays, Surface
from renderer.validation import as_tensor
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import Rasterizer

if TYPE_CHECKING:
    from jaxtyping import Float, Int

TENSORS = ("transfer", "albedo", "coverage", "pixels", "nonzero")  # of a TransferOperator
BLOCK = 2**12  # So many pixels are filtered at a time, whose sums stay in the processor's cache.
GLOSSY = 2**20  # coefficients of samples with gloss at a time, of which more numbers are computed


@dataclass(frozen=True)
class TransferOperator:
    """The transfer matrix of one (mesh, view): linear radiance per unit light, weighted with coverage. Of one dtype.

    transfer: three channels of K nonzero coefficients and P covered pixels; or one, a third of the size and the time,
    where no pixel mixes albedos (one sample per pixel, or a mesh of one color). With gloss, that one is followed by
    white light, which is added to all channels.
    albedo: multiplies the one channel; ones where there are three.
    coverage: in (0, 1], the fraction of a pixel's samples that the mesh covers.
    pixels: row-major indices of the covered pixels; row 0 is the top of the image.
    nonzero: ascending indices of the coefficients that reach a pixel: of harmonics of degree 6, 31 of the 49
    under an open sky (`Harmonics.nonzero`), and all in a view with shadows or gloss.
    settings: of the image. basis: of the lights.
    sparse: of three channels, added to the dense transfer: that of patterns, most of whose entries are zero; or None.

    >>> [operator] = renderer.precompute_transfer(renderer.solid("pear"), renderer.orbit_cameras(1, 2.2), size=16)
    >>> light = renderer.load_light("grace")
    >>> torch.allclose(operator.radiance(2 * light), 2 * operator.radiance(light))  # linear, before clamping
    True
    """

    transfer: Float[Tensor, "channels K P"]
    albedo: Float[Tensor, "3 P"]
    coverage: Float[Tensor, " P"]
    pixels: Int[Tensor, " P"]
    nonzero: Int[Tensor, " K"]
    settings: ImageSettings
    basis: Basis = HARMONICS
    sparse: SparseTransfer | None = None

    def image(
        self, lights: Float[Tensor, "*lights coefficients 3"], background: float | Tensor = 0.5
    ) -> Float[Tensor, "*lights 3 size size"]:
        """Render images under B lights, differentiable in the lights and in the background.

        Args:
            lights: Coefficients of the operator's basis, shape (*B, coefficients, 3).
            background: Gray value, color or images in [0, 1]; see `renderer.image.as_background`.

        Returns:
            Images in [0, 1], shape (*B, 3, size, size), of the dtype of the lights.

        Raises:
            InputError: If the lights hold NaN or are of another basis, or the background has another shape.
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        if isinstance(background, Tensor) and background.requires_grad:
            behind = as_background(background, self.settings.size, lights)
            coverage = self.coverage.to(lights)
            return composite(self.radiance(lights), coverage, self.pixels, behind, self.settings.encoding)
        return _Image.apply(lights, self, self._behind(background, lights))

    def image_and_gradient(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        loss_gradient: Callable[[Tensor], Tensor],
        background: float | Tensor = 0.5,
    ) -> tuple[Float[Tensor, "*lights 3 size size"], Float[Tensor, "*lights coefficients 3"]]:
        """Render images under B lights and compute the gradient of a loss by the lights, without autograd.

        The results equal those of `image` and `torch.autograd.grad` to the bit. In small images, autograd takes most
        of the time of a step.

        Args:
            lights: Coefficients of the operator's basis, shape (*B, coefficients, 3).
            loss_gradient: Function of the images (*B, 3, size, size) that returns the gradient of the loss by them, of
                the same shape. `torch.func.grad(loss)` makes one from a loss.
            background: Gray value, color or images in [0, 1]; see `renderer.image.as_background`.

        Returns:
            The images in [0, 1], shape (*B, 3, size, size), and the gradient of the loss by the lights.

        Raises:
            InputError: If lights, background or the gradient of the loss hold NaN or have another shape.

        >>> [operator] = renderer.precompute_transfer(renderer.solid("pear"), renderer.orbit_cameras(1, 2.2), size=16)
        >>> light, target = renderer.load_light("grace"), torch.zeros(3, 16, 16)
        >>> image, gradient = operator.image_and_gradient(light, lambda image: 2 * (image - target))
        >>> image.shape, gradient.shape
        (torch.Size([3, 16, 16]), torch.Size([49, 3]))
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        lights = lights.detach()
        if isinstance(background, Tensor):
            background = background.detach()
        images, passing, clamped = self._images(lights, self._behind(background, lights))
        image_gradient = loss_gradient(images)
        require_image_gradient(image_gradient, images)
        return images, self._gradient_of_images(image_gradient.detach(), passing, clamped)

    def radiance(self, lights: Float[Tensor, "*lights coefficients 3"]) -> Float[Tensor, "*lights 3 P"]:
        """Linear radiance; differentiable, by `light_gradient`.

        Computed in the operator's dtype, returned in the lights'. InputError: NaN, or lights of another basis' size.
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        return _Radiance.apply(lights, self)

    def light_gradient(
        self, radiance_gradient: Float[Tensor, "*lights 3 P"]
    ) -> Float[Tensor, "*lights coefficients 3"]:
        """∂C/∂U = T ∂C/∂radiance, without a graph.

        Exactly zero for the coefficients that reach no pixel. InputError: NaN.
        """
        radiance_gradient = as_tensor("radiance_gradient", radiance_gradient)
        require_bounded(radiance_gradient=radiance_gradient)
        if radiance_gradient.shape[-2:] != self.albedo.shape:
            shape, expected = tuple(radiance_gradient.shape), tuple(self.albedo.shape)
            raise InputError(f"radiance_gradient of shape {shape} is not of the operator's pixels: give {expected}")
        return self._light_gradient(radiance_gradient)

    def _images(self, lights: Tensor, behind: _Behind) -> tuple[Tensor, Tensor, Tensor]:
        """Render without a graph.

        Returns:
            The images (*B, 3, size, size), where the clamp lets the gradient pass (*B, 3, P), as ones and zeros, and
            the clamped linear values (*B, 3, P).
        """
        unclamped = self._radiance(lights).add_(behind.at_pixels)
        clamped = unclamped.clamp(0, 1)
        # At the bounds themselves the gradient passes, as in `renderer.image.clamp`.
        passing = unclamped.eq_(clamped)
        rows, everywhere, shape = self._pixel_rows, behind.everywhere, self._image_shape
        if lights.ndim > 2:
            lit = lights.shape[:-2]
            rows, everywhere, shape = rows.expand(*lit, -1, -1), everywhere.expand(*lit, -1, -1), (*lit, *shape)
        images = everywhere.clone(memory_format=torch.contiguous_format)
        # On a CPU, index_copy_ takes twice as long as scatter_.
        images.scatter_(-1, rows, clamped if self._is_linear else encode(clamped, self.settings.encoding))
        return images.view(shape), passing, clamped

    def _gradient_of_images(self, image_gradient: Tensor, passing: Tensor, clamped: Tensor) -> Tensor:
        """Compute the gradient by the lights from that by the images (*B, 3, size, size) of `_images`."""
        # From two axes, torch selects ten times as fast as from three.
        by_channel = image_gradient.reshape(-1, self._image_shape[1] * self._image_shape[2])
        covered = by_channel.index_select(1, self.pixels)
        if passing.ndim > 2:
            covered = covered.view(passing.shape)
        if not self._is_linear:
            covered = encode_gradient(clamped, covered, self.settings.encoding)
        gradient = self._light_gradient(covered.mul_(passing))
        if not math.isfinite(gradient.sum().item()):  # a sum takes less time than the largest of all pixels
            require_bounded(image_gradient=covered)
        return gradient

    def require_lights(self, lights: Tensor) -> None:
        """Raise InputError if the lights hold NaN or are of another basis."""
        if not lights.is_floating_point():
            require_bounded(lights=lights)
        if lights.shape[-2:] != self._light_shape:
            shape, size = tuple(lights.shape), self.basis.size
            raise InputError(f"lights of shape {shape} are not of the operator's {self.basis}: give {size} rows")
        # In small images this takes half the time of `require_bounded`, which finds and names the fault.
        values = lights.detach().reshape(-1)
        if not torch.dot(values, values).item() <= LARGEST**2:
            require_bounded(lights=lights)

    def _radiance(self, lights: Tensor) -> Tensor:
        """Compute the radiance (*B, 3, P) without a graph, in a new tensor of the dtype of the lights."""
        dtype = self.transfer.dtype
        nonzero = lights.index_select(-2, self.nonzero)
        if lights.dtype != dtype:  # in small images, a call that converts nothing counts, too
            nonzero = nonzero.to(dtype)
        if self._shared is not None:
            product = (nonzero.mT @ self._shared).mul_(self.albedo)
            if self._white is not None:
                product.add_(nonzero.mT @ self._white)
        else:
            product = torch.einsum("...kc,ckp->...cp", nonzero, self.transfer)
        if self.sparse is not None:
            arriving = lights.to(product.dtype).index_select(-2, self.sparse.function) * self.sparse.weight
            product = product.index_add(-1, self.sparse.pixel, arriving.mT)
        return product if lights.dtype == dtype else product.to(lights.dtype)

    def _light_gradient(self, radiance_gradient: Tensor) -> Tensor:
        """Compute `light_gradient` of values that may hold NaN."""
        upstream, dtype = radiance_gradient, self.transfer.dtype
        if upstream.dtype != dtype:
            upstream = upstream.to(dtype)
        if self._shared is not None:
            product = linear(upstream * self.albedo, self._shared)
            if self._white is not None:
                product = product + linear(upstream, self._white)
        else:
            product = torch.einsum("...cp,ckp->...ck", upstream, self.transfer)
        gradient = self._scatter @ product.mT
        if self.sparse is not None:
            arriving = upstream.mT.index_select(-2, self.sparse.pixel) * self.sparse.weight
            gradient = gradient.index_add(-2, self.sparse.function, arriving)
        return gradient if dtype == radiance_gradient.dtype else gradient.to(radiance_gradient.dtype)

    def _behind(self, background: float | Tensor, lights: Tensor) -> _Behind:
        """Prepare a background for lights; that of a gray value behind one light is kept for the next call."""
        if not isinstance(background, float | int) or lights.ndim > 2:
            return self._behind_surface(as_background(background, self.settings.size, lights), lights)
        key = (background, lights.dtype, lights.device)
        if self._kept_behind.get("key") != key:
            behind = self._behind_surface(as_background(background, self.settings.size, lights), lights)
            self._kept_behind.update(key=key, behind=behind)
        return self._kept_behind["behind"]

    def _behind_surface(self, images: Tensor, lights: Tensor) -> _Behind:
        """Prepare images (*B, 3, size, size) that lie behind the surface under lights (*B, coefficients, 3)."""
        everywhere = images.flatten(-2)
        at_pixels = everywhere.index_select(-1, self.pixels)
        if self.settings.encoding != "linear":
            # The last bit of a power depends on the position in memory, so it is computed for each light.
            at_pixels = at_pixels.expand(*lights.shape[:-2], *at_pixels.shape[-2:]).contiguous()
        return _Behind(everywhere, background_term(self.coverage.to(images)[None], at_pixels, self.settings.encoding))

    def to(self, device: torch.device | str) -> TransferOperator:
        """The same on another device."""
        device = as_device(device)
        if device == self.transfer.device:
            return self
        sparse = self.sparse and self.sparse.to(device)
        return replace(self, **{name: getattr(self, name).to(device) for name in TENSORS}, sparse=sparse)

    @property
    def by_channel(self) -> Tensor:
        """(3, K, P): the transfer of three channels, with their albedo."""
        if self._shared is None:
            return self.transfer
        colored = self._shared * self.albedo[:, None]
        return colored if self._white is None else colored + self._white

    # Cached, since at 32² even an index or a comparison of dtypes counts.

    @cached_property
    def _shared(self) -> Tensor | None:
        """(K, P), where the channels share it."""
        return self.transfer[0] if len(self.transfer) < 3 else None

    @cached_property
    def _white(self) -> Tensor | None:
        """(K, P), added to the product of albedo and what the channels share."""
        return self.transfer[1] if len(self.transfer) == 2 else None

    @cached_property
    def _kept_behind(self) -> dict[str, Any]:
        """The background of the last call of `image` with a gray value, and the key that it is kept for."""
        return {}

    @cached_property
    def _is_linear(self) -> bool:
        """Whether image values are not encoded."""
        return self.settings.encoding == "linear"

    @cached_property
    def _image_shape(self) -> tuple[int, int, int]:
        """(3, size, size): the shape of one image."""
        return 3, self.settings.size, self.settings.size

    @cached_property
    def _light_shape(self) -> tuple[int, int]:
        """(coefficients, 3): the shape of one light."""
        return self.basis.size, 3

    @cached_property
    def _pixel_rows(self) -> Tensor:
        """(3, P): the covered pixels, for each channel."""
        return self.pixels.expand(3, -1)

    @cached_property
    def _scatter(self) -> Tensor:
        """(size, K): scatters the nonzero coefficients among all, with exact zeros elsewhere."""
        return torch.eye(self.basis.size).to(self.transfer)[:, self.nonzero]


class _Behind(NamedTuple):
    """A background (*B, 3, size²), and what it adds to the radiance of the covered pixels (*B, 3, P)."""

    everywhere: Tensor
    at_pixels: Tensor


class _Radiance(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lights: Tensor, operator: TransferOperator) -> Tensor:
        ctx.operator = operator
        return operator._radiance(lights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        return ctx.operator.light_gradient(upstream), None


class _Image(torch.autograd.Function):
    """Lights (*B, coefficients, 3) to images (*B, 3, size, size), in one node of autograd, since each costs time."""

    @staticmethod
    def forward(ctx: Any, lights: Tensor, operator: TransferOperator, behind: _Behind) -> Tensor:
        images, passing, clamped = operator._images(lights, behind)
        ctx.operator, ctx.passing, ctx.clamped = operator, passing, clamped
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        return ctx.operator._gradient_of_images(upstream, ctx.passing, ctx.clamped), None, None


def require_image_gradient(image_gradient: Tensor, images: Tensor) -> None:
    """Raise InputError unless the gradient of a loss by images has their shape."""
    if not isinstance(image_gradient, Tensor) or image_gradient.shape != images.shape:
        given = tuple(image_gradient.shape) if isinstance(image_gradient, Tensor) else type(image_gradient).__name__
        raise InputError(f"loss_gradient returned {given}: return a tensor of the images' shape {tuple(images.shape)}")


def apply_transfer(lights: Tensor, transfer: Tensor, albedo: Tensor) -> Tensor:
    """Radiance (..., B, 3, P) of B lights (..., B, K, 3) under transfer (..., C, K, P), C = 1 to 3, and albedo
    (..., 3, P), as of a `TransferOperator`. The light comes first in the product: on a CPU that is several times
    faster."""
    if transfer.shape[-3] == 3:
        return (lights.movedim(-1, -3) @ transfer).movedim(-3, -2)
    shared, *white = transfer.unbind(-3)
    by_light = lights.mT.flatten(-3, -2)
    product = (by_light @ shared).unflatten(-2, (-1, 3)) * albedo.unsqueeze(-3)
    return product + (by_light @ white[0]).unflatten(-2, (-1, 3)) if white else product


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
    """Compute one operator per camera, for lights of one basis.

    Surfaces shade on the side that the camera sees.

    Args:
        mesh: The mesh.
        cameras: The cameras.
        settings: Settings of the images.
        rasterizer: What finds the visible faces.
        albedo_scale: Factor of the albedo, for meshes whose texture is darker than
            the thing.
        basis: Basis of the lights.
        dtype: Of the operators, which are computed in float64.
        gloss: Gloss instead of the mesh's.

    Returns:
        The operators, in the order of the cameras.

    Raises:
        InputError: If local lights are to bounce, or the scale is not finite.
    """
    require_bounded(albedo_scale=torch.tensor(float(albedo_scale)))
    views = build_fragments(mesh.vertices, mesh.faces, cameras, settings, rasterizer, closed=mesh.closed)
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
    """How the channels of a view's transfer are laid out, and where the albedo is.

    Attributes:
        number: 3 if each color has a channel. 1 if the colors share a channel, and
            2 if white light of the gloss follows it.
        is_shared: Whether the colors share a channel.
        sample_albedo: Albedo that is folded into the transfer, shape (S, 3), or
            ones (S, 1) if the colors share a channel.
        pixel_albedo: Albedo that multiplies a shared channel, shape (P, 3), or
            ones.
    """

    number: int
    is_shared: bool
    sample_albedo: Tensor
    pixel_albedo: Tensor


class _DenseRows(NamedTuple):
    """Rows of a transfer matrix.

    Attributes:
        transfer: Radiance per unit of K coefficients, shape (C, K, P).
        coefficients: Indices of these coefficients in the light, shape (K,).
    """

    transfer: Tensor
    coefficients: Tensor


@dataclass(frozen=True)
class _OperatorBuilder:
    """Computes the operators of one mesh, view by view.

    Attributes:
        mesh: The mesh.
        settings: Settings of the images.
        albedo_scale: Factor of the albedo.
        basis: Basis of the lights.
        dtype: Of the operators.
        gloss: Gloss instead of the mesh's, or None.
        transport: Shadows and bounces of environment light, None without them.
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
        dense = []
        sparse = []
        for part in self.basis.local_lights:
            entries = self._local_entries(part, surface, channels)
            if entries.few(len(fragments.pixels)):
                sparse.append(self._sparse_rows(part, entries, channels))
            else:
                dense.append(self._local_rows(part, entries, surface))
        if self.basis.environment is not None:
            dense.append(self._environment_rows(self.basis.environment, surface, channels))
        joined_rows = self._join(dense, channels.number, len(fragments.pixels))
        return TransferOperator(
            transfer=joined_rows.transfer,
            albedo=channels.pixel_albedo.T.to(self.dtype).contiguous(),
            coverage=fragments.coverage.to(self.dtype),
            pixels=fragments.pixels,
            nonzero=joined_rows.coefficients,
            settings=self.settings,
            basis=self.basis,
            sparse=joined(sparse),
        )

    def _channels(self, surface: Surface) -> _Channels:
        """Choose the layout with the fewest channels that is exact."""
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
            return _Channels(3, False, sample_albedo, torch.ones(pixel_count, 3))
        # The albedo multiplies whole pixels, so that the samples have 1.
        ones = torch.ones(1, 1, dtype=torch.float64).expand(len(fragments.pixel), 1)
        return _Channels(2 if is_glossy else 1, True, ones, pixel_albedo)

    def _needs_three_channels(self, is_glossy: bool) -> bool:
        """Return whether light takes on color in a way that no factor per pixel expresses.

        Bounced light may have another color than the sky's. Shadows and local
        lights compute gloss in the channels of the albedo.
        """
        if self.transport is not None and self.transport.colors:
            return True
        return is_glossy and (self.transport is not None or bool(self.basis.local_lights))

    def _surface_albedo(self, fragments: Fragments) -> Tensor:
        """Return the scaled albedo (S, 3) at the samples."""
        return surface_albedo(self.mesh, fragments, self.settings.encoding) * self.albedo_scale

    def _environment_rows(self, part: EnvironmentPart, surface: Surface, channels: _Channels) -> _DenseRows:
        """Compute the rows of environment light, with shadows and bounces."""
        harmonics_basis = part.basis
        everything = torch.arange(harmonics_basis.size)
        if surface.gloss is None:
            weights = None if channels.is_shared else channels.sample_albedo
            transfer = _box_filter(surface, weights, harmonics_basis, self.dtype)
            coefficients = harmonics_basis.nonzero
        else:
            albedo = channels.sample_albedo
            transfer = _glossy_box_filter(surface, surface.gloss, albedo, harmonics_basis, self.dtype)
            coefficients = everything
        change = None
        if self.transport is not None:
            change = self.transport.change(surface, channels.sample_albedo)
        if change is not None:
            transfer = change.index_add_(1, coefficients, transfer.double())
            coefficients = everything
        return _DenseRows(transfer.to(self.dtype), part.rows.start + coefficients)

    def _local_entries(self, part: LocalPart, surface: Surface, channels: _Channels) -> SparseTransfer:
        """Compute the nonzero entries of a local light."""
        return local_transfer(self.rays, surface, channels.sample_albedo, part.basis)

    def _local_rows(self, part: LocalPart, entries: SparseTransfer, surface: Surface) -> _DenseRows:
        """Write the entries of a local light as rows."""
        transfer, coefficients = entries.dense(len(surface.fragments.pixels))
        return _DenseRows(transfer.to(self.dtype), part.rows.start + coefficients)

    def _sparse_rows(self, part: LocalPart, entries: SparseTransfer, channels: _Channels) -> SparseTransfer:
        """Return the entries of a local light in three channels, with their albedo."""
        weight = (entries.weight * channels.pixel_albedo[entries.pixel]).to(self.dtype)
        return SparseTransfer(part.rows.start + entries.function, entries.pixel, weight)

    def _join(self, parts: list[_DenseRows], channel_count: int, pixel_count: int) -> _DenseRows:
        """Join rows in the order of their coefficients."""
        if len(parts) == 1:  # There is nothing to join, so that nothing is copied.
            return parts[0]
        empty = torch.empty(channel_count, 0, pixel_count, dtype=self.dtype)
        ordered = sorted(parts, key=_first_coefficient)
        transfer = torch.cat([empty, *(part.transfer for part in ordered)], dim=1)
        coefficients = [torch.arange(0), *(part.coefficients for part in ordered)]
        return _DenseRows(transfer, torch.cat(coefficients))


def _first_coefficient(rows: _DenseRows) -> int:
    """Return the index of the first coefficient, 0 for none."""
    return int(rows.coefficients[0]) if len(rows.coefficients) else 0


def _pixel_albedo(fragments: Fragments, albedo: Tensor, dtype: torch.dtype) -> Tensor | None:
    """Return the albedo (P, 3) of each pixel if its samples' (S, 3) agree to the dtype's rounding, else None."""
    by_channel = albedo.T  # Each row holds one channel and is contiguous.
    by_pixel = by_channel.new_zeros(3, len(fragments.pixels)).index_copy(1, fragments.pixel, by_channel)
    # In float64, index_select takes three times as long.
    at_samples = by_pixel.gather(1, fragments.pixel.expand(3, -1))
    spread = (by_channel - at_samples).abs_()
    agrees = spread <= torch.finfo(dtype).eps * by_channel
    return by_pixel.T if agrees.all() else None


def _box_filter(surface: Surface, albedo: Tensor | None, basis: Harmonics, dtype: torch.dtype) -> Tensor:
    """Sum albedo × A_l Y_lm(n) over each pixel's samples, in float64.

    Args:
        surface: Normals at the S samples of a view, in P pixels.
        albedo: Linear (S, C) at the samples. None stands for 1 in a single channel.
        basis: The K nonzero functions A_l Y_lm.
        dtype: Of the result.

    Returns:
        (C, K, P).
    """
    fragments = surface.fragments
    pixel_count = len(fragments.pixels)
    by_face = surface.settings.normals == "flat"
    if by_face:
        face_harmonics = basis.irradiance(surface.face_planes)
        if albedo is None and _mostly_filled(fragments):
            return _copied_from_faces(fragments, face_harmonics, dtype)
        pixel, face, weights = _face_weights(fragments, albedo)
    else:
        pixel, weights = fragments.pixel, _sample_weights(fragments, albedo)
    filtered = torch.empty(weights.shape[1], len(basis.nonzero), pixel_count, dtype=dtype)
    row_starts = _row_starts(torch.bincount(pixel, minlength=pixel_count))
    for first in range(0, pixel_count, BLOCK):
        rows = row_starts[first : first + BLOCK + 1]
        entries = slice(int(rows[0]), int(rows[-1]))
        if by_face:
            column, harmonics = face[entries], face_harmonics
        else:
            harmonics = basis.irradiance(surface.normals[entries])
            column = torch.arange(len(harmonics))
        for channel, weight in zip(filtered, weights[entries].T, strict=True):
            sums = _row_sums(weight, column, rows, harmonics)
            channel[:, first : first + BLOCK] = sums.to(dtype).T
    return filtered


def _mostly_filled(fragments: Fragments) -> bool:
    """Return whether a single face fills most pixels."""
    filled = fragments.runs.sample_count == fragments.samples**2
    return 2 * int(filled.sum()) > len(fragments.pixels)


def _copied_from_faces(fragments: Fragments, face_harmonics: Tensor, dtype: torch.dtype) -> Tensor:
    """Return `_box_filter` (1, K, P) of G faces of albedo 1 that have the values (G, K).

    A pixel that one face fills has the values of this face, which are copied. Only the
    other pixels are summed.
    """
    pixel, face, sample_count = fragments.runs
    run_count = torch.bincount(pixel, minlength=len(fragments.pixels))
    first_run = _row_starts(run_count)[:-1]
    positive_zero = face_harmonics + 0.0  # A sum is never −0.0, so a copy must not be, either.
    by_function = positive_zero.T.to(dtype).contiguous()
    filtered = by_function.index_select(1, face.index_select(0, first_run))
    is_partial = sample_count < fragments.samples**2
    partial_runs = _indices(is_partial)
    partial_face = face.index_select(0, partial_runs)
    partial_weight = sample_count.index_select(0, partial_runs).double() / fragments.samples**2
    summed_pixels = _indices(is_partial.index_select(0, first_run))
    row_starts = _row_starts(run_count.index_select(0, summed_pixels))
    for first in range(0, len(summed_pixels), BLOCK):
        rows = row_starts[first : first + BLOCK + 1]
        entries = slice(int(rows[0]), int(rows[-1]))
        sums = _row_sums(partial_weight[entries], partial_face[entries], rows, face_harmonics)
        of_block = summed_pixels[first : first + BLOCK].expand(len(filtered), -1)
        filtered.scatter_(1, of_block, sums.to(dtype).T.contiguous())
    return filtered[None]


def _indices(is_chosen: Tensor) -> Tensor:
    """Return where a mask (N,) is true: NumPy takes a quarter of the time of torch."""
    return torch.from_numpy(np.flatnonzero(is_chosen.numpy()))


def _row_starts(counts: Tensor) -> Tensor:
    """Return where rows of these lengths (N,) begin, and where the last ends (N + 1,)."""
    starts = counts.new_zeros(len(counts) + 1)
    torch.cumsum(counts, 0, out=starts[1:])
    return starts


def _row_sums(weight: Tensor, column: Tensor, row_starts: Tensor, values: Tensor) -> Tensor:
    """Sum weighted rows of values.

    Args:
        weight: Of each entry (E,).
        column: The row of `values` that each entry weights (E,).
        row_starts: Where the entries of N sums begin, and where the last ends (N + 1,).
        values: (M, K).

    Returns:
        The sums (N, K).
    """
    # The weights are a sparse matrix in compressed rows.
    compressed = column.int().numpy(), (row_starts - row_starts[0]).int().numpy()
    shape = (len(row_starts) - 1, len(values))
    return torch.from_numpy(csr_array((weight.numpy(), *compressed), shape=shape) @ values.numpy())


def _face_weights(fragments: Fragments, albedo: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pixel (R,), the face (R,) and the summed weight (R, C) of each run of samples of one face."""
    if albedo is not None:
        return fragments.merge(albedo)
    runs = fragments.runs
    return runs.pixel, runs.face, (runs.sample_count.double() / fragments.samples**2)[:, None]


def _sample_weights(fragments: Fragments, albedo: Tensor | None) -> Tensor:
    """Return the weight (S, C) of each sample in its pixel."""
    if albedo is None:
        albedo = torch.ones(1, 1, dtype=torch.float64).expand(len(fragments.pixel), 1)
    return albedo / fragments.samples**2


def _glossy_box_filter(
    surface: Surface, gloss: SampleGloss, albedo: Tensor, basis: Harmonics, dtype: torch.dtype
) -> Tensor:
    """`_box_filter` (C, K, P) with what gloss adds, for all K coefficients. One channel is followed by white."""
    fragments, colors = surface.fragments, albedo.shape[1]
    filtered = torch.zeros(colors + (colors == 1), basis.size, len(fragments.pixels), dtype=dtype)
    weights, degree = albedo / fragments.samples**2, min(basis.degree, harmonics.DIFFUSE_DEGREE)
    pixels_at_once = max(1, GLOSSY // (basis.size * fragments.samples**2))
    for some, at, block in _blocks(fragments.pixel, filtered, pixels_at_once):
        seen, pixels = (surface.normals[some], at_samples(surface.toward, some)), block.shape[2]
        part = gloss.at(some)
        colored, white, frame = part.transfer(*seen, basis.degree)
        rows = harmonics.basis(seen[0], degree) * part.entering_bands(degree).T * part.diffuse(*seen)[:, None]
        for channel, weight in zip(block, weights[some].T, strict=False):
            channel[: rows.shape[1]] = _over_pixels(rows * weight[:, None], at, pixels).to(dtype)
            if colored is not None:
                channel += frame.to_world(_over_pixels((colored * weight).T, at, pixels))
        shine = frame.to_world(_over_pixels(white.T, at, pixels)) / fragments.samples**2
        block[1 if colors == 1 else slice(None)] += shine
    return filtered


def _blocks(pixel: Tensor, filtered: Tensor, size: int) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """The samples of so many pixels at a time, their pixels counted from the first, and the part of (..., P) to
    fill."""
    starts = torch.arange(0, filtered.shape[-1], size)
    ends = torch.searchsorted(pixel, starts + size).tolist()
    for first, begin, end in zip(starts.tolist(), [0, *ends], ends, strict=False):
        yield slice(begin, end), pixel[begin:end] - first, filtered[..., first : first + size]


def _over_pixels(rows: Tensor, at: Tensor, pixels: int) -> Tensor:
    """(K, pixels): rows (S, K) summed by pixel."""
    return rows.new_zeros(pixels, rows.shape[1]).index_add_(0, at, rows).T
