"""Accuracy of the renderer under numerically hard conditions, against wider numbers.

An error is the largest difference anywhere in an image or gradient, divided by the largest
magnitude in it, in units of ε, the spacing of the number type at 1.

    python tests/renderer/test_accuracy.py [--quick]

The command prints the tables as Markdown, in some minutes. --quick uses the sizes of the test.
"""

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import extended_precision as wide
import hard_meshes as hard
import numpy as np
import pytest
import torch
from extended_precision import exact, extended
from oracles import draw, scipy_basis
from torch import Tensor

from renderer.camera import OrthographicCamera
from renderer.light.basis import Harmonics
from renderer.light.files import ambient
from renderer.light.harmonics import basis
from renderer.mesh import Mesh, normalize
from renderer.operators import rays
from renderer.operators.build import build_operators
from renderer.operators.rays import Surface
from renderer.settings import ImageSettings
from renderer.surface.albedo import surface_albedo
from renderer.surface.shading import radiance
from renderer.visibility import Rasterizer, choose
from renderer.visibility.fragments import Fragments, build_fragments

CAMERA = OrthographicCamera(polar=57.3, azimuth=28.6, width=2.2)
TOWARDS = CAMERA.axes()[2]
SETTINGS = ImageSettings(size=16, samples=2)
RASTERIZER = choose("numpy")
DTYPES = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
QUICK = {"degree": 6, "subdivisions": 2, "size": 64, "slivers": 1}
FULL = {"degree": 20, "subdivisions": 8, "size": 4096, "slivers": 16}

# Errors in units of ε by the name of the quantity.
Errors = dict[str, float]


@dataclass(frozen=True)
class Case:
    """Row of a table: the largest errors of all subjects, and a bound on them in units of ε."""

    name: str
    bound: float
    measure: Callable[[Any], Errors]
    subjects: Iterable[Any]

    def errors(self) -> Errors:
        return largest_errors([self.measure(subject) for subject in self.subjects])


def largest_errors(measured: Sequence[Errors]) -> Errors:
    return {name: max(errors[name] for errors in measured) for name in measured[0]}


def random_light(degree: int = 6) -> Tensor:
    """Draw coefficients of order one, also in the bands that no diffuse surface reflects."""
    return draw((degree + 1) ** 2, 3, seed=degree)


@dataclass(frozen=True)
class Setup:
    """Scene that is rendered in `dtype`, and computed by the reference from rounded values."""

    mesh: Mesh
    light: Tensor = field(default_factory=random_light)
    vertices: np.ndarray | None = None
    camera: OrthographicCamera = CAMERA
    settings: ImageSettings = SETTINGS
    rasterizer: Rasterizer = RASTERIZER
    dtype: torch.dtype = torch.float64
    lift: Callable[..., Any] = extended

    @property
    def degree(self) -> int:
        return round(len(self.light) ** 0.5) - 1

    def shaded_vertices(self) -> Tensor:
        """Return the vertices (V, 3) that are shaded, rounded to the type."""
        vertices = self.mesh.vertices if self.vertices is None else self.vertices
        return torch.from_numpy(vertices).to(self.dtype)

    def view(self) -> wide.View:
        mesh = self.mesh
        samples = self.settings.samples
        points = self.camera.project(mesh.vertices)
        is_cut_open = bool((points[:, 2] < -1).any())
        resolution = self.settings.size * samples
        closed = mesh.closed and not is_cut_open
        [ids] = self.rasterizer.rasterize(points[None], mesh.faces, resolution, closed)
        shaded = (self.shaded_vertices().double().numpy(), mesh.faces)
        albedo = mesh.corner_colors[:, 0].astype(np.float64)
        towards = self.camera.axes()[2]
        return wide.view(ids, samples, mesh.vertices, *shaded, albedo, towards, self.lift)

    def fragments(self) -> Fragments:
        mesh = self.mesh
        [fragments] = build_fragments(
            mesh.vertices, mesh.faces, [self.camera], self.settings, self.rasterizer, mesh.closed
        )
        return fragments

    def lifted(self, values: Tensor) -> np.ndarray:
        return self.lift(values.double().numpy())


def harmonics_cases(degree: int) -> Iterator[Case]:
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 3)))
    every_degree = partial(harmonics_errors, degrees=range(1, degree + 1))
    last_degree = partial(harmonics_errors, degrees=[degree])
    degree_6 = partial(harmonics_errors, degrees=[6])
    degree_1 = partial(harmonics_errors, degrees=[1])
    # A recurrence adds a rounding error per band.
    rounding = 8.0 * degree
    yield Case(f"degree 1 to {degree}, float64", rounding, every_degree, [directions])

    narrow = [directions.to(dtype) for dtype in DTYPES[1:]]
    yield Case(f"degree 1 to {degree}, narrower types", 1, every_degree, narrow)

    near_poles = f"0 and 10⁻¹ to 10⁻³⁰⁰ rad from a pole, degree {degree}"
    yield Case(near_poles, rounding, last_degree, [directions_near_poles()])

    lengths = torch.tensor([1e-29, 1e-15, 1e-3, 1e3, 1e15, 1e29])
    scaled = directions * lengths[:, None]
    yield Case("lengths of 10⁻²⁹ to 10²⁹, degree 6", 16, degree_6, [scaled])

    units = directions / directions.norm(dim=1, keepdim=True)
    denormal = []
    for dtype in (torch.float64, torch.float32):
        denormal.append(units.to(dtype) * (torch.finfo(dtype).smallest_normal / 2))
    half_normal = "half the smallest normal length, float64 and float32, degree 1"
    yield Case(half_normal, 4, degree_1, denormal)


def directions_near_poles() -> Tensor:
    angles = torch.tensor([0, 0, 1e-1, 1e-4, 1e-8, 1e-300], dtype=torch.float64)
    poles = torch.tensor([1, -1, 1, -1, 1, -1], dtype=torch.float64)
    return torch.stack([0.6 * angles, 0.8 * angles, poles], dim=1)


def mesh_cases(subdivisions: int) -> Iterator[Case]:
    ball = hard.sphere()
    yield Case("dented sphere of 320 faces, radius 1", 8, all_errors, [Setup(ball)])
    yield from placement_cases(ball)
    yield from topology_cases(ball)
    # Sums over many pixels with terms of either sign cost digits.
    fine = ImageSettings(size=256, samples=1)
    # A generator makes the large mesh when it is needed.
    large = (Setup(hard.sphere(count), settings=fine) for count in [subdivisions])
    yield Case(f"{20 * 4**subdivisions:,} faces at 256²", 64, all_errors, large)


def placement_cases(ball: Mesh) -> Iterator[Case]:
    scaled = [moved(ball.vertices * 10.0**power) for power in (-6, -3, 3, 6)]
    yield Case("scaled by 10⁻⁶, 10⁻³, 10³ and 10⁶", 8, all_errors, scaled)

    offsets = 1e6 * np.array([[1, 0, 0], [0, -1, 0], [1, -1, 1]])
    offset = [moved(ball.vertices + offset) for offset in offsets]
    yield Case("moved by 10⁶", 8, all_errors, offset)


def topology_cases(ball: Mesh) -> Iterator[Case]:
    flat = Setup(hard.with_faces_without_area(ball))
    yield Case("three faces without area beside each", 12, all_errors, [flat])

    merged = ball.vertices.copy()
    for face in ball.faces[::9]:
        merged[face[1]] = merged[face[2]]
    collapsed = Setup(ball, vertices=merged)
    yield Case("faces that lose their area after rasterization", 8, geometry_errors, [collapsed])

    yield Case("open, its inside visible", 8, all_errors, [Setup(hard.opened(ball))])


def thin_face_cases(count: int) -> Iterator[Case]:
    double = [thin_faces(power, count, torch.float64) for power in (2, 4, 6, 8, 10, 12)]
    yield Case("height / edge of 10⁻² to 10⁻¹²", 8, all_errors, double)
    single = [thin_faces(power, count, torch.float32) for power in (4, 6, 12)]
    yield Case("height / edge of 10⁻⁴ to 10⁻¹², float32", 8, all_errors, single)


def thin_faces(power: int, count: int, dtype: torch.dtype) -> Setup:
    """Return triangles of height 10^-power, with a sample for each triangle."""
    mesh = rounded(hard.slivers(10.0**-power, count, TOWARDS), dtype)
    size = math.ceil(math.sqrt(len(mesh.faces)))
    settings = ImageSettings(size=size, samples=1)
    return Setup(mesh, settings=settings, rasterizer=hard.Chart(), lift=exact, dtype=dtype)


def light_cases(degree: int) -> Iterator[Case]:
    scaled = [lit(random_light() * 10.0**power) for power in (-8, -4, 4, 8, 11)]
    yield Case("coefficients of 10⁻⁸ to 10¹¹", 8, all_errors, scaled)
    negative = [lit(-random_light().abs()), lit(ambient(-torch.ones(3)))]
    yield Case("coefficients, or all radiance, negative", 8, all_errors, negative)
    boxes = []
    for dtype in (torch.float64, torch.float32):
        box = rounded(hard.box(), dtype)
        for l in range(degree + 1):
            boxes.append(Setup(box, random_light(l), dtype=dtype, lift=exact))
    yield Case(f"degree 0 to {degree} on a box, float64 and float32", 12, all_errors, boxes)


def lit(light: Tensor) -> Setup:
    return Setup(rounded(hard.sphere(), torch.float32), light, dtype=torch.float32)


def number_type_cases() -> Iterator[Case]:
    for dtype in DTYPES:
        bound = 1 if torch.finfo(dtype).bits == 16 else 8
        setup = Setup(rounded(hard.sphere(), dtype), dtype=dtype)
        measure = partial(all_errors, dtype=dtype)
        yield Case(str(dtype).removeprefix("torch."), bound, measure, [setup])


def image_cases(size: int) -> Iterator[Case]:
    ball = hard.sphere()
    one_sample = Setup(ball, settings=ImageSettings(size=1, samples=1))
    many_samples = Setup(ball, settings=ImageSettings(size=1, samples=16))
    yield Case("1 × 1, 1 and 256 samples", 8, all_errors, [one_sample, many_samples])

    large = Setup(ball, settings=ImageSettings(size=size, samples=1), camera=framing(6.0))
    # Sums over many pixels have terms of either sign.
    yield Case(f"{size} × {size}", 8 + size / 16, all_errors, [large])

    around = replace(ball, vertices=1.5 * ball.vertices + 1.2 * TOWARDS)
    yield Case("the camera inside the mesh", 8, all_errors, [Setup(around)])
    close_up = Setup(ball, camera=framing(1e-3))
    yield Case("a mesh far larger than the frame", 8, all_errors, [close_up])


def shadow_cases() -> Iterator[Case]:
    # The dents of this sphere shade each other.
    lumpy = Setup(hard.sphere(1, lowest=0.5))
    heap = "open, self-touching, of several parts"
    yield Case(heap, 8, shadow_errors, [Setup(hard.heap())])
    yield Case("thin boards, 0.03 apart", 8, shadow_errors, [Setup(hard.boards())])
    in_double = partial(shadow_errors, dtype=torch.float64)
    yield Case("closed and lumpy, float64", 8, in_double, [lumpy])


def tables(degree: int, subdivisions: int, size: int, slivers: int) -> dict[str, Iterator[Case]]:
    """Return the rows of each table by its title. `slivers` thin triangles are of each kind."""
    return {
        "Spherical harmonics": harmonics_cases(degree),
        "Meshes": mesh_cases(subdivisions),
        "Thin faces": thin_face_cases(slivers),
        "Lights": light_cases(degree),
        "Number types": number_type_cases(),
        "Images and cameras": image_cases(size),
        "Shadows": shadow_cases(),
    }


def framing(width: float) -> OrthographicCamera:
    return replace(CAMERA, width=width)


def rounded(mesh: Mesh, dtype: torch.dtype) -> Mesh:
    vertices = torch.from_numpy(mesh.vertices).to(dtype).double().numpy()
    return replace(mesh, vertices=vertices)


def moved(vertices: np.ndarray) -> Setup:
    """Return the sphere with other vertices, which the shading takes as they are."""
    return Setup(normalize(replace(hard.sphere(), vertices=vertices)), vertices=vertices)


def units(ours: Tensor, reference: np.ndarray) -> float:
    """Return the largest error by the largest magnitude, in ε, or infinity if not finite."""
    values = ours.detach().double().numpy()
    if values.shape != reference.shape or not np.isfinite(values).all():
        return math.inf
    if not values.size:
        return 0.0
    wide_values = exact(values) if wide.is_exact(reference) else extended(values)
    largest_error = abs(wide_values - reference).max()
    largest_magnitude = abs(reference).max() or 1
    return float(largest_error / largest_magnitude) / torch.finfo(ours.dtype).eps


def all_errors(setup: Setup, dtype: torch.dtype = torch.float32) -> Errors:
    return operator_errors(setup, dtype) | geometry_errors(setup)


def operator_errors(setup, dtype=torch.float32, lost=None) -> Errors:
    """Measure the errors of an operator's image and light gradient, without `lost` radiance."""
    scene = (setup.mesh, [setup.camera], setup.settings, setup.rasterizer)
    [operator] = build_operators(*scene, basis=Harmonics(setup.degree), dtype=dtype)
    view = setup.view()
    light = setup.light.to(dtype)
    upstream = random_upstream(len(view.pixels))
    wide_light = setup.lifted(light)
    wide_upstream = setup.lifted(upstream)
    image = wide.image(view, wide_light)
    gradient = wide.light_gradient(view, wide_upstream, setup.degree)
    if lost is not None:
        image = image - (lost * wide_light).sum(axis=1)
        gradient = gradient - (lost * wide_upstream[:, None]).sum(axis=0)
    found_gradient = operator.light_gradient(upstream.to(dtype).T)
    return {
        "image": units(operator.radiance(light).T, image),
        "light gradient": units(found_gradient, gradient),
    }


def geometry_errors(setup: Setup) -> Errors:
    view = setup.view()
    vertices = setup.shaded_vertices().requires_grad_()
    light = setup.light.to(setup.dtype)
    fragments = setup.fragments()
    upstream = random_upstream(len(view.pixels))
    albedo = surface_albedo(setup.mesh, fragments, "linear")
    image = radiance(fragments, vertices, light, albedo)
    (gradient,) = torch.autograd.grad(image, vertices, upstream.T.to(image))

    wide_light = setup.lifted(light)
    wide_upstream = setup.lifted(upstream)
    wide_image = wide.image(view, wide_light)
    wide_gradient = wide.vertex_gradient(view, wide_upstream, wide_light, len(vertices))
    return {
        "image by geometry": units(image.T, wide_image),
        "vertex gradient": units(gradient, wide_gradient),
    }


def shadow_errors(setup: Setup, dtype: torch.dtype = torch.float32) -> Errors:
    """Measure the errors of an operator with shadows, from the renderer's origins of rays."""
    mesh = setup.mesh
    settings = replace(setup.settings, samples=1, shadows=True)
    setup = replace(setup, settings=settings)
    surface = Surface(mesh, setup.fragments(), settings)
    offsets = rays.Rays(mesh).offset * surface.planes
    points = extended((surface.points + offsets).numpy())
    corners = extended(mesh.vertices[mesh.faces])
    directions = extended(rays.sphere(rays.DIRECTIONS).numpy())
    lost = wide.shadow(setup.view(), points, corners, directions, setup.degree)
    return operator_errors(setup, dtype, lost)


def harmonics_errors(directions: Tensor, degrees: Sequence[int]) -> Errors:
    """Measure the largest errors of the harmonics, and of a gradient relative to its direction."""
    wide_directions = exact(directions.double().numpy()).T
    wide_values = wide.basis(wide_directions, max(degrees))
    wide_gradient = wide.basis_gradient(wide_directions, max(degrees))
    measured = []
    for degree in degrees:
        count = (degree + 1) ** 2
        upstream = random_upstream(count)[:, 0]
        wide_upstream = exact(upstream.double().numpy())
        expected_gradient = (wide_gradient[:, :count] * wide_upstream[:, None]).sum(axis=1)

        variable = directions.clone().requires_grad_()
        values = basis(variable, degree)
        total = (values @ upstream.to(directions)).sum()
        (gradient,) = torch.autograd.grad(total, variable)
        by_direction = [units(*pair) for pair in zip(gradient, expected_gradient, strict=True)]
        errors = {"basis": units(values, wide_values[:, :count]), "gradient": max(by_direction)}
        measured.append(errors)
    return largest_errors(measured)


def random_upstream(rows: int) -> Tensor:
    """Draw multiples (rows, 3) of 1/64 in [-1, 1], which every number type holds exactly."""
    generator = torch.Generator().manual_seed(0)
    return torch.randint(-64, 65, (rows, 3), generator=generator) / 64.0


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=f"{title}: {case.name}")
        for title, cases in tables(**QUICK).items()
        for case in cases
    ],
)
def test_every_error_is_rounding(case):
    """Errors are a few ε, and more if thousands of pixels or hundreds of harmonics cancel."""
    errors = case.errors()
    assert errors
    # The comparison is written so that NaN is too large.
    too_large = {name: error for name, error in errors.items() if not error <= case.bound}
    assert too_large == {}


@pytest.mark.parametrize("lift", [extended, exact], ids=["extended", "exact"])
def test_the_references_harmonics_are_scipys_without_the_condon_shortley_sign(lift):
    directions = np.random.default_rng(0).normal(size=(20, 3))
    values = wide.basis(lift(directions.T), 6).astype(float)
    # The tolerance is the rounding error of SciPy.
    np.testing.assert_allclose(values, scipy_basis(directions, 6), rtol=0, atol=1e-14)


def main() -> int:
    """Print the tables, and return 1 if an error, which is then bold, is beyond its bound."""
    torch.set_num_threads(1)
    status = 0
    for title, cases in tables(**(QUICK if "--quick" in sys.argv else FULL)).items():
        measured = {case.name: (case.bound, case.errors()) for case in cases}
        # A dictionary keeps the order.
        quantities = dict.fromkeys(name for _, errors in measured.values() for name in errors)
        rows = [[title, *quantities], ["-"] * (1 + len(quantities))]
        for case, (bound, errors) in measured.items():
            is_beyond = {name: not error <= bound for name, error in errors.items()}
            status |= any(is_beyond.values())
            cells = [f"{errors[name]:.3g}" if name in errors else "–" for name in quantities]
            marks = ["**" if is_beyond.get(name) else "" for name in quantities]
            rows.append([case, *(m + cell + m for m, cell in zip(marks, cells, strict=True))])
        print("\n".join(f"|{'|'.join(cells)}|" for cells in rows), end="\n\n", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
