"""Light of a projector on photographs, and what a camera then sees.

A photograph is treated as a flat print, whose linear values are its albedo. A projector shows a
slide (a picture) on it. The light is multiplied by the shading of a random smooth surface and, in
attacks, by smooth factors (gain). Weak ambient light is added, and a camera exposes the result:

    radiance = albedo · (slide · gain · shading + ambient)

There are no shadows, no reflections and no depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from augment.random_streams import generator
from augment.scene.patterns import draw_slides, interpolate_smoothly, luminance
from renderer.errors import InputError, require_kind, require_whole
from renderer.image import clamp, decode, encode, to_bytes, to_unit

# A random smooth surface interpolates random heights at a grid of this number of points per side.
SURFACE_NODES = 4
# Largest standard deviation of the random heights of a surface, in units of half the width of the
# image.
MAX_STEEPNESS = 0.3
# Largest angle in degrees between the light of the projector and the normal of a flat print.
MAX_POLAR = 60.0
# Smallest and largest ambient light, in units of the light of a white slide.
AMBIENT = (0.01, 0.1)
# Smallest and largest random change of the exposure, in stops.
STOPS = (-1.0, 0.5)
# The exposure divides by the mean luminance of an image, but at least by this, so that black images
# stay dark.
DARKEST = 1e-6


@dataclass(frozen=True)
class ProjectedLight:
    """Light of a projector on B photographs, and the exposure of the camera that sees them.

    Attributes:
        slide: Picture that the projector shows on each photograph, as linear
            light in [0, 1], shape (B, 3, H, W).
        shading: Cosine between the light and the normal of the surface, by which
            the slide is multiplied, in [0, 1], shape (B, 1, H, W).
        ambient: Light that is the same everywhere, shape (B, 1, 1, 1).
        stops: Exposure in stops, shape (B, 1, 1, 1). At 0, the mean luminance
            is that of the unchanged photograph.
    """

    slide: Float[Tensor, "B 3 H W"]
    shading: Float[Tensor, "B 1 H W"]
    ambient: Float[Tensor, "B 1 1 1"]
    stops: Float[Tensor, "B 1 1 1"]

    def to(self, device: torch.device | str) -> ProjectedLight:
        """Return a copy whose tensors are on a device."""
        return ProjectedLight(*(getattr(self, item.name).to(device) for item in fields(self)))

    def select(self, photographs: Int[Tensor, " A"]) -> ProjectedLight:
        """Return the light on some of the photographs."""
        return ProjectedLight(*(getattr(self, item.name)[photographs] for item in fields(self)))

    @classmethod
    def join(cls, lights: Sequence[ProjectedLight]) -> ProjectedLight:
        """Return the light on the photographs of several lights."""
        names = [item.name for item in fields(cls)]
        return cls(*(torch.cat([getattr(light, name) for light in lights]) for name in names))

    def light(
        self, log_gain: Float[Tensor, "B 3 cells cells"] | None = None
    ) -> Float[Tensor, "B 3 H W"]:
        """Compute the light that falls on each pixel: slide · gain · shading + ambient.

        Logarithms of gains are interpolated linearly between the centers of the cells. None stands
        for no gain.
        """
        slide = self.slide
        if log_gain is not None:
            size = slide.shape[-2:]
            # Interpolate the logarithms from the cells to the pixels, shape (B, 3, H, W).
            log_gain_of_pixel = F.interpolate(log_gain, size, mode="bilinear", align_corners=False)
            slide = slide * log_gain_of_pixel.exp()
        return slide * self.shading + self.ambient

    def apply(
        self,
        photographs: Float[Tensor, "B 3 H W"],
        log_gain: Float[Tensor, "B 3 cells cells"] | None = None,
    ) -> Float[Tensor, "B 3 H W"]:
        """Compute images of photographs in the light of the projector.

        Photographs and images are sRGB, and gains are logarithms.
        """
        return self.expose(decode(photographs, "srgb"), log_gain)

    def expose(
        self,
        albedo: Float[Tensor, "B 3 H W"],
        log_gain: Float[Tensor, "B 3 cells cells"] | None = None,
    ) -> Float[Tensor, "B 3 H W"]:
        """Compute images of linear photographs in the light of the projector.

        The camera exposes an image such that its mean luminance is 2^stops
        times that of the photograph, before values above 1 are clamped. The
        result is differentiable in `log_gain`.
        """
        radiance = albedo * self.light(log_gain)
        # Mean luminance before and after the photograph is lit, shape (B, 1, 1, 1) each.
        mean_before = luminance(albedo).mean((2, 3), keepdim=True)
        mean_after = luminance(radiance).mean((2, 3), keepdim=True)
        exposure = 2**self.stops * mean_before / mean_after.clamp(min=DARKEST)
        return encode(clamp(exposure * radiance), "srgb")


def draw_shading(
    count: int, size: int, draws: torch.Generator
) -> Float[Tensor, "count 1 size size"]:
    """Draw the shading of random smooth surfaces in light from random directions.

    It is the cosine between normal and light, or 0 if the surface faces away.
    """
    # Three numbers in [0, 1] of each surface, shape (count, 1, 1) each: steepness, azimuth and
    # polar angle of the light, as fractions of their ranges.
    steepness, turn, tilt = torch.rand(3, count, 1, 1, generator=draws)
    node_heights = torch.randn(count, 1, SURFACE_NODES, SURFACE_NODES, generator=draws)
    # Height of each pixel, shape (count, 1, size, size).
    height = MAX_STEEPNESS * steepness[:, None] * interpolate_smoothly(node_heights, size)
    # Slope of the surface. The image is 2 units wide, so a pixel has the width 2 / size.
    slope_down, slope_right = torch.gradient(height[:, 0], spacing=2 / size, dim=(1, 2))
    polar = math.radians(MAX_POLAR) * tilt
    azimuth = 2 * math.pi * turn
    # Components of the unit vector towards the light. The one along the view is polar.cos().
    to_right = polar.sin() * azimuth.cos()
    to_bottom = polar.sin() * azimuth.sin()
    length = (1 + slope_right**2 + slope_down**2).sqrt()
    # Product of the light's vector with the normal (-slope_right, -slope_down, 1) / length.
    cosine = (polar.cos() - to_right * slope_right - to_bottom * slope_down) / length
    return cosine.clamp(min=0)[:, None]


def draw_projected_light(
    count: int,
    size: int,
    draws: torch.Generator,
    photographs: UInt8[Tensor, "N 3 H W"] | None = None,
) -> ProjectedLight:
    """Draw the random light of a projector: slide, shading, ambient light and exposure.

    Slides show photographs only if some are given.
    """
    slide = draw_slides(count, size, draws, photographs)
    shading = draw_shading(count, size, draws)
    # Fractions in [0, 1] of the ranges of the ambient light and of the exposure.
    ambient, stops = torch.rand(2, count, 1, 1, 1, generator=draws)
    return ProjectedLight(
        slide=slide,
        shading=shading,
        ambient=AMBIENT[0] + (AMBIENT[1] - AMBIENT[0]) * ambient,
        stops=STOPS[0] + (STOPS[1] - STOPS[0]) * stops,
    )


def relight_photographs(
    photographs: Tensor,
    seed: int = 0,
    *,
    slides: Tensor | None = None,
) -> Tensor:
    """Show photographs in the light of a projector with random slides.

    This models a flat print in the light of a projector, with the shading of a
    random smooth surface. It needs neither meshes nor labels.

    Args:
        photographs: Square photographs, sRGB of 8 bits, uint8, shape
            (N, 3, size, size).
        seed: Seed of all random draws.
        slides: Photographs that the projector may show as slides, uint8, shape
            (M, 3, H, W). None for generated slides only.

    Returns:
        Photographs in the light of the projector, uint8, shape
        (N, 3, size, size).

    Raises:
        InputError: If the photographs have another dtype or shape.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> photographs = torch.full((2, 3, 8, 8), 128, dtype=torch.uint8)
        >>> nb.relight_photographs(photographs, seed=1).shape
        torch.Size([2, 3, 8, 8])
    """
    require_photographs("photographs", photographs)
    if slides is not None:
        require_photographs("slides", slides)
    require_whole("seed", seed)
    count, _, size, _ = photographs.shape
    light = draw_projected_light(count, size, generator(seed, "relight"), slides)
    relit = light.to(photographs.device).apply(to_unit(photographs))
    return to_bytes(relit)


def require_photographs(name: str, photographs: Tensor) -> None:
    """Check that a value is a tensor of square photographs of 8 bits."""
    require_kind(name, photographs, Tensor, "a tensor of photographs, uint8")
    shape = tuple(photographs.shape)
    is_square = len(shape) == 4 and shape[1] == 3 and shape[2] == shape[3]
    if photographs.dtype != torch.uint8 or not is_square or not shape[0]:
        raise InputError(
            f"{name} is {str(photographs.dtype).removeprefix('torch.')} of shape {shape}: "
            "give uint8 of shape (N, 3, size, size)",
        )
