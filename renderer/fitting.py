"""Estimate the camera and the light of a photograph of an object whose mesh is known.

All pixels outside of the object are set to one gray value in the photograph and
in the render, so that the images show the silhouette and the shading at once. An
image is linear in the light, and the radiance of the light must not be negative.
The best light for a given camera is therefore the solution of a convex quadratic
program. The differences of the pixels are then a function of the camera alone
(variable projection, Golub and Pereyra 1973). The Gauss-Newton method minimizes
the sum of the squared differences.

Only the product of light and albedo can be seen: with twice the albedo, half the
light is found.

A light has K = 49 SH coefficients per color channel (degree 6).
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
from renderer.validation import as_tensor

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

# The search for a camera starts from cameras at these angles from +z in degrees,
# with AZIMUTHS equally spaced azimuths for each angle.
POLAR = (20, 40, 60, 80, 100)
AZIMUTHS = 16
# Width in world units that all these first cameras show. `_framed` changes the width
# so that the mesh is as large as the object in the photograph.
FIRST_WIDTH = 2.0
# `fit_scene` searches for cameras in images with this many pixels per side, before
# it refines the cameras in images of the full size.
COARSE = 32
# Number of cameras that the search keeps: the best first cameras from which a descent
# starts, and the best cameras that are refined at the full size.
KEPT = 3
# Largest number of Gauss-Newton steps in a descent from one camera.
STEPS = 20
# A descent ends if a step changes the squared error, or the camera, by a smaller
# fraction.
LEAST_GAIN = 1e-3
# Step sizes of the numerical derivatives of a descent, times the image size in
# pixels. They belong to the polar angle and the azimuth in radians, the relative
# width, and the shifts right and up in units of the width. A shift by 0.5 / size is
# half a pixel.
DIFFERENCES = (1.0, 1.0, 1.0, 0.5, 0.5)
# In a descent, the camera stays at least at this angle in radians from +z and from
# -z, because the azimuth has no effect there.
POLE_DISTANCE = 0.02
# Number of samples along one side of a pixel in renders.
SAMPLES = 8
# `_distinct` treats two cameras as the same one if all their axes differ by less
# than this angle in degrees.
DISTINCT = 2.0
# A camera of the search is refined at the full size if its squared error is at most
# this multiple of the smallest squared error.
PLAUSIBLE = 3
# Weight of the smoothness penalty of the light, relative to the squared brightness
# of the object under uniform light (see `_Target.penalty`). Without a penalty, light
# from directions that the object hardly reflects could become arbitrarily bright.
SMOOTH = 1e-6
# A pixel of the photograph with this linear value or more counts as clipped: the
# scene may have been brighter than the photograph shows.
CLIPPED = 0.995
# The light is solved for up to this many times. Each time, the clipped pixels that
# the last solution made brighter than 1 are left out.
CLIPPING_ROUNDS = 3
# The radiance of the light must be at least this fraction of its mean in all
# directions of a grid. The margin keeps the radiance positive between the
# directions.
LEAST_RADIANCE = 0.01
# Largest number of iterations of SciPy's `nnls` per direction. Three are usual.
MAX_EXCHANGES = 100
# The first solution for a light is constrained in every FIRST_DIRECTIONS-th direction
# of the grid. Directions with negative radiance are added afterwards.
FIRST_DIRECTIONS = 16
# Number of subdivisions of the icosphere whose vertices are the grid of directions:
# SEARCH_GRID while a camera is sought, and FINAL_GRID for the returned light.
SEARCH_GRID = 2
FINAL_GRID = 5
# A pixel counts as completely covered by the object if the object's share of the
# pixel is larger than this. With a limit of 0.99, the other hundredth of a pixel could
# be brighter than the object, such as a white background beside the blue channel of a
# banana.
WHOLE = 0.999
# Pixels on the border of the object get the mean color of the completely covered
# pixels that are at most this many pixels away in each direction.
BORDER = 2
# Side of the square window that is cut around an object, as a multiple of the longer
# side of the object's bounding box.
MARGIN = 1.6
# A pixel of an 8-bit mask belongs to the object if its value is larger than this.
OPAQUE = 127
# First guess of the angle between +z and the direction to the camera, in degrees.
USUAL_POLAR = 60.0
# `fit_photograph` cuts a window again if a component of the window's axes changes by
# more than this.
TILTED = 1e-3
# Smallest number of pixels that the object must cover.
MIN_COVERED_PIXELS = 16
# Number of color channels.
COLORS = 3


class FittedPhotograph(NamedTuple):
    """Camera, light and window that `fit_photograph` found.

    Attributes:
        scene: Camera and light. The camera looks at the center of the mesh.
        window: Part of the photograph that the camera shows.
    """

    scene: FittedScene
    window: Window


class FittedScene(NamedTuple):
    """Camera and light of a photograph.

    Attributes:
        camera: Camera from which the mesh looks most like the photograph.
        light: SH coefficients of environment light without negative radiance,
            shape (49, 3).
        error: Root mean square difference between the linear values of the
            render and of the photograph, over the pixels of the object, divided
            by the root mean square of the photograph.
        overlap: Intersection over union of the silhouettes in the render and in
            the mask.
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

    The function cuts a square window around the object out of the photograph.
    The window shows what a camera would see that is turned toward the object
    (see `renderer.photograph`), and it is fitted with `fit_scene`. The upward
    direction in the window depends on the height of the camera, which is only
    known after the fit. If the first window was tilted, a second window is cut
    and fitted.

    Args:
        photograph: Photograph with 8 bits per channel, shape (H, W, 3) for H
            rows and W columns. The camera of the photograph is upright, and its
            optical axis passes through the center of the photograph.
        mask: Mask with 8 bits, white where the object is, shape (H, W).
        mesh: Mesh of the object, normalized and upright.
        size: Number of pixels per side of the images that are compared.
        fov: Field of view of the window in degrees. The window is `MARGIN` times
            as wide as the object. None for a camera without perspective.
        encoding: Encoding of the photograph and of the images that will be
            rendered with the result, "linear" or "srgb".
        **options: Other arguments of `fit_scene`.

    Returns:
        Camera and light, and the window of the photograph that the camera shows.

    Raises:
        InputError: If no pixel of the mask is white.
    """
    is_object = mask > OPAQUE
    rows = np.flatnonzero(is_object.any(axis=1))
    columns = np.flatnonzero(is_object.any(axis=0))
    if not len(rows):
        raise InputError(
            "the mask has no white pixels: give a mask that is white where the object is, "
            "or a box around the object"
        )
    # Center of the bounding box in pixels, and side of the window in pixels.
    center = np.array([columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1]) / 2
    side = MARGIN * max(int(np.ptp(rows)), int(np.ptp(columns)), 1)
    focal_length = None if fov is None else side / 2 / math.tan(math.radians(fov) / 2)
    camera_image = Photograph(photograph, focal_length)
    fit = _WindowFit(photograph, mask, mesh, size, {**options, "fov": fov, "encoding": encoding})

    # First fit: the world's z-axis, in the axes of the photograph's camera, is guessed.
    usual_polar = math.radians(USUAL_POLAR)
    guessed_up = np.array([0.0, math.sin(usual_polar), math.cos(usual_polar)])
    window = camera_image.window(center, side, guessed_up)
    scene = fit.fit(window, None)
    # Second fit: the z-axis is known from the first fit. It has no component to the
    # right, because the camera of the photograph is upright.
    up = _up_direction(scene.camera, window)
    up[0] = 0
    upright_window = camera_image.window(center, side, up)
    if np.abs(upright_window.axes - window.axes).max() > TILTED:
        window = upright_window
        scene = fit.fit(window, scene.camera)
    # The returned camera and window are centered on the mesh instead of the mask.
    camera = scene.camera
    up = _up_direction(camera, window)
    # Position of the mesh center in the window, in pixels from the window's center.
    shift = np.array([camera.right, camera.up]) * side / camera.width
    mesh_center = np.array(window.pixels(*shift))
    centered_scene = scene._replace(camera=_turned_to_mesh(camera))
    return FittedPhotograph(centered_scene, camera_image.window(mesh_center, side, up))


@dataclass(frozen=True)
class _WindowFit:
    """Fits of the camera and the light in windows of one photograph.

    Attributes:
        photograph: Photograph with 8 bits per channel, shape (H, W, 3).
        mask: Mask with 8 bits, white where the object is, shape (H, W).
        mesh: Mesh of the object.
        size: Number of pixels per side of the images that are compared.
        options: Keyword arguments of `fit_scene`.
    """

    photograph: NDArray[Any]
    mask: NDArray[Any]
    mesh: Mesh
    size: int
    options: dict[str, Any]

    def fit(self, window: Window, start: Camera | None) -> FittedScene:
        """Fit the camera and the light in one window.

        Args:
            window: Window of the photograph.
            start: Camera near the one that is sought. None searches for a
                camera.

        Returns:
            Camera and light.
        """
        linear_image = window.cut(self.photograph, self.size, self.options["encoding"])
        # The object's share of each pixel, shape (size, size).
        coverage = window.cut(self.mask[..., None], self.size, beyond=0)[0]
        return fit_scene(linear_image, coverage, self.mesh, start=start, **self.options)


def _up_direction(camera: Camera, window: Window) -> NDArray[Any]:
    """Convert the world's z-axis to the axes of the camera that took the photograph.

    Args:
        camera: Fitted camera, which shows the window.
        window: Window of the photograph.

    Returns:
        Unit vector (right, up, back), shape (3,).
    """
    z_axis_in_window = camera.axes()[:, 2]
    return window.axes.T @ z_axis_in_window


def _turned_to_mesh(camera: Camera) -> Camera:
    """Return a copy of a camera at the same place that looks at the center of the mesh.

    The center of the mesh is the origin. If the camera has perspective and does
    not show the origin in the image center, its viewing direction changes.

    Args:
        camera: Camera whose image center may be shifted from the origin by
            `camera.right` and `camera.up`.

    Returns:
        Camera without a shift.
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
    """Settings that are passed on to `render` and `precompute_transfer`.

    The attributes are arguments of `fit_scene`, except for `samples`, the number
    of samples along one side of a pixel.
    """

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
    """Find the camera and the light with which a render of a mesh resembles a photograph most.

    The light is environment light. The camera is upright. The mesh may be shifted
    from the center of the image (`Camera.right`, `Camera.up`).

    Args:
        photograph: Linear values in [0, 1], shape (3, size, size). Values of
            `CLIPPED` or more count as clipped.
        mask: The object's share of each pixel in [0, 1], shape (size, size).
        mesh: Mesh of the object, normalized and upright.
        fov: Angle between opposite sides of the image in degrees. None for a
            camera without perspective.
        albedo_scale: Factor for the albedo of the mesh.
        encoding: Encoding of the images that will be rendered with the result,
            "linear" or "srgb". With "srgb", the colors of the mesh are decoded,
            as in `render`. The photograph is linear in both cases.
        normals: "flat" or "smooth".
        bounces: Number of light bounces, with shadows, with which the returned
            light is fitted. With 0, the light for a concave mesh is too bright
            or too dim. The search for the camera ignores shadows and bounces.
        rasterizer: "auto", "opengl", "numba" or "numpy".
        start: Camera near the one that is sought. None searches for a camera.

    Returns:
        Camera and light, the error of the pixels, and the overlap of the
        silhouettes.

    Raises:
        InputError: If the photograph or the mask has a wrong shape, or if the
            mask covers fewer than `MIN_COVERED_PIXELS` pixels.

    Example:
        >>> import norm_balls as nb
        >>> mesh = nb.solid("cup")
        >>> camera = nb.OrthographicCamera(polar=60.0, azimuth=0.0, width=2.4)
        >>> light = 0.3 * nb.load_light("grace")
        >>> photograph = nb.render(mesh, camera, light, size=32).clamp(0, 1)
        >>> mask = 1 - nb.render(mesh, camera, 0 * light, size=32, background=1.0)[0]
        >>> found = nb.fit_scene(photograph, mask, mesh)  # doctest: +SKIP
    """
    photograph = as_tensor("photograph", photograph)
    mask = as_tensor("mask", mask)
    for name, values in (("photograph", photograph), ("mask", mask)):
        if not (values.min() >= 0 and values.max() <= 1):
            raise InputError(f"{name} has values outside [0, 1]: divide bytes by 255")
    size = photograph.shape[-1]
    if photograph.shape != (COLORS, size, size) or mask.shape != (size, size):
        given = f"{tuple(photograph.shape)} and {tuple(mask.shape)}"
        raise InputError(
            f"photograph and mask have the shapes {given}: "
            "give a photograph (3, size, size) and a mask (size, size)"
        )
    covered_pixels = float(mask.sum())
    if covered_pixels < MIN_COVERED_PIXELS:
        raise InputError(
            f"the mask covers {covered_pixels:.0f} pixels of {size} × {size}, but at least "
            f"{MIN_COVERED_PIXELS} are needed: give a mask that shows the object"
        )
    options = _RenderOptions(albedo_scale, encoding, normals, rasterizer)
    photograph = photograph.double()
    mask = mask.double()
    # The search for first cameras uses a small copy of the photograph. The best of these
    # cameras are refined with the photograph in its full size.
    fine_target = _Target.from_photograph(photograph, mask, mesh, size, options)
    if start is None:
        coarse_size = min(COARSE, size)
        coarse_target = _Target.from_photograph(photograph, mask, mesh, coarse_size, options)
        starts = _plausible_cameras(coarse_target, mask, fov)
    else:
        starts = [start]
    refined_cameras = [fine_target.refine_camera(camera) for camera in starts]
    _, best_camera = fine_target.rank_cameras(refined_cameras)[0]
    # Bounces are slow to compute, so only the final light is fitted with bounces.
    target_with_bounces = fine_target._replace(options=replace(options, bounces=bounces))
    return target_with_bounces.fit_final_light(best_camera)


def _plausible_cameras(target: _Target, mask: Tensor, fov: float | None) -> list[Camera]:
    """Search all directions for a few cameras, one of which should be near the best camera.

    Args:
        target: Small image to which renders are compared.
        mask: The object's share of each pixel in the full image,
            shape (size, size).
        fov: Field of view in degrees. None for cameras without perspective.

    Returns:
        At most `KEPT` different cameras, the best one first.
    """
    mesh = target.mesh
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    first_cameras = []
    for polar in POLAR:
        for camera in orbit_cameras(AZIMUTHS, FIRST_WIDTH, polar, fov=fov):
            first_cameras.append(_framed(camera.with_clip_range(radius), mesh, mask))
    # From the best camera to the worst.
    ranked_cameras = [camera for _, camera in target.rank_cameras(first_cameras)]
    # All azimuths fit a round object equally well, so the best cameras may all have
    # the same polar angle. A descent therefore also starts from the best camera of
    # each polar angle. In reversed order, the best camera is written last.
    best_of_polar = {camera.polar: camera for camera in reversed(ranked_cameras)}
    # dict.fromkeys removes duplicates and keeps the order.
    starts = dict.fromkeys([*ranked_cameras[:KEPT], *best_of_polar.values()])
    refined = target.rank_cameras(target.refine_camera(camera) for camera in starts)
    smallest_error, _ = refined[0]
    plausible = [camera for error, camera in refined if error <= PLAUSIBLE * smallest_error]
    return _distinct(plausible)[:KEPT]


def _distinct(cameras: Sequence[Camera]) -> list[Camera]:
    """Remove cameras that look in nearly the same direction as an earlier camera.

    Args:
        cameras: Cameras in order of preference.

    Returns:
        The cameras whose axes differ from those of each earlier camera by at
        least `DISTINCT` degrees.
    """
    kept: list[Camera] = []
    for camera in cameras:
        # Cosine of the largest angle between the axes of two cameras.
        cosines = [float((camera.axes() * other.axes()).sum(1).min()) for other in kept]
        if max(cosines, default=-1.0) < math.cos(math.radians(DISTINCT)):
            kept.append(camera)
    return kept


class _LightFit(NamedTuple):
    """Best light for a given camera.

    Attributes:
        residuals: Differences between the render and the target for all pixels
            and channels, followed by the weighted differences of the light's
            coefficients from the expected light, shape (N,). The sum of their
            squares is the error.
        light: SH coefficients, shape (49, 3).
        coverage: Fraction of each pixel that the mesh covers in the render,
            shape (size²,).
    """

    residuals: Tensor
    light: Tensor
    coverage: Tensor


class _Target(NamedTuple):
    """Image of an object that renders of a mesh should resemble.

    Attributes:
        image: Linear values of the photograph, shape (3, size²). Pixels outside
            of the object have the value `gray`.
        mask: The object's share of each pixel, shape (size²,).
        gray: Linear value outside of the object, 0 or 1.
        mesh: Mesh of the object.
        size: Number of pixels per side.
        options: Settings with which the mesh is rendered.
    """

    image: Tensor
    mask: Tensor
    gray: float
    mesh: Mesh
    size: int
    options: _RenderOptions

    @staticmethod
    def from_photograph(
        photograph: Tensor, mask: Tensor, mesh: Mesh, size: int, options: _RenderOptions
    ) -> _Target:
        """Resample a photograph and its mask, and replace the background by a gray value.

        Pixels on the border of the object show a mixture of object and
        background. They get the mean color of the object's pixels around them.

        Args:
            photograph: Linear values, shape (3, H, H).
            mask: The object's share of each pixel, shape (H, H).
            mesh: Mesh of the object.
            size: Number of pixels per side of the target.
            options: Settings with which the mesh is rendered.

        Returns:
            Target with `size` pixels per side.
        """
        # 1 in pixels that the object covers completely, shape (1, H, H).
        is_inside = (mask > WHOLE).double()[None]
        # Mean color of the inside pixels around each pixel: sum over their count.
        window = 2 * BORDER + 1
        mean_inside_color = F.avg_pool2d(photograph * is_inside, window, 1, BORDER)
        inside_fraction = F.avg_pool2d(is_inside, window, 1, BORDER)
        border_color = mean_inside_color / inside_fraction.clamp(min=1e-9)
        color = torch.where(is_inside > 0, photograph, border_color)
        object_image = F.interpolate((color * mask)[None], (size, size), mode="area")[0]
        mask = F.interpolate(mask[None][None], (size, size), mode="area")[0]
        # Black behind a bright object, and white behind a dark object, so that the
        # silhouette stands out.
        is_bright = float(object_image.sum()) > 0.5 * COLORS * float(mask.sum())
        gray = 0.0 if is_bright else 1.0
        image = object_image + gray * (1 - mask)
        return _Target(image.flatten(1), mask.flatten(), gray, mesh, size, options)

    def fit_light(
        self, camera: Camera, min_coverage: float = 0.0, grid: int = SEARCH_GRID
    ) -> _LightFit:
        """Find the light under which a render from a camera resembles the target most.

        Args:
            camera: Camera from which the mesh is rendered.
            min_coverage: Smallest share of a pixel that the mesh and the mask
                must both cover. Other pixels do not count.
            grid: Number of subdivisions of the grid of directions in which the
                radiance of the light is constrained (see `LEAST_RADIANCE`).

        Returns:
            Best light, with its residuals and the rendered coverage.
        """
        operator = precompute_transfer(self.mesh, camera, self.size, **asdict(self.options))
        # 49 lights, each with a single coefficient of 1, shape (49, 49, 3).
        unit_lights = torch.eye(COEFFICIENTS, dtype=torch.float64)
        unit_lights = unit_lights[..., None].expand(-1, -1, COLORS)
        # Radiance of the P covered pixels per unit of each coefficient, (3, 49, P).
        transfer = operator.radiance(unit_lights).permute(1, 0, 2)
        pixels = operator.pixels
        no_coverage = self.mask.new_zeros(self.size**2)
        coverage = no_coverage.index_copy(0, pixels, operator.coverage.double())
        background = self.gray * (1 - coverage)
        image = self.image[:, pixels]
        is_covered = torch.minimum(coverage, self.mask)[pixels] >= min_coverage
        is_covered = is_covered.expand(COLORS, -1)
        is_clipped = image >= CLIPPED
        is_used = is_covered
        for _ in range(CLIPPING_ROUNDS):
            # Normal equations of the least squares over the used pixels: matrix
            # (3, 49, 49) and right side (3, 49).
            used_transfer = transfer * is_used[:, None]
            normal_matrix = used_transfer @ transfer.mT
            # Weights of a smoothness penalty. It keeps coefficients that the pixels do
            # not determine close to `expected_light`.
            penalty = self.penalty(normal_matrix)
            difference = (image - background[pixels])[..., None]
            right_side = (used_transfer @ difference)[..., 0]
            light, expected_light = _fit_channels(normal_matrix, right_side, penalty, grid)
            # Rendered values of the covered pixels, shape (3, P).
            predicted = (light.T[:, None] @ transfer)[:, 0] + background[pixels]
            # A clipped pixel may be brighter than the photograph shows. It is left
            # out if the render is brighter than 1.
            is_explained = is_covered & ~(is_clipped & (predicted > 1))
            if torch.equal(is_explained, is_used):
                break
            is_used = is_explained
        rendered = background.repeat(COLORS, 1).index_copy(1, pixels, predicted)
        differences = rendered.clamp(max=1) - self.image
        penalties = penalty.sqrt() * (light - expected_light).T
        residuals = torch.cat([differences.flatten(), penalties.flatten()])
        return _LightFit(residuals, light, coverage)

    def rank_cameras(self, cameras: Iterable[Camera]) -> list[tuple[float, Camera]]:
        """Sort cameras by the squared error that is left with the best light of each camera.

        Args:
            cameras: Cameras to compare.

        Returns:
            Pairs of the squared error and the camera, the smallest error first.
        """
        errors = [
            (float(self.fit_light(camera).residuals.square().sum()), camera) for camera in cameras
        ]
        return sorted(errors, key=lambda pair: pair[0])

    def penalty(self, normal_matrix: Tensor) -> Tensor:
        """Compute the weights of the squared SH coefficients of a light in the error.

        The weights of band l are proportional to 1 + (l (l + 1))², because
        -l (l + 1) is the eigenvalue of the Laplacian on the sphere. They are also
        proportional to the squared brightness of the object under uniform light,
        so the fit does not depend on the scale of the albedo.

        Args:
            normal_matrix: For each channel, the sums over pixels of products of
                the radiances per unit of two coefficients, shape (3, 49, 49).

        Returns:
            Weight of each coefficient, shape (49,).
        """
        # Coefficient 0 is uniform light. The small addition avoids weights of 0.
        uniform_brightness = normal_matrix[:, 0, 0].max() + 1e-12 * self.mask.sum()
        band = bands(DEGREE).double()
        return SMOOTH * uniform_brightness * (1 + (band * (band + 1)).square())

    def refine_camera(self, camera: Camera) -> Camera:
        """Minimize the error over cameras near a given camera, and return the best camera."""
        return _Descent(self, camera).run()

    def render_linear(self, camera: Camera, light: Tensor) -> Tensor:
        """Render the mesh, and decode the image to linear values.

        Args:
            camera: Camera of the image.
            light: SH coefficients, shape (49, 3).

        Returns:
            Linear values, shape (3, size²).
        """
        options = asdict(self.options)
        image = render(self.mesh, camera, light, self.size, self.gray, **options)
        return decode(image, self.options.encoding).flatten(1)

    def fit_final_light(self, camera: Camera) -> FittedScene:
        """Fit the light for the final camera, and compute how well the render fits.

        Args:
            camera: Camera that was found.

        Returns:
            Camera and light, with the error and the overlap of the silhouettes.
        """
        # Only pixels inside of the object count, and the grid of directions is fine.
        fit = self.fit_light(camera, WHOLE, FINAL_GRID)
        rendered = self.render_linear(camera, fit.light)
        is_inside = self.mask > WHOLE
        inside_image = self.image[:, is_inside]
        error = (rendered - self.image)[:, is_inside].norm() / inside_image.norm()
        intersection = torch.minimum(fit.coverage, self.mask).sum()
        union = torch.maximum(fit.coverage, self.mask).sum()
        overlap = intersection / union
        return FittedScene(camera, fit.light, float(error), float(overlap))


class _Descent:
    """Gauss-Newton method in a trust region that minimizes the error over five camera values.

    The values are the polar angle and the azimuth in radians, the width divided
    by the width of the first camera, and the shifts right and up divided by the
    width of the first camera. The best light is computed for each camera
    (variable projection). The error jumps slightly if a sample changes from one
    face to another. Derivatives are therefore differences over about a pixel.

    Args:
        target: Image that the render should resemble.
        camera: First camera.
    """

    def __init__(self, target: _Target, camera: Camera):
        """Keep the target and the first camera. `run` starts the descent."""
        self._target = target
        self._first_camera = camera

    def run(self) -> Camera:
        """Return the camera with the smallest error that the descent finds."""
        camera = self._first_camera
        right = camera.right / camera.width
        up = camera.up / camera.width
        # Bounds of the five values.
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
        """Convert the five values of the descent, shape (5,), to a camera."""
        polar, azimuth, relative_width, right, up = values.tolist()
        width = self._first_camera.width
        moved = replace(
            self._first_camera,
            polar=math.degrees(polar),
            azimuth=math.degrees(azimuth),
            width=width * relative_width,
            right=width * right,
            up=width * up,
        )
        # The distance changes with the width, so that the field of view stays.
        if isinstance(moved, PerspectiveCamera):
            moved = replace(moved, distance=moved.distance * relative_width)
        return moved

    def _residuals(self, values: np.ndarray) -> np.ndarray:
        """Compute the residuals of the target for a camera with its best light.

        Args:
            values: Five values of the camera, shape (5,).

        Returns:
            Residuals of `_LightFit`, shape (N,).
        """
        return self._target.fit_light(self._camera_of(values)).residuals.numpy()

    def _jacobian(self, values: np.ndarray) -> np.ndarray:
        """Compute the derivatives of the residuals by the five values, by central differences.

        Args:
            values: Five values of the camera, shape (5,).

        Returns:
            Derivatives, shape (N, 5).
        """
        columns = []
        step_sizes = np.array(DIFFERENCES) / self._target.size
        # Each row of the diagonal matrix changes one value.
        for step in np.diag(step_sizes):
            difference = self._residuals(values + step) - self._residuals(values - step)
            columns.append(difference / (2 * step.sum()))
        return np.stack(columns, axis=1)


def _fit_channels(
    normal_matrix: Tensor, right_side: Tensor, penalty: Tensor, grid: int
) -> tuple[Tensor, Tensor]:
    """Solve the normal equations for the light of the brightest channel, then of all channels.

    The object may hardly reflect a color. For example, a yellow object hardly
    shows from where blue light comes. The light of each channel is therefore
    expected to be a multiple of the light of the brightest channel, and
    differences from this expected light are penalized.

    Args:
        normal_matrix: For each channel, the sums over pixels of products of the
            radiances per unit of two coefficients, shape (3, 49, 49).
        right_side: For each channel, the sums over pixels of products of the
            radiance per unit of a coefficient and the radiance of the
            photograph, shape (3, 49).
        penalty: Weights of the squared differences of the coefficients from the
            expected light, shape (49,).
        grid: Number of subdivisions of the grid of directions in which the
            radiance is constrained.

    Returns:
        The light and the expected light, shape (49, 3) each. The expected light
        of the brightest channel is zero.
    """
    regularized = normal_matrix + torch.diag(penalty)
    # Coefficient 0 is uniform light.
    best = int(normal_matrix[:, 0, 0].argmax())
    best_light = _nonnegative_light(regularized[best, None], right_side[best, None], grid)[:, 0]
    # For each channel, the factor for `best_light` with the smallest squared error.
    squared_radiance = (normal_matrix @ best_light) @ best_light
    tiny = torch.finfo(torch.float64).tiny
    factors = (right_side @ best_light) / squared_radiance.clamp(min=tiny)
    expected = best_light[:, None] * factors.clamp(min=0)
    expected[:, best] = 0
    # The penalty pulls each channel toward its expected light.
    penalized_right_side = right_side + (penalty[:, None] * expected).T
    return _nonnegative_light(regularized, penalized_right_side, grid), expected


def _nonnegative_light(matrices: Tensor, right_sides: Tensor, grid: int) -> Tensor:
    """Minimize xᵀ S x / 2 − wᵀ x over lights x without negative radiance, for each channel.

    With S = L Lᵀ and y = Lᵀ x, this is the projection of L⁻¹ w onto the cone
    {y: G y ≥ 0}. Here G = R L⁻ᵀ, and a row of R maps x to its radiance in one
    direction. By Moreau's decomposition, the projection is L⁻¹ w + Gᵀ μ with the
    non-negative μ that minimizes |L⁻¹ w + Gᵀ μ|.

    Args:
        matrices: Positive definite matrix S of each of C channels,
            shape (C, 49, 49).
        right_sides: Vector w of each channel, shape (C, 49).
        grid: Number of subdivisions of the grid of directions.

    Returns:
        Lights x, shape (49, C).
    """
    # Matrix R: a light times a row gives the radiance in one of N directions, shape (N, 49).
    radiance_rows = _radiance_rows(grid)
    lights = []
    for matrix, right_side in zip(matrices.numpy(), right_sides.numpy(), strict=True):
        # Matrix L, vector L⁻¹ w and matrix Gᵀ of the docstring.
        lower = np.linalg.cholesky(matrix)
        unconstrained = solve_triangular(lower, right_side, lower=True)
        constraints = solve_triangular(lower, radiance_rows.T, lower=True)
        nearest = unconstrained
        # Only few directions limit the light. The first solution is constrained in
        # some directions. Directions in which its radiance is negative are added,
        # until there are none. The result is the same as with all directions.
        is_constrained = np.arange(len(radiance_rows)) % FIRST_DIRECTIONS == 0
        is_negative = unconstrained @ constraints < 0
        while is_negative.any():
            iterations = MAX_EXCHANGES * len(is_constrained)
            active_constraints = constraints[:, is_constrained]
            multipliers, _ = nnls(active_constraints, -unconstrained, maxiter=iterations)
            nearest = unconstrained + active_constraints @ multipliers
            is_negative = (nearest @ constraints < 0) & ~is_constrained
            is_constrained |= is_negative
        # x = L⁻ᵀ y.
        lights.append(solve_triangular(lower, nearest, lower=True, trans="T"))
    return torch.from_numpy(np.stack(lights, axis=1))


@cache
def _radiance_rows(grid: int) -> NDArray[Any]:
    """Compute the matrix from SH coefficients to radiance above the smallest allowed radiance.

    The smallest allowed radiance is `LEAST_RADIANCE` times the mean radiance of
    the light.

    Args:
        grid: Number of subdivisions of the icosphere whose N vertices are the
            directions.

    Returns:
        Matrix from 49 coefficients to N directions, shape (N, 49).
    """
    directions, _ = sphere(grid)
    rows = basis(torch.from_numpy(directions), DEGREE).numpy()
    # Coefficient 0 is the mean radiance times a constant, so reducing its column
    # subtracts a fraction of the mean.
    rows[:, 0] *= 1 - LEAST_RADIANCE
    return rows


def _framed(camera: Camera, mesh: Mesh, mask: Tensor) -> Camera:
    """Change the width and the shift of a camera so that the mesh is as large as the mask.

    The bounding box of the mesh in the image gets the center and the area of the
    bounding box of the mask.

    Args:
        camera: Camera whose direction is kept.
        mesh: Mesh of the object.
        mask: The object's share of each pixel, shape (size, size).

    Returns:
        Copy of the camera with another width, shift and, if it has perspective,
        distance.
    """
    # Bounding boxes in image coordinates from -1 to 1, with x to the right and y up.
    points = camera.project(mesh.vertices[np.unique(mesh.faces)])[:, :2]
    mesh_low = points.min(0)
    mesh_high = points.max(0)
    size = len(mask)
    rows = np.flatnonzero((mask > 0.5).any(1).numpy())
    columns = np.flatnonzero((mask > 0.5).any(0).numpy())
    left = 2 * columns[0] / size - 1
    right = 2 * (columns[-1] + 1) / size - 1
    bottom = 1 - 2 * (rows[-1] + 1) / size
    top = 1 - 2 * rows[0] / size
    mesh_area = float(np.prod(mesh_high - mesh_low))
    mask_area = (right - left) * (top - bottom)
    # A camera that is wider by this factor shows the mesh smaller by this factor.
    factor = math.sqrt(mesh_area / mask_area)
    width = camera.width * factor
    mask_center = np.array([left + right, bottom + top]) / 2
    shift = mask_center - (mesh_low + mesh_high) / 2 / factor
    framed = replace(camera, width=width, right=shift[0] * width / 2, up=shift[1] * width / 2)
    if isinstance(framed, PerspectiveCamera):
        framed = replace(framed, distance=framed.distance * factor)
    return framed
