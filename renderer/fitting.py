"""Estimate the camera and the light of a photograph of a mesh.

All pixels outside the mesh are set to one gray, so that the image shows outline and shading at once. For each camera,
the best light is the solution of a convex quadratic program: images are linear in the light, and its radiance must not
be negative. So the differences of the pixels are a function of the camera alone (variable projection, Golub and
Pereyra 1973), whose squares the Gauss-Newton method minimizes.

Light and albedo appear as their product: an albedo twice as large halves the light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, nnls
from torch import Tensor

from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera, orbit_cameras
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

POLAR, AZIMUTHS = (20, 40, 60, 80, 100), 16  # cameras to begin with: degrees off +z, and so many around it
COARSE, KEPT = 32, 3  # Pixels per side of the first search, and how many of its best cameras start a descent.
STEPS = 20  # Steps of descent from each camera.
LEAST_GAIN = 1e-3  # Relative change of the squared error, or of the camera, at which a descent ends.
# Steps of the differences by polar angle, azimuth, relative width, right and up, as multiples of 1 / size.
DIFFERENCES = (1.0, 1.0, 1.0, 0.5, 0.5)
SAMPLES = 8  # Samples per side of a pixel.
DISTINCT = math.radians(2)  # Cameras whose axes differ by less count as one.
PLAUSIBLE = 3  # Cameras with this multiple of the least squared error are compared at the full size.
# Weight of the squared Laplacian of the light, or of its difference from what the best channel lets expect, relative to
# what that channel shows of a constant light. It bounds light that is not seen.
SMOOTH = 1e-6
CLIPPED = 0.995  # Pixel values from here on are clipped: the scene may be brighter.
CLIPPING_ROUNDS = 3  # Solutions of the light, each with the clipped pixels of the solution before.
LEAST_RADIANCE = 0.01  # Of the mean radiance, in the directions of a grid. Between them, radiance is then above zero.
MOST_EXCHANGES = 100  # Iterations of non-negative least squares per direction; three are usual.
FIRST_DIRECTIONS = 16  # Every so many directions of a grid constrain the first solution.
SEARCH_GRID, FINAL_GRID = 2, 5  # Subdivisions of the grid of directions, for the camera and for the returned light.
# Pixels with a larger share are the object's. A hundredth of a background may be brighter than the blue of a banana.
WHOLE = 0.999
BORDER = 2  # Other pixels take their color from the object's pixels that are so near.
MARGIN = 1.6  # The side of an object's window, in those of its box.
OPAQUE = 127  # A mask with larger values holds the object.
USUAL_POLAR = math.radians(60)  # The first guess of how far the camera looks from straight down.
TILTED = 1e-3  # Radians that a window may be turned about its middle.
LEAST = 16  # Pixels that the object must cover.


class FittedPhotograph(NamedTuple):
    """A scene whose camera looks at the mesh's middle, and the part of the photograph that this camera shows."""

    scene: FittedScene
    window: Window


class FittedScene(NamedTuple):
    """Camera and light of a photograph.

    Attributes:
        camera: The camera.
        light: Coefficients, shape (49, 3), of a radiance that is nowhere negative.
        error: Root mean square of the differences in linear light over the object's pixels, divided by that of the
            photograph.
        overlap: Intersection over union of the rendered and the given outline.
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

    The object's window is turned to it (`renderer.photograph`). Which way is up there depends on how high the camera
    stands, so that the window and the camera are found anew if a first fit says that the window was tilted.

    Args:
        photograph: Pixels of 8 bits, shape (H, W, 3). Its camera is upright, and its optical axis passes through the
            photograph's middle.
        mask: White where the object is, shape (H, W).
        mesh: The mesh, normalized and upright.
        size: Pixels per side that are compared.
        fov: Angle across a square `MARGIN` times as wide as the object, in radians. None for a camera without
            perspective.
        encoding: Encoding of the photograph and of the images that are to be rendered, linear or srgb.
        **options: Further arguments of `fit_scene`.

    Returns:
        The scene and its window of the photograph.

    Raises:
        InputError: If the mask holds no object.
    """
    rows, columns = (np.flatnonzero((mask > OPAQUE).any(axis)) for axis in (1, 0))
    if not len(rows):
        raise InputError("no object is found: give a mask that is white where it is, or a box around it")
    center = np.array([columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1]) / 2
    side = MARGIN * max(int(np.ptp(rows)), int(np.ptp(columns)), 1)
    whole = Photograph(photograph, None if fov is None else side / 2 / math.tan(fov / 2))
    options = {**options, "fov": fov, "encoding": encoding}

    def fit(window: Window, start: Camera | None) -> FittedScene:
        linear = window.cut(photograph, size, encoding)
        share = window.cut(mask[..., None], size, beyond=0)[0]
        return fit_scene(linear, share, mesh, start=start, **options)

    window = whole.window(center, side, np.array([0.0, math.sin(USUAL_POLAR), math.cos(USUAL_POLAR)]))
    scene = fit(window, None)
    above = _direction_above(scene.camera, window)
    above[0] = 0  # The photograph's camera is upright.
    upright = whole.window(center, side, above)
    if np.abs(upright.axes - window.axes).max() > TILTED:
        window = upright
        scene = fit(window, scene.camera)
    camera = scene.camera
    above = _direction_above(camera, window)
    middle = window.pixels(*(np.array([camera.right, camera.up]) * side / camera.width))
    turned = _turned_to_mesh(camera)
    return FittedPhotograph(scene._replace(camera=turned), whole.window(np.array(middle), side, above))


def _direction_above(camera: Camera, window: Window) -> NDArray[Any]:
    """Return the world's z axis in the axes of the photograph's camera, of a camera that shows a window."""
    return window.axes.T @ camera.axes()[:, 2]


def _turned_to_mesh(camera: Camera) -> Camera:
    """Turn a camera at its place, so that it looks at the mesh's middle.

    A camera with perspective sees the mesh from another angle than that of its optical axis if the mesh is not in the
    middle of the image.
    """
    if not isinstance(camera, PerspectiveCamera):
        return replace(camera, right=0.0, up=0.0)
    x, y, z = camera.eye()[:3].tolist()
    distance = math.hypot(x, y, z)
    polar = math.acos(z / distance)
    azimuth = math.atan2(y, x)
    width = camera.width * distance / camera.distance
    return replace(camera, polar=polar, azimuth=azimuth, width=width, right=0.0, up=0.0, distance=distance)


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
    """Find the camera and the environment light under which renders of a normalized mesh resemble a photograph most.

    The camera is upright, and its optical axis may lie outside the image's middle (`Camera.right`, `Camera.up`).

    Args:
        photograph: Linear values in [0, 1], shape (3, size, size). Values of 1 count as clipped.
        mask: The object's share of each pixel in [0, 1], shape (size, size).
        mesh: The mesh, normalized and upright.
        fov: Angle between the image's sides in radians. None for a camera without perspective.
        albedo_scale: Factor of the mesh's albedo.
        encoding: Encoding of the images that are to be rendered with the result, linear or srgb. It says whether the
            mesh's colors are decoded, as in `render`. The photograph is linear in either case.
        normals: flat or smooth.
        bounces: Bounces of the returned light, with shadows. Without them, the light of a concave mesh is too bright
            or too dim. The search for the camera ignores shadows.
        rasterizer: auto, opengl, numba or numpy.
        start: A camera near the one that is sought. None searches for one.

    Returns:
        The camera, the light, and how well they fit.

    Raises:
        InputError: If the mask holds no object, or if shapes do not fit.
    """
    size = photograph.shape[-1]
    if photograph.shape != (3, size, size) or mask.shape != (size, size):
        given = f"{tuple(photograph.shape)} and {tuple(mask.shape)}"
        raise InputError(f"photograph and mask of shapes {given} do not fit: give (3, size, size) and (size, size)")
    if float(mask.sum()) < LEAST:
        raise InputError(f"the mask covers {float(mask.sum()):.0f} pixels of {size}²: give one that shows the object")
    options = {"albedo_scale": albedo_scale, "encoding": encoding, "normals": normals, "rasterizer": rasterizer}
    photograph, mask = photograph.double(), mask.double()
    fine = _Target.of(photograph, mask, mesh, size, options)
    if start is None:
        coarse = _Target.of(photograph, mask, mesh, min(COARSE, size), options)
        starts = _plausible_cameras(coarse, mask, fov)
    else:
        starts = [start]
    _, camera = fine.ranked(fine.descended(camera) for camera in starts)[0]
    return fine._replace(options={**options, "bounces": bounces}).scene(camera)


def _plausible_cameras(coarse: _Target, mask: Tensor, fov: float | None) -> list[Camera]:
    """Search for cameras at a coarse size, of which one is near the best one."""
    mesh = coarse.mesh
    cameras = [
        camera.seeing(float(np.linalg.norm(mesh.vertices, axis=1).max()))
        for polar in POLAR
        for camera in orbit_cameras(AZIMUTHS, 2.0, math.radians(polar), fov=fov)
    ]
    framed = [camera for _, camera in coarse.ranked(_framed(camera, mesh, mask) for camera in cameras)]
    # Of a round object, all azimuths fit alike: so the best of each polar angle, too.
    of_polar = {camera.polar: camera for camera in reversed(framed)}
    starts = dict.fromkeys([*framed[:KEPT], *of_polar.values()])
    descended = coarse.ranked(coarse.descended(camera) for camera in starts)
    least = descended[0][0]
    return _distinct([camera for error, camera in descended if error <= PLAUSIBLE * least])[:KEPT]


def _distinct(cameras: Sequence[Camera]) -> list[Camera]:
    """Keep the first of all cameras whose axes differ by less than `DISTINCT`."""
    kept: list[Camera] = []
    for camera in cameras:
        cosines = [float((camera.axes() * other.axes()).sum(1).min()) for other in kept]
        if max(cosines, default=-1.0) < math.cos(DISTINCT):
            kept.append(camera)
    return kept


class _Target(NamedTuple):
    """What renders should look like: image (3, size²), linear, gray where the mask (size²,) is 0."""

    image: Tensor
    mask: Tensor
    gray: float
    mesh: Mesh
    size: int
    options: dict[str, Any]

    @staticmethod
    def of(photograph: Tensor, mask: Tensor, mesh: Mesh, size: int, options: dict[str, Any]) -> _Target:
        inside = (mask > WHOLE).double()[None]
        near, weight = (F.avg_pool2d(values, 2 * BORDER + 1, 1, BORDER) for values in (photograph * inside, inside))
        photograph = torch.where(inside > 0, photograph, near / weight.clamp(min=1e-9))  # without background
        photograph, mask = (
            F.interpolate(image[None], (size, size), mode="area")[0] for image in (photograph * mask, mask[None])
        )
        gray = 0.0 if float(photograph.sum()) > 1.5 * float(mask.sum()) else 1.0  # far from the object's own
        image = photograph + gray * (1 - mask)
        return _Target(image.flatten(1), mask.flatten(), gray, mesh, size, options)

    def fitted(self, camera: Camera, least: float = 0.0, grid: int = SEARCH_GRID) -> tuple[Tensor, Tensor, Tensor]:
        """Fit the light for a camera.

        Args:
            camera: The camera.
            least: The light is fitted to the pixels of which mesh and mask cover at least this share.
            grid: Subdivisions of the grid of directions in which the light is at least `LEAST_RADIANCE`.

        Returns:
            The residuals, whose squares sum to the error with the penalty, the light (49, 3) and the coverage (size²,).
        """
        [operator] = precompute_transfer(self.mesh, camera, self.size, samples=SAMPLES, **self.options)
        units = torch.eye(COEFFICIENTS, dtype=torch.float64)[..., None].expand(-1, -1, 3)
        shown = operator.radiance(units).permute(1, 0, 2)  # (3, 49, P)
        coverage = self.mask.new_zeros(self.size**2).index_copy(0, operator.pixels, operator.coverage.double())
        behind = self.gray * (1 - coverage)
        image = self.image[:, operator.pixels]
        seen = (torch.minimum(coverage, self.mask)[operator.pixels] >= least).expand(3, -1)
        clipped = image >= CLIPPED
        used = seen
        for _ in range(CLIPPING_ROUNDS):
            known = shown * used[:, None]
            squares = known @ shown.mT
            penalty = self.penalty(squares)
            wanted = (known @ (image - behind[operator.pixels])[..., None])[..., 0]
            light, expected = _light_of_channels(squares, wanted, penalty, grid)
            predicted = (light.T[:, None] @ shown)[:, 0] + behind[operator.pixels]
            brighter = seen & ~(clipped & (predicted > 1))  # A clipped pixel may be brighter than the photograph.
            if torch.equal(brighter, used):
                break
            used = brighter
        whole = behind.repeat(3, 1).index_copy(1, operator.pixels, predicted)
        residuals = torch.cat(
            [(whole.clamp(max=1) - self.image).flatten(), (penalty.sqrt() * (light - expected).T).flatten()]
        )
        return residuals, light, coverage

    def ranked(self, cameras: Iterable[Camera]) -> list[tuple[float, Camera]]:
        """Sort cameras by the squared error of their best light, which is returned with each."""
        errors = [(float(self.fitted(camera)[0].square().sum()), camera) for camera in cameras]
        return sorted(errors, key=lambda pair: pair[0])

    def penalty(self, squares: Tensor) -> Tensor:
        """Weights (49,) of a light's squared coefficients, in proportion to the squares (3, 49, 49) of what they show,
        so that the result does not depend on the albedo's scale."""
        brightest = squares[:, 0, 0].max() + 1e-12 * self.mask.sum()
        band = bands(DEGREE).double()
        return SMOOTH * brightest * (1 + (band * (band + 1)).square())

    def descended(self, camera: Camera) -> Camera:
        """Return the camera after descent by the Gauss-Newton method in a trust region.

        The light is fitted anew for each camera (variable projection), and differentiated with it. Differences over
        half a pixel average the steps that samples make.
        """
        width = camera.width

        def moved(values: np.ndarray) -> Camera:
            polar, azimuth, wider, right, up = values.tolist()
            turned = replace(camera, polar=polar, azimuth=azimuth, width=width * wider)
            if isinstance(turned, PerspectiveCamera):
                turned = replace(turned, distance=turned.distance * wider)
            return replace(turned, right=width * right, up=width * up)

        def residuals(values: np.ndarray) -> np.ndarray:
            return self.fitted(moved(values))[0].numpy()

        def jacobian(values: np.ndarray) -> np.ndarray:
            steps = np.diag(np.array(DIFFERENCES) / self.size)
            columns = [(residuals(values + step) - residuals(values - step)) / (2 * step.sum()) for step in steps]
            return np.stack(columns, axis=1)

        start = np.array([camera.polar, camera.azimuth, 1.0, camera.right / width, camera.up / width])
        lowest = [0.02, -np.inf, 0.5, -1.0, -1.0]
        highest = [math.pi - 0.02, np.inf, 2.0, 1.0, 1.0]
        start = start.clip(lowest, highest)
        bounds = (lowest, highest)
        stop = {"ftol": LEAST_GAIN, "xtol": LEAST_GAIN, "max_nfev": STEPS}
        found = least_squares(residuals, start, jacobian, bounds, x_scale="jac", **stop)
        return moved(found.x)

    def rendered(self, camera: Camera, light: Tensor) -> Tensor:
        """Render the mesh in linear light, shape (3, size²)."""
        options = {"samples": SAMPLES, **self.options}
        image = render(self.mesh, camera, light, self.size, self.gray, **options)[0]
        return decode(image, self.options["encoding"]).flatten(1)

    def scene(self, camera: Camera) -> FittedScene:
        """Fit the light of a camera and measure the result."""
        _, light, coverage = self.fitted(camera, WHOLE, FINAL_GRID)
        image = self.rendered(camera, light)
        inside = self.mask > WHOLE
        error = (image - self.image)[:, inside].norm() / self.image[:, inside].norm()
        overlap = torch.minimum(coverage, self.mask).sum() / torch.maximum(coverage, self.mask).sum()
        return FittedScene(camera, light, float(error), float(overlap))


def _light_of_channels(squares: Tensor, wanted: Tensor, penalty: Tensor, grid: int) -> tuple[Tensor, Tensor]:
    """Fit the light of the channel that the object shows best, and then of the others, which are expected to resemble
    it: a yellow object hardly says from where blue light comes.

    Args:
        squares: The products of what the light's coefficients show, shape (3, 49, 49).
        wanted: Their products with what is to be shown, shape (3, 49).
        penalty: Weights of the squared differences from the expected light, shape (49,).
        grid: Subdivisions of the grid of directions.

    Returns:
        The lights and the expected lights, shapes (49, 3). In the first channel, none is expected.
    """
    regular = squares + torch.diag(penalty)
    best = int(squares[:, 0, 0].argmax())
    seen = _nonnegative_light(regular[best, None], wanted[best, None], grid)[:, 0]
    brightness = (wanted @ seen) / ((squares @ seen) @ seen).clamp(min=torch.finfo(torch.float64).tiny)
    expected = seen[:, None] * brightness.clamp(min=0)
    expected[:, best] = 0
    return _nonnegative_light(regular, wanted + (penalty[:, None] * expected).T, grid), expected


def _nonnegative_light(squares: Tensor, wanted: Tensor, grid: int) -> Tensor:
    """Minimize xᵀ S x / 2 − wᵀ x for each channel over lights x of nowhere negative radiance.

    With S = L Lᵀ and y = Lᵀ x, this is the projection of L⁻¹ w onto the cone {y: G y ≥ 0}, where G = R L⁻ᵀ and R holds
    the harmonics in the directions of a grid. By Moreau's decomposition, it is L⁻¹ w + Gᵀ μ with the non-negative μ
    that minimizes |L⁻¹ w + Gᵀ μ|.

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
        free = solve_triangular(lower, vector, lower=True)
        sides = solve_triangular(lower, rows.T, lower=True)
        nearest = free
        # Few directions matter, so others join when radiance is negative there. The result is that of all directions.
        known = np.arange(len(rows)) % FIRST_DIRECTIONS == 0
        negative = free @ sides < 0
        while negative.any():
            multipliers, _ = nnls(sides[:, known], -free, maxiter=MOST_EXCHANGES * len(known))
            nearest = free + sides[:, known] @ multipliers
            negative = (nearest @ sides < 0) & ~known
            known |= negative
        lights.append(solve_triangular(lower, nearest, lower=True, trans="T"))
    return torch.from_numpy(np.stack(lights, axis=1))


@cache
def _radiance_above_least(grid: int) -> NDArray[Any]:
    """Map a light's coefficients to its radiance in the directions of a grid, less `LEAST_RADIANCE` of its mean:
    shape (N, 49)."""
    directions, _ = sphere(grid)
    rows = basis(torch.from_numpy(directions), DEGREE).numpy()
    rows[:, 0] *= 1 - LEAST_RADIANCE
    return rows


def _framed(camera: Camera, mesh: Mesh, mask: Tensor) -> Camera:
    """The camera with a width and a position at which the mesh's box in the image is that of the mask."""
    points = camera.project(mesh.vertices[np.unique(mesh.faces)])[:, :2]
    low, high = points.min(0), points.max(0)
    rows, columns = (np.flatnonzero((mask > 0.5).any(axis).numpy()) for axis in (1, 0))
    size = len(mask)
    left, right = 2 * columns[0] / size - 1, 2 * (columns[-1] + 1) / size - 1
    bottom, top = 1 - 2 * (rows[-1] + 1) / size, 1 - 2 * rows[0] / size
    factor = math.sqrt(float(np.prod(high - low)) / ((right - left) * (top - bottom)))  # of the image's width
    width = camera.width * factor
    shift = np.array([left + right, bottom + top]) / 2 - (low + high) / 2 / factor
    wider = {} if isinstance(camera, OrthographicCamera) else {"distance": camera.distance * factor}
    return replace(camera, width=width, right=shift[0] * width / 2, up=shift[1] * width / 2, **wider)
