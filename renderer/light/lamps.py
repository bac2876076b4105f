"""Local lights: a projector of pixel patterns, and lamps that are points or discs."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from renderer.camera import MAX_FOV, MIN_FOV, OrthographicCamera, PerspectiveCamera
from renderer.errors import MAX_SCALE, InputError, as_array, as_tensor, explained, require_number
from renderer.io.images import gray_or_image
from renderer.io.mitsuba_entries import pose_of, projector
from renderer.light.basis import LightPaths, LocalBasis
from renderer.light.files import read_light
from renderer.microfacets import Vectors
from renderer.settings import Settings, setting
from renderer.vectors import tangent_axes


@dataclass(frozen=True)
class Projector(Settings, LocalBasis):
    """Projector that aims at the origin, with one RGB coefficient for each pixel of its pattern.

    The pattern has pixels² pixels. Their coefficients are in row-major order
    from the top left, as a screen would show the pattern. A white surface at the
    origin that faces the projector gets the radiance 1 from a coefficient of 1.
    The light falls with the squared distance. A pattern with equal coefficients
    lights a flat screen at the origin uniformly.

    Attributes:
        pixels: Number of pixels along one side of the pattern, at most 256.
        polar: Angle between +z and the position of the projector, in degrees.
        azimuth: Azimuth of the projector in degrees, measured from +x toward +y.
        distance: Distance from the origin in world units, at least 2.
        fov: Angle between opposite sides of the pattern, in degrees, from 0.05
            to 172.
        power: Largest coefficient. The smallest coefficient is 0.

    Raises:
        InputError: If an attribute is out of range.

    Example:
        >>> import norm_balls as nb
        >>> beamer = nb.Projector(pixels=4)
        >>> beamer.size, str(beamer)
        (16, 'a projector of 4² pixels')
    """

    pixels: int = setting(16, "Pixels per side of the pattern.", within=(1, 256))
    polar: float = setting(60.0, "Its polar angle.", "degrees", within=(-MAX_SCALE, MAX_SCALE))
    azimuth: float = setting(30.0, "Its azimuth.", "degrees", within=(-MAX_SCALE, MAX_SCALE))
    distance: float = setting(4.0, "Its distance in world units.", within=(2, MAX_SCALE))
    fov: float = setting(30.0, "Its field of view.", "degrees", within=(MIN_FOV, MAX_FOV))
    power: float = setting(1.0, "Largest coefficient.", within=(1 / MAX_SCALE, MAX_SCALE))

    name = "projector"

    @classmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        """Create a projector and its pattern from settings.

        Args:
            settings: `ProjectorSettings` of `augment.settings`. Its field `pattern`
                is a gray value in [0, 1] or the path of an image.

        Returns:
            A tuple of
            - the projector;
            - the RGB coefficients of its pixels, shape (pixels², 3).

        Raises:
            InputError: If a setting is out of range, or if the image cannot be
                read.
        """
        light = cls(**{field.name: getattr(settings, field.name) for field in fields(cls)})
        pattern = gray_or_image("pattern", settings.pattern, light.pixels).expand(3, -1, -1)
        return light, light.power * pattern.flatten(1).T

    def __str__(self) -> str:
        return f"a {self.name} of {self.pixels}² pixels"

    @property
    def size(self) -> int:
        """Number of pixels of the projector."""
        return self.pixels**2

    def picture(self, coefficients: Tensor) -> Tensor:
        """Convert coefficients to an image of the pattern.

        Args:
            coefficients: RGB coefficients, shape (pixels², 3).

        Returns:
            Image in [0, 1], in which 1 is a coefficient of `power`,
            shape (pixels, pixels, 3).
        """
        return coefficients.view(self.pixels, self.pixels, 3) / self.power

    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None, lobe_width: float
    ) -> LightPaths:
        """Find the straight path from the projector to each surface point that it lights.

        Args:
            points: N surface points in world axes, shape (N, 3).
            normals: Unit normals at the points, shape (N, 3).
            positions: Not used, because a projector cannot be moved.
            lobe_width: Not used, because a projector is a point.

        Returns:
            One path for each point that lies within the pattern and faces the
            projector, also if an object blocks the path.
        """
        source, depth, places = self._seen(points)
        row, column = places.floor()
        # Cosine between path and normal, divided by the cosine between path and axis.
        cosine_ratio = ((source - points) * normals).sum(1) / depth
        # Whether the row and the column are within the pattern.
        is_within = (places >= 0) & (places < self.pixels)
        is_lit = is_within[0] & is_within[1] & (depth > 0) & (cosine_ratio > 0)
        lit_point = torch.nonzero(is_lit).squeeze(1)
        irradiance = cosine_ratio * (self.distance / depth) ** 2
        pattern_pixel = (row * self.pixels + column)[lit_point].long()
        sources = source.expand(len(lit_point), 3)
        return LightPaths(lit_point, pattern_pixel, sources, irradiance[lit_point])

    def _seen(self, points: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor, Float[Tensor, "2 N"]]:
        """Return the projector's position, the depth of points, and their row and column."""
        # Axes of the pattern, one for each row: right, up and back (away from the origin). A
        # camera at the position of the projector has the same axes.
        axes = torch.from_numpy(OrthographicCamera(self.polar, self.azimuth, 1.0).axes()).to(points)
        source = self.distance * axes[2]
        right, up, back = ((points - source) @ axes.T).unbind(1)
        # Half the width of the pattern at the depth of each point.
        half_width = -back * math.tan(math.radians(self.fov) / 2)
        places = (1 + torch.stack([-up, right]) / half_width) / 2 * self.pixels
        return source, -back, places

    def arriving(self, light: Tensor, paths: LightPaths, points: Tensor) -> Tensor:
        """Return the pixel of each path, whose gradient follows the pattern as points move.

        The slope of the pattern is that between both neighbors of a pixel.
        """
        arriving = light[paths.function]
        if not points.requires_grad or self.pixels == 1:
            return arriving
        _, _, places = self._seen(points[paths.point])
        pattern = light.detach().view(self.pixels, self.pixels, -1)
        rows, columns = torch.gradient(pattern, dim=(0, 1))
        # A step between two pixels counts half in each.
        rows[[0, -1]] /= 2
        columns[:, [0, -1]] /= 2
        for place, slope in zip(places, (rows, columns), strict=True):
            moved = place - place.detach()
            arriving = arriving + slope.flatten(0, 1)[paths.function] * moved[:, None]
        return arriving

    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        """Create the entry of the projector in a Mitsuba scene.

        Args:
            coefficients: RGB coefficients of the pixels, shape (pixels², 3).
            albedo_scale: Factor for the albedo of the mesh. Here it multiplies the
                light, which gives the same image.

        Returns:
            List with one entry.
        """
        texels = coefficients.view(self.pixels, self.pixels, 3).numpy()
        pattern = {"bitmap": texels, "filter_type": "nearest", "wrap_mode": "clamp"}
        camera = PerspectiveCamera(self.polar, self.azimuth, 1.0, distance=self.distance)
        # The coefficients are irradiances at the origin. Mitsuba needs those at distance 1
        # from the projector, which are larger by the factor distance². Mitsuba
        # itself multiplies them by π.
        return [projector(pose_of(camera), self.fov, pattern, albedo_scale * self.distance**2)]


# A matte surface point casts a ray to each point of a set of points on a disc lamp. A glossy one
# casts more, so that single points do not show in highlights, but a view casts at most about
# `MAX_PATHS` rays in total.
POINTS_PER_SET = 8
MAX_PATHS = 2**20
# Number of different sets of points on a disc lamp. Neighboring surface points use
# different sets, which makes the edges of soft shadows smoother.
POINT_SETS = 4


@dataclass(frozen=True)
class Lamps(LocalBasis):
    """Lamps with given positions and one RGB coefficient per lamp.

    The coefficient of a lamp is the irradiance of a surface at distance 1 that
    faces the lamp. The irradiance falls with the squared distance.

    Attributes:
        positions: Position (x, y, z) of each lamp in world axes. No lamp may be
            at the origin.
        power: Largest coefficient. The smallest coefficient is 0.
        radius: Radius of the lamps in world units. With 0, the lamps are points
            that emit in all directions. Otherwise, the lamps are discs that face
            the origin and emit like diffuse surfaces, with the cosine of the
            angle to their axis. A distant disc is as bright as a point with the
            same coefficient.

    Raises:
        InputError: If there is no position, or if a lamp is at the origin.

    Example:
        >>> import norm_balls as nb
        >>> lamps = nb.Lamps(((2.0, 0.0, 2.0), (0.0, 2.0, 2.0)), radius=0.2)
        >>> lamps.size, str(lamps)
        (2, '2 lamps')
    """

    positions: tuple[tuple[float, float, float], ...]
    power: float = 10.0
    radius: float = 0.0

    name = "lamps"
    is_movable = True

    def __post_init__(self) -> None:
        """Check the fields, and convert the positions to tuples of numbers."""
        positions = as_array("positions", self.positions)
        is_triple = positions.shape[1:] == (3,) and (positions != 0).any(axis=1).all()
        if not is_triple or not (np.abs(positions) <= MAX_SCALE).all():
            fault = f"lamps.positions={self.positions} are no positions of lamps"
            limits = f"with magnitudes up to {MAX_SCALE:g}, and no lamp at the origin"
            raise InputError(f"{fault}: give [x, y, z] for each lamp, {limits}")
        # Plain assignment to a field of a frozen dataclass raises an error.
        object.__setattr__(self, "positions", tuple(map(tuple, positions.tolist())))
        require_number("lamps.power", self.power, 1 / MAX_SCALE, MAX_SCALE)
        require_number("lamps.radius", self.radius, 0, MAX_SCALE)

    @classmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        """Create lamps and their coefficients from settings.

        Args:
            settings: `LampsSettings` of `augment.settings`. Its field `start` gives
                the coefficients: a number for all, an RGB color for each lamp, or
                the path of a file of `save_light` with lamps and coefficients.

        Returns:
            Lamps, and their RGB coefficients, shape (L, 3) for L lamps.

        Raises:
            InputError: If a position or a coefficient is invalid.
        """
        if isinstance(settings.start, str | Path):
            lamps, powers = read_light(settings.start, cls)
            return lamps, lamps.project_nonnegative(powers)
        lamps = cls(settings.positions, settings.power, settings.radius)
        advice = "give a number or a list with [r, g, b] for each lamp"
        with explained(f"start={settings.start} does not fit {lamps}", advice):
            start = as_tensor("start", settings.start).float().expand(lamps.size, 3)
        # NaN is out of range, too, because both comparisons with NaN are False.
        if not ((start >= 0) & (start <= settings.power)).all():
            raise InputError(f"start={settings.start} must be from 0 to power={settings.power:g}")
        return lamps, lamps.project_nonnegative(start)

    def __str__(self) -> str:
        return f"{len(self.positions)} {self.name}"

    @property
    def size(self) -> int:
        """Number of lamps."""
        return len(self.positions)

    def moved(self, positions: Tensor) -> Self:
        """Return a copy of this basis with the lamps at new positions.

        Args:
            positions: New positions of the L lamps in world axes, shape (L, 3).
        """
        return replace(self, positions=tuple(map(tuple, positions.tolist())))

    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None, lobe_width: float
    ) -> LightPaths:
        """Find the straight paths from lamps to surface points, without shadows.

        Args:
            points: S surface points in world axes, shape (S, 3).
            normals: Unit normals at the points, shape (S, 3).
            positions: Positions to which the L lamps have moved, shape (L, 3).
                None uses the positions of the basis.
            lobe_width: Smallest width α of the specular lobes at the points. Discs have
                more points for narrower lobes. Infinite if the points are matte.

        Returns:
            Paths that arrive at the front of the surface, also those that an
            object blocks. There is one path for each pair of a surface point and
            a lamp, or at least `POINTS_PER_SET` paths if the lamps are discs.
        """
        positions = points.new_tensor(self.positions) if positions is None else positions
        # Points on the lamps. Neighboring surface points use different sets of points. Axes:
        # set, lamp, point, coordinate. A point lamp has one set of one point.
        sources = positions[None, :, None]
        if self.radius:
            sources = self._disc_points(positions, self._point_count(points, positions, lobe_width))
        set_of_point = torch.arange(len(points), device=points.device) % len(sources)
        # First find the paths with light, without recording operations for gradients.
        with torch.no_grad():
            # Vectors with the axes: surface point, lamp, point on the lamp, coordinate.
            to_lamp = sources[set_of_point] - points[:, None, None]
            irradiance = self._irradiance(to_lamp, normals[:, None, None], positions[:, None])
            point, lamp, point_on_lamp = torch.nonzero(irradiance > 0, as_tuple=True)
        # Then compute the irradiance of these paths again, with gradients.
        source = sources[set_of_point[point], lamp, point_on_lamp]
        irradiance = self._irradiance(source - points[point], normals[point], positions[lamp])
        paths_per_lamp = sources.shape[2]
        return LightPaths(point, lamp, source, irradiance / paths_per_lamp)

    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        """Create an entry of a Mitsuba scene for each lamp.

        Args:
            coefficients: RGB coefficients of the L lamps, shape (L, 3).
            albedo_scale: Factor for the albedo of the mesh. It multiplies the
                intensity of the lamps instead, which gives the same image.

        Returns:
            Entries of point or disc emitters, one for each lamp.
        """
        # A surface reflects albedo / π times the irradiance in Mitsuba, and albedo times
        # the irradiance in this project.
        intensities = math.pi * albedo_scale * coefficients
        emitters: list[dict[str, Any]] = []
        for (x, y, z), intensity in zip(self.positions, intensities.tolist(), strict=True):
            if not self.radius:
                color = {"type": "rgb", "value": intensity}
                emitters.append({"type": "point", "position": [x, y, z], "intensity": color})
                continue
            # A Mitsuba disk emits along its +z axis, as a camera looks along it. The disc
            # therefore has the pose of a camera at its center that looks at the origin.
            polar = math.degrees(math.atan2(math.hypot(x, y), z))
            azimuth = math.degrees(math.atan2(y, x))
            camera = PerspectiveCamera(polar, azimuth, 1.0, distance=math.hypot(x, y, z))
            area = math.pi * self.radius**2
            radiance = {"type": "rgb", "value": [channel / area for channel in intensity]}
            area_light = {"type": "area", "radiance": radiance}
            pose = pose_of(camera, self.radius)
            emitters.append({"type": "disk", "to_world": pose, "emitter": area_light})
        return emitters

    def _point_count(self, points: Tensor, positions: Tensor, lobe_width: float) -> int:
        """Choose how many points each disc has, apart by less than the narrowest highlight."""
        if math.isinf(lobe_width):
            return POINTS_PER_SET
        distances = torch.cdist(points.detach(), positions.detach()).cpu().numpy()
        # Length of the narrowest highlight on the nearest disc.
        length = max(lobe_width * distances.min(initial=math.inf), 1e-9)
        wanted = 2 * (self.radius / length) ** 2
        limit = MAX_PATHS / max(1, len(points) * len(positions))
        return math.ceil(max(POINTS_PER_SET, min(wanted, limit)))

    def _disc_points(self, positions: Float[Tensor, "L 3"], count: int) -> Float[Tensor, "_ L _ 3"]:
        """Choose points on disc lamps, to which shadow rays are cast.

        Each of several sets lies on Vogel's spiral (1979), rotated by another angle, with one point
        for equal areas. Positions and points are in world axes; the axes are: set, lamp, point,
        coordinate.
        """
        # Tensors have one row for each set and one column for each point.
        set_index, point_index = torch.arange(POINT_SETS)[:, None], torch.arange(count)
        area_fraction = (point_index + (set_index + 0.5) / POINT_SETS) / count
        distance = self.radius * area_fraction.sqrt()
        # Successive points of the spiral are apart by the golden angle π (3 - √5).
        angle = point_index * math.pi * (3 - math.sqrt(5)) + set_index * 2 * math.pi / POINT_SETS
        # Positions in the plane of a disc, with the axes: set, point, plane coordinate.
        in_plane = torch.stack([distance * angle.cos(), distance * angle.sin()], 2).to(positions)
        # Unit vector from the origin to each disc, which is the axis of the disc.
        x, y, z = F.normalize(positions, dim=1).unbind(1)
        # `tangent_axes` would be singular for some discs below the origin without this sign.
        sign = torch.where(z < -0.5, -1.0, 1.0).to(z)
        plane_axes = [torch.stack(axis, dim=1) for axis in tangent_axes(x, y, z, sign)]
        # Axes: set s, point p, plane coordinate a, lamp l, world coordinate w.
        offsets = torch.einsum("spa,law->slpw", in_plane, torch.stack(plane_axes, dim=1))
        return positions[:, None] + offsets

    def _irradiance(
        self, to_lamp: Vectors, normals: Vectors, positions: Vectors
    ) -> Float[Tensor, " ..."]:
        """Compute irradiance for a coefficient of 1, at most 0 behind the surface or a disc."""
        squared_distance = to_lamp.square().sum(-1)
        # Cosine to the normal, divided by the squared distance.
        irradiance = (to_lamp * normals).sum(-1) / squared_distance**1.5
        if not self.radius:
            return irradiance
        # A disc faces the origin, so its axis is the direction of its position.
        disc_axis = F.normalize(positions, dim=-1)
        cosine_at_disc = (to_lamp * disc_axis).sum(-1) / squared_distance.sqrt()
        return irradiance * cosine_at_disc.clamp(min=0)


# All kinds of local light by name. In this order, their coefficients follow those of the
# environment light in a scene. The name is also the name of two settings: a field of
# `augment.settings.SceneSettings` for the light, and a field of
# `augment.attack_settings.ParameterSettings` for attacks on the light.
LOCAL_LIGHTS: dict[str, type[LocalBasis]] = {kind.name: kind for kind in (Projector, Lamps)}
