"""A view of a mesh as a linear operator on its light.

Before clamping, the radiance of every pixel is linear in the coefficients U of
the light (the paper's appendix B.2): radiance = Uᵀ T. The transfer matrix T is
computed once for a mesh and a camera, and multiplied with every light. T
contains the box filter, the texture and the albedo exactly. It also contains
gloss (`renderer.shading.gloss`), and shadows and bounces (the package
`renderer.transport`).

Shapes use these letters: an operator has P covered pixels and K coefficients
that reach a pixel, and ... are any dimensions of a batch of lights.
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
from renderer.errors import MAX_MAGNITUDE, InputError, as_device, require_bounded
from renderer.geometry.mesh import Mesh
from renderer.image import as_background, background_term, composite, encode, encode_gradient
from renderer.light import harmonics
from renderer.light.basis import HARMONICS, Basis, EnvironmentPart, Harmonics, LocalPart
from renderer.settings import ImageSettings
from renderer.shading.gloss import Gloss, SampleGloss, at_samples
from renderer.surface.albedo import shared_albedo, surface_albedo
from renderer.transport.lamp_paths import SparseTransfer, concatenate_entries, local_transfer
from renderer.transport.precomputed import Transport, build_transport
from renderer.transport.rays import Rays, Surface
from renderer.validation import as_tensor
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import Rasterizer

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Fields of a `TransferOperator` that are moved to another device.
TENSORS = ("transfer", "albedo", "coverage", "pixels", "nonzero")
# `_box_filter` sums as many pixels at a time, whose sums stay in the CPU cache.
BLOCK = 2**12
# `_glossy_box_filter` computes as many coefficients of samples at a time. They
# need several times as many numbers.
GLOSSY = 2**20
COLORS = 3
# An operator multiplies equal pixels once if this saves at least so many. In smaller
# images, copying the pixels takes more time than the product.
FEWEST_SAVED_PIXELS = 2**12


@dataclass(frozen=True)
class TransferOperator:
    """The transfer matrix of a view of a mesh.

    It maps the coefficients of a light to the linear radiance of the covered
    pixels, weighted with coverage. All floating tensors have one dtype.

    Attributes:
        transfer: Radiance per unit of each coefficient, shape (channels, K, P).
            Usually, there are 3 channels. There is 1 channel, which takes a
            third of the memory and the time, if no pixel mixes albedos (one
            sample per pixel, or a mesh of one color). With gloss, the 1 channel
            is followed by a second one of white light, which is added to all
            colors.
        albedo: Factor of the first channel if colors share it, shape (3, P).
            Ones if there are 3 channels.
        coverage: Fraction of the samples of each pixel that show the mesh, in
            (0, 1], shape (P,).
        pixels: Row-major indices of the covered pixels, shape (P,). Row 0 is the
            top of the image.
        nonzero: Ascending indices of the coefficients that reach a pixel, shape
            (K,). At degree 6 these are 31 of the 49 under an open sky
            (`Harmonics.nonzero`), and all 49 with shadows or gloss.
        settings: Settings of the image.
        basis: Basis of the lights.
        sparse: Entries in three channels that are added to the dense transfer.
            They are those of projected patterns, which are mostly zero. None
            without such entries.
        distinct: Pixels that differ, so that equal pixels are multiplied once.
            None if most pixels differ.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> camera = nb.OrthographicCamera(polar=60.0, azimuth=0.0, width=2.2)
        >>> operator = nb.precompute_transfer(nb.solid("pear"), camera, size=16)
        >>> light = nb.load_light("grace")
        >>> twice = operator.radiance(2 * light)  # Before clamping, this is linear.
        >>> torch.allclose(twice, 2 * operator.radiance(light))
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
    distinct: DistinctPixels | None = None

    def image(
        self, lights: Float[Tensor, "*lights coefficients 3"], background: float | Tensor = 0.5
    ) -> Float[Tensor, "*lights 3 size size"]:
        """Render images under B lights, differentiable in the lights and in the background.

        Args:
            lights: Coefficients of the operator's basis, shape
                (..., coefficients, 3).
            background: Gray value, color or images in [0, 1]. See
                `renderer.image.as_background`.

        Returns:
            Images in [0, 1], shape (..., 3, size, size), in the dtype of the
            lights.

        Raises:
            InputError: If the lights hold NaN or have another basis, or the
                background has another shape.
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        if isinstance(background, Tensor) and background.requires_grad:
            images = as_background(background, self.settings.size, lights)
            coverage = self.coverage.to(lights)
            radiance = self.radiance(lights)
            return composite(radiance, coverage, self.pixels, images, self.settings.encoding)
        return _Image.apply(lights, self, self._prepare_background(background, lights))

    def image_and_gradient(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        loss_gradient: Callable[[Tensor], Tensor],
        background: float | Tensor = 0.5,
    ) -> tuple[Float[Tensor, "*lights 3 size size"], Float[Tensor, "*lights coefficients 3"]]:
        """Render images under B lights and compute the gradient of a loss, without autograd.

        The results equal those of `image` and `torch.autograd.grad` to the bit.
        For small images, autograd would take most of the time of a step.

        Args:
            lights: Coefficients of the operator's basis, shape
                (..., coefficients, 3).
            loss_gradient: Function of the images, shape (..., 3, size, size). It
                returns the gradient of the loss by the images, of the same
                shape. `torch.func.grad(loss)` makes such a function from a loss.
            background: Gray value, color or images in [0, 1]. See
                `renderer.image.as_background`.

        Returns:
            The images in [0, 1], shape (..., 3, size, size), and the gradient of
            the loss by the lights, with the shape of the lights.

        Raises:
            InputError: If the lights, the background or the gradient of the loss
                hold NaN or have another shape.

        Example:
            >>> import torch
            >>> import norm_balls as nb
            >>> camera = nb.OrthographicCamera(polar=60.0, azimuth=0.0, width=2.2)
            >>> operator = nb.precompute_transfer(nb.solid("pear"), camera, size=16)
            >>> light = nb.load_light("grace")
            >>> target = torch.zeros(3, 16, 16)
            >>> image, gradient = operator.image_and_gradient(light, lambda x: 2 * (x - target))
            >>> image.shape, gradient.shape
            (torch.Size([3, 16, 16]), torch.Size([49, 3]))
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        lights = lights.detach()
        if isinstance(background, Tensor):
            background = background.detach()
        prepared = self._prepare_background(background, lights)
        images, is_passing, clamped = self._images(lights, prepared)
        image_gradient = loss_gradient(images)
        require_image_gradient(image_gradient, images)
        gradient = self._gradient_of_images(image_gradient.detach(), is_passing, clamped)
        return images, gradient

    def radiance(
        self, lights: Float[Tensor, "*lights coefficients 3"]
    ) -> Float[Tensor, "*lights 3 P"]:
        """Compute the linear radiance of the covered pixels, differentiable in the lights.

        The product is computed in the dtype of the operator.

        Args:
            lights: Coefficients of the operator's basis, shape
                (..., coefficients, 3).

        Returns:
            Radiance, weighted with coverage, shape (..., 3, P), in the dtype of
            the lights.

        Raises:
            InputError: If the lights hold NaN or have another number of
                coefficients.
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        return _Radiance.apply(lights, self)

    def light_gradient(
        self, radiance_gradient: Float[Tensor, "*lights 3 P"]
    ) -> Float[Tensor, "*lights coefficients 3"]:
        """Compute the gradient of a loss by the lights from that by the radiance, without a graph.

        This is the product with the transposed matrix:
        ∂loss/∂U = T ∂loss/∂radiance.

        Args:
            radiance_gradient: Gradient by the radiance, shape (..., 3, P).

        Returns:
            Gradient by the lights, shape (..., coefficients, 3). It is exactly
            zero for coefficients that reach no pixel.

        Raises:
            InputError: If the gradient holds NaN or has another shape.
        """
        radiance_gradient = as_tensor("radiance_gradient", radiance_gradient)
        require_bounded(radiance_gradient=radiance_gradient)
        if radiance_gradient.shape[-2:] != self.albedo.shape:
            given = tuple(radiance_gradient.shape)
            expected = tuple(self.albedo.shape)
            raise InputError(
                f"radiance_gradient of shape {given} is not of the operator's pixels: "
                f"give {expected}"
            )
        if self._compact is None:
            return self._light_gradient(radiance_gradient)
        return self._compact._light_gradient(self._sum_equal(radiance_gradient))

    def _images(
        self, lights: Tensor, background: _PreparedBackground
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render without a graph.

        Returns the images (..., 3, size, size), ones and zeros where the clamp
        lets the gradient pass or not (..., 3, U), and the clamped linear values
        (..., 3, U) of the U distinct pixels.
        """
        operator = self._compact or self
        unclamped = operator._radiance(lights).add_(background.term)
        clamped = unclamped.clamp(0, 1)
        # The gradient passes at the bounds themselves, as in `renderer.image.clamp`.
        is_passing = unclamped.eq_(clamped)
        rows = self._pixel_rows
        canvas = background.images
        image_shape: tuple[int, ...] = self._image_shape
        if lights.ndim > 2:
            batch = lights.shape[:-2]
            rows = rows.expand(*batch, -1, -1)
            canvas = canvas.expand(*batch, -1, -1)
            image_shape = (*batch, *image_shape)
        images = canvas.clone(memory_format=torch.contiguous_format)
        encoded = clamped if self._is_linear else encode(clamped, self.settings.encoding)
        if self._compact is not None:
            encoded = self._copy_equal(encoded)
        # index_copy_ takes twice as long as scatter_ on a CPU.
        images.scatter_(-1, rows, encoded)
        return images.view(image_shape), is_passing, clamped

    def _gradient_of_images(
        self, image_gradient: Tensor, is_passing: Tensor, clamped: Tensor
    ) -> Tensor:
        """Compute the gradient by the lights from that by the images of `_images`.

        The gradient by the images has the shape (..., 3, size, size).
        """
        rows = self._pixel_rows
        if is_passing.ndim > 2:
            rows = rows.expand(*is_passing.shape[:-2], -1, -1)
        # index_select takes longer, and much longer if there are three axes.
        covered = image_gradient.flatten(-2).gather(-1, rows)
        operator = self
        if self._compact is not None:
            operator = self._compact
            covered = self._sum_equal(covered)
        if not self._is_linear:
            covered = encode_gradient(clamped, covered, self.settings.encoding)
        gradient = operator._light_gradient(covered.mul_(is_passing))
        # A sum takes less time than the largest magnitude of all pixels.
        if not math.isfinite(gradient.sum().item()):
            require_bounded(image_gradient=covered)
        return gradient

    def require_lights(self, lights: Tensor) -> None:
        """Check that lights have the operator's basis and hold no NaN.

        Args:
            lights: Coefficients, shape (..., coefficients, 3).

        Raises:
            InputError: If the lights hold NaN or have another shape.
        """
        if not lights.is_floating_point():
            require_bounded(lights=lights)
        if lights.shape[-2:] != self._light_shape:
            raise InputError(
                f"lights of shape {tuple(lights.shape)} are not of the operator's {self.basis}: "
                f"give {self.basis.size} rows"
            )
        # This takes half the time of `require_bounded` in small images.
        # `require_bounded` finds and names the fault.
        values = lights.detach().reshape(-1)
        if not torch.dot(values, values).item() <= MAX_MAGNITUDE**2:
            require_bounded(lights=lights)

    def _radiance(self, lights: Tensor) -> Tensor:
        """Compute `radiance` without a graph, in a new tensor of the dtype of the lights."""
        dtype = self.transfer.dtype
        nonzero = lights.index_select(-2, self.nonzero)
        # Even a call that converts nothing takes notable time in small images.
        if lights.dtype != dtype:
            nonzero = nonzero.to(dtype)
        if self._shared is not None:
            product = (nonzero.mT @ self._shared).mul_(self.albedo)
            if self._white is not None:
                product.add_(nonzero.mT @ self._white)
        else:
            product = torch.einsum("...kc,ckp->...cp", nonzero, self.transfer)
        if self.sparse is not None:
            selected = lights.to(product.dtype).index_select(-2, self.sparse.function)
            arriving = selected * self.sparse.weight
            product = product.index_add(-1, self.sparse.pixel, arriving.mT)
        return product if lights.dtype == dtype else product.to(lights.dtype)

    def _light_gradient(self, radiance_gradient: Tensor) -> Tensor:
        """Compute `light_gradient` of values that may hold NaN."""
        upstream = radiance_gradient
        dtype = self.transfer.dtype
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
            selected = upstream.mT.index_select(-2, self.sparse.pixel)
            arriving = selected * self.sparse.weight
            gradient = gradient.index_add(-2, self.sparse.function, arriving)
        return (
            gradient if dtype == radiance_gradient.dtype else gradient.to(radiance_gradient.dtype)
        )

    def _copy_equal(self, values: Tensor) -> Tensor:
        """Copy values (..., U) of the distinct pixels to all covered pixels, shape (..., P)."""
        assert self.distinct is not None
        source = self.distinct.source.expand(*values.shape[:-1], -1)
        return values.gather(-1, source)

    def _sum_equal(self, values: Tensor) -> Tensor:
        """Sum values (..., P) of equal pixels, shape (..., U)."""
        assert self.distinct is not None
        sums = values.new_zeros(*values.shape[:-1], len(self.distinct.first))
        source = self.distinct.source.expand(values.shape)
        return sums.scatter_add_(-1, source, values)

    def _prepare_background(
        self, background: float | Tensor, lights: Tensor
    ) -> _PreparedBackground:
        """Prepare a background for lights.

        A gray value behind one light is kept for the next call.
        """
        is_gray = isinstance(background, float | int)
        if not is_gray or lights.ndim > 2:
            images = as_background(background, self.settings.size, lights)
            return self._prepare_background_images(images, lights)
        key = (background, lights.dtype, lights.device)
        if self._kept_background.get("key") != key:
            images = as_background(background, self.settings.size, lights)
            prepared = self._prepare_background_images(images, lights)
            self._kept_background.update(key=key, prepared=prepared)
        return self._kept_background["prepared"]

    def _prepare_background_images(self, images: Tensor, lights: Tensor) -> _PreparedBackground:
        """Flatten background images, and compute what they add to the covered pixels.

        The images have the shape (..., 3, size, size), and the lights
        (..., coefficients, 3).
        """
        operator = self._compact or self
        flat = images.flatten(-2)
        at_pixels = flat.index_select(-1, operator.pixels)
        if self.settings.encoding != "linear":
            # The last bit of a power depends on the position in memory, so it is
            # computed for each light.
            at_pixels = at_pixels.expand(*lights.shape[:-2], *at_pixels.shape[-2:]).contiguous()
        coverage = operator.coverage.to(images)[None]
        term = background_term(coverage, at_pixels, self.settings.encoding)
        return _PreparedBackground(flat, term)

    def to(self, device: torch.device | str) -> TransferOperator:
        """Return the same operator on another device.

        Args:
            device: The device, such as "cuda".

        Raises:
            InputError: If there is no such device.
        """
        device = as_device(device)
        if device == self.transfer.device:
            return self
        sparse = self.sparse and self.sparse.to(device)
        tensors = {name: getattr(self, name).to(device) for name in TENSORS}
        # On a GPU, the order of the sums of equal pixels would differ from run to run.
        return replace(self, **tensors, sparse=sparse, distinct=None)

    @property
    def by_channel(self) -> Tensor:
        """Return the transfer of three channels, including the albedo, shape (3, K, P)."""
        if self._shared is None:
            return self.transfer
        colored = self._shared * self.albedo[:, None]
        return colored if self._white is None else colored + self._white

    # The following are cached. In images of 32² pixels, even an index or a
    # comparison of dtypes takes notable time.

    @cached_property
    def _shared(self) -> Tensor | None:
        """Return the transfer (K, P) that the colors share, or None if they do not."""
        return self.transfer[0] if len(self.transfer) < COLORS else None

    @cached_property
    def _white(self) -> Tensor | None:
        """Return the white transfer (K, P) of gloss, or None without it."""
        return self.transfer[1] if len(self.transfer) == 2 else None

    @cached_property
    def _compact(self) -> TransferOperator | None:
        """Return the operator of the distinct pixels, or None if most pixels differ."""
        if self.distinct is None:
            return None
        first = self.distinct.first
        return replace(
            self,
            transfer=self.transfer.index_select(-1, first),
            albedo=self.albedo.index_select(-1, first),
            coverage=self.coverage.index_select(0, first),
            pixels=self.pixels.index_select(0, first),
            distinct=None,
        )

    @cached_property
    def _kept_background(self) -> dict[str, Any]:
        """Return the prepared background of the last gray value, and its key in the cache."""
        return {}

    @cached_property
    def _is_linear(self) -> bool:
        """Return whether image values are not encoded."""
        return self.settings.encoding == "linear"

    @cached_property
    def _image_shape(self) -> tuple[int, int, int]:
        """Return the shape of one image, (3, size, size)."""
        return COLORS, self.settings.size, self.settings.size

    @cached_property
    def _light_shape(self) -> tuple[int, int]:
        """Return the shape of one light, (coefficients, 3)."""
        return self.basis.size, COLORS

    @cached_property
    def _pixel_rows(self) -> Tensor:
        """Return the covered pixels for each color, shape (3, P)."""
        return self.pixels.expand(COLORS, -1)

    @cached_property
    def _scatter(self) -> Tensor:
        """Return the matrix (size, K) that puts K coefficients in their place among all.

        The other coefficients become exactly zero.
        """
        return torch.eye(self.basis.size).to(self.transfer)[:, self.nonzero]


class DistinctPixels(NamedTuple):
    """The U covered pixels of an operator that differ from each other.

    Equal pixels have the same transfer, albedo and coverage.

    Attributes:
        first: First of the equal pixels, as an index into the P covered pixels,
            ascending, shape (U,).
        source: Index into `first` of the pixel that each covered pixel equals,
            shape (P,).
    """

    first: Int[Tensor, " U"]
    source: Int[Tensor, " P"]


class _PreparedBackground(NamedTuple):
    """A background of an operator.

    Attributes:
        images: Background images, shape (..., 3, size²).
        term: Linear values that are added to the radiance of the U distinct
            pixels, shape (..., 3, U).
    """

    images: Tensor
    term: Tensor


class _Radiance(torch.autograd.Function):
    """`TransferOperator._radiance` with its gradient by the lights."""

    @staticmethod
    def forward(ctx: Any, lights: Tensor, operator: TransferOperator) -> Tensor:
        ctx.operator = operator
        if operator._compact is None:
            return operator._radiance(lights)
        return operator._copy_equal(operator._compact._radiance(lights))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        return ctx.operator.light_gradient(upstream), None


class _Image(torch.autograd.Function):
    """`TransferOperator._images` with its gradient by the lights.

    It is a single node of autograd, since each node takes time.
    """

    @staticmethod
    def forward(
        ctx: Any, lights: Tensor, operator: TransferOperator, background: _PreparedBackground
    ) -> Tensor:
        images, is_passing, clamped = operator._images(lights, background)
        ctx.operator = operator
        ctx.is_passing = is_passing
        ctx.clamped = clamped
        return images

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        # Gradients are recorded only with create_graph. Without this test,
        # once_differentiable would take several percent of a step in small images.
        if torch.is_grad_enabled():
            return _Image._backward_once(ctx, upstream)
        return _Image._backward(ctx, upstream)

    @staticmethod
    def _backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        """Compute the gradient by the lights."""
        gradient = ctx.operator._gradient_of_images(upstream, ctx.is_passing, ctx.clamped)
        return gradient, None, None

    # A second derivative raises an error.
    _backward_once = staticmethod(once_differentiable(_backward))


def require_image_gradient(image_gradient: Tensor, images: Tensor) -> None:
    """Check that the gradient of a loss by images has their shape.

    Args:
        image_gradient: What a function `loss_gradient` returned.
        images: The images, of any shape.

    Raises:
        InputError: If it is no tensor or has another shape.
    """
    is_tensor = isinstance(image_gradient, Tensor)
    if not is_tensor or image_gradient.shape != images.shape:
        given = tuple(image_gradient.shape) if is_tensor else type(image_gradient).__name__
        raise InputError(
            f"loss_gradient returned {given}: "
            f"return a tensor of the images' shape {tuple(images.shape)}"
        )


def apply_transfer(lights: Tensor, transfer: Tensor, albedo: Tensor) -> Tensor:
    """Compute the radiance of views under B lights.

    The light comes first in the product, which is several times faster on a CPU.

    Args:
        lights: Nonzero coefficients, shape (..., B, K, 3).
        transfer: Transfer of C = 1 to 3 channels, as in a `TransferOperator`,
            shape (..., C, K, P).
        albedo: Albedo, as in a `TransferOperator`, shape (..., 3, P).

    Returns:
        Radiance, shape (..., B, 3, P).
    """
    if transfer.shape[-3] == COLORS:
        return (lights.movedim(-1, -3) @ transfer).movedim(-3, -2)
    shared, *white = transfer.unbind(-3)
    by_color = lights.mT.flatten(-3, -2)
    product = (by_color @ shared).unflatten(-2, (-1, COLORS)) * albedo.unsqueeze(-3)
    if white:
        product = product + (by_color @ white[0]).unflatten(-2, (-1, COLORS))
    return product


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

    Surfaces are shaded on the side that the camera sees.

    Args:
        mesh: The mesh.
        cameras: The cameras.
        settings: Settings of the images.
        rasterizer: Rasterizer that finds the visible faces.
        albedo_scale: Factor of the albedo, for meshes whose texture is darker
            than the real object.
        basis: Basis of the lights.
        dtype: Type of the operators. They are computed in float64.
        gloss: Gloss instead of that of the mesh. None for that of the mesh.

    Returns:
        One operator per camera, in the order of the cameras.

    Raises:
        InputError: If the basis has local lights and light is to bounce, or the
            scale is not finite.
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
    """The layout of the channels of a view's transfer, and the place of the albedo.

    Attributes:
        number: Number of channels. It is 3 if each color has a channel, 1 if the
            colors share a channel, and 2 if the white light of gloss follows the
            shared channel.
        is_shared: Whether the colors share a channel.
        sample_albedo: Albedo that is multiplied into the transfer, shape (S, 3).
            It is ones (S, 1) if the colors share a channel.
        pixel_albedo: Albedo that multiplies a shared channel, shape (P, 3). It
            is ones if each color has a channel.
    """

    number: int
    is_shared: bool
    sample_albedo: Tensor
    pixel_albedo: Tensor


class _DenseRows(NamedTuple):
    """The rows of a transfer matrix for some coefficients of the light.

    Attributes:
        transfer: Radiance per unit of K coefficients, shape (C, K, P).
        coefficients: Indices of these coefficients in the light, shape (K,).
    """

    transfer: Tensor
    coefficients: Tensor


@dataclass(frozen=True)
class _OperatorBuilder:
    """Builder of the operators of one mesh, view by view.

    Attributes:
        mesh: The mesh.
        settings: Settings of the images.
        albedo_scale: Factor of the albedo.
        basis: Basis of the lights.
        dtype: Type of the operators.
        gloss: Gloss instead of that of the mesh, or None.
        transport: Shadows and bounces of environment light, or None without them.
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
            if entries.is_sparse(len(fragments.pixels)):
                sparse.append(self._sparse_rows(part, entries, channels))
            else:
                dense.append(self._local_rows(part, entries, surface))
        if self.basis.environment is not None:
            dense.append(self._environment_rows(self.basis.environment, surface, channels))
        joined_rows = self._join(dense, channels.number, len(fragments.pixels))
        albedo = channels.pixel_albedo.T.to(self.dtype).contiguous()
        distinct = None
        if self._is_alike_on_faces(surface, channels):
            distinct = _distinct_pixels(fragments, albedo)
        return TransferOperator(
            transfer=joined_rows.transfer,
            albedo=albedo,
            coverage=fragments.coverage.to(self.dtype),
            pixels=fragments.pixels,
            nonzero=joined_rows.coefficients,
            settings=self.settings,
            basis=self.basis,
            sparse=concatenate_entries(sparse),
            distinct=distinct,
        )

    def _is_alike_on_faces(self, surface: Surface, channels: _Channels) -> bool:
        """Return whether all pixels that one face fills have the same transfer."""
        is_matte = surface.gloss is None and channels.is_shared
        is_open = self.transport is None and not self.basis.local_lights
        return is_matte and is_open and self.settings.normals == "flat"

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
            return _Channels(
                number=COLORS,
                is_shared=False,
                sample_albedo=sample_albedo,
                pixel_albedo=torch.ones(pixel_count, COLORS),
            )
        ones = torch.ones(1, 1, dtype=torch.float64).expand(len(fragments.pixel), 1)
        return _Channels(
            number=2 if is_glossy else 1,
            is_shared=True,
            sample_albedo=ones,
            pixel_albedo=pixel_albedo,
        )

    def _needs_three_channels(self, is_glossy: bool) -> bool:
        """Return whether a factor per pixel cannot express the colors of the radiance.

        This is so if bounced light has another color than the light of the sky.
        It is also so if gloss meets shadows or local lights, because these add
        the white light of gloss to the channels of the albedo.
        """
        if self.transport is not None and self.transport.colors:
            return True
        return is_glossy and (self.transport is not None or bool(self.basis.local_lights))

    def _surface_albedo(self, fragments: Fragments) -> Tensor:
        """Return the scaled albedo (S, 3) at the samples."""
        return surface_albedo(self.mesh, fragments, self.settings.encoding) * self.albedo_scale

    def _environment_rows(
        self, part: EnvironmentPart, surface: Surface, channels: _Channels
    ) -> _DenseRows:
        """Compute the rows of environment light, with shadows and bounces."""
        harmonics_basis = part.basis
        everything = torch.arange(harmonics_basis.size)
        if surface.gloss is None:
            weights = None if channels.is_shared else channels.sample_albedo
            transfer = _box_filter(surface, weights, harmonics_basis, self.dtype)
            coefficients = harmonics_basis.nonzero
        else:
            albedo = channels.sample_albedo
            transfer = _glossy_box_filter(
                surface, surface.gloss, albedo, harmonics_basis, self.dtype
            )
            coefficients = everything
        change = None
        if self.transport is not None:
            change = self.transport.change(surface, channels.sample_albedo)
        if change is not None:
            transfer = change.index_add_(1, coefficients, transfer.double())
            coefficients = everything
        return _DenseRows(transfer.to(self.dtype), part.rows.start + coefficients)

    def _local_entries(
        self, part: LocalPart, surface: Surface, channels: _Channels
    ) -> SparseTransfer:
        """Compute the nonzero entries of a local light."""
        return local_transfer(self.rays, surface, channels.sample_albedo, part.basis)

    def _local_rows(self, part: LocalPart, entries: SparseTransfer, surface: Surface) -> _DenseRows:
        """Write the entries of a local light as rows."""
        transfer, coefficients = entries.dense(len(surface.fragments.pixels))
        return _DenseRows(transfer.to(self.dtype), part.rows.start + coefficients)

    def _sparse_rows(
        self, part: LocalPart, entries: SparseTransfer, channels: _Channels
    ) -> SparseTransfer:
        """Return the entries of a local light in three channels, with their albedo."""
        weight = (entries.weight * channels.pixel_albedo[entries.pixel]).to(self.dtype)
        return SparseTransfer(part.rows.start + entries.function, entries.pixel, weight)

    def _join(self, parts: list[_DenseRows], channel_count: int, pixel_count: int) -> _DenseRows:
        """Join rows in the order of their coefficients."""
        if len(parts) == 1:
            # Returning the part avoids a copy.
            return parts[0]
        empty = torch.empty(channel_count, 0, pixel_count, dtype=self.dtype)
        ordered = sorted(parts, key=_first_coefficient)
        transfer = torch.cat([empty, *(part.transfer for part in ordered)], dim=1)
        coefficients = [torch.arange(0), *(part.coefficients for part in ordered)]
        return _DenseRows(transfer, torch.cat(coefficients))


def _first_coefficient(rows: _DenseRows) -> int:
    """Return the index of the first coefficient, or 0 without coefficients."""
    return int(rows.coefficients[0]) if len(rows.coefficients) else 0


def _pixel_albedo(fragments: Fragments, albedo: Tensor, dtype: torch.dtype) -> Tensor | None:
    """Return the albedo (P, 3) of each pixel, or None if the samples of a pixel disagree.

    The albedo of the samples (S, 3) may differ by the rounding of the dtype.
    """
    # Each row holds one channel and is contiguous.
    by_channel = albedo.T
    zeros = by_channel.new_zeros(COLORS, len(fragments.pixels))
    by_pixel = zeros.index_copy(1, fragments.pixel, by_channel)
    # index_select takes three times as long in float64.
    pixel_of_sample = fragments.pixel.expand(COLORS, -1)
    difference = (by_channel - by_pixel.gather(1, pixel_of_sample)).abs_()
    is_equal = difference <= torch.finfo(dtype).eps * by_channel
    return by_pixel.T if is_equal.all() else None


def _box_filter(
    surface: Surface, albedo: Tensor | None, basis: Harmonics, dtype: torch.dtype
) -> Tensor:
    """Sum albedo × A_l Y_lm(n) over each pixel's samples, in float64.

    This is the transfer of a matte surface under an open sky, with the factors
    A_l of `harmonics.lambertian_factors` and the normals n of the samples.

    Args:
        surface: The S samples of a view, in P pixels.
        albedo: Linear albedo at the samples, shape (S, C). None stands for 1 in
            a single channel.
        basis: Basis with K nonzero functions A_l Y_lm.
        dtype: Type of the result.

    Returns:
        Transfer, shape (C, K, P).
    """
    fragments = surface.fragments
    pixel_count = len(fragments.pixels)
    is_flat = surface.settings.normals == "flat"
    if is_flat:
        face_harmonics = basis.irradiance(surface.face_planes)
        if albedo is None and _mostly_filled(fragments):
            return _copied_from_faces(fragments, face_harmonics, dtype)
        pixel, face, weights = _face_weights(fragments, albedo)
    else:
        pixel = fragments.pixel
        weights = _sample_weights(fragments, albedo)
    filtered = torch.empty(weights.shape[1], len(basis.nonzero), pixel_count, dtype=dtype)
    row_starts = _row_starts(torch.bincount(pixel, minlength=pixel_count))
    for first in range(0, pixel_count, BLOCK):
        rows = row_starts[first : first + BLOCK + 1]
        entries = slice(int(rows[0]), int(rows[-1]))
        if is_flat:
            values = face_harmonics
            value_of_entry = face[entries]
        else:
            values = basis.irradiance(surface.normals[entries])
            value_of_entry = torch.arange(len(values))
        for channel, weight in zip(filtered, weights[entries].T, strict=True):
            sums = _row_sums(weight, value_of_entry, rows, values)
            channel[:, first : first + BLOCK] = sums.to(dtype).T
    return filtered


def _mostly_filled(fragments: Fragments) -> bool:
    """Return whether most pixels show a single face."""
    is_filled = fragments.runs.sample_count == fragments.samples**2
    return 2 * int(is_filled.sum()) > len(fragments.pixels)


def _copied_from_faces(fragments: Fragments, face_harmonics: Tensor, dtype: torch.dtype) -> Tensor:
    """Return `_box_filter`, shape (1, K, P), for flat normals and an albedo of 1.

    `face_harmonics` (G, K) are the functions A_l Y_lm of each seen face. A pixel
    that one face fills has the values of this face, which are copied. Only the
    other pixels are summed.
    """
    pixel, face, sample_count = fragments.runs
    run_count = torch.bincount(pixel, minlength=len(fragments.pixels))
    first_run = _row_starts(run_count)[:-1]
    # A sum is never −0.0. Adding 0.0 ensures that a copy is not −0.0 either.
    positive_zero = face_harmonics + 0.0
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
        block = summed_pixels[first : first + BLOCK].expand(len(filtered), -1)
        filtered.scatter_(1, block, sums.to(dtype).T.contiguous())
    return filtered[None]


def _distinct_pixels(fragments: Fragments, albedo: Tensor) -> DistinctPixels | None:
    """Find equal pixels of a view in which all samples of a face have the same transfer.

    The pixels that one face fills are equal if they have the same albedo, given
    in shape (3, P). None is returned if there are too few to save time.
    """
    pixel_count = len(fragments.pixels)
    if pixel_count < FEWEST_SAVED_PIXELS:
        return None
    filling_runs = _indices(fragments.runs.sample_count == fragments.samples**2)
    pixel = fragments.runs.pixel.index_select(0, filling_runs)
    face = fragments.runs.face.index_select(0, filling_runs)
    first_of_face = face.new_full((len(fragments.faces),), pixel_count)
    first_of_face.scatter_reduce_(0, face, pixel, "amin")
    all_pixels = torch.arange(pixel_count)
    first_equal = all_pixels.index_copy(0, pixel, first_of_face.index_select(0, face))
    is_first = first_equal == all_pixels
    first = _indices(is_first)
    saved = pixel_count - len(first)
    if saved < FEWEST_SAVED_PIXELS or 2 * saved < pixel_count:
        return None
    if not torch.equal(albedo, albedo.index_select(1, first_equal)):
        return None
    position_in_first = is_first.cumsum(0) - 1
    return DistinctPixels(first, position_in_first.index_select(0, first_equal))


def _indices(is_chosen: Tensor) -> Tensor:
    """Return the indices at which a mask (N,) is true.

    NumPy takes a quarter of the time of torch.
    """
    return torch.from_numpy(np.flatnonzero(is_chosen.numpy()))


def _row_starts(counts: Tensor) -> Tensor:
    """Return the first entry of each of N rows and the end of the last one, shape (N + 1,).

    `counts` (N,) is the number of entries of each row.
    """
    starts = counts.new_zeros(len(counts) + 1)
    torch.cumsum(counts, 0, out=starts[1:])
    return starts


def _row_sums(weight: Tensor, value_of_entry: Tensor, row_starts: Tensor, values: Tensor) -> Tensor:
    """Return N weighted sums of rows of values, shape (N, K).

    Args:
        weight: Weight of each entry, shape (E,).
        value_of_entry: Row of `values` that each entry weights, shape (E,).
        row_starts: First entry of each sum and the end of the last one, up to a
            common offset, shape (N + 1,).
        values: The values, shape (M, K).
    """
    # The weights are a sparse matrix (N, M) in compressed rows.
    columns = value_of_entry.int().numpy()
    starts = (row_starts - row_starts[0]).int().numpy()
    shape = (len(row_starts) - 1, len(values))
    matrix = csr_array((weight.numpy(), columns, starts), shape=shape)
    return torch.from_numpy(matrix @ values.numpy())


def _face_weights(fragments: Fragments, albedo: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pixel, the seen face and the weight of each run of samples of one face.

    The shapes for R runs are (R,), (R,) and (R, C).
    """
    if albedo is not None:
        return fragments.merge(albedo)
    runs = fragments.runs
    weights = runs.sample_count.double() / fragments.samples**2
    return runs.pixel, runs.face, weights[:, None]


def _sample_weights(fragments: Fragments, albedo: Tensor | None) -> Tensor:
    """Return the weight (S, C) of each sample in its pixel."""
    if albedo is None:
        albedo = torch.ones(1, 1, dtype=torch.float64).expand(len(fragments.pixel), 1)
    return albedo / fragments.samples**2


def _glossy_box_filter(
    surface: Surface, gloss: SampleGloss, albedo: Tensor, basis: Harmonics, dtype: torch.dtype
) -> Tensor:
    """Return the transfer (channels, K, P) of a glossy surface under an open sky.

    `albedo` (S, C) is given at the samples. K counts all coefficients of the
    basis. If C is 1, a second channel holds the white light of gloss. Otherwise
    this white light is added to all channels.
    """
    fragments = surface.fragments
    color_count = albedo.shape[1]
    channel_count = 2 if color_count == 1 else color_count
    filtered = torch.zeros(channel_count, basis.size, len(fragments.pixels), dtype=dtype)
    # The white light of gloss is added to these channels.
    white_channels = 1 if color_count == 1 else slice(None)
    weights = albedo / fragments.samples**2
    diffuse_degree = min(basis.degree, harmonics.DIFFUSE_DEGREE)
    pixels_at_once = max(1, GLOSSY // (basis.size * fragments.samples**2))
    for block in _blocks(fragments.pixel, filtered, pixels_at_once):
        normals = surface.normals[block.samples]
        to_camera = at_samples(surface.toward, block.samples)
        block_gloss = gloss.at(block.samples)
        colored, white, frame = block_gloss.transfer(normals, to_camera, basis.degree)
        diffuse = _diffuse_rows(block_gloss, normals, to_camera, diffuse_degree)
        for channel, weight in zip(block.filtered, weights[block.samples].T, strict=False):
            channel[: diffuse.shape[1]] = block.sum_by_pixel(diffuse * weight[:, None]).to(dtype)
            if colored is not None:
                channel += frame.to_world(block.sum_by_pixel((colored * weight).T))
        shine = frame.to_world(block.sum_by_pixel(white.T)) / fragments.samples**2
        block.filtered[white_channels] += shine
    return filtered


def _diffuse_rows(gloss: SampleGloss, normals: Tensor, to_camera: Tensor, degree: int) -> Tensor:
    """Return the diffuse radiance of samples per unit of albedo and of each coefficient.

    The shape is (S, K) for unit normals (S, 3) and K coefficients of environment
    light. The light passes the coat of gloss twice.
    """
    entering = harmonics.basis(normals, degree) * gloss.entering_bands(degree).T
    return entering * gloss.diffuse(normals, to_camera)[:, None]


class _Block(NamedTuple):
    """Some neighboring pixels of a view with their samples.

    Attributes:
        samples: The samples of the pixels.
        pixel: Pixel of each sample, counted from the first pixel of the block,
            shape (S,).
        filtered: Part of the transfer to fill, shape (channels, K, P).
    """

    samples: slice
    pixel: Tensor
    filtered: Tensor

    def sum_by_pixel(self, rows: Tensor) -> Tensor:
        """Return the sums (K, P) over the samples of each pixel, of rows (S, K)."""
        zeros = rows.new_zeros(self.filtered.shape[2], rows.shape[1])
        return zeros.index_add_(0, self.pixel, rows).T


def _blocks(pixel: Tensor, filtered: Tensor, size: int) -> Iterator[_Block]:
    """Yield blocks of pixels, given the pixel of each sample and the transfer (channels, K, P)."""
    first_sample = 0
    for first in range(0, filtered.shape[-1], size):
        last_sample = int(torch.searchsorted(pixel, first + size))
        samples = slice(first_sample, last_sample)
        yield _Block(samples, pixel[samples] - first, filtered[..., first : first + size])
        first_sample = last_sample
