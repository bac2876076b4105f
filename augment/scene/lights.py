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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.scene import loops, patterns, surfaces
from augment.scene.surfaces import Range, limits
from renderer.errors import InputError, as_list, require_choice, require_number
from renderer.image import straight_through
from renderer.settings import Size, height_and_width

# Ranges of the numbers that several models have.
TURN = Range(0, 2 * math.pi)
WEAK = Range(*patterns.AMBIENT)
METER = Range(*patterns.STOPS)
STEEPNESS = Range(0, surfaces.MAX_STEEPNESS)
SURFACE = (STEEPNESS, TURN, Range(0, math.radians(surfaces.MAX_POLAR)))
# Position of a small lamp, in half widths.
LAMP = (Range(-1.5, 1.5), Range(-1.5, 1.5), Range(0.4, 2.0, True))


class Drawn(NamedTuple):
    """Numbers of the lights of B images, and what the lights depend on.

    `rows` has the numbers that light depends on smoothly, in their ranges. The `constants` are
    uniform in [0, 1]. `seeds` are for the noise and for slides.
    """

    rows: Float[Tensor, "B D"]
    constants: Float[Tensor, "B E"]
    size: Size
    depth: Tensor | None
    seeds: Sequence[int]

    @property
    def numbers(self) -> Float[Tensor, "D B 1 1 1"]:
        """Numbers of all images, each of which can be multiplied by fields."""
        return self.rows.T[..., None, None, None]

    def field(self, channels: int = 1) -> Float[Tensor, "B _ H W"]:
        """Return an empty field for a loop."""
        return self.rows.new_empty(len(self.rows), channels, *height_and_width(self.size))

    def heights(self) -> Float[Tensor, "B nodes"]:
        """Return heights of the nodes of a random surface, whose steepness is the first number."""
        last = self.constants[:, -(surfaces.SURFACE_NODES**2) :]
        return self.rows[:, :1] * surfaces.normal_numbers(last)

    def lit(self, places: Tensor, colors: Tensor, near: float = 1.0) -> Tensor | None:
        """Return the light of lamps on a random surface by a loop, or None if it is not compiled.

        If `near` is 0, the lamps are far away, in the directions of the unit vectors `places`.
        """
        if self.depth is not None or not (loop := loops.lamps(places)):
            return None
        field = self.field(colors.shape[2])
        weights = surfaces.grid(surfaces.SURFACE_NODES, self.size)
        loop(self.heights(), weights, near, places, colors, field)
        return field

    def surface(self) -> surfaces.Surface:
        """Return the surface of the depth of the images, or a random smooth one."""
        if self.depth is not None:
            return surfaces.surface_of_depth(self.depth)
        nodes = self.heights().view(-1, 1, surfaces.SURFACE_NODES, surfaces.SURFACE_NODES)
        down, right = (surfaces.smooth(nodes, self.size, slope) for slope in "yx")
        position = (*surfaces.axes(self.size, nodes), surfaces.smooth(nodes, self.size))
        return surfaces.Surface(down, right, position)


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

    # Smallest and largest value of each number, and whether its logarithm is uniform. If METER is
    # the last range, a meter sets the exposure, of which the last number has the stops.
    ranges: ClassVar[tuple[Range, ...]]
    constants: ClassVar[int] = 0
    # Whether the camera clips values above the white of HDR images.
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
        low, span, is_geometric = limits(self.ranges, values.device, values.dtype)
        numbers = torch.addcmul(low, span, values[:, : self.dimensions])
        numbers = torch.where(is_geometric, numbers.exp(), numbers)
        return Drawn(numbers, values[:, self.dimensions :], size, depth, seeds)

    def illumination(self, drawn: Drawn, strength: float = 1.0) -> Illumination:
        """Mix the light with the unchanged light, and expose it."""
        light = self.light(drawn)
        if strength < 1:
            light = light.scaled(strength, 1 - strength)
        if self.ranges[-1] != METER:
            return light
        mean = light._replace(field=light.field.mean((2, 3), keepdim=True)).total()
        gray = patterns.luminance(mean) if mean.shape[1] == 3 else mean
        # The last number is the exposure in stops. After it, the mean luminance is 2^stops.
        exposure = torch.exp2(strength * drawn.numbers[-1])
        return light.scaled(exposure / gray.clamp(min=patterns.DARKEST))

    def camera(
        self, radiance: Float[Tensor, "B C H W"], drawn: Drawn, strength: float, white: Tensor
    ) -> Float[Tensor, "B C H W"]:
        """Return what the camera measures of the radiance. `white` fills its pixels."""
        return radiance


@dataclass(frozen=True, eq=False)
class ProjectedSlide(LightModel):
    """A projector shows a picture on the surface of a flat print.

    The light is slide · gain · shading + ambient (Grossberg et al. 2004), as in
    `nb.attack_photographs`. The picture has stripes, checkers, spots, cells or smooth colors, or
    shows one of the slides (M, 3, H, W).
    """

    slides: Tensor | None = None
    cells: ClassVar[int] = 3
    ranges = (*SURFACE, WEAK, *[Range(-math.log(2), math.log(2))] * 3 * cells**2, METER)
    constants = surfaces.SURFACE_NODES**2

    def __post_init__(self) -> None:
        if self.slides is not None:
            object.__setattr__(self, "slides", patterns.as_photographs("slides", self.slides))

    def light(self, drawn: Drawn) -> Illumination:
        """Project a picture of its own on each image."""
        draws = [torch.Generator().manual_seed(seed) for seed in drawn.seeds]
        shown = [patterns.draw_slides(1, drawn.size, draw, self.slides) for draw in draws]
        slides = torch.cat(shown) if len(shown) > 1 else shown[0]
        # Logarithms of the gains of the channels in a grid of cells, shape (B, 3, cells, cells).
        log_gain = drawn.numbers[4:-1, :, 0, 0, 0].T.reshape(-1, 3, self.cells, self.cells)
        if loop := loops.multiply_slides(log_gain):
            weights = surfaces.grid(self.cells, drawn.size, "bilinear")
            loop(log_gain, weights, shading(drawn), slides)
            return Illumination(slides, offset=drawn.numbers[3])
        light = surfaces.smooth(log_gain, drawn.size, mode="bilinear").exp()
        return Illumination(light * slides.to(light) * shading(drawn), offset=drawn.numbers[3])


def shading(drawn: Drawn) -> Float[Tensor, "B 1 H W"]:
    """Compute the shading of a surface in the light of a direction."""
    _, azimuth, polar, *_ = drawn.numbers
    towards = surfaces.direction(azimuth, polar)
    place = torch.cat(towards, 1)[:, None, :, 0, 0]
    if (field := drawn.lit(place, torch.ones_like(place[..., :1]), near=0.0)) is not None:
        return field
    surface = drawn.surface()
    return surfaces.lambert(surface.slope_down, surface.slope_right, *towards)


@dataclass(frozen=True)
class DirectionalLight(LightModel):
    """A distant lamp lights a matte surface: the cosine between normal and light (Lambert 1760).

    The surface is random and smooth, or that of the depth of the image.
    """

    ranges = (*SURFACE, WEAK, METER)
    constants = surfaces.SURFACE_NODES**2

    def light(self, drawn: Drawn) -> Illumination:
        """Add weak ambient light to the shading."""
        return Illumination(shading(drawn), offset=drawn.numbers[3])


def lamp_light(
    drawn: Drawn, places: Float[Tensor, "B L 3"], colors: Float[Tensor, "B L C"]
) -> Float[Tensor, "B C H W"]:
    """Add up the irradiance of small lamps, cos / distance², in units of that right below each."""
    if (field := drawn.lit(places, colors)) is not None:
        return field
    surface = drawn.surface()
    x, y, height = surface.position
    # Position of each lamp, shape (B, L, 1, 1) each, so that fields have the shape (B, L, H, W).
    right, down, above = places[..., None, None].unbind(2)
    # No surface is nearer to the lamp than a tenth of its distance.
    offsets = right - x, down - y, torch.maximum(above - height, 0.1 * above)
    squares = torch.addcmul(offsets[0] ** 2 + offsets[1] ** 2, offsets[2], offsets[2])
    cosine = surfaces.lambert(surface.slope_down, surface.slope_right, *offsets)
    fields = cosine * (squares * squares.sqrt()).reciprocal() * above**2
    return (colors.mT @ fields.flatten(2)).unflatten(2, fields.shape[2:])


@dataclass(frozen=True)
class PointLight(LightModel):
    """A small lamp lights a matte surface: cos / distance², the inverse-square law (Lambert 1760).

    The lamp is up to 1.5 half widths from the center, at a height of 0.4 to 2 half widths. The
    surface is random and smooth, or that of the depth of the image.
    """

    ranges = (STEEPNESS, *LAMP, WEAK, METER)
    constants = surfaces.SURFACE_NODES**2

    def light(self, drawn: Drawn) -> Illumination:
        """Add weak ambient light to the light of the lamp."""
        # Position of the one lamp of each image, shape (B, 1, 3).
        place = drawn.rows[:, None, 1:4]
        light = lamp_light(drawn, place, torch.ones_like(place[..., :1]))
        return Illumination(light, offset=drawn.numbers[4])


@dataclass(frozen=True)
class ColoredLamps(LightModel):
    """One to three small lamps, each of its own color, light a matte surface (see `PointLight`).

    The light of several lamps is the sum of theirs (Grassmann 1853).
    """

    ranges = (STEEPNESS, *[*LAMP, Range(0, 1), Range(0, 1)] * 3, WEAK, METER)
    constants = 1 + surfaces.SURFACE_NODES**2

    def light(self, drawn: Drawn) -> Illumination:
        """Add the light of the lamps, of which some are off, to weak ambient light."""
        # Index of the last lamp of each image that is on.
        last = (3 * drawn.constants[:, :1]).floor().clamp(max=2)
        count = int(last.max()) + 1
        # Numbers of each lamp, shape (B, count, 5).
        lamps = drawn.rows[:, 1 : 1 + 5 * count].unflatten(1, (count, 5))
        colors = patterns.random_colors(lamps[..., 3:].flatten(0, 1)).view(-1, count, 3)
        is_on = torch.arange(count, device=last.device) <= last
        light = lamp_light(drawn, lamps[..., :3], colors * is_on[..., None])
        return Illumination(light, offset=drawn.numbers[-2])


@dataclass(frozen=True)
class LinearLight(LightModel):
    """Light that rises evenly from one side of the image to the other.

    It is the first-order expansion of any smooth light, such as that of a window at one side (Land
    & McCann 1971).
    """

    ranges = (TURN, Range(0, 0.95), METER)

    def illumination(self, drawn: Drawn, strength: float = 1.0) -> Illumination:
        """Expose the light, whose mean is 1, by a loop that needs no meter."""
        if loop := loops.ramps(drawn.rows):
            field, parts = drawn.field(), torch.empty(2, len(drawn.rows), 1)
            loop(drawn.rows, surfaces.grid(1, drawn.size), strength, field, parts)
            return Illumination(field, *parts[..., None, None])
        return super().illumination(drawn, strength)

    def light(self, drawn: Drawn) -> Illumination:
        """Compute a ramp with the mean 1 and the minimum 1 − contrast."""
        turn, contrast, _ = drawn.numbers
        height, width = height_and_width(drawn.size)
        x, y = surfaces.axes(drawn.size, turn)
        right, down = turn.cos(), turn.sin()
        # The largest value of right · x + down · y is in a corner. There, the ramp is 1 ± contrast.
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

    def light(self, drawn: Drawn) -> Illumination:
        """Blend two random fields of the same variance, and take the exponential."""
        contrast, angle, _ = drawn.numbers
        # Normal numbers at the nodes of all octaves, shape (B, all nodes).
        blended = surfaces.blend(drawn.constants, angle)[..., 0, 0]
        nodes = blended @ surfaces.sum_of_octaves(self.octaves, angle.device, angle.dtype)
        nodes = contrast * nodes.view(-1, 1, self.octaves[-1], self.octaves[-1])
        return Illumination(surfaces.smooth(nodes, drawn.size).exp())


# Kinds of cast shadows, in the order of the numbers in `loops.shadows`.
SHADOWS = ("polygon", "leaves", "blinds", "window")


@dataclass(frozen=True)
class CastShadow(LightModel):
    """An object between the sun and the scene casts a shadow, whose penumbra has a uniform width.

    A pixel of the penumbra sees a part of the disc of the sun (`circle_segment`, Hasenfratz et al.
    2003). Edges count as straight. The shadow is lit by the sky, which is bluish. Kinds are
    "polygon", "leaves", "blinds" and "window".
    """

    kinds: tuple[str, ...] = SHADOWS
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
        for kind in as_list("kinds", self.kinds, str, "a list of names"):
            require_choice("kinds", kind, SHADOWS)
        object.__setattr__(self, "kinds", tuple(self.kinds))
        if not self.kinds:
            raise InputError("kinds is empty: name at least one kind of shadow")

    def light(self, drawn: Drawn) -> Illumination:
        """Compute the light of the sun and of the sky."""
        # Uniform numbers are less than 1, but their product with the count is rounded.
        last = len(self.kinds) - 1
        kinds = [min(int(each * (last + 1)), last) for each in drawn.constants[:, 0].tolist()]
        if loop := loops.shadows(drawn.rows):
            indices = np.array([SHADOWS.index(self.kinds[kind]) for kind in kinds])
            field, parts = drawn.field(), torch.empty(2, len(kinds), 3)
            heights = surfaces.blend(drawn.constants[:, 1:], drawn.numbers[2])[..., 0, 0]
            weights = surfaces.grid(self.nodes, drawn.size)
            loop(indices, drawn.rows, drawn.constants, heights, weights, field, parts)
            return Illumination(field, *parts[..., None, None])

        def segment(kind: int, rows: list[int] | slice) -> Tensor:
            part = drawn._replace(rows=drawn.rows[rows], constants=drawn.constants[rows, 1:])
            return self._segment(self.kinds[kind], part)

        *_, ambient, blue = drawn.numbers
        # Light of the sky in the shadow, relative to that of sun and sky.
        sky = ambient - ambient * blue * blue.new_tensor(loops.SKY)[:, None, None]
        # sky + (1 − sky) · v, where v = 1/2 + segment / π is the visible fraction of the sun.
        return Illumination(patterns.by_kind(kinds, segment), (1 - sky) / math.pi, (1 + sky) / 2)

    def _segment(self, kind: str, drawn: Drawn) -> Float[Tensor, "B 1 H W"]:
        """Compute the segment of the sun, which depends on the distance to the edge of a shadow.

        Distances are positive in the light, and in units of the penumbra's radius.
        """
        right, down, angle, scale, softness, *_ = drawn.numbers
        if kind == "leaves":
            nodes = surfaces.blend(drawn.constants, angle).view(-1, 1, self.nodes, self.nodes)
            # The heights are 0 at the edges between leaves and gaps.
            height = surfaces.smooth(nodes, drawn.size) - right
            slopes = [surfaces.smooth(nodes, drawn.size, slope) for slope in "xy"]
            # Distance to the edge, to first order.
            squares = torch.addcmul(slopes[0] * slopes[0], slopes[1], slopes[1])
            return surfaces.circle_segment(height * (squares + 1e-6).rsqrt() / softness)
        x, y = surfaces.axes(drawn.size, right)
        x, y, scale = (x - right) / softness, (y - down) / softness, scale / softness
        constants = drawn.constants[..., None, None]
        # `back` is the distance of the edges of a polygon from its center. `gap`, `scale`, `high`
        # and `bar` are half widths, and `period` is that of blinds.
        period, back = 1.0, 0.0
        index = torch.arange(self.corners, device=scale.device)[:, None, None]
        if kind == "polygon":
            # Each edge has a random direction near that of a regular polygon, and a distance.
            turns, far = constants[:, : 2 * self.corners].chunk(2, 1)
            normal = angle + 2 * math.pi / self.corners * (index + 0.8 * turns)
            back = scale * surfaces.between(far, *loops.FAR)
        elif kind == "blinds":
            normal, period = angle + math.pi / 2, scale / 2.5
            gap = surfaces.between(constants[:, :1], *loops.GAP)
        else:
            normal = angle + math.pi / 2 * index[:2]
            high = scale * surfaces.between(constants[:, :1], *loops.HIGH)
            bar = scale * surfaces.between(constants[:, 1:2], *loops.BAR)
        # Distances of each column, and of each row, along the normals of the shape.
        columns, rows = normal.cos() * x / period, (normal.sin() * y - back) / period
        edges = columns + rows
        if kind == "polygon":
            # Outside a convex polygon. The distance is exact except near corners.
            return surfaces.circle_segment(edges.amax(1, keepdim=True))
        if kind == "blinds":
            # Inside the gaps between parallel slats, with a period of 0.4 in units of the scale.
            return surfaces.circle_segment((gap - (patterns.fraction(edges) - 0.5).abs()) * period)
        # Inside the panes of a window with a cross bar.
        p, q = edges.abs().split(1, 1)
        inside = torch.minimum(scale - p, high - q)
        return surfaces.circle_segment(torch.minimum(inside, torch.minimum(p, q) - bar))


@dataclass(frozen=True)
class ColorTemperature(LightModel):
    """A black body of 2,000 to 15,000 K lights the scene, and the camera's white balance is off.

    The light is that of Planck (1901), approximated as by Krystek (1985). The camera divides its
    channels by the color of the lamp that it assumes (von Kries 1902 in the channels of the
    camera). Its temperature is between that of the lamp and of D65. A tint is up to 0.02 (Duv) to
    green or magenta. That of daylight is 0.003.
    """

    # Temperature in 1/K, how much of it the camera corrects, and the tint.
    ranges = (Range(1 / 2000, 1 / 15000), Range(0, 1), Range(-0.02, 0.02))

    def light(self, drawn: Drawn) -> Illumination:
        """Compute one color for all pixels. Temperatures are uniform in reciprocal units."""
        lamp, balance, tint = drawn.numbers
        # The camera assumes a color between that of D65 (6504 K) and that of the lamp.
        assumed = 1 / 6504 + balance * (lamp - 1 / 6504)
        kelvin = 1 / torch.stack([lamp, assumed])
        color = torch.div(*patterns.planckian_rgb(kelvin, torch.stack([tint, 0 * tint])))
        return Illumination(torch.ones_like(lamp), color / patterns.luminance(color))


@dataclass(frozen=True)
class LowLight(LightModel):
    """Little light reaches a noisy sensor. For half of the images, gain recovers some brightness.

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
    # Fraction of the stops, read noise in electrons, and fraction that the gain recovers. Below 0,
    # it recovers nothing, and the image stays dark.
    ranges = (Range(0, 1), Range(1, 5), Range(-1, 1))

    def __post_init__(self) -> None:
        require_number("exposure", self.exposure, 1e-6, 1)

    def light(self, drawn: Drawn) -> Illumination:
        """Return 1, because the camera receives less light (see `camera`)."""
        return Illumination(torch.ones_like(drawn.numbers[0]))

    def camera(
        self, radiance: Float[Tensor, "B C H W"], drawn: Drawn, strength: float, white: Tensor
    ) -> Float[Tensor, "B C H W"]:
        """Count electrons, add noise, amplify and round. Gradients pass through the rounding."""
        z = normal_noise(radiance, drawn.seeds)
        middle, slope, curve = self.response(radiance, drawn, strength, white)
        # middle + z (slope + z curve), limited to the range of the converter.
        signal = torch.addcmul(middle, z, torch.addcmul(slope, z, curve)).clamp(0, self.levels)
        return straight_through(signal, torch.round) * (white / self.levels)

    def response(
        self, radiance: Float[Tensor, "B C H W"], drawn: Drawn, strength: float, white: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return a, b and c for each value, where a + b z + c z² is the signal of the amplifier.

        z is a normal number. The mean number of electrons l and σ² = l + r² are those of the class.
        """
        darkness, read_noise, recovered = drawn.numbers
        # The light is 2^-stops of that of the photograph, between `exposure` and 1.
        stops = strength * math.log2(1 / self.exposure) * darkness
        mean = radiance.clamp(min=0) * (self.full_well * torch.exp2(-stops) / white)
        variance = mean + read_noise**2
        # After the gain of the amplifier, a full pixel has the largest number.
        gain = torch.exp2(stops * recovered.clamp(min=0)) * (self.levels / self.full_well)
        # c = gain · l / (6 σ²). The "−1" of z² − 1 subtracts c from a = gain · l.
        curve = gain / 6 * mean / variance
        return gain * mean - curve, gain * variance.sqrt(), curve


def normal_noise(like: Float[Tensor, "B C H W"], seeds: Sequence[int]) -> Tensor:
    """Draw a normal number for each value of each image, from the seed of the image."""
    # The numbers depend on neither the layout nor the type of the images.
    noise = torch.empty(like.shape, dtype=torch.float32, device=like.device)
    for image, seed in zip(noise, seeds, strict=True):
        image.normal_(generator=torch.Generator(like.device).manual_seed(seed))
    return noise.to(like.dtype)


@dataclass(frozen=True)
class ClippedHighlights(LightModel):
    """The exposure is too long by 0.5 to 3 stops, and full pixels of the sensor are white.

    The sensor is linear up to its saturation (EMVA 1288).
    """

    ranges = (Range(0.5, 3.0),)
    has_limit = True

    def light(self, drawn: Drawn) -> Illumination:
        """Return the exposure."""
        return Illumination(torch.exp2(drawn.numbers[0]))


@dataclass(frozen=True)
class Stripes(LightModel):
    """A scanner projects stripes, waves or one border, of full contrast, on an object (Geng 2011).

    They are along rows or columns, bend with a random smooth surface, and jump where it ends. No
    meter sets the exposure.
    """

    ranges = (
        Range(0.05, 2.0, True),  # Period in half widths.
        Range(0, 1),  # Position in periods.
        Range(-0.2, 0.2),  # Slope in radians.
        Range(0, 0.5),  # Bend in periods.
        Range(-0.5, 0.5),  # Jump in periods.
        Range(0.01, 0.4, True),  # Ambient light.
        Range(0.3, 2.0, True),  # Exposure.
    )
    constants = 3 + 2 * surfaces.SURFACE_NODES**2

    def light(self, drawn: Drawn) -> Illumination:
        """Compute stripes whose edges are blurred by one to five pixels."""
        period, phase, slope, bend, jump, ambient, exposure = drawn.numbers
        is_upright, kind, blur = drawn.constants[:, :3].T[..., None, None, None]
        nodes = surfaces.normal_numbers(drawn.constants[:, 3:])
        nodes = nodes.view(-1, 2, surfaces.SURFACE_NODES, surfaces.SURFACE_NODES)
        bent, side = surfaces.smooth(nodes, drawn.size).split(1, 1)
        x, y = surfaces.axes(drawn.size, period)
        turn = slope + math.pi / 2 * (is_upright < 0.5)
        place = turn.cos() * x + turn.sin() * y + period * (bend * bent + jump * (side > 0))
        edge = surfaces.between(blur, 1, 5) / height_and_width(drawn.size)[1]
        pattern = patterns.waves(place, period, phase, kind, edge)
        return Illumination(pattern, exposure * (1 - ambient), exposure * ambient)


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
    "stripes": Stripes,
}
