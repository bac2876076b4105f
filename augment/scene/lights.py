"""Models of light that change a photograph, each a function of a few numbers in [0, 1].

The linear colors of a photograph stand for the albedo of what it shows:

    radiance = albedo · light

A model maps numbers to the light of each pixel, which is 1 in the photograph itself. It is
differentiable in the first `dimensions` numbers, which an attack may change. The other `constants`
choose the kind of a pattern and its random parts. In a light with a meter, the camera sets its
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
from jaxtyping import Float
from torch import Tensor

from augment.scene.patterns import (
    AMBIENT,
    DARKEST,
    STOPS,
    draw_slides,
    luminance,
    random_colors,
    require_photographs,
)
from augment.scene.surfaces import (
    MAX_POLAR,
    MAX_STEEPNESS,
    SURFACE_NODES,
    Surface,
    axes,
    lambert,
    smooth,
    surface_of_depth,
)
from renderer import errors
from renderer.errors import InputError
from renderer.settings import Size, height_and_width


def between(numbers: Tensor, low: float, high: float) -> Tensor:
    """Map numbers in [0, 1] to an interval."""
    return low + (high - low) * numbers


def normal_numbers(uniform: Float[Tensor, "B E"], nodes: int) -> Float[Tensor, "B 1 nodes nodes"]:
    """Convert the first uniform numbers to standard normal ones at a grid of nodes."""
    inside = uniform[:, : nodes**2].clamp(1e-6, 1 - 1e-6)
    return (2**0.5 * torch.erfinv(2 * inside - 1)).view(-1, 1, nodes, nodes)


def blend(
    uniform: Float[Tensor, "B E"], nodes: int, angle: Float[Tensor, "B 1 1 1"]
) -> Float[Tensor, "B 1 nodes nodes"]:
    """Blend two grids of normal numbers. The variance is the same at any angle."""
    first, second = (normal_numbers(uniform[:, start:], nodes) for start in (0, nodes**2))
    return angle.cos() * first + angle.sin() * second


class Range(NamedTuple):
    """Smallest and largest value of a number, and whether its logarithm is uniform."""

    low: float
    high: float
    is_geometric: bool = False


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _ranges(
    ranges: tuple[Range, ...], device: torch.device, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the low ends and the widths of ranges, and where they are of logarithms."""
    ends = [[math.log(end) if log else end for end in (low, high)] for low, high, log in ranges]
    low, high = torch.tensor(ends, device=device, dtype=dtype).T.contiguous()
    return low, high - low, torch.tensor([each.is_geometric for each in ranges], device=device)


# Ranges of the numbers that several models have.
TURN = Range(0, 2 * math.pi)
WEAK = Range(*AMBIENT)
METER = Range(*STOPS)
STEEPNESS = Range(0, MAX_STEEPNESS)
SURFACE = (STEEPNESS, TURN, Range(0, math.radians(MAX_POLAR)))
# Position of a small lamp, in half widths.
LAMP = (Range(-1.5, 1.5), Range(-1.5, 1.5), Range(0.4, 2.0, True))


class Drawn(NamedTuple):
    """Numbers of the lights of B images, and what the lights depend on.

    `numbers` are what light depends on smoothly, in their ranges, shape (B, 1, 1, 1) each. The
    `constants` are uniform in [0, 1], shape (B, E). `seeds` are for the noise and for slides.
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
        nodes = steepness * heights
        down, right = (smooth(nodes, self.size, slope) for slope in "yx")
        return Surface(down, right, (*axes(self.size, nodes), smooth(nodes, self.size)))


class Illumination(NamedTuple):
    """Light of each pixel: gain · field + offset. Gain and offset hold for a whole image."""

    field: Float[Tensor, "B _ H W"]
    gain: Float[Tensor, "B _ 1 1"] | float = 1.0
    offset: Float[Tensor, "B _ 1 1"] | float = 0.0

    def total(self) -> Float[Tensor, "B _ H W"]:
        """Compute the light."""
        return self.gain * self.field + self.offset

    def scaled(self, gain: Tensor | float, offset: Tensor | float = 0.0) -> Illumination:
        """Multiply the light, and add to it."""
        return Illumination(self.field, gain * self.gain, gain * self.offset + offset)


class LightModel:
    """Light as a function of numbers in [0, 1]."""

    # Smallest and largest value of each number, and whether its logarithm is uniform.
    ranges: ClassVar[tuple[Range, ...]]
    constants: ClassVar[int] = 0
    # Whether a meter sets the exposure, of which the last number has the stops.
    has_meter: ClassVar[bool] = False
    # Whether the camera adds noise, and whether it clips values above the white of HDR images.
    has_noise: ClassVar[bool] = False
    has_limit: ClassVar[bool] = False

    @property
    def dimensions(self) -> int:
        """Number of numbers that the light depends on smoothly."""
        return len(self.ranges)

    def light(self, drawn: Drawn) -> Illumination:
        """Compute the linear light of each pixel."""
        raise NotImplementedError

    def draw(
        self,
        values: Float[Tensor, "B D"],
        size: Size,
        depth: Tensor | None = None,
        seeds: Sequence[int] = (),
    ) -> Drawn:
        """Map the numbers of the lights of images to their ranges."""
        low, span, is_geometric = _ranges(self.ranges, values.device, values.dtype)
        numbers = torch.addcmul(low, span, values[:, : self.dimensions])
        numbers = torch.where(is_geometric, numbers.exp(), numbers)
        columns = numbers.T[..., None, None, None].unbind()
        return Drawn(columns, values[:, self.dimensions :], size, depth, seeds)

    def illumination(self, drawn: Drawn, strength: float = 1.0) -> Illumination:
        """Mix the light with the unchanged light, and expose it."""
        light = self.light(drawn)
        if strength < 1:
            light = light.scaled(strength, 1 - strength)
        if not self.has_meter:
            return light
        mean = light._replace(field=light.field.mean((2, 3), keepdim=True)).total()
        gray = luminance(mean) if mean.shape[1] == 3 else mean
        return light.scaled(torch.exp2(strength * drawn.numbers[-1]) / gray.clamp(min=DARKEST))

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
    ranges = (*SURFACE, WEAK, *[Range(-math.log(2), math.log(2))] * 3 * cells**2, METER)
    constants = SURFACE_NODES**2
    has_meter = True

    def __post_init__(self) -> None:
        if self.slides is not None:
            require_photographs("slides", self.slides)

    def light(self, drawn: Drawn) -> Illumination:
        """Project a picture of its own on each image."""
        draws = [torch.Generator().manual_seed(seed) for seed in drawn.seeds]
        pictures = torch.cat([draw_slides(1, drawn.size, draw, self.slides) for draw in draws])
        log_gain = torch.cat(list(drawn.numbers[4:-1]), 1).view(-1, 3, self.cells, self.cells)
        gain = smooth(log_gain, drawn.size, mode="bilinear").exp()
        return Illumination(pictures.to(gain) * gain * shading(drawn), offset=drawn.numbers[3])


def shading(drawn: Drawn) -> Float[Tensor, "B 1 H W"]:
    """Compute the shading of a surface from its steepness and the direction of the light."""
    steepness, azimuth, polar, *_ = drawn.numbers
    surface = drawn.surface(steepness)
    to_light = polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()
    return lambert(surface.slope_down, surface.slope_right, *to_light)


@dataclass(frozen=True)
class DirectionalLight(LightModel):
    """A distant lamp lights a matte surface: the cosine between normal and light (Lambert 1760).

    The surface is random and smooth, or that of the depth of the image.
    """

    ranges = (*SURFACE, WEAK, METER)
    constants = SURFACE_NODES**2
    has_meter = True

    def light(self, drawn: Drawn) -> Illumination:
        """Add weak ambient light to the shading."""
        return Illumination(shading(drawn), offset=drawn.numbers[3])


def lamp_light(
    surface: Surface, right: Tensor, down: Tensor, above: Tensor
) -> Float[Tensor, "B 1 H W"]:
    """Compute the irradiance of a small lamp, cos / distance², in units of that right below it."""
    x, y, height = surface.position
    # No surface is nearer to the lamp than a tenth of its distance.
    offsets = right - x, down - y, (above - height).clamp(min=0.1 * above)
    squares = offsets[0] ** 2 + offsets[1] ** 2 + offsets[2] ** 2
    cosine = lambert(surface.slope_down, surface.slope_right, *offsets)
    return cosine * (above**2 / (squares * squares.sqrt()))


@dataclass(frozen=True)
class PointLight(LightModel):
    """A small lamp lights a matte surface: cos / distance², the inverse-square law (Lambert 1760).

    The lamp is up to 1.5 half widths from the center, at a height of 0.4 to 2 half widths. The
    surface is random and smooth, or that of the depth of the image.
    """

    ranges = (STEEPNESS, *LAMP, WEAK, METER)
    constants = SURFACE_NODES**2
    has_meter = True

    def light(self, drawn: Drawn) -> Illumination:
        """Add weak ambient light to the light of the lamp."""
        steepness, *lamp, ambient, _ = drawn.numbers
        return Illumination(lamp_light(drawn.surface(steepness), *lamp), offset=ambient)


@dataclass(frozen=True)
class ColoredLamps(LightModel):
    """One to three small lamps, each of its own color, light a matte surface (see `PointLight`)."""

    ranges = (STEEPNESS, *[*LAMP, Range(0, 1), Range(0, 1)] * 3, WEAK, METER)
    constants = 1 + SURFACE_NODES**2
    has_meter = True

    def light(self, drawn: Drawn) -> Illumination:
        """Add the light of the lamps, of which some are off, to weak ambient light."""
        steepness, *lamps, ambient, _ = drawn.numbers
        surface = drawn.surface(steepness, start=1)
        # Index of the last lamp of each image that is on.
        last = (3 * drawn.constants[:, :1]).floor().clamp(max=2)
        colors, fields = [], []
        for lamp in range(int(last.max()) + 1):
            *place, hue, saturation = lamps[5 * lamp : 5 * lamp + 5]
            color = random_colors(torch.cat([hue, saturation], 1)[:, :, 0, 0])[..., 0]
            colors.append(color * (last >= lamp)[..., None])
            fields.append(lamp_light(surface, *place))
        mixed = torch.cat(colors, 2) @ torch.cat(fields, 1).flatten(2)
        return Illumination(mixed.unflatten(2, fields[0].shape[2:]), offset=ambient)


@dataclass(frozen=True)
class LinearLight(LightModel):
    """Light that rises evenly from one side of the image to the other.

    It is the first-order expansion of any smooth light, such as that of a window at one side.
    """

    ranges = (TURN, Range(0, 0.95), METER)
    has_meter = True

    def light(self, drawn: Drawn) -> Illumination:
        """Compute a ramp with the mean 1 and the minimum 1 − contrast."""
        turn, contrast, _ = drawn.numbers
        height, width = height_and_width(drawn.size)
        x, y = axes(drawn.size, turn)
        right, down = turn.cos(), turn.sin()
        gain = contrast / (right.abs() + height / width * down.abs())
        return Illumination(right * x + down * y, gain, 1.0)


@dataclass(frozen=True)
class FractalLight(LightModel):
    """Cloudy light, whose logarithm is a random field with the spectrum of plasma fractals.

    The amplitude halves with each octave (Fournier, Fussell & Carpenter 1982).
    """

    octaves: ClassVar[tuple[int, ...]] = (2, 4, 8, 16)
    ranges = (Range(0.1, 1.0), TURN, METER)
    constants = 2 * sum(count**2 for count in octaves)
    has_meter = True

    def light(self, drawn: Drawn) -> Illumination:
        """Blend two random fields of the same variance, and take the exponential."""
        contrast, angle, _ = drawn.numbers
        nodes = torch.zeros_like(contrast)
        start = 0
        for octave, count in enumerate(self.octaves):
            blended = blend(drawn.constants[:, start:], count, angle)
            nodes = nodes + 0.5**octave * smooth(blended, self.octaves[-1])
            start += 2 * count**2
        return Illumination(smooth(contrast * nodes, drawn.size).exp())


def circle_segment(distance: Tensor) -> Tensor:
    """Return t √(1 − t²) + asin t, where t is the distance of an edge from the center of a disc.

    A straight edge at a distance, in units of the radius, leaves the fraction 1/2 + segment / π of
    a uniform disc visible. The distance is positive if the center is visible.
    """
    t = distance.clamp(-1 + 1e-6, 1 - 1e-6)
    return torch.addcmul(torch.asin(t), t, torch.addcmul(t.new_ones(()), t, t, value=-1).sqrt())


Along = Callable[[Tensor | float, Tensor | float, Tensor], Tensor]


@dataclass(frozen=True)
class CastShadow(LightModel):
    """An object between the sun and the scene casts a shadow, whose penumbra has a uniform width.

    A pixel of the penumbra sees a part of the disc of the sun (`circle_segment`). Edges count as
    straight. The shadow is lit by the sky, which is bluish. Kinds are "polygon", "leaves", "blinds"
    and "window".
    """

    kinds: tuple[str, ...] = ("polygon", "leaves", "blinds", "window")
    corners: ClassVar[int] = 4
    nodes: ClassVar[int] = 9
    # Position, turn and scale of the shape, radius of the penumbra, and amount and blueness of the
    # light of the sky.
    ranges = (
        *[Range(-0.8, 0.8)] * 2,
        TURN,
        Range(0.3, 1.2, True),
        Range(0.005, 0.15, True),
        Range(0.08, 0.5),
        Range(0, 1),
    )
    constants = 1 + 2 * nodes**2

    def __post_init__(self) -> None:
        for kind in errors.as_list("kinds", self.kinds, str, "a list of names"):
            errors.require_choice("kinds", kind, ("polygon", "leaves", "blinds", "window"))
        if not self.kinds:
            raise InputError("kinds is empty: name at least one kind of shadow")

    def light(self, drawn: Drawn) -> Illumination:
        """Compute the light of the sun and of the sky."""
        kinds = (drawn.constants[:, 0] * len(self.kinds)).long().clamp(max=len(self.kinds) - 1)
        if len(kinds) == 1:
            part = drawn._replace(constants=drawn.constants[:, 1:])
            return self._light(self.kinds[int(kinds)], part)
        of_kind = [torch.nonzero(kinds == kind)[:, 0] for kind in range(len(self.kinds))]
        parts = []
        for kind, rows in zip(self.kinds, of_kind, strict=True):
            numbers = [column[rows] for column in drawn.numbers]
            part = drawn._replace(numbers=numbers, constants=drawn.constants[rows, 1:])
            parts.append(self._light(kind, part))
        order = torch.cat(of_kind).argsort()
        return Illumination(*(torch.cat(part)[order] for part in zip(*parts, strict=True)))

    def _light(self, kind: str, drawn: Drawn) -> Illumination:
        """Compute the light of shadows of one kind."""
        right, down, angle, scale, softness, ambient, blue = drawn.numbers
        if kind == "leaves":
            nodes = blend(drawn.constants, self.nodes, angle)
            # The heights are 0 at the edges between leaves and gaps.
            height = smooth(nodes, drawn.size) - right
            slopes = [smooth(nodes, drawn.size, slope) for slope in "xy"]
            # Distance to the edge, to first order.
            squares = torch.addcmul(slopes[0] * slopes[0], slopes[1], slopes[1])
            distance = height * (squares + 1e-6).rsqrt() / softness
        else:
            x, y = axes(drawn.size, right)
            x, y = x - right, y - down
            # Distances are in units of the penumbra's radius.
            cosine, sine, scale = angle.cos() / softness, angle.sin() / softness, scale / softness

            def along(first: Tensor | float, second: Tensor | float, back: Tensor) -> Tensor:
                """Return first · p + second · q − back, where p and q turn with the shape."""
                right, down = first * cosine - second * sine, first * sine + second * cosine
                return right * x + (down * y - back)

            constants = drawn.constants[..., None, None]
            distance = getattr(self, f"_{kind}")(along, scale, constants)
        segment = circle_segment(distance)
        # Light of the sky in the shadow, relative to that of sun and sky.
        tint = torch.cat([0.5 * blue, 0.2 * blue, 0 * blue], 1)
        sky = ambient - ambient * tint
        return Illumination(segment, (1 - sky) / math.pi, (1 + sky) / 2)

    def _polygon(self, along: Along, scale: Tensor, constants: Tensor) -> Tensor:
        """Return the distance outside a convex polygon, which is exact except near corners."""
        turns, far = constants[:, : self.corners], constants[:, self.corners : 2 * self.corners]
        index = torch.arange(self.corners, device=far.device).view(1, -1, 1, 1)
        angle = 2 * math.pi / self.corners * (index + 0.8 * turns)
        cosine, sine, far = angle.cos(), angle.sin(), scale * between(far, 0.4, 1.0)
        distance = along(cosine[:, :1], sine[:, :1], far[:, :1])
        for corner in range(1, self.corners):
            one = slice(corner, corner + 1)
            edge = along(cosine[:, one], sine[:, one], far[:, one])
            distance = torch.maximum(distance, edge)
        return distance

    def _blinds(self, along: Along, scale: Tensor, constants: Tensor) -> Tensor:
        """Return the distance inside the gaps between parallel slats, of which a period is 0.4."""
        across = along(0.0, 2.5 / scale, 0 * scale)
        gap = between(constants[:, :1], 0.15, 0.35)
        return (gap - (across - across.floor() - 0.5).abs()) * (scale / 2.5)

    def _window(self, along: Along, scale: Tensor, constants: Tensor) -> Tensor:
        """Return the distance inside the panes of a window with a cross bar."""
        high = scale * between(constants[:, :1], 0.6, 1.6)
        bar = scale * between(constants[:, 1:2], 0.03, 0.12)
        p, q = along(1.0, 0.0, 0 * scale).abs(), along(0.0, 1.0, 0 * scale).abs()
        return torch.minimum(torch.minimum(scale - p, high - q), torch.minimum(p - bar, q - bar))


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

    # Temperature in 1/K, how much of it the camera corrects, and the tint.
    ranges = (Range(1 / 2000, 1 / 15000), Range(0, 1), Range(-0.02, 0.02))

    def light(self, drawn: Drawn) -> Illumination:
        """Compute one color for all pixels. Temperatures are uniform in reciprocal units."""
        lamp, balance, tint = drawn.numbers
        assumed = 1 / 6504 + balance * (lamp - 1 / 6504)
        color = planckian_rgb(1 / lamp, tint) / planckian_rgb(1 / assumed)
        return Illumination(torch.ones_like(lamp), color / luminance(color))


@dataclass(frozen=True)
class LowLight(LightModel):
    """Little light reaches a noisy sensor, whose gain recovers a part of the brightness.

    Electrons are Poisson-distributed, the amplifier adds Gaussian noise of 1 to 5 electrons, and a
    converter of 12 bits rounds them (EMVA 1288; Hasinoff 2014). A white pixel has 15,000 electrons
    at full light. The light is at least `exposure` of the original.

    The sum of Poisson and Gaussian numbers has the cumulants l, l + r² and l. It is drawn as
    l + σ z + l / σ² · (z² − 1) / 6 with σ² = l + r² and a normal number z (Cornish & Fisher 1938).
    Its distribution function is wrong by less than 0.01.
    """

    exposure: float = 0.005
    full_well: ClassVar[float] = 15000.0
    levels: ClassVar[int] = 2**12 - 1
    # Fraction of the stops, read noise in electrons, and fraction that the gain recovers.
    ranges = (Range(0, 1), Range(1, 5), Range(0, 1))
    has_noise = True

    def __post_init__(self) -> None:
        errors.require_number("exposure", self.exposure, 1e-6, 1)

    def light(self, drawn: Drawn) -> Illumination:
        """Return 1, because the camera receives less light (see `camera`)."""
        return Illumination(torch.ones_like(drawn.numbers[0]))

    def camera(
        self, radiance: Float[Tensor, "B C H W"], drawn: Drawn, strength: float, white: Tensor
    ) -> Float[Tensor, "B C H W"]:
        """Count electrons, add noise, amplify and round. Gradients pass through the rounding."""
        darkness, read, recovered = drawn.numbers
        stops = strength * math.log2(1 / self.exposure) * darkness
        mean = radiance.clamp(min=0) * (self.full_well * torch.exp2(-stops) / white)
        variance = mean + read**2
        z, ratio = normal_noise(radiance, drawn.seeds), mean / variance
        slope = torch.addcmul(variance.sqrt(), z, ratio, value=1 / 6)
        electrons = torch.addcmul(mean, z, slope).sub(ratio, alpha=1 / 6)
        # The gain of the amplifier, after which a full pixel has the largest number.
        gain = torch.exp2(stops * recovered) * (self.levels / self.full_well)
        signal = (electrons * gain).clamp(0, self.levels)
        return _rounded(signal) * (white / self.levels)


def normal_noise(like: Float[Tensor, "B C H W"], seeds: Sequence[int]) -> Tensor:
    """Draw a normal number for each value of each image, from the seed of the image."""
    noise = torch.empty_like(like)
    for image, seed in zip(noise, seeds, strict=True):
        image.normal_(generator=torch.Generator(like.device).manual_seed(seed))
    return noise


def _rounded(values: Tensor) -> Tensor:
    """Round values, with the gradient 1."""
    if not values.requires_grad:
        return values.round()
    return values + (values.round() - values).detach()


@dataclass(frozen=True)
class ClippedHighlights(LightModel):
    """The exposure is too long by 0.5 to 3 stops, and full pixels of the sensor are white."""

    ranges = (Range(0.5, 3.0),)
    has_limit = True

    def light(self, drawn: Drawn) -> Illumination:
        """Return the exposure."""
        return Illumination(torch.exp2(drawn.numbers[0]))


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
