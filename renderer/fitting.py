"""The camera and the light of a photograph of a mesh, by descent through the renderer.

All but the mesh is made one gray, so that the image shows outline and shading at once. Of each camera, the light that
fits best is the solution of linear equations, since images are linear in it. The gradient by the camera at that light
is the gradient of the whole (variable projection, Golub and Pereyra 1973), so descent moves the camera alone.

Light and albedo appear as their product: an albedo twice as large halves the light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import minimize
from torch import Tensor

from renderer.camera import Camera, OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.light.harmonics import bands
from renderer.mesh import Mesh
from renderer.rendering import precompute_transfer, render
from renderer.transfer import COEFFICIENTS, DEGREE

if TYPE_CHECKING:
    from jaxtyping import Float

POLAR, AZIMUTHS = (20, 40, 60, 80, 100), 16  # cameras to begin with: degrees off +z, and so many around it
COARSE, KEPT, STEPS = 32, 3, 40  # pixels of the first search, its best cameras, and steps of descent from each
SAMPLES = 8  # per side of a pixel
SMOOTH = 1e-5  # weight of the light's squared Laplacian; what no surface shows of the light stays small
WHOLE, BORDER = 0.98, 2  # a pixel with a larger share is the object's; others take its color from so near
LEAST = 16  # pixels that the object must cover


class FittedScene(NamedTuple):
    """light: (49, 3). error: root mean square over the object's pixels, relative to theirs. overlap: of the rendered
    and the given outline, their intersection over their union."""

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
    normals: str = "smooth",
    bounces: int = 0,
    rasterizer: str = "auto",
) -> FittedScene:
    """The camera and the environment light under which renders of a normalized mesh resemble a photograph most.

    photograph: linear, in [0, 1]. mask: the object's share of each pixel, in [0, 1]. fov: in radians between the
    image's sides; None for a camera without perspective. The camera is upright and its optical axis may lie outside the
    image's middle (`Camera.right`, `Camera.up`). bounces: of the light that is returned, with shadows;
    without them, that of a concave mesh is too bright or too dim. InputError: no object in the mask, or shapes that do
    not fit.
    """
    size = photograph.shape[-1]
    if photograph.shape != (3, size, size) or mask.shape != (size, size):
        given = f"{tuple(photograph.shape)} and {tuple(mask.shape)}"
        raise InputError(f"photograph and mask of shapes {given} do not fit: give (3, size, size) and (size, size)")
    if float(mask.sum()) < LEAST:
        raise InputError(f"the mask covers {float(mask.sum()):.0f} pixels of {size}²: give one that shows the object")
    options = {"albedo_scale": albedo_scale, "normals": normals, "rasterizer": rasterizer}
    photograph, mask = photograph.double(), mask.double()
    coarse, fine = (_Target.of(photograph, mask, mesh, small, options) for small in (min(COARSE, size), size))
    cameras = [
        camera.seeing(float(np.linalg.norm(mesh.vertices, axis=1).max()))
        for polar in POLAR
        for camera in orbit_cameras(AZIMUTHS, 2.0, math.radians(polar), fov=fov)
    ]
    framed = coarse.ranked(_framed(camera, mesh, mask) for camera in cameras)
    # Of a round object, all azimuths fit alike: so the best of each polar angle, too.
    of_polar = {camera.polar: camera for camera in reversed(framed)}
    starts = dict.fromkeys([*framed[:KEPT], *of_polar.values()])
    descended = coarse.ranked(coarse.descended(camera) for camera in starts)
    camera = fine.ranked(fine.descended(camera) for camera in descended[:KEPT])[0]
    return fine._replace(options={**options, "bounces": bounces}).scene(camera)


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

    def fitted(self, camera: Camera, least: float = 0.0) -> tuple[float, Tensor, Tensor]:
        """(squared error, light (49, 3), coverage (size²,)) of the best light for a camera. least: share of the pixels
        that the light is fitted to."""
        [operator] = precompute_transfer(self.mesh, camera, self.size, samples=SAMPLES, **self.options)
        units = torch.eye(COEFFICIENTS, dtype=torch.float64)[..., None].expand(-1, -1, 3)
        shown = operator.radiance(units).permute(1, 0, 2)  # (3, 49, P)
        coverage = self.mask.new_zeros(self.size**2).index_copy(0, operator.pixels, operator.coverage.double())
        wanted = (self.image - self.gray * (1 - coverage))[:, operator.pixels]
        known = shown * (torch.minimum(coverage, self.mask)[operator.pixels] >= least)
        light = torch.linalg.solve(known @ shown.mT + torch.diag(self.penalty), (known @ wanted[..., None])[..., 0]).T
        predicted = self.gray * (1 - coverage).repeat(3, 1)
        predicted[:, operator.pixels] += (light.T[:, None] @ shown)[:, 0]
        error = (predicted - self.image).square().sum() + (self.penalty[:, None] * light.square()).sum()
        return float(error), light, coverage

    def ranked(self, cameras: Iterable[Camera]) -> list[Camera]:
        """The cameras, those first whose best light fits best."""
        return sorted(cameras, key=lambda camera: self.fitted(camera)[0])

    @property
    def penalty(self) -> Tensor:
        band = bands(DEGREE).double()
        return SMOOTH * self.mask.sum() * (1 + (band * (band + 1)).square())

    def descended(self, camera: Camera) -> Camera:
        """The camera after descent, with numbers for fields."""
        width = camera.width

        def moved(values: Sequence[Any]) -> Camera:
            polar, azimuth, wider, right, up = values
            return replace(
                camera, polar=polar, azimuth=azimuth, width=width * wider, right=width * right, up=width * up,
                **({} if isinstance(camera, OrthographicCamera) else {"distance": camera.distance * wider}),
            )  # fmt: skip

        def step(values: np.ndarray) -> tuple[float, np.ndarray]:
            error, light, _ = self.fitted(moved(values.tolist()))
            fields = torch.from_numpy(values).requires_grad_()
            options = {"samples": SAMPLES, "silhouettes": True, **self.options}
            image = render(self.mesh, moved(fields.unbind()), light, self.size, self.gray, **options)[0]
            (gradient,) = torch.autograd.grad((image.flatten(1) - self.image).square().sum(), fields)
            return error, gradient.numpy()

        start = np.array([camera.polar, camera.azimuth, 1.0, camera.right / width, camera.up / width])
        bounds = [(0.02, math.pi - 0.02), (None, None), (0.5, 2.0), (-1.0, 1.0), (-1.0, 1.0)]
        found = minimize(step, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": STEPS})
        return moved(found.x.tolist())

    def scene(self, camera: Camera) -> FittedScene:
        _, light, coverage = self.fitted(camera, WHOLE)
        image = render(self.mesh, camera, light, self.size, self.gray, samples=SAMPLES, **self.options)[0].flatten(1)
        inside = self.mask > WHOLE
        error = (image - self.image)[:, inside].norm() / self.image[:, inside].norm()
        overlap = torch.minimum(coverage, self.mask).sum() / torch.maximum(coverage, self.mask).sum()
        return FittedScene(camera, light, float(error), float(overlap))


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
