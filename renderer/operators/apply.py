"""Views of a mesh as linear operators, which map a light to an image.

Before clamping, the radiance of every pixel is linear in the coefficients U of
the light (the paper's appendix B.2): radiance = Uᵀ T. The transfer matrix T is
computed once for a mesh and a camera, and multiplied with every light. T
contains the box filter, the texture and the albedo exactly. It also contains
gloss (`renderer.surface.gloss`), and shadows and bounces (the package
`renderer.operators`).

Shapes use these letters: the mesh covers P pixels of a view, and K coefficients of
the light reach a pixel. The dots (...) are any axes of a batch of lights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import linear

from renderer import errors
from renderer.image import as_background, background_term, composite, encode, encode_gradient
from renderer.light.basis import HARMONICS, Basis
from renderer.modes import once_differentiable, without_autocast
from renderer.settings import ImageSettings
from renderer.visibility.fragments import on_device

# Number of color channels.
COLORS = 3


# Coefficients of lights.
Lights = Float[Tensor, "... coefficients 3"]
# Values of the P covered pixels under each light.
PixelValues = Float[Tensor, "... 3 P"]


class SparseTransfer(NamedTuple):
    """The N nonzero entries of a matrix from light coefficients to pixel radiance.

    Attributes:
        function: Index of the basis function (lamp, or pixel of a projector) whose
            light each entry describes, int64, shape (N,).
        pixel: Index of the covered pixel of each entry, int64, shape (N,).
        weight: Radiance of the pixel per unit of the function's coefficient, in
            one channel that all colors share or in three, shape (N, C).
    """

    function: Int[Tensor, " N"]
    pixel: Int[Tensor, " N"]
    weight: Float[Tensor, "N C"]

    def to(self, device: torch.device | str) -> SparseTransfer:
        """Return a copy of the entries on another device."""
        return SparseTransfer(*(field.to(device) for field in self))


def concatenate_entries(parts: Sequence[SparseTransfer]) -> SparseTransfer:
    """Concatenate the nonzero entries of several transfer matrices, in their order."""
    return SparseTransfer(*map(torch.cat, zip(*parts, strict=True)))


@dataclass(frozen=True)
class TransferOperator:
    """Transfer matrix of a view of a mesh, which maps a light to an image.

    The matrix maps the coefficients of a light to the linear radiance of the P
    covered pixels (those that show the mesh), times the coverage of each pixel.
    All floating-point tensors have the same dtype.

    Attributes:
        transfer: Radiance of the P covered pixels per unit of each of K
            coefficients, in C channels, shape (C, K, P). C = 3 is one channel for
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
        sparse: Nonzero entries of further rows of the matrix, in three channels that
            include the albedo. These are rows of projected patterns, which are
            mostly zero. None without such rows.

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

    def image(
        self, lights: Float[Tensor, "*lights coefficients 3"], background: float | Tensor = 0.5
    ) -> Float[Tensor, "*lights 3 height width"]:
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
            shape (..., 3, height, width).

        Raises:
            InputError: If `lights` has NaN or another number of coefficients
                than the basis, or if `background` has a wrong shape.
        """
        lights = self.require_lights(lights)
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
    ) -> tuple[Float[Tensor, "*lights 3 height width"], Float[Tensor, "*lights coefficients 3"]]:
        """Render images, and compute the gradient of a loss with respect to the lights.

        The gradient is computed without autograd. The results equal those of
        `image` and `torch.autograd.grad` to the bit. For small images, autograd
        would take most of the time of an optimization step.

        Args:
            lights: Coefficients in the basis of the operator,
                shape (..., coefficients, 3).
            loss_gradient: Function that takes the images, shape
                (..., 3, height, width), and returns the gradient of the loss with
                respect to the images, in the same shape.
                `torch.func.grad(loss)` makes such a function from a loss.
            background: Gray value, color or images in [0, 1]. See
                `renderer.image.as_background`.

        Returns:
            A tuple of

            - the images in [0, 1], shape (..., 3, height, width);
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
        lights = self.require_lights(lights).detach()
        if isinstance(background, Tensor):
            background = background.detach()
        images, covered = self._images(lights, self._prepare_background(background, lights))
        image_gradient = loss_gradient(images)
        require_image_gradient(image_gradient, images)
        return images, self._gradient_of_images(image_gradient.detach(), covered)

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
        return self._radiance(self.require_lights(lights))

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
        radiance_gradient = errors.as_tensor("radiance_gradient", radiance_gradient)
        errors.require_bounded(radiance_gradient=radiance_gradient)
        errors.require_shape("radiance_gradient", radiance_gradient, "...", *self.albedo.shape)
        return self._light_gradient(radiance_gradient)

    def _images(
        self, lights: Lights, background: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, tuple[PixelValues, PixelValues]]:
        """Render images without autograd, and return what the gradient needs.

        These are two values for each covered pixel: 1 if clamping left its value alone and 0 if
        not, and the clamped linear value.
        """
        background_images, background_values = background
        unclamped = self._radiance(lights).add_(background_values)
        clamped_values = unclamped.clamp(0, 1)
        # 1.0 for values in [0, 1], including the limits: they have a gradient. 0.0 for others.
        is_unclamped = unclamped.eq_(clamped_values)
        encoded = encode(clamped_values, self.settings.encoding)
        batch_shape = lights.shape[:-2]
        # Copy the background, and write the covered pixels over it.
        canvas = background_images.expand(*batch_shape, -1, -1)
        images = canvas.clone(memory_format=torch.contiguous_format)
        # `scatter_` takes half the time of `index_copy_` on a CPU.
        images.scatter_(-1, self.pixels.expand(*batch_shape, COLORS, -1), encoded)
        image_shape = (*batch_shape, COLORS, *self.settings.shape)
        return images.view(image_shape), (is_unclamped, clamped_values)

    def _gradient_of_images(
        self, image_gradient: Float[Tensor, "... 3 height width"], covered: tuple[Tensor, Tensor]
    ) -> Lights:
        """Convert a gradient from images to lights, with the second result of `_images`."""
        is_unclamped, clamped_values = covered
        pixel_index = self.pixels.expand(is_unclamped.shape)
        # `gather` is faster than `index_select`, most of all for three axes.
        pixel_gradient = image_gradient.flatten(-2).gather(-1, pixel_index)
        pixel_gradient = encode_gradient(clamped_values, pixel_gradient, self.settings.encoding)
        gradient = self._light_gradient(pixel_gradient.mul_(is_unclamped))
        # Checking the few numbers of the result is fast. If one is not finite,
        # `require_bounded` checks the gradient of all pixels and raises the error.
        if not math.isfinite(gradient.sum().item()):
            errors.require_bounded(image_gradient=pixel_gradient)
        return gradient

    def require_lights(self, lights: object) -> Tensor:
        """Convert lights to a tensor, and check that they fit the basis, and have no NaN.

        Args:
            lights: Coefficients, shape (..., coefficients, 3).

        Returns:
            Coefficients as a tensor of floating-point numbers on the device of the operator.

        Raises:
            InputError: If `lights` has NaN or another number of coefficients
                than the basis.
        """
        lights = errors.as_tensor("lights", lights).to(self.transfer.device)
        if lights.shape[-2:] != (self.basis.size, COLORS):
            errors.require_shape(f"lights of {self.basis}", lights, "...", self.basis.size, COLORS)
        # The sum of squares is faster to check than each value. If it is too large or NaN,
        # `require_bounded` checks each value and raises the error.
        values = lights.detach().reshape(-1)
        if not torch.dot(values, values).item() <= errors.MAX_MAGNITUDE**2:
            errors.require_bounded(lights=lights)
        return lights

    @without_autocast
    def _radiance(self, lights: Lights) -> PixelValues:
        """Compute `radiance` without checks."""
        # Coefficients that change a pixel. All other coefficients have no row in the matrix.
        used_lights = lights.index_select(-2, self.nonzero).to(self.transfer.dtype)
        # See `_channels`: one channel, two with specular reflection, or three colors.
        shared, *white = self._channels
        if len(self._channels) == COLORS:
            radiance = torch.einsum("...kc,ckp->...cp", used_lights, self.transfer)
        else:
            radiance = (used_lights.mT @ shared).mul_(self.albedo)
            if white:
                radiance.add_(used_lights.mT @ white[0])
        if self.sparse is not None:
            light_of_entry = lights.to(radiance.dtype).index_select(-2, self.sparse.function)
            # Radiance that each nonzero entry of the matrix adds to its pixel: one row for
            # each entry, one column for each color.
            contributions = light_of_entry * self.sparse.weight
            radiance = radiance.index_add(-1, self.sparse.pixel, contributions.mT)
        return radiance.to(lights.dtype)

    @without_autocast
    def _light_gradient(self, radiance_gradient: PixelValues) -> Lights:
        """Compute `light_gradient` without checks."""
        upstream = radiance_gradient.to(self.transfer.dtype)
        # Compute the gradient with respect to the K used coefficients, shape (..., 3, K). The
        # function `linear(a, b)` of torch is a bᵀ.
        shared, *white = self._channels
        if len(self._channels) == COLORS:
            used_gradient = torch.einsum("...cp,ckp->...ck", upstream, self.transfer)
        else:
            used_gradient = linear(upstream * self.albedo, shared)
            if white:
                used_gradient = used_gradient + linear(upstream, white[0])
        # The gradient of unused coefficients is 0.
        gradient = self._placement @ used_gradient.mT
        if self.sparse is not None:
            gradient_of_entry = upstream.mT.index_select(-2, self.sparse.pixel)
            # Each nonzero entry of the sparse matrix links a pixel to a coefficient of the
            # light. One row for each entry: the gradient that it adds to its coefficient.
            contributions = gradient_of_entry * self.sparse.weight
            gradient = gradient.index_add(-2, self.sparse.function, contributions)
        return gradient.to(radiance_gradient.dtype)

    def _prepare_background(
        self, background: float | Tensor, lights: Lights
    ) -> tuple[Tensor, Tensor]:
        """Convert a background to images, and to what it adds to partly covered pixels.

        The result for a gray value and a single light is cached, because optimizations repeat it.
        """
        key = (background, lights.dtype, lights.device)
        is_kept = isinstance(background, float | int) and lights.ndim <= 2
        # Other threads may replace the pair meanwhile.
        last_key, last = self._last_background.get("pair", (None, None))
        if is_kept and last is not None and last_key == key:
            return last
        images = as_background(background, self.settings.size, lights).flatten(-2)
        # Background of the P covered pixels. Only these mix with the mesh.
        at_pixels = images.index_select(-1, self.pixels)
        if self.settings.encoding != "linear":
            # Repeat the background for each light before it is decoded, as `composite` does.
            # The decoding computes powers, whose last bit depends on the position of a
            # number in memory.
            at_pixels = at_pixels.expand(*lights.shape[:-2], *at_pixels.shape[-2:]).contiguous()
        coverage = self.coverage.to(images)[None]
        prepared = (images, background_term(coverage, at_pixels, self.settings.encoding))
        if is_kept:
            self._last_background["pair"] = key, prepared
        return prepared

    def to(self, device: torch.device | str) -> TransferOperator:
        """Return a copy of the operator on another device.

        Args:
            device: Device of the copy, such as "cuda".

        Raises:
            InputError: If there is no such device.
        """
        device = errors.as_device(device)
        return self if device == self.transfer.device else on_device(self, device)

    @property
    def by_channel(self) -> Tensor:
        """`transfer` in three color channels, which include the albedo, shape (3, K, P)."""
        if len(self.transfer) == COLORS:
            return self.transfer
        # Specular reflection does not have the color of the surface, so it is added behind the
        # product.
        shared, *white = self.transfer
        colored = shared * self.albedo[:, None]
        return colored + white[0] if white else colored

    # The properties below are cached, because even indexing a tensor takes notable time for
    # images of 32² pixels.

    @cached_property
    def _channels(self) -> list[Tensor]:
        """Channels of `transfer`, shape (K, P) each.

        One is shared by all colors. A second one of specular reflection is added to all. Three are
        those of the colors.
        """
        return list(self.transfer)

    @cached_property
    def _last_background(self) -> dict[str, tuple[Any, tuple[Tensor, Tensor]]]:
        """Key of the last gray background, and what was prepared for it ("pair")."""
        return {}

    @cached_property
    def _placement(self) -> Tensor:
        """Matrix that writes the K used coefficients among all others, which become exactly 0."""
        return torch.eye(self.basis.size).to(self.transfer)[:, self.nonzero]


class _Image(torch.autograd.Function):
    """Images under a light, differentiable with respect to the light.

    The matrix product, the background, the clamping and the encoding are a single
    operation of autograd, because autograd takes time for each operation.
    """

    @staticmethod
    def forward(
        ctx: Any, lights: Lights, operator: TransferOperator, background: tuple[Tensor, Tensor]
    ) -> Float[Tensor, "... 3 height width"]:
        """Render one image under each light."""
        images, ctx.covered = operator._images(lights, background)
        # `once_differentiable` looks for saved tensors.
        ctx.save_for_backward(lights)
        ctx.operator = operator
        return images

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, upstream: Float[Tensor, "... 3 height width"]
    ) -> tuple[Tensor, None, None]:
        """Compute the gradient with respect to the lights."""
        return ctx.operator._gradient_of_images(upstream, ctx.covered), None, None


def require_image_gradient(image_gradient: Tensor, images: Tensor) -> None:
    """Check that the result of a user's function `loss_gradient` has the shape of the images."""
    name = "the result of loss_gradient"
    errors.require_kind(name, image_gradient, Tensor, "a tensor in the shape of the images")
    if image_gradient.shape != images.shape:
        errors.require_shape(name, image_gradient, *images.shape)
