"""Light of a projector on photographs, and what a camera then sees.

A photograph is a flat print. Its linear values are its albedo. A projector
shows a slide on it, at the shading of a random smooth surface. Weak ambient
light is added, and a camera exposes the result:

    radiance = albedo · (slide · gain · shading + ambient)

There are no shadows, no reflections and no depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.photographs.slides import draw_slides, interpolate_smoothly
from augment.random_streams import generator
from augment.scene.patterns import luminance
from renderer.errors import InputError
from renderer.image import clamp, decode, encode, to_bytes, to_unit
from renderer.validation import require_kind, require_seed

# `draw_shading` draws the heights of a surface at a grid with this number of nodes per side.
SURFACE_NODES = 4
# Largest standard deviation of these heights, in units of half the width of the image.
MAX_STEEPNESS = 0.3
# Largest angle between the light and the normal of the flat print, in degrees.
MAX_POLAR = 60.0
# Smallest and largest ambient light that `draw_projected_light` draws. A white slide has the
# light 1.
AMBIENT = (0.01, 0.1)
# Smallest and largest change of the exposure that `draw_projected_light` draws, in stops.
STOPS = (-1.0, 0.5)
# Smallest mean luminance by which `ProjectedLight.expose` divides. Darker images stay dark.
DARKEST = 1e-6


@dataclass(frozen=True)
class ProjectedLight:
    """Light of a projector on B photographs, with the exposure of the camera.

    Attributes:
        slide: Linear light of the slide in [0, 1], shape (B, 3, H, W).
        shading: Fraction of this light that the surface reflects, in [0, 1],
            shape (B, 1, H, W).
        ambient: Light that is the same everywhere, shape (B, 1, 1, 1).
        stops: Exposure relative to the photograph, shape (B, 1, 1, 1). At 0,
            the mean luminance is that of the unchanged photograph.
    """

    slide: Tensor
    shading: Tensor
    ambient: Tensor
    stops: Tensor

    def to(self, device: torch.device | str) -> ProjectedLight:
        """Return a copy on a device."""
        return replace(
            self,
            slide=self.slide.to(device),
            shading=self.shading.to(device),
            ambient=self.ambient.to(device),
            stops=self.stops.to(device),
        )

    def light(self, log_gain: Tensor | None = None) -> Tensor:
        """Compute the light that falls on each pixel.

        Args:
            log_gain: Logarithm of the factor of the slide in each cell, shape
                (B, 3, cells, cells). It is interpolated linearly between the
                centers of the cells, so that it exceeds no value. None for
                the slide as it is.

        Returns:
            Linear light, shape (B, 3, H, W).
        """
        slide = self.slide
        if log_gain is not None:
            size = slide.shape[-2:]
            # Logarithm of the factor of each pixel, shape (B, 3, H, W).
            log_gain_of_pixel = F.interpolate(log_gain, size, mode="bilinear", align_corners=False)
            slide = slide * log_gain_of_pixel.exp()
        return slide * self.shading + self.ambient

    def apply(self, photographs: Tensor, log_gain: Tensor | None = None) -> Tensor:
        """Compute what a camera sees of photographs.

        Args:
            photographs: Photographs in [0, 1], sRGB, shape (B, 3, H, W).
            log_gain: Logarithm of the factor of the slide; see `light`.

        Returns:
            Images in [0, 1], sRGB, shape (B, 3, H, W).
        """
        return self.expose(decode(photographs, "srgb"), log_gain)

    def expose(self, albedo: Tensor, log_gain: Tensor | None = None) -> Tensor:
        """Compute what a camera sees. The result is differentiable in the gain.

        The exposure makes the mean luminance, before overexposed values are
        clamped, 2^stops times that of the photograph.

        Args:
            albedo: Linear values of the photographs, shape (B, 3, H, W).
            log_gain: Logarithm of the factor of the slide; see `light`.

        Returns:
            Images in [0, 1], sRGB, shape (B, 3, H, W).
        """
        radiance = albedo * self.light(log_gain)
        # Mean luminance of the photograph and of the relit print, shape (B, 1, 1, 1).
        mean_of_photograph = luminance(albedo).mean((2, 3), keepdim=True)
        mean_of_print = luminance(radiance).mean((2, 3), keepdim=True)
        exposure = 2**self.stops * mean_of_photograph / mean_of_print.clamp(min=DARKEST)
        return encode(clamp(exposure * radiance), "srgb")


def draw_shading(count: int, size: int, draws: torch.Generator) -> Tensor:
    """Draw the shading of random smooth surfaces in light from random directions.

    Args:
        count: Number of surfaces.
        size: Pixels per side.
        draws: CPU generator of the random numbers.

    Returns:
        Cosine between normal and light, 0 where the surface faces away, shape
        (count, 1, size, size).
    """
    # Numbers in [0, 1], shape (count, 1, 1) each: steepness, and azimuth and polar angle of the
    # light as fractions of their ranges.
    steepness, turn, tilt = torch.rand(3, count, 1, 1, generator=draws)
    node_heights = torch.randn(count, 1, SURFACE_NODES, SURFACE_NODES, generator=draws)
    # Height of each pixel, shape (count, 1, size, size).
    height = MAX_STEEPNESS * steepness[:, None] * interpolate_smoothly(node_heights, size)
    # The unit of length is half the width of the image, so a pixel is 2 / size wide.
    slope_down, slope_right = torch.gradient(height[:, 0], spacing=2 / size, dim=(1, 2))
    polar = math.radians(MAX_POLAR) * tilt
    azimuth = 2 * math.pi * turn
    # Components of the unit vector towards the light. The third is polar.cos().
    to_right = polar.sin() * azimuth.cos()
    to_bottom = polar.sin() * azimuth.sin()
    # The normal is (-slope_right, -slope_down, 1) / length.
    length = (1 + slope_right**2 + slope_down**2).sqrt()
    cosine = (polar.cos() - to_right * slope_right - to_bottom * slope_down) / length
    return cosine.clamp(min=0)[:, None]


def draw_projected_light(
    count: int,
    size: int,
    draws: torch.Generator,
    photographs: Tensor | None = None,
) -> ProjectedLight:
    """Draw slides, shading, ambient light and exposure at random.

    Args:
        count: Number of lights.
        size: Pixels per side.
        draws: CPU generator of the random numbers.
        photographs: Photographs that slides may show, uint8,
            shape (N, 3, H, W). None for slides without photographs.

    Returns:
        The lights, on the CPU.
    """
    slide = draw_slides(count, size, draws, photographs)
    shading = draw_shading(count, size, draws)
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
        slides: Photographs that the projector may show, uint8, shape
            (M, 3, H, W). None for generated slides only.

    Returns:
        Relit photographs, uint8, shape (N, 3, size, size).

    Raises:
        InputError: If the photographs are no such tensor.

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
    require_seed("seed", seed)
    count, _, size, _ = photographs.shape
    light = draw_projected_light(count, size, generator(seed, "relight"), slides)
    relit = light.to(photographs.device).apply(to_unit(photographs))
    return to_bytes(relit)


def require_photographs(name: str, photographs: Tensor) -> None:
    """Check that a value holds square photographs of 8 bits.

    Args:
        name: Name of the argument.
        photographs: Value to check.

    Raises:
        InputError: If it is no tensor of uint8 of shape (N, 3, size, size).
    """
    require_kind(name, photographs, Tensor, "a tensor of photographs, uint8")
    shape = tuple(photographs.shape)
    is_square = len(shape) == 4 and shape[1] == 3 and shape[2] == shape[3]
    if photographs.dtype != torch.uint8 or not is_square or not shape[0]:
        raise InputError(
            f"{name} is {str(photographs.dtype).removeprefix('torch.')} of shape {shape}: "
            "give uint8 of shape (N, 3, size, size)",
        )
