"""Models of light that change a photograph, each a function of a few numbers in [0, 1].

The linear colors of a photograph stand for the albedo of what it shows:

    radiance = albedo · light

A model maps numbers to the light of each pixel, which is 1 in the photograph itself. It is
differentiable in the first `dimensions` numbers, which an attack may change. The other `constants`
choose the kind of a pattern and its random parts. In a light with a `meter`, the camera sets its
exposure such that the mean luminance of the light is 2^stops.

The image is 2 units wide: x points to the right, y down, and heights towards the camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from augment.scene.patterns import (
    AMBIENT,
    DARKEST,
    MAX_POLAR,
    MAX_STEEPNESS,
    STOPS,
    SURFACE_NODES,
    ProjectedLight,
    draw_slides,
    lambert,
    luminance,
    random_colors,
    require_photographs,
)
from renderer import errors
from renderer.errors import InputError
from renderer.settings import Size, height_and_width

# Horizontal field of view in degrees of the camera that a depth map is from.
FIELD_OF_VIEW = 60.0


def between(numbers: Tensor, low: float, high: float) -> Tensor:
    """Map numbers in [0, 1] to an interval."""
    return low + (high - low) * numbers


def geometric(numbers: Tensor, low: float, high: float) -> Tensor:
    """Map numbers in [0, 1] to an interval whose logarithm is uniform."""
    return between(numbers, math.log(low), math.log(high)).exp()


def axes(size: Size, like: Tensor) -> tuple[Float[Tensor, "1 1 1 W"], Float[Tensor, "1 1 H 1"]]:
    """Return x of the columns and y of the rows of an image."""
    height, width = height_and_width(size)
    x, y = (
        (torch.arange(count, device=like.device, dtype=like.dtype) * 2 + (1 - count)) / width
        for count in (width, height)
    )
    return x.view(1, 1, 1, -1), y.view(1, 1, -1, 1)


@lru_cache(maxsize=64)
def spline(nodes: int, pixels: int, spacing: float = 0.0) -> Float[Tensor, "pixels nodes"]:
    """Return the matrix that interpolates nodes to pixels, or to slopes at a spacing of pixels."""
    identity = torch.eye(nodes).view(1, nodes, nodes, 1)
    values = F.interpolate(identity, (pixels, 1), mode="bicubic", align_corners=True)[0, :, :, 0].T
    if not spacing:
        return values.contiguous()
    if pixels == 1:
        return torch.zeros(1, nodes)
    return torch.gradient(values, spacing=spacing, dim=0)[0].contiguous()


def smooth(
    nodes: Float[Tensor, "B 1 n n"], size: Size, slope: str = ""
) -> Float[Tensor, "B 1 H W"]:
    """Interpolate nodes at the pixels of an image by bicubic splines, or return a slope of them.

    The slope is along "x" or "y". Two products of matrices are faster than `F.interpolate`.
    """
    height, width = height_and_width(size)
    count = nodes.shape[-1]
    to_rows = spline(count, height, 2 / width if slope == "y" else 0.0).to(nodes)
    to_columns = spline(count, width, 2 / width if slope == "x" else 0.0).to(nodes)
    return to_rows @ nodes @ to_columns.T


def normal_numbers(uniform: Float[Tensor, "B E"], nodes: int) -> Float[Tensor, "B 1 nodes nodes"]:
    """Convert the first uniform numbers to standard normal ones at a grid of nodes."""
    inside = uniform[:, : nodes**2].clamp(1e-6, 1 - 1e-6)
    return (2**0.5 * torch.erfinv(2 * inside - 1)).view(-1, 1, nodes, nodes)


def blend(
    uniform: Float[Tensor, "B E"], nodes: int, angle: Float[Tensor, "B 1 1 1"]
) -> Float[Tensor, "B 1 nodes nodes"]:
    """Blend two grids of normal numbers, of which none changes the variance at any angle."""
    first, second = (normal_numbers(uniform[:, start:], nodes) for start in (0, nodes**2))
    return angle.cos() * first + angle.sin() * second


class Surface(NamedTuple):
    """Slopes of the heights of a surface, and the position (x, y, height) of each pixel."""

    slope_down: Tensor
    slope_right: Tensor
    position: tuple[Tensor, Tensor, Tensor]


def surface_of_depth(depth: Float[Tensor, "B 1 H W"]) -> Surface:
    """Compute the surface that a pinhole camera sees at given depths, in any unit.

    It is enlarged such that the mean depth has half the width 1. Pixels without a depth, which is
    not positive or not finite, get the mean.
    """
    is_known = depth.isfinite() & (depth > 0)
    known = torch.where(is_known, depth, 0)
    mean = known.mean((2, 3), keepdim=True) / is_known.float().mean((2, 3), keepdim=True)
    mean = mean.nan_to_num(1.0)
    relative = torch.where(is_known, known / mean, 1)
    tangent = math.tan(math.radians(FIELD_OF_VIEW / 2))
    x, y = axes(depth.shape[-2:], depth)
    # Slopes of the logarithm of the depth along the pixels, where half the width is the tangent.
    spacing = 2 * tangent / depth.shape[-1]
    down, right = (
        torch.gradient(relative.log(), spacing=spacing, dim=axis)[0]
        if depth.shape[axis] > 1
        else torch.zeros_like(depth)
        for axis in (2, 3)
    )
    # Product of both tangents of the surface z · (x, y, 1), up to a factor.
    towards = 1 + tangent * (x * right + y * down)
    towards = towards.clamp(min=0.05)
    height = (1 - relative) / tangent
    return Surface(-down / towards, -right / towards, (x * relative, y * relative, height))


class Drawn(NamedTuple):
    """Numbers of the lights of B images, and what the lights depend on.

    `numbers` are the columns that light depends on smoothly, shape (B, 1, 1, 1) each. `constants`
    are uniform in [0, 1], shape (B, E). `seeds` are for random numbers of pixels and of slides.
    """

    numbers: Sequence[Tensor]
    constants: Tensor
    size: Size
    depth: Tensor | None
    seeds: Sequence[int]

    def surface(self, steepness: Tensor, start: int = 0) -> Surface:
        """Return the surface of the depth of the images, or a random smooth one."""
        if self.depth is not None:
            return surface_of_depth(self.depth)
        heights = normal_numbers(self.constants[:, start:], SURFACE_NODES)
        nodes = MAX_STEEPNESS * steepness * heights
        down, right = (smooth(nodes, self.size, slope) for slope in "yx")
        return Surface(down, right, (*axes(self.size, nodes), smooth(nodes, self.size)))


class LightModel:
    """Light as a function of numbers in [0, 1]."""

    dimensions: ClassVar[int]
    constants: ClassVar[int] = 0
    # Column of the number of stops of a light whose exposure a meter sets. None without a meter.
    meter: ClassVar[int | None] = None
    # Whether the camera adds noise, and whether it clips values above the white of HDR images.
    has_noise: ClassVar[bool] = False
    has_limit: ClassVar[bool] = False

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Compute the linear light of each pixel, whose axes C, H and W may be 1."""
        raise NotImplementedError

    def draw(
        self,
        values: Float[Tensor, "B D"],
        size: Size,
        depth: Tensor | None = None,
        seeds: Sequence[int] = (),
    ) -> Drawn:
        """Split the numbers of the lights of images."""
        numbers = values[:, : self.dimensions].T[..., None, None, None].unbind()
        return Drawn(numbers, values[:, self.dimensions :], size, depth, seeds)

    def illumination(self, drawn: Drawn, strength: float = 1.0) -> Float[Tensor, "B C H W"]:
        """Mix the light with the unchanged light, and expose it."""
        light = self.light(drawn)
        if strength < 1:
            light = (1 - strength) + strength * light
        if self.meter is None:
            return light
        gray = luminance(light) if light.shape[1] == 3 else light
        stops = strength * between(drawn.numbers[self.meter], *STOPS)
        return light * (torch.exp2(stops) / gray.mean((2, 3), keepdim=True).clamp(min=DARKEST))

    def camera(
        self, radiance: Float[Tensor, "B C H W"], drawn: Drawn, strength: float, white: Tensor
    ) -> Float[Tensor, "B C H W"]:
        """Return what the camera measures of the radiance. `white` fills its pixels."""
        return radiance


@dataclass(frozen=True, eq=False)
class ProjectedSlide(LightModel):
    """A projector shows a picture on the surface of a flat print.

    The light is slide · gain · shading + ambient, as in `nb.attack_photographs`. The picture has
    stripes, checkers, spots, cells or smooth colors, or shows one of the slides (M, 3, H, W).
    """

    slides: Tensor | None = None
    cells: ClassVar[int] = 3
    dimensions = 5 + 3 * 3**2
    constants = SURFACE_NODES**2
    meter = 4

    def __post_init__(self) -> None:
        if self.slides is not None:
            require_photographs("slides", self.slides)

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Project a picture of its own on each image."""
        draws = [torch.Generator().manual_seed(seed) for seed in drawn.seeds]
        pictures = torch.cat([draw_slides(1, drawn.size, draw, self.slides) for draw in draws])
        ambient = between(drawn.numbers[3], *AMBIENT)
        projected = ProjectedLight(pictures.to(ambient), shading(drawn), ambient, ambient)
        gains = torch.cat(list(drawn.numbers[5:]), 1).view(-1, 3, self.cells, self.cells)
        return projected.light(math.log(2) * (2 * gains - 1))


def shading(drawn: Drawn) -> Float[Tensor, "B 1 H W"]:
    """Compute the shading of a surface from its steepness and the direction of the light."""
    steepness, turn, tilt, *_ = drawn.numbers
    surface = drawn.surface(steepness)
    polar, azimuth = math.radians(MAX_POLAR) * tilt, 2 * math.pi * turn
    to_light = polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()
    return lambert(surface.slope_down, surface.slope_right, *to_light)


@dataclass(frozen=True)
class DirectionalLight(LightModel):
    """A distant lamp lights a matte surface: the cosine between normal and light (Lambert 1760).

    The surface is random and smooth, or that of the depth of the image.
    """

    dimensions = 5
    constants = SURFACE_NODES**2
    meter = 4

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Add weak ambient light to the shading."""
        return shading(drawn) + between(drawn.numbers[3], *AMBIENT)


def lamp_light(
    surface: Surface, right: Tensor, down: Tensor, above: Tensor
) -> Float[Tensor, "B 1 H W"]:
    """Compute the irradiance of a small lamp, cos / distance², in units of that right below it."""
    x, y, height = surface.position
    # No surface is nearer to the lamp than a tenth of its distance.
    offsets = right - x, down - y, (above - height).clamp(min=0.1 * above)
    squares = sum(offset**2 for offset in offsets)
    cosine = lambert(surface.slope_down, surface.slope_right, *offsets)
    return cosine * (above**2 / (squares * squares.sqrt()))


@dataclass(frozen=True)
class PointLight(LightModel):
    """A small lamp lights a matte surface: cos / distance², the inverse-square law (Lambert 1760).

    The lamp is up to 1.5 half widths from the center, at a height of 0.4 to 2 half widths. The
    surface is random and smooth, or that of the depth of the image.
    """

    dimensions = 6
    constants = SURFACE_NODES**2
    meter = 5

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Add weak ambient light to the light of the lamp."""
        steepness, right, down, above, ambient, _ = drawn.numbers
        lamp = between(right, -1.5, 1.5), between(down, -1.5, 1.5), geometric(above, 0.4, 2.0)
        return lamp_light(drawn.surface(steepness), *lamp) + between(ambient, *AMBIENT)


@dataclass(frozen=True)
class ColoredLamps(LightModel):
    """One to three small lamps, each of its own color, light a matte surface (see `PointLight`)."""

    dimensions = 3 + 5 * 3
    constants = 1 + SURFACE_NODES**2
    meter = 2

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Add the light of the lamps, of which some are off, to weak ambient light."""
        steepness, ambient, _, *lamps = drawn.numbers
        surface = drawn.surface(steepness, start=1)
        count = (3 * drawn.constants[:, 0]).floor().view(-1, 1, 1, 1)
        light = between(ambient, *AMBIENT)
        for lamp in range(3):
            right, down, above, hue, saturation = lamps[5 * lamp : 5 * lamp + 5]
            place = between(right, -1.5, 1.5), between(down, -1.5, 1.5), geometric(above, 0.4, 2.0)
            color = random_colors(torch.cat([hue, saturation], 1)[:, :, 0, 0])
            light = light + (count >= lamp).to(color) * color * lamp_light(surface, *place)
        return light


@dataclass(frozen=True)
class LinearLight(LightModel):
    """Light that rises evenly from one side of the image to the other.

    It is the first-order expansion of any smooth light, such as that of a window at one side.
    """

    dimensions = 3
    meter = 2

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Compute a ramp with the mean 1 and the minimum 1 − contrast."""
        turn, contrast, _ = drawn.numbers
        height, width = height_and_width(drawn.size)
        x, y = axes(drawn.size, turn)
        right, down = (2 * math.pi * turn).cos(), (2 * math.pi * turn).sin()
        scale = 0.95 * contrast / (right.abs() + height / width * down.abs())
        return (1 + scale * right * x) + scale * down * y


@dataclass(frozen=True)
class FractalLight(LightModel):
    """Cloudy light, whose logarithm is a random field with the spectrum of plasma fractals.

    The amplitude halves with each octave (Fournier, Fussell & Carpenter 1982).
    """

    octaves: ClassVar[tuple[int, ...]] = (2, 4, 8, 16)
    dimensions = 3
    constants = 2 * sum(count**2 for count in octaves)
    meter = 2

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Blend two random fields of the same variance, and take the exponential."""
        contrast, turn, _ = drawn.numbers
        angle = 2 * math.pi * turn
        nodes = torch.zeros_like(contrast)
        start = 0
        for octave, count in enumerate(self.octaves):
            blended = blend(drawn.constants[:, start:], count, angle)
            nodes = nodes + 0.5**octave * smooth(blended, self.octaves[-1])
            start += 2 * count**2
        return (between(contrast, 0.1, 1.0) * smooth(nodes, drawn.size)).exp()


def visible_fraction(distance: Tensor) -> Tensor:
    """Return the visible fraction of a uniform disc behind a straight edge.

    The distance between the center of the disc and the edge is in units of its radius, and positive
    if the center is visible: 1/2 + (t √(1 − t²) + asin t) / π, the area of a circular segment.
    """
    t = distance.clamp(-1 + 1e-6, 1 - 1e-6)
    return torch.addcmul(torch.asin(t), t, (1 - t * t).sqrt()) / math.pi + 0.5


Along = Callable[[Tensor | float, Tensor | float], Tensor]


@dataclass(frozen=True)
class CastShadow(LightModel):
    """An object between the sun and the scene casts a shadow, whose penumbra has a uniform width.

    A pixel of the penumbra sees a part of the disc of the sun (`visible_fraction`). Edges count as
    straight. The shadow is lit by the sky, which is bluish. Kinds are "polygon", "leaves", "blinds"
    and "window".
    """

    kinds: tuple[str, ...] = ("polygon", "leaves", "blinds", "window")
    corners: ClassVar[int] = 6
    nodes: ClassVar[int] = 9
    dimensions = 7
    constants = 1 + 2 * nodes**2

    def __post_init__(self) -> None:
        for kind in errors.as_list("kinds", self.kinds, str, "a list of names"):
            errors.require_choice("kinds", kind, ("polygon", "leaves", "blinds", "window"))
        if not self.kinds:
            raise InputError("kinds is empty: name at least one kind of shadow")

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Compute the light of the sun and of the sky."""
        kinds = (drawn.constants[:, 0] * len(self.kinds)).long().clamp(max=len(self.kinds) - 1)
        light = drawn.constants.new_empty(len(kinds), 3, *height_and_width(drawn.size))
        for kind in set(kinds.tolist()):
            rows = torch.nonzero(kinds == kind)[:, 0]
            numbers = [column[rows] for column in drawn.numbers]
            part = drawn._replace(numbers=numbers, constants=drawn.constants[rows, 1:])
            shadow = self._light(self.kinds[kind], part)
            if len(rows) == len(kinds):
                return shadow
            light = light.index_copy(0, rows, shadow)
        return light

    def _light(self, kind: str, drawn: Drawn) -> Float[Tensor, "B 3 H W"]:
        """Compute the light of shadows of one kind."""
        right, down, turn, scale, softness, ambient, blue = drawn.numbers
        angle, scale = 2 * math.pi * turn, geometric(scale, 0.3, 1.2)
        if kind == "leaves":
            nodes = blend(drawn.constants, self.nodes, angle)
            # The heights are 0 at the edges between leaves and gaps.
            height = smooth(nodes, drawn.size) - between(right, -0.6, 0.6)
            slopes = [smooth(nodes, drawn.size, slope) for slope in "xy"]
            # Distance to the edge, to first order.
            squares = torch.addcmul(slopes[0] * slopes[0], slopes[1], slopes[1])
            distance = height * (squares + 1e-6).rsqrt()
        else:
            x, y = axes(drawn.size, right)
            x, y = x - between(right, -0.8, 0.8), y - between(down, -0.8, 0.8)
            cosine, sine = angle.cos() / scale, angle.sin() / scale

            def along(first: Tensor | float, second: Tensor | float) -> Tensor:
                """Return first · p + second · q of coordinates p and q that turn with the shape."""
                return (first * cosine - second * sine) * x + (first * sine + second * cosine) * y

            constants = drawn.constants.T[:, :, None, None, None]
            distance = scale * getattr(self, f"_{kind}")(along, constants)
        visible = visible_fraction(distance / geometric(softness, 0.005, 0.15))
        # Light of the sky in the shadow, relative to that of sun and sky.
        tint = torch.tensor([0.5, 0.2, 0.0]).to(blue).view(1, 3, 1, 1)
        sky = between(ambient, 0.08, 0.5) * (1 - blue * tint)
        return torch.addcmul(sky, 1 - sky, visible)

    def _polygon(self, along: Along, constants: Tensor) -> Tensor:
        """Return the distance outside a convex polygon, which is exact except near corners."""
        distance: Tensor | None = None
        for corner in range(self.corners):
            turn, far = constants[2 * corner], constants[2 * corner + 1]
            angle = 2 * math.pi * (corner + 0.8 * turn) / self.corners
            edge = along(angle.cos(), angle.sin()) - between(far, 0.4, 1.0)
            distance = edge if distance is None else torch.maximum(distance, edge)
        assert distance is not None
        return distance

    def _blinds(self, along: Along, constants: Tensor) -> Tensor:
        """Return the distance inside the gaps between parallel slats, of which a period is 0.4."""
        across = along(0.0, 2.5)
        return (between(constants[0], 0.15, 0.35) - (across - across.floor() - 0.5).abs()) / 2.5

    def _window(self, along: Along, constants: Tensor) -> Tensor:
        """Return the distance inside the panes of a window with a cross bar."""
        high, bar = between(constants[0], 0.6, 1.6), between(constants[1], 0.03, 0.12)
        p, q = along(1.0, 0.0).abs(), along(0.0, 1.0).abs()
        return torch.minimum(torch.minimum(1 - p, high - q), torch.minimum(p - bar, q - bar))


def planckian_locus(kelvin: Tensor) -> tuple[Tensor, Tensor]:
    """Return CIE 1960 u and v of a black body at 1,000 to 15,000 K, within 1e-4 (Krystek 1985)."""
    u = (0.860117757 + 1.54118254e-4 * kelvin + 1.28641212e-7 * kelvin**2) / (
        1 + 8.42420235e-4 * kelvin + 7.08145163e-7 * kelvin**2
    )
    v = (0.317398726 + 4.22806245e-5 * kelvin + 4.20481691e-8 * kelvin**2) / (
        1 - 2.89741816e-5 * kelvin + 1.61456053e-7 * kelvin**2
    )
    return u, v


def planckian_rgb(kelvin: Tensor, offset: Tensor | float = 0.0) -> Float[Tensor, "... 3 1 1"]:
    """Return the linear RGB, with Y = 1, of a color at a distance (Duv) above a black body."""
    u, v = planckian_locus(kelvin)
    hotter_u, hotter_v = planckian_locus(1.01 * kelvin)
    # A hotter body has less u and v. The normal of the locus points to green.
    along_u, along_v = hotter_u - u, hotter_v - v
    length = (along_u**2 + along_v**2).sqrt()
    u, v = u + offset * along_v / length, v - offset * along_u / length
    # CIE 1960 (u, v) to X and Z at Y = 1: X / Y = 3u / 2v and Z / Y = (4 − u − 10v) / 2v.
    x, z = 3 * u / (2 * v), (4 - u - 10 * v) / (2 * v)
    red = 3.2404542 * x - 1.5371385 - 0.4985314 * z
    green = -0.9692660 * x + 1.8760108 + 0.0415560 * z
    blue = 0.0556434 * x - 0.2040259 + 1.0572252 * z
    return torch.cat([red, green, blue], -3).clamp(min=1e-3)


@dataclass(frozen=True)
class ColorTemperature(LightModel):
    """A black body of 2,000 to 15,000 K lights the scene, and the camera's white balance is off.

    The camera divides its channels by the color of the lamp that it assumes (von Kries 1902 in the
    channels of the camera). Its temperature is between that of the lamp and of D65. A tint is up to
    0.02 (Duv) to green or magenta. That of daylight is 0.003.
    """

    dimensions = 3

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Compute one color for all pixels. Temperatures are uniform in reciprocal units."""
        coolness, balance, tint = drawn.numbers
        lamp = between(coolness, 1 / 2000, 1 / 15000)
        assumed = 1 / 6504 + balance * (lamp - 1 / 6504)
        color = planckian_rgb(1 / lamp, 0.02 * (2 * tint - 1)) / planckian_rgb(1 / assumed)
        return color / luminance(color)


@dataclass(frozen=True)
class LowLight(LightModel):
    """Little light reaches a noisy sensor, whose gain recovers a part of the brightness.

    Electrons are Poisson-distributed, the amplifier adds Gaussian noise of 1 to 5 electrons, and a
    converter of 12 bits rounds them (EMVA 1288; Hasinoff 2014). A white pixel has 15,000 electrons
    at full light. The light is at least `exposure` of the original. Poisson numbers are
    round(l + √l z + (z² − 1) / 6 · l / (l + 0.03)) of a normal number z. The total variation
    between both distributions is below 0.04 for all means l, and 0.003 for l ≥ 10.
    """

    exposure: float = 0.005
    full_well: ClassVar[float] = 15000.0
    levels: ClassVar[int] = 2**12 - 1
    dimensions = 3
    has_noise = True

    def __post_init__(self) -> None:
        errors.require_number("exposure", self.exposure, 1e-6, 1)

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Return 1, because the camera receives less light (see `camera`)."""
        return torch.ones_like(drawn.numbers[0])

    def camera(
        self, radiance: Float[Tensor, "B C H W"], drawn: Drawn, strength: float, white: Tensor
    ) -> Float[Tensor, "B C H W"]:
        """Count electrons, add noise, amplify and round. Gradients pass through the rounding."""
        darkness, read, recovered = drawn.numbers
        stops = strength * math.log2(1 / self.exposure) * darkness
        mean = radiance.clamp(min=0) * (self.full_well * torch.exp2(-stops) / white)
        photons, amplifier = normal_noise(radiance, drawn.seeds)
        # The limit avoids an infinite gradient at 0.
        spread = mean.clamp(min=1e-6).sqrt() * photons
        skew = (photons * photons - 1) * (mean / (6 * mean + 0.18))
        counted = _rounded(mean + spread + skew).clamp(min=0)
        # The gain of the amplifier, after which a full pixel has the value 1.
        gain = torch.exp2(stops * recovered) / self.full_well
        signal = gain * (counted + between(read, 1.0, 5.0) * amplifier)
        return _rounded(signal.clamp(0, 1) * self.levels) * (white / self.levels)


def normal_noise(
    like: Float[Tensor, "B C H W"], seeds: Sequence[int]
) -> Float[Tensor, "2 B C H W"]:
    """Draw two normal numbers for each pixel of each image, from the seed of the image."""
    noise = like.new_empty(len(like), 2, *like.shape[1:])
    for image, seed in zip(noise, seeds, strict=True):
        image.normal_(generator=torch.Generator(like.device).manual_seed(seed))
    return noise.unbind(1)


def _rounded(values: Tensor) -> Tensor:
    """Round values, with the gradient 1."""
    if not values.requires_grad:
        return values.round()
    return values + (values.round() - values).detach()


@dataclass(frozen=True)
class ClippedHighlights(LightModel):
    """The exposure is too long by 0.5 to 3 stops, and full pixels of the sensor are white."""

    dimensions = 1
    has_limit = True

    def light(self, drawn: Drawn) -> Float[Tensor, "B C H W"]:
        """Return the exposure."""
        return torch.exp2(between(drawn.numbers[0], 0.5, 3.0))


# Each model of light, by the name that selects it.
MODELS: dict[str, type[LightModel]] = {
    "projected_slide": ProjectedSlide,
    "cast_shadow": CastShadow,
    "directional": DirectionalLight,
    "point": PointLight,
    "lamps": ColoredLamps,
    "linear": LinearLight,
    "fractal": FractalLight,
    "color_temperature": ColorTemperature,
    "low_light": LowLight,
    "highlights": ClippedHighlights,
}
