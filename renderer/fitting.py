"""Estimate the camera and the light of a photograph of a mesh.

All pixels outside of the mesh are set to one gray value, so that an image shows
silhouette and shading at once. For each camera, the best light is the solution
of a convex quadratic program, because images are linear in the light and the
radiance of the light must not be negative. The differences of the pixels are
therefore a function of the camera alone (variable projection, Golub and Pereyra
1973). The Gauss-Newton method minimizes the sum of their squares.

Light and albedo only appear as their product: doubling the albedo halves the
light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, nnls
from torch import Tensor

from renderer.camera import Camera, PerspectiveCamera, orbit_cameras
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.shapes import sphere
from renderer.image import decode
from renderer.light.basis import COEFFICIENTS, DEGREE
from renderer.light.harmonics import bands, basis
from renderer.photograph import Photograph, Window
from renderer.rendering import precompute_transfer, render

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

# The search begins with cameras at these angles from +z in degrees, and at as
# many azimuths for each of them. All have the same width in world units.
POLAR = (20, 40, 60, 80, 100)
AZIMUTHS = 16
FIRST_WIDTH = 2.0
# `fit_scene` first searches for cameras in images of this many pixels per side.
COARSE = 32
# Descents start from as many of the best cameras of the search.
KEPT = 3
# Largest number of Gauss-Newton steps from one camera.
STEPS = 20
# Relative change of the squared error, or of the camera, at which a descent ends.
LEAST_GAIN = 1e-3
# Steps of the numerical derivatives by polar angle and azimuth (in radians),
# relative width, right and up, as multiples of 1 / size. A step to the right is half a pixel.
DIFFERENCES = (1.0, 1.0, 1.0, 0.5, 0.5)
# Smallest angle between +z or -z and the camera in a descent. Descents are in
# radians.
POLE_DISTANCE = 0.02
# Samples per side of a pixel.
SAMPLES = 8
# Cameras whose axes differ by a smaller angle in degrees count as one.
DISTINCT = 2.0
# Cameras of the search are compared at the full size if their squared error is at
# most this multiple of the smallest one.
PLAUSIBLE = 3
# Weight of the squared Laplacian of the light, or of its difference from the
# expected light of a channel (see `_light_of_channels`). It is relative to the
# squares of what the best channel shows of a uniform light. It bounds light that
# the object does not show.
SMOOTH = 1e-6
# Pixels of the photograph with this linear value or more count as clipped. The
# scene may have been brighter there.
CLIPPED = 0.995
# The light is solved for as many times, each time with the clipped pixels of the
# solution before.
CLIPPING_ROUNDS = 3
# The light is at least this fraction of its mean radiance in the directions of a
# grid. This margin keeps it positive in the directions between them.
LEAST_RADIANCE = 0.01
# Largest number of iterations of non-negative least squares per direction. Three
# are usual.
MAX_EXCHANGES = 100
# One of as many directions of a grid constrains the first solution.
FIRST_DIRECTIONS = 16
# Subdivisions of the grid of directions while a camera is sought, and for the
# light that is returned.
SEARCH_GRID = 2
FINAL_GRID = 5
# Pixels in which the object has a larger share belong to the object. At a smaller
# limit, the background could outshine the object: a hundredth of a bright
# background may be brighter than the blue of a banana.
WHOLE = 0.999
# Pixels on the border of the object take their color from the object's pixels at
# this distance or less.
BORDER = 2
# Side of the window of an object, as a multiple of the longer side of its box.
MARGIN = 1.6
# A pixel of a mask belongs to the object if its value is larger.
OPAQUE = 127
# First guess of the camera's angle from +z, in degrees.
USUAL_POLAR = 60.0
# If the axes of a window change by more, the window is cut anew.
TILTED = 1e-3
# Number of pixels that the object must cover.
MIN_COVERED_PIXELS = 16
COLORS = 3


class FittedPhotograph(NamedTuple):
    """The result of `fit_photograph`.

    Attributes:
        scene: Camera and light. The camera looks at the center of the mesh.
        window: The part of the photograph that this camera shows.
    """

    scene: FittedScene
    window: Window


class FittedScene(NamedTuple):
    """Camera and light of a photograph.

    Attributes:
        camera: The camera.
        light: SH coefficients of a light with non-negative radiance, shape
            (49, 3).
        error: Root mean square of the differences in linear light over the
            pixels of the object, divided by that of the photograph.
        overlap: Intersection over union of the rendered and the given
            silhouette.
    """

    camera: Camera
    light: Tensor
    error: float
    overlap: float


def fit_photograph(
    photograph: UInt8[NDArray[Any], "height width 3"],
    mask: UInt8[NDArray[Any], "height width"],
    mesh: Mesh,
    size: int = 64,
    *,
    fov: float | None = None,
    encoding: str = "srgb",
    **options: Any,
) -> FittedPhotograph:
    """Find the camera and the light of an object anywhere in a photograph.

    The object is seen through a window, as by a camera that is turned towards it
    (`renderer.photograph`). Which way is up in the window depends on how high the
    camera stands. Window and camera are therefore found again if the first fit
    shows that the window was tilted.

    Args:
        photograph: Pixels of 8 bits, shape (H, W, 3). Its camera is upright, and
            its optical axis passes through the center of the photograph.
        mask: White where the object is, shape (H, W).
        mesh: The mesh, normalized and upright.
        size: Pixels per side that are compared.
        fov: Angle across a square `MARGIN` times as wide as the object, in
            degrees. None for a camera without perspective.
        encoding: Encoding of the photograph and of the images that are to be
            rendered, "linear" or "srgb".
        **options: Further arguments of `fit_scene`.

    Returns:
        The scene and its window of the photograph.

    Raises:
        InputError: If the mask holds no object.
    """
    is_object = mask > OPAQUE
    rows = np.flatnonzero(is_object.any(axis=1))
    columns = np.flatnonzero(is_object.any(axis=0))
    if not len(rows):
        raise InputError(
            "no object is found: give a mask that is white where it is, or a box around it"
        )
    center = np.array([columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1]) / 2
    side = MARGIN * max(int(np.ptp(rows)), int(np.ptp(columns)), 1)
    focal_length = None if fov is None else side / 2 / math.tan(math.radians(fov) / 2)
    camera_image = Photograph(photograph, focal_length)
    fit = _WindowFit(photograph, mask, mesh, size, {**options, "fov": fov, "encoding": encoding})

    usual_polar = math.radians(USUAL_POLAR)
    up_at_usual_angle = np.array([0.0, math.sin(usual_polar), math.cos(usual_polar)])
    window = camera_image.window(center, side, up_at_usual_angle)
    scene = fit.fit(window, None)
    up = _up_direction(scene.camera, window)
    # The camera of the photograph is upright.
    up[0] = 0
    upright = camera_image.window(center, side, up)
    if np.abs(upright.axes - window.axes).max() > TILTED:
        window = upright
        scene = fit.fit(window, scene.camera)
    camera = scene.camera
    up = _up_direction(camera, window)
    shift = np.array([camera.right, camera.up]) * side / camera.width
    mesh_center = np.array(window.pixels(*shift))
    turned_scene = scene._replace(camera=_turned_to_mesh(camera))
    return FittedPhotograph(turned_scene, camera_image.window(mesh_center, side, up))


@dataclass(frozen=True)
class _WindowFit:
    """A photograph with a mask and a mesh, which is fitted in windows of the photograph.

    `options` are arguments of `fit_scene`.
    """

    photograph: NDArray[Any]
    mask: NDArray[Any]
    mesh: Mesh
    size: int
    options: dict[str, Any]

    def fit(self, window: Window, start: Camera | None) -> FittedScene:
        """Fit camera and light in one window, from a camera nearby if one is given."""
        linear = window.cut(self.photograph, self.size, self.options["encoding"])
        share = window.cut(self.mask[..., None], self.size, beyond=0)[0]
        return fit_scene(linear, share, self.mesh, start=start, **self.options)


def _up_direction(camera: Camera, window: Window) -> NDArray[Any]:
    """Return the world's z axis in the axes of the photograph's camera.

    `camera` is the camera that shows the window.
    """
    return window.axes.T @ camera.axes()[:, 2]


def _turned_to_mesh(camera: Camera) -> Camera:
    """Return a camera at the same place that looks at the center of the mesh.

    If the mesh is not in the center of the image, a camera with perspective sees
    it from another angle than that of the optical axis.
    """
    if not isinstance(camera, PerspectiveCamera):
        return replace(camera, right=0.0, up=0.0)
    x, y, z = camera.eye()[:3].tolist()
    distance = math.hypot(x, y, z)
    return replace(
        camera,
        polar=math.degrees(math.acos(z / distance)),
        azimuth=math.degrees(math.atan2(y, x)),
        width=camera.width * distance / camera.distance,
        right=0.0,
        up=0.0,
        distance=distance,
    )


@dataclass(frozen=True)
class _RenderOptions:
    """Arguments of `render` and of `precompute_transfer`, as `fit_scene` has them."""

    albedo_scale: float
    encoding: str
    normals: str
    rasterizer: str
    samples: int = SAMPLES
    bounces: int = 0


def fit_scene(
    photograph: Float[Tensor, "3 size size"],
    mask: Float[Tensor, "size size"],
    mesh: Mesh,
    *,
    fov: float | None = None,
    albedo_scale: float = 1.0,
    encoding: str = "linear",
    normals: str = "smooth",
    bounces: int = 0,
    rasterizer: str = "auto",
    start: Camera | None = None,
) -> FittedScene:
    """Find the camera and the light whose render of a mesh resembles a photograph most.

    The light is environment light. The camera is upright, and its optical axis may
    lie outside of the center of the image (`Camera.right`, `Camera.up`).

    Args:
        photograph: Linear values in [0, 1], shape (3, size, size). Values of 1
            count as clipped.
        mask: The object's share of each pixel in [0, 1], shape (size, size).
        mesh: The mesh, normalized and upright.
        fov: Angle between the sides of the image in degrees. None for a camera
            without perspective.
        albedo_scale: Factor of the mesh's albedo.
        encoding: Encoding of the images that are to be rendered with the result,
            "linear" or "srgb". With "srgb", the colors of the mesh are decoded, as
            in `render`. The photograph is linear in either case.
        normals: "flat" or "smooth".
        bounces: Bounces of the returned light, with shadows. Without them, the
            light of a concave mesh is too bright or too dim. The search for the
            camera ignores shadows.
        rasterizer: "auto", "opengl", "numba" or "numpy".
        start: A camera near the one that is sought. None to search for one.

    Returns:
        The camera, the light, and how well they fit.

    Raises:
        InputError: If the mask holds no object, or if shapes do not fit.

    Example:
        >>> import norm_balls as nb
        >>> mesh = nb.solid("cup")
        >>> camera = nb.OrthographicCamera(polar=60.0, azimuth=0.0, width=2.4)
        >>> light = 0.3 * nb.load_light("grace")
        >>> photograph = nb.render(mesh, camera, light, size=32).clamp(0, 1)
        >>> mask = 1 - nb.render(mesh, camera, 0 * light, size=32, background=1.0)[0]
        >>> found = nb.fit_scene(photograph, mask, mesh)  # doctest: +SKIP
    """
    size = photograph.shape[-1]
    if photograph.shape != (COLORS, size, size) or mask.shape != (size, size):
        given = f"{tuple(photograph.shape)} and {tuple(mask.shape)}"
        raise InputError(
            f"photograph and mask of shapes {given} do not fit: "
            "give (3, size, size) and (size, size)"
        )
    covered = float(mask.sum())
    if covered < MIN_COVERED_PIXELS:
        raise InputError(
            f"the mask covers {covered:.0f} pixels of {size}²: give one that shows the object"
        )
    options = _RenderOptions(albedo_scale, encoding, normals, rasterizer)
    photograph = photograph.double()
    mask = mask.double()
    fine = _Target.of(photograph, mask, mesh, size, options)
    if start is None:
        coarse = _Target.of(photograph, mask, mesh, min(COARSE, size), options)
        starts = _plausible_cameras(coarse, mask, fov)
    else:
        starts = [start]
    _, camera = fine.ranked(fine.descended(camera) for camera in starts)[0]
    with_bounces = replace(options, bounces=bounces)
    return fine._replace(options=with_bounces).scene(camera)


def _plausible_cameras(coarse: _Target, mask: Tensor, fov: float | None) -> list[Camera]:
    """Return a few cameras, one of which should be near the best one.

    They are sought in small images.
    """
    mesh = coarse.mesh
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    cameras = []
    for polar in POLAR:
        for camera in orbit_cameras(AZIMUTHS, FIRST_WIDTH, polar, fov=fov):
            cameras.append(_framed(camera.with_clip_range(radius), mesh, mask))
    framed = [camera for _, camera in coarse.ranked(cameras)]
    # All azimuths fit a round object equally well. The best camera of each polar
    # angle is therefore a start, too.
    best_of_polar = {camera.polar: camera for camera in reversed(framed)}
    starts = dict.fromkeys([*framed[:KEPT], *best_of_polar.values()])
    descended = coarse.ranked(coarse.descended(camera) for camera in starts)
    smallest_error, _ = descended[0]
    plausible = [camera for error, camera in descended if error <= PLAUSIBLE * smallest_error]
    return _distinct(plausible)[:KEPT]


def _distinct(cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras, except those whose axes are near the axes of an earlier one."""
    kept: list[Camera] = []
    for camera in cameras:
        cosines = [float((camera.axes() * other.axes()).sum(1).min()) for other in kept]
        if max(cosines, default=-1.0) < math.cos(math.radians(DISTINCT)):
            kept.append(camera)
    return kept


class _LightFit(NamedTuple):
    """The best light for a camera.

    Attributes:
        residuals: Differences of the pixels and square roots of the penalties,
            whose squares sum to the error, shape (N,).
        light: SH coefficients, shape (49, 3).
        coverage: Rendered coverage of each pixel, shape (size²,).
    """

    residuals: Tensor
    light: Tensor
    coverage: Tensor


class _Target(NamedTuple):
    """The image that renders should resemble.

    Attributes:
        image: Linear values, shape (3, size²), gray where the mask is 0.
        mask: The object's share of each pixel, shape (size²,).
        gray: Linear value outside of the object, 0 or 1.
        mesh: The mesh.
        size: Pixels per side.
        options: How the mesh is rendered.
    """

    image: Tensor
    mask: Tensor
    gray: float
    mesh: Mesh
    size: int
    options: _RenderOptions

    @staticmethod
    def of(
        photograph: Tensor, mask: Tensor, mesh: Mesh, size: int, options: _RenderOptions
    ) -> _Target:
        """Resample a photograph (3, H, H) and a mask (H, H), and remove the background.

        Pixels on the border of the object show a mixture of object and background.
        They get the mean color of the object's pixels around them.
        """
        is_inside = (mask > WHOLE).double()[None]
        window = 2 * BORDER + 1
        near = F.avg_pool2d(photograph * is_inside, window, 1, BORDER)
        weight = F.avg_pool2d(is_inside, window, 1, BORDER)
        color = torch.where(is_inside > 0, photograph, near / weight.clamp(min=1e-9))
        object_image = F.interpolate((color * mask)[None], (size, size), mode="area")[0]
        mask = F.interpolate(mask[None][None], (size, size), mode="area")[0]
        # The gray value is far from the object's own brightness.
        is_bright = float(object_image.sum()) > 0.5 * COLORS * float(mask.sum())
        gray = 0.0 if is_bright else 1.0
        image = object_image + gray * (1 - mask)
        return _Target(image.flatten(1), mask.flatten(), gray, mesh, size, options)

    def fitted(self, camera: Camera, least: float = 0.0, grid: int = SEARCH_GRID) -> _LightFit:
        """Fit the light for a camera.

        Args:
            camera: The camera.
            least: Share of a pixel that both mesh and mask must cover, so that the
                pixel counts.
            grid: Subdivisions of the grid of directions in which the light is at
                least `LEAST_RADIANCE`.
        """
        operator = precompute_transfer(self.mesh, camera, self.size, **asdict(self.options))
        units = torch.eye(COEFFICIENTS, dtype=torch.float64)[..., None].expand(-1, -1, COLORS)
        # Radiance of the P covered pixels per unit of each coefficient, (3, 49, P).
        shown = operator.radiance(units).permute(1, 0, 2)
        pixels = operator.pixels
        no_coverage = self.mask.new_zeros(self.size**2)
        coverage = no_coverage.index_copy(0, pixels, operator.coverage.double())
        background = self.gray * (1 - coverage)
        image = self.image[:, pixels]
        is_seen = torch.minimum(coverage, self.mask)[pixels] >= least
        is_seen = is_seen.expand(COLORS, -1)
        is_clipped = image >= CLIPPED
        is_used = is_seen
        for _ in range(CLIPPING_ROUNDS):
            used = shown * is_used[:, None]
            squares = used @ shown.mT
            penalty = self.penalty(squares)
            wanted = (used @ (image - background[pixels])[..., None])[..., 0]
            light, expected = _light_of_channels(squares, wanted, penalty, grid)
            predicted = (light.T[:, None] @ shown)[:, 0] + background[pixels]
            # A clipped pixel may be brighter than the photograph shows.
            is_explained = is_seen & ~(is_clipped & (predicted > 1))
            if torch.equal(is_explained, is_used):
                break
            is_used = is_explained
        rendered = background.repeat(COLORS, 1).index_copy(1, pixels, predicted)
        differences = rendered.clamp(max=1) - self.image
        penalties = penalty.sqrt() * (light - expected).T
        residuals = torch.cat([differences.flatten(), penalties.flatten()])
        return _LightFit(residuals, light, coverage)

    def ranked(self, cameras: Iterable[Camera]) -> list[tuple[float, Camera]]:
        """Return the squared error of each camera with its best light, smallest first."""
        errors = [
            (float(self.fitted(camera).residuals.square().sum()), camera) for camera in cameras
        ]
        return sorted(errors, key=lambda pair: pair[0])

    def penalty(self, squares: Tensor) -> Tensor:
        """Return the weights (49,) of the squared coefficients of a light in the error.

        They are in proportion to the squares (3, 49, 49) of what the coefficients
        show, so the result does not depend on the scale of the albedo.
        """
        brightest = squares[:, 0, 0].max() + 1e-12 * self.mask.sum()
        band = bands(DEGREE).double()
        return SMOOTH * brightest * (1 + (band * (band + 1)).square())

    def descended(self, camera: Camera) -> Camera:
        """Return the camera after descent from a camera."""
        return _Descent(self, camera).run()

    def rendered(self, camera: Camera, light: Tensor) -> Tensor:
        """Render the mesh in linear light, shape (3, size²)."""
        options = asdict(self.options)
        image = render(self.mesh, camera, light, self.size, self.gray, **options)
        return decode(image, self.options.encoding).flatten(1)

    def scene(self, camera: Camera) -> FittedScene:
        """Fit the light for a camera, and compare the render with the target."""
        fit = self.fitted(camera, WHOLE, FINAL_GRID)
        image = self.rendered(camera, fit.light)
        is_inside = self.mask > WHOLE
        target = self.image[:, is_inside]
        error = (image - self.image)[:, is_inside].norm() / target.norm()
        intersection = torch.minimum(fit.coverage, self.mask).sum()
        overlap = intersection / torch.maximum(fit.coverage, self.mask).sum()
        return FittedScene(camera, fit.light, float(error), float(overlap))


class _Descent:
    """The Gauss-Newton method in a trust region, over five values of a camera.

    The values are polar angle and azimuth in radians, the width relative to the first camera's,
    and the shifts right and up in units of the first camera's width. The light is
    fitted anew for each camera (variable projection). Central differences over
    half a pixel smooth the steps that the error makes at single samples.
    """

    def __init__(self, target: _Target, camera: Camera):
        self._target = target
        self._camera = camera

    def run(self) -> Camera:
        """Return the camera with the smallest error that is found."""
        camera = self._camera
        right = camera.right / camera.width
        up = camera.up / camera.width
        lowest = [POLE_DISTANCE, -np.inf, 0.5, -1.0, -1.0]
        highest = [math.pi - POLE_DISTANCE, np.inf, 2.0, 1.0, 1.0]
        polar = math.radians(camera.polar)
        azimuth = math.radians(camera.azimuth)
        start = np.array([polar, azimuth, 1.0, right, up]).clip(lowest, highest)
        found = least_squares(
            self._residuals,
            start,
            self._jacobian,
            bounds=(lowest, highest),
            x_scale="jac",
            ftol=LEAST_GAIN,
            xtol=LEAST_GAIN,
            max_nfev=STEPS,
        )
        return self._camera_of(found.x)

    def _camera_of(self, values: np.ndarray) -> Camera:
        """Return the camera of the five values."""
        polar, azimuth, relative_width, right, up = values.tolist()
        width = self._camera.width
        moved = replace(
            self._camera,
            polar=math.degrees(polar),
            azimuth=math.degrees(azimuth),
            width=width * relative_width,
            right=width * right,
            up=width * up,
        )
        # The distance changes with the width, so that the angle of view stays.
        if isinstance(moved, PerspectiveCamera):
            moved = replace(moved, distance=moved.distance * relative_width)
        return moved

    def _residuals(self, values: np.ndarray) -> np.ndarray:
        """Return the residuals (N,) of the target, for the camera of the five values."""
        return self._target.fitted(self._camera_of(values)).residuals.numpy()

    def _jacobian(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives (N, 5) of the residuals, by central differences."""
        columns = []
        for step in np.diag(np.array(DIFFERENCES) / self._target.size):
            difference = self._residuals(values + step) - self._residuals(values - step)
            columns.append(difference / (2 * step.sum()))
        return np.stack(columns, axis=1)


def _light_of_channels(
    squares: Tensor, wanted: Tensor, penalty: Tensor, grid: int
) -> tuple[Tensor, Tensor]:
    """Fit the light of the channel that the object shows best, and then of the other channels.

    The other channels are expected to resemble the first one, because the object
    may show little of them. For example, a yellow object hardly shows from where
    blue light comes.

    Args:
        squares: Products of what the coefficients of the light show, shape
            (3, 49, 49).
        wanted: Products of what the coefficients show with what is to be shown,
            shape (3, 49).
        penalty: Weights of the squared differences from the expected light, shape
            (49,).
        grid: Subdivisions of the grid of directions.

    Returns:
        The light and the expected light, shape (49, 3) each. The expected light of
        the first channel is zero.
    """
    regularized = squares + torch.diag(penalty)
    best = int(squares[:, 0, 0].argmax())
    best_light = _nonnegative_light(regularized[best, None], wanted[best, None], grid)[:, 0]
    shown_squared = (squares @ best_light) @ best_light
    tiny = torch.finfo(torch.float64).tiny
    brightness = (wanted @ best_light) / shown_squared.clamp(min=tiny)
    expected = best_light[:, None] * brightness.clamp(min=0)
    expected[:, best] = 0
    wanted_and_expected = wanted + (penalty[:, None] * expected).T
    return _nonnegative_light(regularized, wanted_and_expected, grid), expected


def _nonnegative_light(squares: Tensor, wanted: Tensor, grid: int) -> Tensor:
    """Minimize xᵀ S x / 2 − wᵀ x for each channel, over lights x of non-negative radiance.

    With S = L Lᵀ and y = Lᵀ x, this is the projection of L⁻¹ w onto the cone
    {y: G y ≥ 0}. Here G = R L⁻ᵀ, and the rows of R are the harmonics in the
    directions of a grid. By Moreau's decomposition, the projection is L⁻¹ w + Gᵀ μ
    with the non-negative μ that minimizes |L⁻¹ w + Gᵀ μ|.

    Args:
        squares: The positive definite matrices S, shape (C, 49, 49).
        wanted: The vectors w, shape (C, 49).
        grid: Subdivisions of the grid of directions.

    Returns:
        The lights, shape (49, C).
    """
    rows = _radiance_above_least(grid)
    lights = []
    for square, vector in zip(squares.numpy(), wanted.numpy(), strict=True):
        lower = np.linalg.cholesky(square)
        unconstrained = solve_triangular(lower, vector, lower=True)
        sides = solve_triangular(lower, rows.T, lower=True)
        nearest = unconstrained
        # Few directions matter. The first solution has some of them, and others
        # join if radiance is negative there. The result is that of all directions.
        is_constrained = np.arange(len(rows)) % FIRST_DIRECTIONS == 0
        is_negative = unconstrained @ sides < 0
        while is_negative.any():
            iterations = MAX_EXCHANGES * len(is_constrained)
            multipliers, _ = nnls(sides[:, is_constrained], -unconstrained, maxiter=iterations)
            nearest = unconstrained + sides[:, is_constrained] @ multipliers
            is_negative = (nearest @ sides < 0) & ~is_constrained
            is_constrained |= is_negative
        lights.append(solve_triangular(lower, nearest, lower=True, trans="T"))
    return torch.from_numpy(np.stack(lights, axis=1))


@cache
def _radiance_above_least(grid: int) -> NDArray[Any]:
    """Return the matrix (N, 49) from the coefficients of a light to its radiance in N directions.

    `LEAST_RADIANCE` times the mean radiance of the light is subtracted. The
    directions are the vertices of an icosphere with `grid` subdivisions.
    """
    directions, _ = sphere(grid)
    rows = basis(torch.from_numpy(directions), DEGREE).numpy()
    # Coefficient 0 alone determines the mean radiance.
    rows[:, 0] *= 1 - LEAST_RADIANCE
    return rows


def _framed(camera: Camera, mesh: Mesh, mask: Tensor) -> Camera:
    """Return a camera whose image of the mesh has the bounding box of the mask.

    Width and shift of the camera change. The area of the box is matched, and not
    its width and height separately. Boxes are in coordinates from -1 to 1, with x
    to the right and y up.
    """
    points = camera.project(mesh.vertices[np.unique(mesh.faces)])[:, :2]
    low = points.min(0)
    high = points.max(0)
    size = len(mask)
    rows = np.flatnonzero((mask > 0.5).any(1).numpy())
    columns = np.flatnonzero((mask > 0.5).any(0).numpy())
    left = 2 * columns[0] / size - 1
    right = 2 * (columns[-1] + 1) / size - 1
    bottom = 1 - 2 * (rows[-1] + 1) / size
    top = 1 - 2 * rows[0] / size
    # The factor of the camera's width.
    factor = math.sqrt(float(np.prod(high - low)) / ((right - left) * (top - bottom)))
    width = camera.width * factor
    mask_center = np.array([left + right, bottom + top]) / 2
    shift = mask_center - (low + high) / 2 / factor
    framed = replace(camera, width=width, right=shift[0] * width / 2, up=shift[1] * width / 2)
    if isinstance(framed, PerspectiveCamera):
        framed = replace(framed, distance=framed.distance * factor)
    return framed
