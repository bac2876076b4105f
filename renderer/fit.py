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

A light is environment light with 49 spherical-harmonic (SH) coefficients per
color channel (degree 6).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, nnls
from torch import Tensor

from renderer.camera import Camera, orbit_cameras
from renderer.errors import InputError, as_tensor, require_shape
from renderer.image import decode
from renderer.light.basis import COEFFICIENTS, DEGREE
from renderer.light.harmonics import bands, basis
from renderer.mesh import Mesh
from renderer.rendering import precompute_transfer, render
from renderer.solids import sphere

# Polar angles in degrees of the first cameras of a search.
FIRST_POLAR_ANGLES = (20, 40, 60, 80, 100)
# Number of first cameras at each polar angle, with equally spaced azimuths.
FIRST_AZIMUTH_COUNT = 16
# Width in world units that a first camera shows, before the mesh gets the size of the object.
FIRST_WIDTH = 2.0
# Pixels per side of the small images in which cameras are searched, before the full size.
COARSE_SIZE = 32
# The search refines this many of its best first cameras, and returns at most as many.
KEPT_CAMERAS = 3
# Largest number of steps when one camera is refined with the Gauss-Newton method.
MAX_STEPS = 20
# The refinement ends if a step changes the squared error, or the camera, by less than this.
MIN_GAIN = 1e-3
# Step sizes of numerical derivatives by the five parameters of `_Target.refine_camera`, times the
# image size in pixels.
DERIVATIVE_STEPS = (1.0, 1.0, 1.0, 0.5, 0.5)
# Smallest angle in radians of a refined camera to the z-axis, where the azimuth has no effect.
MIN_POLE_ANGLE = 0.02
# Number of samples along one side of a pixel in renders.
SAMPLES = 8
# Two cameras count as the same one if all their axes differ by less than this angle in degrees.
MIN_CAMERA_ANGLE = 2.0
# A camera is refined in full size if its squared error is at most this multiple of the smallest.
MAX_ERROR_RATIO = 3
# Weight of the smoothness penalty, relative to the squared brightness under uniform light. Without
# it, light from directions that the object hardly reflects could become arbitrarily bright.
SMOOTHNESS_WEIGHT = 1e-6
# A pixel of the photograph with this linear value or more counts as clipped: the scene may have
# been brighter than the photograph can show.
CLIPPED_VALUE = 0.995
# Largest number of fits of a light. Each ignores clipped pixels that the last made brighter than 1.
CLIPPING_ROUNDS = 3
# Smallest radiance in the directions of a grid, over the mean. It is positive between them, too.
MIN_RADIANCE_RATIO = 0.01
# Largest number of iterations of `nnls` for each direction of the grid. Three are usual.
MAX_NNLS_ITERATIONS = 100
# The radiance is first constrained in every 16th direction. Negative ones are added afterwards.
FIRST_DIRECTION_STEP = 16
# Radiance is not negative at the vertices of an icosphere with this number of subdivisions: in the
# search for a camera, and for the light that is returned.
SEARCH_GRID = 2
FINAL_GRID = 5
# The object covers a pixel completely if its share of the pixel is larger than this. A limit of
# 0.99 would be too low: a white background in the other hundredth of the pixel can be brighter than
# the object, for example in the blue channel of a banana.
WHOLE_PIXEL = 0.999
# The bounding box of a mask contains the pixels that it covers by more than this.
HALF_PIXEL = 0.5
# A pixel on the border of the object gets the mean color of the pixels that the object covers
# completely and that are at most this many rows and columns away.
BORDER = 2
# Smallest number of pixels of an image that the object must cover.
MIN_COVERED_PIXELS = 16
CHANNELS = 3


class FittedScene(NamedTuple):
    """Camera and light with which a render resembles a photograph most.

    Attributes:
        camera: Camera from which the mesh looks most like the photograph.
        light: SH coefficients of environment light without negative radiance,
            shape (49, 3).
        error: Root mean square difference between the linear values of the
            render and of the photograph, over the pixels that the object covers
            in both, divided by the root mean square of the photograph there.
            Infinite without such pixels.
        overlap: Intersection over union of the silhouettes in the render and in
            the mask.
    """

    camera: Camera
    light: Tensor
    error: float
    overlap: float


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
        photograph: Linear values in [0, 1], shape (3, size, size). Values of 0.995
            or more count as clipped: the scene may have been brighter.
        mask: Share of each pixel that the object covers, in [0, 1],
            shape (size, size).
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
        rasterizer: "auto", "opengl", "numba", "numpy" or "torch".
        start: Camera that is refined. None searches for a camera.

    Returns:
        Camera and light, the error of the pixels, and the overlap of the
        silhouettes.

    Raises:
        InputError: If the photograph or the mask has a wrong shape, or if the
            mask covers fewer than `MIN_COVERED_PIXELS` pixels, or no pixel by
            more than `WHOLE_PIXEL`.

    Example:
        >>> import norm_balls as nb
        >>> mesh = nb.solid("cup")
        >>> camera = nb.OrthographicCamera(polar=60.0, azimuth=0.0, width=2.4)
        >>> light = 0.3 * nb.load_light("grace")
        >>> photograph = nb.render(mesh, camera, light, size=32).clamp(0, 1)
        >>> mask = 1 - nb.render(mesh, camera, 0 * light, size=32, background=1.0)[0]
        >>> found = nb.fit_scene(photograph, mask, mesh)  # doctest: +SKIP
    """
    photograph = as_tensor("photograph", photograph).double()
    mask = as_tensor("mask", mask).double()
    for name, values in (("photograph", photograph), ("mask", mask)):
        if not (values.min() >= 0 and values.max() <= 1):
            raise InputError(f"{name} has values outside [0, 1]: divide bytes by 255")
    size = photograph.shape[-1]
    require_shape("photograph", photograph, CHANNELS, size, size)
    require_shape("mask", mask, size, size)
    if mask.sum() < MIN_COVERED_PIXELS or mask.max() <= WHOLE_PIXEL:
        covered = f"covers {float(mask.sum()):.0f} pixels of {size} × {size}"
        fault = f"{covered}, and the largest share of a pixel is {float(mask.max()):.3g}"
        advice = f"is 1 where the object is, in at least {MIN_COVERED_PIXELS} pixels"
        raise InputError(f"the mask {fault}: give a mask that {advice}")
    # Arguments of `render` and `precompute_transfer` for all images that are compared.
    surface = {"albedo_scale": albedo_scale, "encoding": encoding, "normals": normals}
    options: dict[str, Any] = {**surface, "rasterizer": rasterizer, "samples": SAMPLES}
    target = _Target(photograph, mask, mesh, size, options)
    if start is not None and fov is not None:
        raise InputError(f"fov={fov} does not change the camera start: leave one of them out")
    if start is not None:
        starts = [start.fixed()]
    else:
        # A search in a small copy of the photograph is faster.
        coarse_target = _Target(photograph, mask, mesh, min(COARSE_SIZE, size), options)
        starts = _plausible_cameras(coarse_target, mask, fov)
    _, camera = target.rank_cameras(target.refine_camera(camera) for camera in starts)[0]
    # Bounces are slow to compute, so only the returned light is fitted with bounces.
    target.options = {**options, "bounces": bounces}
    return target.fit_final_light(camera)


def _plausible_cameras(
    target: _Target, mask: Float[Tensor, "size size"], fov: float | None
) -> list[Camera]:
    """Search all directions for up to `KEPT_CAMERAS` different cameras, the best one first.

    A `fov` of None means no perspective.
    """
    mesh = target.mesh
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    first_cameras = [
        _framed(camera.with_clip_range(radius), mesh, mask)
        for polar in FIRST_POLAR_ANGLES
        for camera in orbit_cameras(FIRST_AZIMUTH_COUNT, FIRST_WIDTH, polar, fov=fov)
    ]
    ranked_cameras = [camera for _, camera in target.rank_cameras(first_cameras)]
    # All azimuths fit a round object equally well, so the best cameras may all have the same polar
    # angle. The best camera of each polar angle is therefore refined, too.
    best_of_polar = {camera.polar: camera for camera in reversed(ranked_cameras)}
    # dict.fromkeys removes duplicates, and keeps the order.
    start_cameras = dict.fromkeys([*ranked_cameras[:KEPT_CAMERAS], *best_of_polar.values()])
    refined = target.rank_cameras(target.refine_camera(camera) for camera in start_cameras)
    largest_error = MAX_ERROR_RATIO * refined[0][0]
    max_cosine = math.cos(math.radians(MIN_CAMERA_ANGLE))
    kept: list[Camera] = []
    for error, camera in refined:
        # Smallest cosine of the angles between the axes right, up and back of both cameras.
        cosines = [(camera.axes() * other.axes()).sum(axis=1).min() for other in kept]
        if error <= largest_error and max(cosines, default=-1.0) < max_cosine:
            kept.append(camera)
    return kept[:KEPT_CAMERAS]


class _Target:
    """Photograph of an object that renders of a mesh should resemble.

    Pixels of `image` (linear) outside of the object have the value `gray`, 0 or 1. `mask` is
    the share of each pixel that the object covers. Meshes are rendered with `options`.
    """

    def __init__(
        self,
        photograph: Float[Tensor, "3 H H"],
        mask: Float[Tensor, "H H"],
        mesh: Mesh,
        size: int,
        options: dict[str, Any],
    ) -> None:
        """Resample a photograph and its mask, and replace the background by black or white.

        Pixels on the border of the object show a mixture of object and
        background. They get the mean color of the object's pixels around them. Values are linear,
        and the mask is the share of each pixel that the object covers.
        """
        # 1 in pixels that the object covers completely, and 0 elsewhere, shape (1, H, H).
        inside_mask = (mask > WHOLE_PIXEL).double()[None]
        # Side of the square of pixels around each pixel over which colors are averaged.
        side = 2 * BORDER + 1
        mean_color = F.avg_pool2d(photograph * inside_mask, side, 1, BORDER)
        inside_fraction = F.avg_pool2d(inside_mask, side, 1, BORDER)
        # Mean color of those pixels of the square that lie inside of the object.
        border_color = mean_color / inside_fraction.clamp(min=1e-9)
        color = torch.where(inside_mask > 0, photograph, border_color)
        object_image = F.interpolate((color * mask)[None], (size, size), mode="area")[0]
        covered = F.interpolate(mask[None][None], (size, size), mode="area")[0]
        # The background becomes black behind a bright object, and white behind a dark one, so that
        # the silhouette stands out.
        is_bright = float(object_image.sum()) > 0.5 * CHANNELS * float(covered.sum())
        self.gray = 0.0 if is_bright else 1.0
        self.image = (object_image + self.gray * (1 - covered)).flatten(1)
        self.mask = covered.flatten()
        self.mesh, self.size, self.options = mesh, size, options

    def fit_light(
        self, camera: Camera, min_coverage: float = 0.0, grid: int = SEARCH_GRID
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Find the light under which a render from a camera resembles the photograph most.

        The results are the residuals (N,), the light (49, 3), and the share of each pixel that the
        mesh covers in the render (P,). The residuals are the differences between the render and the
        photograph for all pixels and channels, followed by the weighted differences between the
        light and the expected light. The sum of their squares is the error of the camera. Only
        pixels of which the mesh and the mask both cover at least `min_coverage` count. The radiance
        is constrained at the vertices of an icosphere with `grid` subdivisions.
        """
        operator = precompute_transfer(self.mesh, camera, self.size, **self.options)
        # 49 lights, of which light k has only coefficient k, shape (49, 49, 3).
        unit_lights = torch.eye(COEFFICIENTS, dtype=torch.float64)[..., None].expand(-1, -1, 3)
        # Radiance of the P covered pixels under each of the 49 lights, shape (3, 49, P).
        transfer = operator.radiance(unit_lights).permute(1, 0, 2)
        pixels = operator.pixels
        coverage = torch.zeros_like(self.mask).index_copy(0, pixels, operator.coverage.double())
        background = self.gray * (1 - coverage)
        image = self.image[:, pixels]
        covered_share = torch.minimum(coverage, self.mask)[pixels]
        is_covered = (covered_share >= min_coverage).expand(CHANNELS, -1)
        object_radiance = image - background[pixels]
        is_used = is_covered
        for _ in range(CLIPPING_ROUNDS):
            # Matrix and right side of the normal equations of each channel, shape (3, 49, 49) and
            # (3, 49).
            used_transfer = transfer * is_used[:, None]
            normal_matrix = used_transfer @ transfer.mT
            right_side = (used_transfer @ object_radiance[..., None])[..., 0]
            penalty = self.penalty(normal_matrix)
            light, expected_light = _fit_channels(normal_matrix, right_side, penalty, grid)
            rendered = (light.T[:, None] @ transfer)[:, 0] + background[pixels]
            # A pixel that is clipped in the photograph may have been brighter. The fit is repeated
            # without the clipped pixels that the render makes brighter than 1.
            is_trusted = is_covered & ~((image >= CLIPPED_VALUE) & (rendered > 1))
            if torch.equal(is_trusted, is_used):
                break
            is_used = is_trusted
        rendered_image = background.repeat(CHANNELS, 1).index_copy(1, pixels, rendered)
        differences = rendered_image.clamp(max=1) - self.image
        penalties = penalty.sqrt() * (light - expected_light).T
        return torch.cat([differences.flatten(), penalties.flatten()]), light, coverage

    def rank_cameras(self, cameras: Iterable[Camera]) -> list[tuple[float, Camera]]:
        """Sort cameras by the squared error of a render with their best light, smallest first."""
        pairs = [(float(self.fit_light(one)[0].square().sum()), one) for one in cameras]
        return sorted(pairs, key=lambda pair: pair[0])

    def penalty(self, normal_matrix: Float[Tensor, "3 49 49"]) -> Float[Tensor, " 49"]:
        """Compute the weights of the smoothness penalty of a light.

        The penalty is the weighted sum of the squared differences between the SH coefficients and
        expected coefficients. The weight in band l is proportional to 1 + (l (l + 1))², because -l
        (l + 1) is the eigenvalue of the Laplacian on the sphere. It is also proportional to the
        squared brightness of the object under uniform light. The fit therefore does not depend on
        the scale of the albedo. Entry (j, k) of a normal matrix is the sum over pixels of the
        radiance under coefficient j times that under k.
        """
        # Entry (0, 0) is the sum over pixels of the squared radiance under uniform light
        # (coefficient 0). The small summand keeps the sum above 0 if the object is black.
        squared_brightness = normal_matrix[:, 0, 0].max() + 1e-12 * self.mask.sum()
        band = bands(DEGREE).double()
        return SMOOTHNESS_WEIGHT * squared_brightness * (1 + (band * (band + 1)).square())

    def refine_camera(self, first: Camera) -> Camera:
        """Find the camera near a given camera whose render resembles the photograph most.

        The Gauss-Newton method in a trust region changes five parameters: the polar
        angle and the azimuth in radians, and the width and the shifts right and up divided
        by the width of the first camera. For each camera, the best light is computed
        (variable projection). The error jumps slightly if a sample changes from one
        face to another. Derivatives are therefore central differences over about a pixel.
        """

        def camera_of(parameters: Float[np.ndarray, " 5"]) -> Camera:
            polar, azimuth, relative_width, right, up = parameters.tolist()
            return replace(
                first.widened(relative_width),
                polar=math.degrees(polar),
                azimuth=math.degrees(azimuth),
                right=first.width * right,
                up=first.width * up,
            )

        def residuals(parameters: Float[np.ndarray, " 5"]) -> Float[np.ndarray, " N"]:
            return self.fit_light(camera_of(parameters))[0].numpy()

        def jacobian(parameters: Float[np.ndarray, " 5"]) -> Float[np.ndarray, "N 5"]:
            steps = np.array(DERIVATIVE_STEPS) / self.size
            # Row k of the diagonal matrix is a step that changes only parameter k.
            pairs = [(parameters + step, parameters - step) for step in np.diag(steps)]
            differences = [residuals(after) - residuals(before) for after, before in pairs]
            return np.stack(differences, axis=1) / (2 * steps)

        # Parameters of the first camera, and the range of each parameter.
        shift = [first.right / first.width, first.up / first.width]
        lowest = [MIN_POLE_ANGLE, -np.inf, 0.5, -1.0, -1.0]
        highest = [math.pi - MIN_POLE_ANGLE, np.inf, 2.0, 1.0, 1.0]
        start = [math.radians(first.polar), math.radians(first.azimuth), 1.0, *shift]
        solution = least_squares(
            residuals,
            np.clip(start, lowest, highest),
            jacobian,
            bounds=(lowest, highest),
            x_scale="jac",
            ftol=MIN_GAIN,
            xtol=MIN_GAIN,
            max_nfev=MAX_STEPS,
        )
        return camera_of(solution.x)

    def fit_final_light(self, camera: Camera) -> FittedScene:
        """Fit the light to fully covered pixels, and compute how well the render fits."""
        _, light, coverage = self.fit_light(camera, WHOLE_PIXEL, FINAL_GRID)
        image = render(self.mesh, camera, light, self.size, self.gray, **self.options)
        rendered = decode(image, self.options["encoding"]).flatten(1)
        # Where the mesh leaves pixels of the mask, the render shows its own background.
        is_inside = torch.minimum(self.mask, coverage) > WHOLE_PIXEL
        error = math.inf
        if is_inside.any():
            photograph = self.image[:, is_inside]
            error = float((rendered[:, is_inside] - photograph).norm() / photograph.norm())
        union = torch.maximum(coverage, self.mask).sum()
        # Fraction of the union of the render and the mask that both cover.
        overlap = torch.minimum(coverage, self.mask).sum() / union
        return FittedScene(camera, light.float(), error, float(overlap))


def _fit_channels(
    normal_matrix: Float[Tensor, "3 49 49"],
    right_side: Float[Tensor, "3 49"],
    penalty: Float[Tensor, " 49"],
    grid: int,
) -> tuple[Tensor, Tensor]:
    """Fit the light of each color channel, with the light of the brightest channel as a guide.

    An object may hardly reflect one color. For example, a yellow object hardly
    shows from where blue light comes. The light of each channel is therefore
    expected to be a multiple of the light of the brightest channel. Differences
    between the light and this expected light are penalized. The result is the light and the
    expected light, shape (49, 3) each. The latter is zero for the brightest channel.
    """
    regularized = normal_matrix + torch.diag(penalty)
    # The brightest channel reflects most of a uniform light, which is coefficient 0.
    best = int(normal_matrix[:, 0, 0].argmax())
    best_light = _nonnegative_light(regularized[best, None], right_side[best, None], grid)[:, 0]
    # The expected light is the multiple of `best_light` with the smallest squared error.
    squared_radiance = (normal_matrix @ best_light) @ best_light
    tiny = torch.finfo(torch.float64).tiny
    factors = (right_side @ best_light) / squared_radiance.clamp(min=tiny)
    expected = best_light[:, None] * factors.clamp(min=0)
    expected[:, best] = 0
    # The penalty pulls the light of each channel toward its expected light.
    penalized_right_side = right_side + (penalty[:, None] * expected).T
    return _nonnegative_light(regularized, penalized_right_side, grid), expected


def _nonnegative_light(
    matrices: Float[Tensor, "C 49 49"], right_sides: Float[Tensor, "C 49"], grid: int
) -> Float[Tensor, "49 C"]:
    """Minimize xᵀ S x / 2 - wᵀ x over all lights x without negative radiance.

    The rows of a matrix R map a light x to its radiance in the directions of a grid, so the
    constraint is R x ≥ 0. With the Cholesky decomposition S = L Lᵀ and y = Lᵀ x, the problem is to
    find the point y of the cone {y: R L⁻ᵀ y ≥ 0} that is nearest to L⁻¹ w. By Moreau's
    decomposition, this point is L⁻¹ w + L⁻¹ Rᵀ m. Here m ≥ 0 is the vector that makes the length of
    this sum as small as possible. SciPy's `nnls` (non-negative least squares) finds m.
    """
    # Matrix R that maps a light to its radiance in N directions, shape (N, 49).
    radiance_rows = _radiance_rows(grid)
    lights = []
    for matrix, right_side in zip(matrices.numpy(), right_sides.numpy(), strict=True):
        lower = np.linalg.cholesky(matrix)
        # L⁻¹ w is the value of y without constraints.
        unconstrained = solve_triangular(lower, right_side, lower=True)
        # The columns of L⁻¹ Rᵀ are the vectors whose dot product with y must not be negative.
        constraints = solve_triangular(lower, radiance_rows.T, lower=True)
        nearest = _nearest_in_cone(unconstrained, constraints)
        # The light is x = L⁻ᵀ y.
        lights.append(solve_triangular(lower, nearest, lower=True, trans="T"))
    return torch.from_numpy(np.stack(lights, axis=1))


def _nearest_in_cone(point: NDArray[Any], constraints: NDArray[Any]) -> NDArray[Any]:
    """Find the nearest point whose dot product with each of N vectors is not negative.

    Few vectors limit the result, so some are used first, and violated ones are added until none is
    left.
    """
    constraint_count = constraints.shape[1]
    is_used = np.arange(constraint_count) % FIRST_DIRECTION_STEP == 0
    nearest = point
    is_negative = point @ constraints < 0
    while is_negative.any():
        # The nearest point is the shortest sum of the given point and of the vectors, each times a
        # multiplier of at least 0.
        used = constraints[:, is_used]
        multipliers, _ = nnls(used, -point, maxiter=MAX_NNLS_ITERATIONS * constraint_count)
        nearest = point + used @ multipliers
        is_negative = (nearest @ constraints < 0) & ~is_used
        is_used |= is_negative
    return nearest


@cache
def _radiance_rows(grid: int) -> NDArray[Any]:
    """Compute the matrix from a light to its radiance minus `MIN_RADIANCE_RATIO` times the mean."""
    directions, _ = sphere(grid)
    rows = basis(torch.from_numpy(directions), DEGREE).numpy()
    # The product of column 0 and coefficient 0 is the mean radiance of the light. Reducing the
    # column therefore subtracts the smallest allowed radiance.
    rows[:, 0] *= 1 - MIN_RADIANCE_RATIO
    return rows


def _framed(camera: Camera, mesh: Mesh, mask: Float[Tensor, "size size"]) -> Camera:
    """Return a camera whose image of the mesh has the box center and the box area of the mask."""
    # Bounding boxes in image coordinates from -1 to 1, with x to the right and y up.
    points = camera.project(mesh.vertices[np.unique(mesh.faces)])[:, :2]
    mesh_low = points.min(0)
    mesh_high = points.max(0)
    size = len(mask)
    rows, columns = np.nonzero((mask > HALF_PIXEL).numpy())
    mask_low = np.array([2 * columns.min() / size - 1, 1 - 2 * (rows.max() + 1) / size])
    mask_high = np.array([2 * (columns.max() + 1) / size - 1, 1 - 2 * rows.min() / size])
    # A camera that is wider by this factor shows the mesh smaller by this factor.
    factor = math.sqrt(np.prod(mesh_high - mesh_low) / np.prod(mask_high - mask_low))
    wider = camera.widened(factor)
    # Offset of the center of the box from its place in the image of the wider camera.
    shift = (mask_low + mask_high) / 2 - (mesh_low + mesh_high) / 2 / factor
    right, up = shift * wider.width / 2
    return replace(wider, right=right, up=up)
