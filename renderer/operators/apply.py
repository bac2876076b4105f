"""Views of a mesh as linear operators, which map a light to an image.

Before clamping, the radiance of every pixel is linear in the coefficients U of
the light (the paper's appendix B.2): radiance = Uᵀ T. The transfer matrix T is
computed once for a mesh and a camera, and multiplied with every light. T
contains the box filter, the texture and the albedo exactly. It also contains
gloss (`renderer.surface.gloss`), and shadows and bounces (the package
`renderer.operators`).

Shapes use these letters: a view has S covered samples in P pixels, which show G
faces of the mesh. D of the pixels are distinct, and the others are copies of
them (`renderer.operators.distinct_pixels`). K coefficients of the light reach a
pixel. The dots (...) are any axes of a batch of lights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int, Num
from scipy.sparse import csr_array
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

from renderer.camera import Camera
from renderer.errors import MAX_MAGNITUDE, InputError, as_device, require_bounded
from renderer.image import as_background, background_term, composite, encode, encode_gradient
from renderer.light import harmonics
from renderer.light.basis import HARMONICS, Basis, EnvironmentPart, Harmonics, LocalPart
from renderer.mesh import Mesh
from renderer.operators.distinct_pixels import (
    DistinctPixels,
    find_distinct_pixels,
    indices_of_true,
)
from renderer.operators.lamp_paths import SparseTransfer, concatenate_entries, local_transfer
from renderer.operators.rays import Rays, Surface
from renderer.operators.shadows import Transport, build_transport
from renderer.settings import ImageSettings
from renderer.surface.albedo import shared_albedo, surface_albedo
from renderer.surface.gloss import Gloss, SampleGloss, at_samples
from renderer.validation import as_tensor
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizer import Rasterizer

# Fields of `TransferOperator` with tensors that `TransferOperator.to` moves to a device.
TENSORS = ("albedo", "coverage", "pixels", "nonzero")
# Number of pixels that `_box_filter` processes at once. Their values fit into the cache of
# the processor.
BLOCK = 2**12
# The transfer of a glossy surface is computed for this many pairs of a sample and an SH
# coefficient at once. It limits the memory.
GLOSSY_BLOCK = 2**20
# Number of color channels.
COLORS = 3


@dataclass(frozen=True)
class TransferOperator:
    """Transfer matrix of a view of a mesh, which maps a light to an image.

    The matrix maps the coefficients of a light to the linear radiance of the P
    covered pixels (those that show the mesh), times the coverage of each pixel.
    All floating-point tensors have the same dtype.

    Attributes:
        distinct_transfer: Radiance of the D distinct pixels per unit of each of K
            coefficients, in C channels, shape (C, K, D). C = 3 is one channel for
            each color. C = 1 is one channel that all colors share. It takes a
            third of the memory and the time, but is only possible if no pixel
            mixes albedos (one sample per pixel, or a mesh of one color). C = 2
            is a shared channel, and a channel of specular reflection that is
            added to all colors.
        albedo: Factor of each color for the shared channel, shape (3, P). Ones
            if C = 3.
        coverage: Fraction of the samples of each pixel that show the mesh, in
            (0, 1], shape (P,).
        pixels: Row-major indices of the covered pixels, shape (P,). Row 0 is at
            the top of the image.
        nonzero: Ascending indices of the K coefficients that reach a pixel,
            shape (K,). At degree 6, these are 31 of the 49 coefficients under an
            open sky (`Harmonics.nonzero`), and all 49 with shadows or gloss.
        settings: Settings of the image.
        basis: Basis of the lights.
        sparse: Nonzero entries of further rows of the matrix, in three channels.
            These are rows of projected patterns, which are mostly zero. None
            without such rows.
        distinct: D groups of covered pixels that are equal in every light.
            Products are only computed for one pixel of each group, its distinct
            pixel. None if most pixels differ. Each pixel is then a group, and
            D = P.

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

    distinct_transfer: Float[Tensor, "channels K D"]
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
        """Render one image under each light.

        The images are differentiable with respect to the lights and the
        background.

        Args:
            lights: Coefficients in the basis of the operator,
                shape (..., coefficients, 3).
            background: Gray value, color or images in [0, 1]. See
                `renderer.image.as_background`.

        Returns:
            Images in [0, 1] in the dtype of the lights,
            shape (..., 3, size, size).

        Raises:
            InputError: If `lights` has NaN or another number of coefficients
                than the basis, or if `background` has a wrong shape.
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        if isinstance(background, Tensor) and background.requires_grad:
            # `_Image` has no gradient with respect to the background, so the image is composed
            # of differentiable operations.
            images = as_background(background, self.settings.size, lights)
            coverage = self.coverage.to(lights)
            radiance = self.radiance(lights)
            return composite(radiance, coverage, self.pixels, images, self.settings.encoding)
        # `_Image` is faster, because it is a single operation of autograd.
        return _Image.apply(lights, self, self._prepare_background(background, lights))

    def image_and_gradient(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        loss_gradient: Callable[[Tensor], Tensor],
        background: float | Tensor = 0.5,
    ) -> tuple[Float[Tensor, "*lights 3 size size"], Float[Tensor, "*lights coefficients 3"]]:
        """Render images, and compute the gradient of a loss with respect to the lights.

        The gradient is computed without autograd. The results equal those of
        `image` and `torch.autograd.grad` to the bit. For small images, autograd
        would take most of the time of an optimization step.

        Args:
            lights: Coefficients in the basis of the operator,
                shape (..., coefficients, 3).
            loss_gradient: Function that takes the images, shape
                (..., 3, size, size), and returns the gradient of the loss with
                respect to the images, in the same shape.
                `torch.func.grad(loss)` makes such a function from a loss.
            background: Gray value, color or images in [0, 1]. See
                `renderer.image.as_background`.

        Returns:
            A tuple of

            - the images in [0, 1], shape (..., 3, size, size);
            - the gradient of the loss with respect to the lights, in the shape
              of `lights`.

        Raises:
            InputError: If the lights, the background or the gradient of the loss
                has NaN or a wrong shape.

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
        images, is_unclamped, clamped_values = self._images(lights, prepared)
        image_gradient = loss_gradient(images)
        require_image_gradient(image_gradient, images)
        gradient = self._gradient_of_images(image_gradient.detach(), is_unclamped, clamped_values)
        return images, gradient

    def radiance(
        self, lights: Float[Tensor, "*lights coefficients 3"]
    ) -> Float[Tensor, "*lights 3 P"]:
        """Compute the linear radiance of the P covered pixels, times their coverage.

        The radiance is differentiable with respect to the lights. It is computed
        in the dtype of the operator.

        Args:
            lights: Coefficients in the basis of the operator,
                shape (..., coefficients, 3).

        Returns:
            Radiance in the dtype of the lights, shape (..., 3, P).

        Raises:
            InputError: If `lights` has NaN or another number of coefficients
                than the basis.
        """
        lights = as_tensor("lights", lights)
        self.require_lights(lights)
        return _Radiance.apply(lights, self)

    def light_gradient(
        self, radiance_gradient: Float[Tensor, "*lights 3 P"]
    ) -> Float[Tensor, "*lights coefficients 3"]:
        """Convert the gradient of a loss from the radiance to the lights, without autograd.

        With the transfer matrix T and the lights U, the radiance is Uᵀ T. The
        gradients are therefore ∂loss/∂U = T (∂loss/∂radiance)ᵀ.

        Args:
            radiance_gradient: Gradient of the loss with respect to the radiance of
                the P covered pixels, shape (..., 3, P).

        Returns:
            Gradient of the loss with respect to the lights,
            shape (..., coefficients, 3). It is exactly 0 for coefficients that do
            not change any pixel.

        Raises:
            InputError: If the gradient has NaN or a wrong shape.
        """
        radiance_gradient = as_tensor("radiance_gradient", radiance_gradient)
        require_bounded(radiance_gradient=radiance_gradient)
        if radiance_gradient.shape[-2:] != self.albedo.shape:
            given = tuple(radiance_gradient.shape)
            expected = tuple(self.albedo.shape)
            raise InputError(
                f"radiance_gradient has shape {given}, but the operator needs (..., 3, P) for its "
                f"P = {expected[1]} covered pixels: give a gradient of this shape"
            )
        if self.distinct is not None:
            radiance_gradient = self.distinct.add_up(radiance_gradient)
        return self._light_gradient(radiance_gradient)

    def _images(
        self, lights: Float[Tensor, "... coefficients 3"], background: _PreparedBackground
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render images without autograd, and return what the gradient needs.

        It returns the images, 1 for values of the distinct pixels that clamping left alone
        and 0 for others, and the clamped linear values of the distinct pixels.
        """
        unclamped = self._radiance(lights).add_(background.term)
        clamped_values = unclamped.clamp(0, 1)
        # 1 for values in [0, 1], including the limits. Only these have a gradient.
        is_unclamped = unclamped.eq_(clamped_values)
        encoded = (
            clamped_values if self._is_linear else encode(clamped_values, self.settings.encoding)
        )
        canvas = background.images
        pixel_index = self._pixels_by_color
        image_shape: tuple[int, ...] = self._image_shape
        if lights.ndim > 2:
            batch_shape = lights.shape[:-2]
            canvas = canvas.expand(*batch_shape, -1, -1)
            pixel_index = pixel_index.expand(*batch_shape, -1, -1)
            image_shape = (*batch_shape, *image_shape)
        images = canvas.clone(memory_format=torch.contiguous_format)
        if self._distinct_in_image is not None:
            self._distinct_in_image.write(encoded, images)
        else:
            # `scatter_` takes half the time of `index_copy_` on a CPU.
            images.scatter_(-1, pixel_index, encoded)
        return images.view(image_shape), is_unclamped, clamped_values

    def _gradient_of_images(
        self,
        image_gradient: Float[Tensor, "... 3 size size"],
        is_unclamped: Float[Tensor, "... 3 D"],
        clamped_values: Float[Tensor, "... 3 D"],
    ) -> Float[Tensor, "... coefficients 3"]:
        """Convert the gradient of a loss from the images of `_images` to the lights.

        The last two arguments are the last two results of `_images`.
        """
        flat_gradient = image_gradient.flatten(-2)
        if self._distinct_in_image is not None:
            pixel_gradient = self._distinct_in_image.add_up(flat_gradient)
        else:
            pixel_index = self._pixels_by_color
            if is_unclamped.ndim > 2:
                pixel_index = pixel_index.expand(*is_unclamped.shape[:-2], -1, -1)
            # `gather` is faster than `index_select`, most of all for three axes.
            pixel_gradient = flat_gradient.gather(-1, pixel_index)
        if not self._is_linear:
            pixel_gradient = encode_gradient(clamped_values, pixel_gradient, self.settings.encoding)
        gradient = self._light_gradient(pixel_gradient.mul_(is_unclamped))
        # Checking the few numbers of the result is fast. If one is not finite,
        # `require_bounded` checks the gradient of all pixels and raises the error.
        if not math.isfinite(gradient.sum().item()):
            require_bounded(image_gradient=pixel_gradient)
        return gradient

    def require_lights(self, lights: Tensor) -> None:
        """Check that lights fit the basis of the operator, and have no NaN.

        Args:
            lights: Coefficients, shape (..., coefficients, 3).

        Raises:
            InputError: If `lights` has NaN or another number of coefficients
                than the basis.
        """
        if not lights.is_floating_point():
            require_bounded(lights=lights)
        if lights.shape[-2:] != self._light_shape:
            raise InputError(
                f"lights has shape {tuple(lights.shape)}, but {self.basis} needs the shape "
                f"(..., {self.basis.size}, 3): give lights of this basis"
            )
        # The sum of squares is faster to check than each value. If it is too large or NaN,
        # `require_bounded` checks each value and raises the error.
        values = lights.detach().reshape(-1)
        if not torch.dot(values, values).item() <= MAX_MAGNITUDE**2:
            require_bounded(lights=lights)

    def _radiance(self, lights: Float[Tensor, "... coefficients 3"]) -> Float[Tensor, "... 3 D"]:
        """Compute the light that D pixels send to the camera, without autograd or checks.

        Pixels that are equal in every light are computed once, which leaves the D
        distinct pixels. The radiance is multiplied by the fraction of the pixel that the
        mesh covers.
        """
        dtype = self.distinct_transfer.dtype
        # Coefficients that change a pixel. All other coefficients have no row in the matrix.
        used_lights = lights.index_select(-2, self.nonzero)
        # A call of `to` that converts nothing takes notable time for small images.
        if lights.dtype != dtype:
            used_lights = used_lights.to(dtype)
        if self._shared is not None:
            radiance = (used_lights.mT @ self._shared).mul_(self._distinct_albedo)
            if self._white is not None:
                radiance.add_(used_lights.mT @ self._white)
        else:
            radiance = torch.einsum("...kc,ckp->...cp", used_lights, self.distinct_transfer)
        if self.sparse is not None:
            light_of_entry = lights.to(radiance.dtype).index_select(-2, self.sparse.function)
            # Radiance that each nonzero entry of the matrix adds to its pixel: one row for
            # each entry, one column for each color.
            contributions = light_of_entry * self.sparse.weight
            radiance = radiance.index_add(-1, self.sparse.pixel, contributions.mT)
        return radiance if lights.dtype == dtype else radiance.to(lights.dtype)

    def _light_gradient(
        self, radiance_gradient: Float[Tensor, "... 3 D"]
    ) -> Float[Tensor, "... coefficients 3"]:
        """Convert a gradient from the radiance of D pixels to the lights.

        The D pixels are the distinct pixels: one of each group of equal pixels.
        """
        upstream = radiance_gradient
        dtype = self.distinct_transfer.dtype
        if upstream.dtype != dtype:
            upstream = upstream.to(dtype)
        # Compute the gradient with respect to the K used coefficients, shape (..., 3, K). The
        # function `linear(a, b)` of torch is a bᵀ.
        if self._shared is not None:
            used_gradient = linear(upstream * self._distinct_albedo, self._shared)
            if self._white is not None:
                used_gradient = used_gradient + linear(upstream, self._white)
        else:
            used_gradient = torch.einsum("...cp,ckp->...ck", upstream, self.distinct_transfer)
        gradient = self._placement @ used_gradient.mT
        if self.sparse is not None:
            gradient_of_entry = upstream.mT.index_select(-2, self.sparse.pixel)
            # Each nonzero entry of the sparse matrix links a pixel to a coefficient of the
            # light. One row for each entry: the gradient that it adds to its coefficient.
            contributions = gradient_of_entry * self.sparse.weight
            gradient = gradient.index_add(-2, self.sparse.function, contributions)
        return (
            gradient if dtype == radiance_gradient.dtype else gradient.to(radiance_gradient.dtype)
        )

    def _prepare_background(
        self, background: float | Tensor, lights: Float[Tensor, "... coefficients 3"]
    ) -> _PreparedBackground:
        """Convert a background to images, and compute what it adds to the covered pixels.

        In a pixel that the mesh covers partly, the background is visible, too. The
        result for a gray value and a single light is cached for the next call,
        because optimizations call `image` many times with the same background.
        """
        is_gray = isinstance(background, float | int)
        if not is_gray or lights.ndim > 2:
            images = as_background(background, self.settings.size, lights)
            return self._prepare_background_images(images, lights)
        key = (background, lights.dtype, lights.device)
        # Other threads may replace the cached pair meanwhile.
        cached = self._background_cache.get("last")
        if cached is None or cached[0] != key:
            images = as_background(background, self.settings.size, lights)
            prepared = self._prepare_background_images(images, lights)
            cached = key, prepared
            self._background_cache["last"] = cached
        return cached[1]

    def _prepare_background_images(
        self, images: Float[Tensor, "... 3 size size"], lights: Float[Tensor, "... coefficients 3"]
    ) -> _PreparedBackground:
        """Flatten background images, and compute what they add to the covered pixels."""
        flat_images = images.flatten(-2)
        at_pixels = flat_images.index_select(-1, self._select_distinct(self.pixels))
        if self.settings.encoding != "linear":
            # Repeat the background for each light before it is decoded, as `composite` does.
            # The decoding computes powers, whose last bit depends on the position of a
            # number in memory.
            at_pixels = at_pixels.expand(*lights.shape[:-2], *at_pixels.shape[-2:]).contiguous()
        coverage = self._select_distinct(self.coverage).to(images)[None]
        term = background_term(coverage, at_pixels, self.settings.encoding)
        return _PreparedBackground(images=flat_images, term=term)

    def to(self, device: torch.device | str) -> TransferOperator:
        """Return a copy of the operator on another device.

        Args:
            device: Device of the copy, such as "cuda".

        Raises:
            InputError: If there is no such device.
        """
        device = as_device(device)
        if device == self.distinct_transfer.device:
            return self
        sparse = self.sparse and self.sparse.to(device)
        tensors = {name: getattr(self, name).to(device) for name in TENSORS}
        # The copy does not group equal pixels. On a GPU, the gradients of the pixels of a group
        # would be added up in a random order, so that results would differ between runs.
        transfer = self.transfer.to(device)
        return replace(self, distinct_transfer=transfer, **tensors, sparse=sparse, distinct=None)

    @cached_property
    def transfer(self) -> Tensor:
        """Transfer matrix of all P covered pixels, in C channels, shape (C, K, P).

        If some pixels are equal, this property copies `distinct_transfer` to all
        pixels when it is first read.
        """
        if self.distinct is None:
            return self.distinct_transfer
        shape = (*self.distinct_transfer.shape[:-1], len(self.pixels))
        empty = self.distinct_transfer.new_empty(shape)
        return self.distinct.write(self.distinct_transfer, empty)

    @property
    def by_channel(self) -> Tensor:
        """Transfer matrix in three color channels, which include the albedo, shape (3, K, P)."""
        if self._shared is None:
            return self.transfer
        shared, *white = self.transfer
        colored = shared * self.albedo[:, None]
        return colored + white[0] if white else colored

    # The properties below are cached, because even indexing a tensor takes notable time for
    # images of 32² pixels.

    @cached_property
    def _shared(self) -> Tensor | None:
        """Channel of `distinct_transfer` that all colors share, shape (K, D), or None."""
        return self.distinct_transfer[0] if len(self.distinct_transfer) < COLORS else None

    @cached_property
    def _white(self) -> Tensor | None:
        """Channel of specular reflection that is added to all colors, shape (K, D), or None."""
        return self.distinct_transfer[1] if len(self.distinct_transfer) == 2 else None

    @cached_property
    def _distinct_albedo(self) -> Tensor:
        """Albedo of the distinct pixels, shape (3, D)."""
        return self._select_distinct(self.albedo)

    @cached_property
    def _distinct_in_image(self) -> DistinctPixels | None:
        """Groups of equal pixels as in `distinct`, with row-major indices of image pixels."""
        return None if self.distinct is None else self.distinct.at(self.pixels)

    def _select_distinct(self, values: Num[Tensor, "... P"]) -> Num[Tensor, "... D"]:
        """Select the values of the D distinct pixels from those of the P covered pixels."""
        if self.distinct is None:
            return values
        return values.index_select(-1, self.distinct.distinct)

    @cached_property
    def _background_cache(self) -> dict[str, tuple[Any, _PreparedBackground]]:
        """Cache for the background of the last call ("last"): its arguments and the result."""
        return {}

    @cached_property
    def _is_linear(self) -> bool:
        """Whether images have linear values, which are not encoded as sRGB."""
        return self.settings.encoding == "linear"

    @cached_property
    def _image_shape(self) -> tuple[int, int, int]:
        """Shape of one image, (3, size, size)."""
        return COLORS, self.settings.size, self.settings.size

    @cached_property
    def _light_shape(self) -> tuple[int, int]:
        """Shape of one light, (coefficients, 3)."""
        return self.basis.size, COLORS

    @cached_property
    def _pixels_by_color(self) -> Tensor:
        """Indices of the covered pixels, repeated for the three colors, shape (3, P)."""
        return self.pixels.expand(COLORS, -1)

    @cached_property
    def _placement(self) -> Tensor:
        """Matrix that writes the K used coefficients to their places among all coefficients.

        All other places become exactly 0. The matrix has one row for each
        coefficient, and one column for each used coefficient.
        """
        return torch.eye(self.basis.size).to(self.distinct_transfer)[:, self.nonzero]


class _PreparedBackground(NamedTuple):
    """Background of the images of an operator, in the form in which it is added.

    Attributes:
        images: Background images, shape (..., 3, size²).
        term: Linear values of the background that are added to the radiance of
            the D distinct pixels (one of each group of equal covered pixels),
            shape (..., 3, D).
    """

    images: Float[Tensor, "... 3 size²"]
    term: Float[Tensor, "... 3 D"]


class _Radiance(torch.autograd.Function):
    """Radiance of the covered pixels of a view, differentiable with respect to the light."""

    @staticmethod
    def forward(
        ctx: Any, lights: Float[Tensor, "... coefficients 3"], operator: TransferOperator
    ) -> Float[Tensor, "... 3 P"]:
        """Compute the radiance of the P covered pixels, times the fraction that the mesh covers."""
        ctx.operator = operator
        radiance = operator._radiance(lights)
        if operator.distinct is None:
            return radiance
        all_radiance = radiance.new_empty(*radiance.shape[:-1], len(operator.pixels))
        return operator.distinct.write(radiance, all_radiance)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "... 3 P"]) -> tuple[Tensor, None]:
        """Compute the gradient with respect to the lights."""
        return ctx.operator.light_gradient(upstream), None


class _Image(torch.autograd.Function):
    """Images under a light, differentiable with respect to the light.

    The matrix product, the background, the clamping and the encoding are a single
    operation of autograd, because autograd takes time for each operation.
    """

    @staticmethod
    def forward(
        ctx: Any,
        lights: Float[Tensor, "... coefficients 3"],
        operator: TransferOperator,
        background: _PreparedBackground,
    ) -> Float[Tensor, "... 3 size size"]:
        """Render one image under each light."""
        images, is_unclamped, clamped_values = operator._images(lights, background)
        ctx.operator = operator
        ctx.is_unclamped = is_unclamped
        ctx.clamped_values = clamped_values
        return images

    @staticmethod
    def backward(ctx: Any, upstream: Float[Tensor, "... 3 size size"]) -> tuple[Tensor, None, None]:
        """Compute the gradient with respect to the lights."""
        # `_backward_once` raises an error if a second derivative is computed. Its decorator
        # takes notable time, so it only runs if the caller set create_graph=True.
        if torch.is_grad_enabled():
            return _Image._backward_once(ctx, upstream)
        return _Image._backward(ctx, upstream)

    @staticmethod
    def _backward(
        ctx: Any, upstream: Float[Tensor, "... 3 size size"]
    ) -> tuple[Tensor, None, None]:
        """Compute the gradient with respect to the lights, without a check for second derivatives.

        A second derivative through this function would be wrong, without an error.
        """
        gradient = ctx.operator._gradient_of_images(upstream, ctx.is_unclamped, ctx.clamped_values)
        return gradient, None, None

    # The same function, but a second derivative through it raises an error.
    _backward_once = staticmethod(once_differentiable(_backward))


def require_image_gradient(image_gradient: Tensor, images: Tensor) -> None:
    """Check that the result of a user's function `loss_gradient` has the shape of the images."""
    is_tensor = isinstance(image_gradient, Tensor)
    if not is_tensor or image_gradient.shape != images.shape:
        given = f"the shape {tuple(image_gradient.shape)}"
        if not is_tensor:
            given = f"the type {type(image_gradient).__name__}"
        raise InputError(
            f"loss_gradient returned a value of {given}: "
            f"return a tensor in the shape of the images, {tuple(images.shape)}"
        )


def apply_transfer(
    lights: Float[Tensor, "... B K 3"],
    transfer: Float[Tensor, "... C K P"],
    albedo: Float[Tensor, "... 3 P"],
) -> Float[Tensor, "... B 3 P"]:
    """Compute the radiance of P pixels under B lights, with one or more transfer matrices.

    The lights are the left factor of the matrix product, which is several times
    faster on a CPU. With three channels, each color has its own, and `albedo` is not used.
    A single channel is shared by all colors, and multiplied by `albedo`. A second channel
    is specular reflection, which is added.
    """
    if transfer.shape[-3] == COLORS:
        # Multiply a matrix (B, K) and a matrix (K, P) for each color.
        return (lights.movedim(-1, -3) @ transfer).movedim(-3, -2)
    shared, *white = transfer.unbind(-3)
    # One row for each pair of a light and a color, so that one matrix product computes all.
    light_rows = lights.mT.flatten(-3, -2)
    radiance = (light_rows @ shared).unflatten(-2, (-1, COLORS)) * albedo.unsqueeze(-3)
    if white:
        radiance = radiance + (light_rows @ white[0]).unflatten(-2, (-1, COLORS))
    return radiance


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
        distinct = None
        if self._is_uniform_on_faces(surface, channels):
            distinct = find_distinct_pixels(fragments, albedo)
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
            dense.append(
                self._environment_rows(self.basis.environment, surface, channels, distinct)
            )
        all_rows = self._concatenate(dense, channels.number, len(fragments.pixels))
        return TransferOperator(
            distinct_transfer=all_rows.transfer,
            albedo=albedo,
            coverage=fragments.coverage.to(self.dtype),
            pixels=fragments.pixels,
            nonzero=all_rows.coefficients,
            settings=self.settings,
            basis=self.basis,
            sparse=concatenate_entries(sparse),
            distinct=distinct,
        )

    def _is_uniform_on_faces(self, surface: Surface, channels: _Channels) -> bool:
        """Tell whether two pixels that the same face fills have the same values in the matrix.

        This needs flat normals, a matte surface in which all colors share a
        channel, no shadows, no lamps and no projectors.
        """
        is_matte = surface.gloss is None and channels.is_shared
        has_open_sky = self.transport is None and not self.basis.local_lights
        return is_matte and has_open_sky and self.settings.normals == "flat"

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
        distinct: DistinctPixels | None,
    ) -> _DenseRows:
        """Compute the rows of the transfer matrix for environment light.

        The rows contain shadows and bounces. With `distinct`, they are rows for the
        distinct pixels only.
        """
        harmonics_basis = environment.basis
        all_coefficients = torch.arange(harmonics_basis.size)
        if surface.gloss is None:
            weights = None if channels.is_shared else channels.sample_albedo
            transfer = _box_filter(surface, weights, harmonics_basis, self.dtype, distinct)
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
    distinct: DistinctPixels | None = None,
) -> Float[Tensor, "C K P"]:
    """Compute the transfer matrix of a matte surface under an open sky, without shadows.

    An entry for a pixel and an SH coefficient is the mean of albedo · A_l Y_lm(n)
    over the samples of the pixel (box filter). A_l is the factor of the coefficient
    in the irradiance (`harmonics.lambertian_factors`), Y_lm the harmonic, and n the
    normal of a sample. Sums are computed in float64. An `albedo` of None is 1 in a single
    channel. With `distinct`, only one pixel of each group is computed, which needs flat
    normals and an albedo of 1.
    """
    fragments = surface.fragments
    pixel_count = len(fragments.pixels)
    is_flat = surface.settings.normals == "flat"
    if is_flat:
        # Irradiance of each seen face from a light with a single coefficient of 1: one row for
        # each face, one column for each coefficient.
        face_values = basis.irradiance(surface.face_planes)
        if albedo is None and _are_pixels_mostly_filled(fragments):
            return _copy_from_faces(fragments, face_values, dtype, distinct)
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


def _are_pixels_mostly_filled(fragments: Fragments) -> bool:
    """Tell whether more than half of the covered pixels show a single face in all samples."""
    is_filled = fragments.groups.sample_count == fragments.samples**2
    return 2 * int(is_filled.sum()) > len(fragments.pixels)


def _copy_from_faces(
    fragments: Fragments,
    face_values: Float[Tensor, "G K"],
    dtype: torch.dtype,
    distinct: DistinctPixels | None,
) -> Tensor:
    """Compute `_box_filter` for flat normals and an albedo of 1, by copying values of faces.

    A pixel that a single face fills has the values of this face. Only the other
    pixels need sums over several faces. The face values are the irradiance A_l Y_lm(n) from
    each harmonic.
    """
    # A group is all samples of one face in a pixel.
    group_to_pixel, group_to_face, sample_count = fragments.groups
    groups_per_pixel = torch.bincount(group_to_pixel, minlength=len(fragments.pixels))
    first_group = _row_starts(groups_per_pixel)[:-1]
    if distinct is not None:
        groups_per_pixel = groups_per_pixel.index_select(0, distinct.distinct)
        first_group = first_group.index_select(0, distinct.distinct)
    # Adding 0.0 turns -0.0 into 0.0. The copied values then have the same bits as sums, which
    # start at 0.0 and are never -0.0.
    values_by_function = (face_values + 0.0).T.to(dtype).contiguous()
    # First give each pixel (column) the values of the face of its first group.
    transfer = values_by_function.index_select(1, group_to_face.index_select(0, first_group))
    # Then replace the pixels that no single face fills. A group of samples is partial if it
    # has fewer samples than a pixel.
    is_partial_group = sample_count < fragments.samples**2
    partial_groups = indices_of_true(is_partial_group)
    partial_to_face = group_to_face.index_select(0, partial_groups)
    partial_sample_count = sample_count.index_select(0, partial_groups)
    partial_weights = partial_sample_count.double() / fragments.samples**2
    partial_pixels = indices_of_true(is_partial_group.index_select(0, first_group))
    entry_starts = _row_starts(groups_per_pixel.index_select(0, partial_pixels))
    for first in range(0, len(partial_pixels), BLOCK):
        block_starts = entry_starts[first : first + BLOCK + 1]
        entries = slice(int(block_starts[0]), int(block_starts[-1]))
        sums = _weighted_row_sums(
            partial_weights[entries], partial_to_face[entries], block_starts, face_values
        )
        block_pixels = partial_pixels[first : first + BLOCK].expand(len(transfer), -1)
        transfer.scatter_(1, block_pixels, sums.to(dtype).T.contiguous())
    return transfer[None]


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

    The light passes the coat on its way to the diffuse layer below, and on its way
    back.
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
