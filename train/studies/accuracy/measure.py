"""The renderer's largest errors against the wide reference, quantity by quantity."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import numpy as np
import torch
from torch import Tensor

from renderer.albedo import surface_albedo
from renderer.basis import Harmonics
from renderer.camera import OrthographicCamera
from renderer.fragments import Fragments, build_fragments
from renderer.harmonics import basis, basis_gradient
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.shading import radiance
from renderer.transfer import build_operators
from renderer.transport import radiosity
from renderer.transport.rays import DIRECTIONS, Rays, sphere
from renderer.transport.surface import Surface
from renderer.visibility import Backend, choose
from train.studies.accuracy import reference, reference_transport
from train.studies.accuracy.reference import exact, extended

BACKEND = choose("software")
CAMERA = OrthographicCamera(polar=1.0, azimuth=0.5, field_of_view=2.2)
SETTINGS = ImageSettings(size=16, samples=2)
IMAGE, LIGHT_GRADIENT = "image", "light gradient"  # of an operator
GEOMETRY, VERTEX_GRADIENT = "image by geometry", "vertex gradient"  # of `renderer.shading`


@dataclass(frozen=True)
class Error:
    """The largest error of a quantity over its largest magnitude (over 1 if all of it is zero); infinite where a result
    is not finite. eps: of the result's number type."""

    relative: float
    eps: float

    @property
    def units(self) -> float:
        return self.relative / self.eps


Errors = dict[str, Error]


def error(ours: Tensor, wide: np.ndarray) -> Error:
    """ours: of the wide reference's shape."""
    eps = torch.finfo(ours.dtype).eps
    found = ours.detach().double().numpy()
    if found.shape != wide.shape or not np.isfinite(found).all():
        return Error(inf, eps)
    if not found.size:
        return Error(0.0, eps)
    found = exact(found) if wide.dtype == object else extended(found)
    return Error(float(abs(found - wide).max() / (abs(wide).max() or 1)), eps)


def light(degree: int = 6) -> Tensor:
    """Coefficients of order one, dead bands and all."""
    return torch.randn((degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(degree), dtype=torch.float64)


def worst(conditions: Iterable[Errors]) -> Errors:
    """The largest error of each quantity over several conditions."""
    conditions = list(conditions)
    return {name: max((errors[name] for errors in conditions), key=lambda e: e.units) for name in conditions[0]}


@dataclass(frozen=True)
class Setup:
    """What is rendered. vertices: those that are shaded, where not the mesh's own. They and the light are given to the
    renderer in its dtype, and to the reference with that rounding."""

    mesh: Mesh
    light: Tensor = field(default_factory=light)
    vertices: np.ndarray | None = None
    camera: OrthographicCamera = CAMERA
    settings: ImageSettings = SETTINGS
    backend: Backend = BACKEND
    dtype: torch.dtype = torch.float64
    lift: Callable[..., Any] = extended

    @property
    def degree(self) -> int:
        return round(len(self.light) ** 0.5) - 1

    def shaded(self) -> Tensor:
        """(V, 3) in the dtype."""
        return torch.from_numpy(self.mesh.vertices if self.vertices is None else self.vertices).to(self.dtype)

    def view(self) -> reference.View:
        mesh, samples, lift = self.mesh, self.settings.samples, self.lift
        points = self.camera.project(mesh.vertices)
        closed = mesh.closed and bool((points[:, 2] >= -1).all())
        [ids] = self.backend.rasterise(points[None], mesh.faces, self.settings.size * samples, closed=closed)
        albedo, vertices = mesh.corner_colors[:, 0].astype(np.float64), self.shaded().double().numpy()
        return reference.view(ids, samples, mesh.vertices, vertices, mesh.faces, albedo, self.camera.axes()[2], lift)

    def fragments(self) -> Fragments:
        mesh = self.mesh
        return build_fragments(mesh.vertices, mesh.faces, [self.camera], self.settings, self.backend, mesh.closed)[0]


def by_operator(setup: Setup, dtype: torch.dtype = torch.float32, lost: np.ndarray | None = None) -> Errors:
    """Of the image and its gradient by the light, through an operator kept in `dtype`. lost: (P, (degree + 1)², 3) what
    the image loses per unit of each coefficient, against light that nothing is in the way of."""
    [operator] = build_operators(
        setup.mesh, [setup.camera], setup.settings, setup.backend, basis=Harmonics(setup.degree), dtype=dtype
    )
    view, light = setup.view(), setup.light.to(dtype)
    upstream = _upstream(len(view.pixels))
    lit, above = setup.lift(light.double().numpy()), setup.lift(upstream.double().numpy())
    image, gradient = reference.image(view, lit), reference.light_gradient(view, above, setup.degree)
    if lost is not None:
        image, gradient = image - (lost * lit).sum(axis=1), gradient - (lost * above[:, None]).sum(axis=0)
    return {
        IMAGE: error(operator.radiance(light).T, image),
        LIGHT_GRADIENT: error(operator.light_gradient(upstream.to(dtype).T), gradient),
    }


def by_transport(setup: Setup, bounces: int = 0, dtype: torch.dtype = torch.float32) -> Errors:
    """`by_operator` under transport=shadows or bounces:N, one sample per pixel, which then casts all rays: these, and
    where they start, the reference takes as they are; and of bounces the patches."""
    mesh, kind = setup.mesh, "bounces" if bounces else "shadows"
    settings = replace(setup.settings, samples=1, transport=f"bounces:{bounces}" if bounces else "shadows")
    setup = replace(setup, settings=settings)
    view, directions = setup.view(), extended(sphere(DIRECTIONS).numpy())
    points = _starts(Surface.of(mesh, setup.fragments(), settings), Rays(mesh))
    lost = reference_transport.shadow(view, points, extended(mesh.vertices[mesh.faces]), directions, setup.degree)
    if bounces:
        patches, looked = _patches(mesh)
        sent = reference_transport.radiosity(patches, looked, setup.degree, bounces)
        lost = lost - reference_transport.bounced(view, points, patches, sent, directions)
    return {f"{name}, {kind}": error for name, error in by_operator(setup, dtype, lost).items()}


def _starts(surface: Surface, rays: Rays) -> np.ndarray:
    """(S, 3) of the rays from a surface's samples."""
    return extended((surface.points + rays.offset * surface.planes).numpy())


def _patches(mesh: Mesh) -> tuple[reference_transport.Patches, np.ndarray]:
    """A mesh's, and the directions in which they look."""
    made, directions = radiosity.Patches.of(mesh), sphere(radiosity.DIRECTIONS)
    view, pieces, rays = made.view, made.pieces, Rays(made.pieces)
    surface = Surface(view, torch.from_numpy(pieces.vertices))
    looks = list(rays.looks(surface, directions))
    patches = reference_transport.Patches(
        corners=extended(pieces.vertices[pieces.faces]),
        albedo=extended(pieces.corner_colors[:, 0]),
        points=_starts(surface, rays),
        face=view.faces[view.face].numpy(),
        side=view.facing[view.face, 0].numpy(),
        patch=view.pixel.numpy(),
        share=extended(made.shares[:, 0].numpy()),
        looking=np.concatenate([each.pixels.numpy() for each in looks]),
        dealt=np.concatenate([each.sample.numpy() for each in looks]),
        of_side=made.of_side.numpy(),
    )
    return patches, extended(directions.numpy())


def by_geometry(setup: Setup) -> Errors:
    """Of the image and its gradient by the vertices."""
    view, vertices, light = setup.view(), setup.shaded().requires_grad_(), setup.light.to(setup.dtype)
    fragments, upstream = setup.fragments(), _upstream(len(view.pixels))
    image = radiance(fragments, vertices, light, _albedo(setup, fragments))
    (gradient,) = torch.autograd.grad(image, vertices, upstream.T.to(image))
    light, above = (setup.lift(part.double().numpy()) for part in (light, upstream))
    return {
        GEOMETRY: error(image.T, reference.image(view, light)),
        VERTEX_GRADIENT: error(gradient, reference.vertex_gradient(view, above, light, len(vertices))),
    }


def by_both(setup: Setup) -> Errors:
    return by_operator(setup) | by_geometry(setup)


def with_vertex_normals(setup: Setup) -> Errors:
    """`by_geometry` with interpolated normals; the gradient as its product with one random move of the vertices."""
    view, vertices, light = setup.view(), setup.shaded().requires_grad_(), setup.light.to(setup.dtype)
    fragments, upstream = setup.fragments(), _upstream(len(view.pixels))
    faces = torch.from_numpy(setup.mesh.faces)
    image = radiance(fragments, vertices, light, _albedo(setup, fragments), smooth_faces=faces)
    (gradient,) = torch.autograd.grad(image, vertices, upstream.T.to(image))
    move = _upstream(len(vertices), seed=1)
    parts = vertices.detach().double(), fragments.barycentric, light.double(), upstream, move
    placed, barycentric, lit, above, along = (extended(part.numpy()) for part in parts)

    def shade(vertices: np.ndarray) -> np.ndarray:
        return reference.smooth_image(view, vertices, setup.mesh.faces, barycentric, lit)

    slope = (above * reference.derivative(shade(reference.stepped(placed, along)))).sum()
    product = (gradient.double() * move).sum().to(image)
    return {GEOMETRY: error(image.T, shade(placed)), VERTEX_GRADIENT: error(product, np.asarray(slope))}


def of_harmonics(directions: Tensor, degrees: Iterable[int]) -> Errors:
    """Of basis, gradient and the gradient of a sum that autograd makes: the worst of directions (N, 3) and degrees.

    Gradients count relative to each direction's own, since they fall with its length.
    """
    degrees = list(degrees)
    wide = exact(directions.double().numpy()).T
    basis_to, gradient_to = reference.basis(wide, max(degrees)), reference.basis_gradient(wide, max(degrees))
    largest = torch.finfo(directions.dtype).max

    def by_direction(ours: Tensor, theirs: np.ndarray) -> Error:
        pairs = zip(ours, theirs.clip(-largest, largest), strict=True)
        return max((error(*pair) for pair in pairs), key=lambda e: e.units)

    def at(degree: int) -> Errors:
        rows = directions.clone().requires_grad_()
        upstream = _upstream((degree + 1) ** 2)[:, 0].to(directions)
        values, slopes = basis(rows, degree), basis_gradient(directions, degree)
        (summed,) = torch.autograd.grad(values @ upstream, rows, torch.ones_like(rows[:, 0]))
        kept = gradient_to[:, : values.shape[1]]
        sums = (kept * exact(upstream.double().numpy())[:, None]).sum(axis=1)
        return {
            "basis": error(values, basis_to[:, : values.shape[1]]),
            "gradient": by_direction(slopes, kept),
            "gradient by autograd": by_direction(summed, sums),
        }

    return worst(at(degree) for degree in degrees)


def _upstream(rows: int, seed: int = 0) -> Tensor:
    """(rows, 3) multiples of 1/64 in [-1, 1], which every number type holds exactly."""
    return torch.randint(-64, 65, (rows, 3), generator=torch.Generator().manual_seed(seed)) / 64.0


def _albedo(setup: Setup, fragments: Fragments) -> Tensor:
    return surface_albedo(setup.mesh, fragments, setup.settings.encoding)
