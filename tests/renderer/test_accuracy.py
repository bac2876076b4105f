"""The renderer under numerically hard conditions, against a second implementation in wider numbers.

Errors are the largest difference anywhere in an image or gradient over the largest magnitude in it, in units of ε, the
spacing at 1 of the number type. Gradients are of Σ upstream × image, with random upstream gradients of either sign.

    python tests/renderer/test_accuracy.py            # prints the tables as Markdown, in some minutes
    python tests/renderer/test_accuracy.py --quick    # with the sizes of the test
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
from oracles import scipy_basis
from torch import Tensor

from renderer.camera import OrthographicCamera
from renderer.geometry.mesh import Mesh, normalize
from renderer.light.basis import Harmonics
from renderer.light.harmonics import basis
from renderer.light.presets import ambient
from renderer.settings import ImageSettings
from renderer.shading.shading import radiance
from renderer.surface.albedo import surface_albedo
from renderer.transport import rays
from renderer.transport.operators import build_operators
from renderer.transport.rays import Surface
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import Rasterizer, choose

CAMERA = OrthographicCamera(polar=57.3, azimuth=28.6, width=2.2)
TOWARDS = CAMERA.axes()[2]
SETTINGS = ImageSettings(size=16, samples=2)
RASTERIZER = choose("numpy")
DTYPES = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
QUICK = {"degree": 6, "subdivisions": 2, "size": 64, "slivers": 1}
FULL = {"degree": 20, "subdivisions": 8, "size": 4096, "slivers": 16}

Errors = dict[str, float]  # quantity → units of ε
# The condition, the bound on every error, what measures it, and setups or directions, of which the worst counts.
Case = tuple[str, float, Callable[[Any], Errors], Iterable[Any]]


def light(degree: int = 6) -> Tensor:
    """Coefficients of order one, also in the bands that no diffuse surface reflects."""
    return torch.randn(
        (degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(degree), dtype=torch.float64
    )


@dataclass(frozen=True)
class Setup:
    """One scene. vertices: the shaded ones, if not the mesh's. They and the light are given to the renderer in `dtype`,
    and to the reference with that rounding."""

    mesh: Mesh
    light: Tensor = field(default_factory=light)
    vertices: np.ndarray | None = None
    camera: OrthographicCamera = CAMERA
    settings: ImageSettings = SETTINGS
    rasterizer: Rasterizer = RASTERIZER
    dtype: torch.dtype = torch.float64
    lift: Callable[..., Any] = extended

    @property
    def degree(self) -> int:
        return round(len(self.light) ** 0.5) - 1

    def shaded(self) -> Tensor:
        """(V, 3) in the dtype."""
        return torch.from_numpy(self.mesh.vertices if self.vertices is None else self.vertices).to(
            self.dtype
        )

    def view(self) -> wide.View:
        mesh, samples = self.mesh, self.settings.samples
        points = self.camera.project(mesh.vertices)
        closed = mesh.closed and bool((points[:, 2] >= -1).all())
        [ids] = self.rasterizer.rasterize(
            points[None], mesh.faces, self.settings.size * samples, closed=closed
        )
        albedo, vertices = (
            mesh.corner_colors[:, 0].astype(np.float64),
            self.shaded().double().numpy(),
        )
        return wide.view(
            ids,
            samples,
            mesh.vertices,
            vertices,
            mesh.faces,
            albedo,
            self.camera.axes()[2],
            self.lift,
        )

    def fragments(self) -> Fragments:
        mesh = self.mesh
        return build_fragments(
            mesh.vertices, mesh.faces, [self.camera], self.settings, self.rasterizer, mesh.closed
        )[0]


# ---------------------------------------------------------------------------- conditions


def of_harmonics(degree: int) -> Iterator[Case]:
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 3)))
    units = directions / directions.norm(dim=1, keepdim=True)
    tilts = [(0, 1), (0, -1), (1e-1, 1), (1e-4, -1), (1e-8, 1), (1e-300, -1)]
    poles = torch.tensor(
        [[0.6 * tilt, 0.8 * tilt, pole] for tilt, pole in tilts], dtype=torch.float64
    )
    signed = torch.tensor(
        [[-0.0, 0.0, 1.0], [0.0, -0.0, -1.0], [-0.0, 1.0, -0.0], [-1.0, -0.0, 0.0]]
    ).double()
    lengths = directions * torch.tensor([[1e-29], [1e-15], [1e-3], [1e3], [1e15], [1e29]])
    denormal = [units.to(dtype) * (torch.finfo(dtype).smallest_normal / 2) for dtype in DTYPES[:2]]
    rounding = 8.0 * degree  # a recurrence adds a rounding per band
    every, last, low, first = (
        partial(harmonics_errors, degrees=d) for d in (range(1, degree + 1), [degree], [6], [1])
    )
    yield f"degree 1 to {degree}, float64", rounding, every, [directions]
    yield (
        f"degree 1 to {degree}, narrower types",
        1,
        every,
        [directions.to(dtype) for dtype in DTYPES[1:]],
    )
    yield f"0 and 10⁻¹ to 10⁻³⁰⁰ rad from a pole, degree {degree}", rounding, last, [poles]
    yield f"components of −0, degree {degree}", rounding, last, [signed]
    yield "lengths of 10⁻²⁹ to 10²⁹, degree 6", 16, low, [lengths]
    yield "half the smallest normal length, float64 and float32, degree 1", 4, first, denormal
    yield "a direction of zero, degree 6", 1, low, [torch.zeros(1, 3, dtype=torch.float64)]


def of_meshes(subdivisions: int) -> Iterator[Case]:
    ball = hard.sphere()
    twice = hard.painted(ball.vertices, np.concatenate([ball.faces, ball.faces[:, ::-1]]))
    offsets = [1e6 * np.array(axis) for axis in ([1, 0, 0], [0, -1, 0], [1, -1, 1])]
    small = Setup(replace(ball, vertices=1e-6 * ball.vertices), camera=framing(1e-6 * CAMERA.width))
    yield "dented sphere of 320 faces, radius 1", 8, both, [Setup(ball)]
    scaled = [moved(ball.vertices * 10.0**power) for power in (-6, -3, 3, 6)]
    yield "scaled by 10⁻⁶, 10⁻³, 10³ and 10⁶", 8, both, scaled
    yield "scaled by 10⁻⁶, not normalized, in as small a frame", 8, both, [small]
    yield "moved by 10⁶", 8, both, [moved(ball.vertices + offset) for offset in offsets]
    rounded_vertices = [moved(ball.vertices + offset, torch.float32) for offset in offsets]
    yield "moved by 10⁶, float32 vertices, which are 1/16 apart there", 8, both, rounded_vertices
    unseen = [
        Setup(replace(ball, vertices=vertices))
        for vertices in (ball.vertices * 1e6, ball.vertices + 1e6)
    ]
    yield "scaled or moved by 10⁶, not normalized: an empty image", 0, both, unseen
    yield (
        "three faces without area beside each",
        12,
        both,
        [Setup(hard.with_faces_without_area(ball))],
    )
    merged = ball.vertices.copy()
    for face in ball.faces[::9]:
        merged[face[1]] = merged[face[2]]
    yield (
        "faces that lose their area after rasterization",
        8,
        by_geometry,
        [Setup(ball, vertices=merged)],
    )
    yield "every face twice", 8, both, [Setup(twice)]
    yield "inverted winding", 8, both, [Setup(hard.painted(ball.vertices, ball.faces[:, ::-1]))]
    yield "open, its inside visible", 8, both, [Setup(hard.opened(ball))]
    yield (
        "not manifold: three faces on an edge, two solids in a point",
        8,
        both,
        [Setup(hard.non_manifold())],
    )
    yield "a single triangle", 8, both, [Setup(hard.TRIANGLE)]
    fine = ImageSettings(
        size=256, samples=1
    )  # sums over many pixels with terms of either sign cost digits
    name = f"{20 * 4**subdivisions:,} faces at 256²"
    yield name, 64, both, (Setup(hard.sphere(count), settings=fine) for count in [subdivisions])


def of_thin_faces(count: int) -> Iterator[Case]:
    heights = {power: hard.slivers(10.0**-power, count, TOWARDS) for power in (2, 4, 6, 8, 10, 12)}

    def setup(mesh: Mesh, dtype: torch.dtype) -> Setup:
        settings = ImageSettings(size=math.ceil(math.sqrt(len(mesh.faces))), samples=1)
        return Setup(mesh, settings=settings, rasterizer=hard.Chart(), lift=exact, dtype=dtype)

    double = [setup(mesh, torch.float64) for mesh in heights.values()]
    yield "height / edge of 10⁻² to 10⁻¹²", 8, both, double
    single = [setup(rounded(heights[power], torch.float32), torch.float32) for power in (4, 6, 12)]
    yield "height / edge of 10⁻⁴ to 10⁻¹², float32", 8, both, single


def of_lights(degree: int) -> Iterator[Case]:
    ball = rounded(hard.sphere(), torch.float32)

    def lit(*lights: Tensor) -> list[Setup]:
        return [Setup(ball, coefficients, dtype=torch.float32) for coefficients in lights]

    scaled = lit(*(light() * 10.0**power for power in (-8, -4, 4, 8, 11)))
    yield "coefficients of 10⁻⁸ to 10¹¹", 8, both, scaled
    negative = lit(-light().abs(), ambient(-torch.ones(3)))
    yield "coefficients, or all radiance, negative", 8, both, negative
    yield "all coefficients zero", 8, both, lit(0 * light())
    boxes = [Setup(rounded(hard.box(), dtype), dtype=dtype, lift=exact) for dtype in DTYPES[:2]]
    every = [replace(box, light=light(l)) for box in boxes for l in range(degree + 1)]
    yield f"degree 0 to {degree} on a box, float64 and float32", 12, both, every


def of_number_types() -> Iterator[Case]:
    for dtype in DTYPES:
        bound = 1 if torch.finfo(dtype).bits == 16 else 8
        setup = Setup(rounded(hard.sphere(), dtype), dtype=dtype)
        yield (
            str(dtype).removeprefix("torch."),
            bound,
            lambda scene: both(scene, scene.dtype),
            [setup],
        )


def of_images(size: int) -> Iterator[Case]:
    ball = hard.sphere()
    tiny = [Setup(ball, settings=ImageSettings(size=1, samples=samples)) for samples in (1, 16)]
    yield "1 × 1, 1 and 256 samples", 8, both, tiny
    large = Setup(ball, settings=ImageSettings(size=size, samples=1), camera=framing(6.0))
    yield (
        f"{size} × {size}",
        8 + size / 16,
        both,
        [large],
    )  # sums over many pixels with terms of either sign
    around = replace(ball, vertices=1.5 * ball.vertices + 1.2 * TOWARDS)
    yield "the camera inside the mesh", 8, both, [Setup(around)]
    yield "a mesh far larger than the frame", 8, both, [Setup(ball, camera=framing(1e-3))]
    aside, behind = (
        replace(ball, vertices=ball.vertices + 10 * axis) for axis in (CAMERA.axes()[0], TOWARDS)
    )
    edge_on = hard.painted([-0.5 * TOWARDS, 0.5 * TOWARDS, 0.5 * CAMERA.axes()[1]], [[0, 1, 2]])
    unseen = list(map(Setup, (aside, behind, edge_on)))
    yield "outside the frame, behind the camera, edge on: an empty image", 0, both, unseen


def of_shadows() -> Iterator[Case]:
    lumpy = hard.sphere(1, lowest=0.5)  # its dents shade each other
    small = Setup(
        replace(lumpy, vertices=1e-3 * lumpy.vertices), camera=framing(1e-3 * CAMERA.width)
    )
    yield "closed and lumpy", 8, with_shadows, [Setup(lumpy)]
    yield "open, self-touching, of several parts", 8, with_shadows, [Setup(hard.heap())]
    yield "thin boards, 0.03 apart", 8, with_shadows, [Setup(hard.boards())]
    yield "open, its inside visible", 8, with_shadows, [Setup(hard.opened(hard.sphere(1)))]
    yield "not manifold", 8, with_shadows, [Setup(hard.non_manifold())]
    yield "convex", 8, with_shadows, [Setup(hard.box())]
    yield "scaled by 10⁻³, not normalized", 8, with_shadows, [small]
    yield (
        "closed and lumpy, float64",
        8,
        lambda scene: with_shadows(scene, torch.float64),
        [Setup(lumpy)],
    )


def tables(degree: int, subdivisions: int, size: int, slivers: int) -> dict[str, Iterator[Case]]:
    return {
        "Spherical harmonics": of_harmonics(degree),
        "Meshes": of_meshes(subdivisions),
        "Thin faces": of_thin_faces(slivers),
        "Lights": of_lights(degree),
        "Number types": of_number_types(),
        "Images and cameras": of_images(size),
        "Shadows": of_shadows(),
    }


def worst(measure: Callable[[Any], Errors], several: Iterable[Any]) -> Errors:
    results = list(map(measure, several))
    return {name: max(errors[name] for errors in results) for name in results[0]}


def framing(width: float) -> OrthographicCamera:
    return replace(CAMERA, width=width)


def rounded(mesh: Mesh, dtype: torch.dtype) -> Mesh:
    return replace(mesh, vertices=torch.from_numpy(mesh.vertices).to(dtype).double().numpy())


def moved(vertices: np.ndarray, dtype: torch.dtype = torch.float64) -> Setup:
    """The sphere with other vertices, rounded to a dtype: normalized for the camera, as they are for the shading."""
    mesh = rounded(replace(hard.sphere(), vertices=vertices), dtype)
    return Setup(normalize(mesh), vertices=mesh.vertices, dtype=dtype)


# ---------------------------------------------------------------------------- measurement


def units(ours: Tensor, reference: np.ndarray) -> float:
    """The largest error over the largest magnitude (or over 1 where all is zero), in ε; infinite for NaN and ∞."""
    values = ours.detach().double().numpy()
    if values.shape != reference.shape or not np.isfinite(values).all():
        return math.inf
    if not values.size:
        return 0.0
    values = exact(values) if reference.dtype == object else extended(values)
    relative = abs(values - reference).max() / (abs(reference).max() or 1)
    return float(relative) / torch.finfo(ours.dtype).eps


def both(setup: Setup, dtype: torch.dtype = torch.float32) -> Errors:
    return by_operator(setup, dtype) | by_geometry(setup)


def by_operator(
    setup: Setup, dtype: torch.dtype = torch.float32, lost: np.ndarray | None = None
) -> Errors:
    """Image and its gradient by the light, through an operator in `dtype`. lost: (P, (degree + 1)², 3) what the image
    loses to shadows per unit of each coefficient."""
    [operator] = build_operators(
        setup.mesh,
        [setup.camera],
        setup.settings,
        setup.rasterizer,
        basis=Harmonics(setup.degree),
        dtype=dtype,
    )
    view, light = setup.view(), setup.light.to(dtype)
    upstream = random_upstream(len(view.pixels))
    lit, above = setup.lift(light.double().numpy()), setup.lift(upstream.double().numpy())
    image, gradient = wide.image(view, lit), wide.light_gradient(view, above, setup.degree)
    if lost is not None:
        image, gradient = (
            image - (lost * lit).sum(axis=1),
            gradient - (lost * above[:, None]).sum(axis=0),
        )
    return {
        "image": units(operator.radiance(light).T, image),
        "light gradient": units(operator.light_gradient(upstream.to(dtype).T), gradient),
    }


def by_geometry(setup: Setup) -> Errors:
    """Image and its gradient by the vertices, through `renderer.shading.shading`."""
    view, vertices, light = (
        setup.view(),
        setup.shaded().requires_grad_(),
        setup.light.to(setup.dtype),
    )
    fragments, upstream = setup.fragments(), random_upstream(len(view.pixels))
    image = radiance(fragments, vertices, light, surface_albedo(setup.mesh, fragments, "linear"))
    (gradient,) = torch.autograd.grad(image, vertices, upstream.T.to(image))
    light, above = (setup.lift(part.double().numpy()) for part in (light, upstream))
    return {
        "image by geometry": units(image.T, wide.image(view, light)),
        "vertex gradient": units(gradient, wide.vertex_gradient(view, above, light, len(vertices))),
    }


def with_shadows(setup: Setup, dtype: torch.dtype = torch.float32) -> Errors:
    """`by_operator` with one sample per pixel, which then casts all rays, whose origins are the renderer's."""
    mesh, setup = (
        setup.mesh,
        replace(setup, settings=replace(setup.settings, samples=1, shadows=True)),
    )
    view, directions = setup.view(), extended(rays.sphere(rays.DIRECTIONS).numpy())
    surface = Surface(mesh, setup.fragments(), setup.settings)
    points = extended((surface.points + rays.Rays(mesh).offset * surface.planes).numpy())
    lost = wide.shadow(view, points, extended(mesh.vertices[mesh.faces]), directions, setup.degree)
    return by_operator(setup, dtype, lost)


def harmonics_errors(directions: Tensor, degrees: Sequence[int]) -> Errors:
    """Basis and the gradient of a sum: the worst of directions (N, 3) and degrees.

    Gradients count relative to each direction's own, since they fall with its length.
    """
    rows = exact(directions.double().numpy()).T
    values_to, gradient_to = wide.basis(rows, max(degrees)), wide.basis_gradient(rows, max(degrees))

    def at(degree: int) -> Errors:
        variable = directions.clone().requires_grad_()
        upstream = random_upstream((degree + 1) ** 2)[:, 0].to(directions)
        values = basis(variable, degree)
        (summed,) = torch.autograd.grad(
            values @ upstream, variable, torch.ones_like(variable[:, 0])
        )
        gradient = gradient_to[:, : values.shape[1]]
        sums = (gradient * exact(upstream.double().numpy())[:, None]).sum(axis=1)
        return {
            "basis": units(values, values_to[:, : values.shape[1]]),
            "gradient": max(units(*pair) for pair in zip(summed, sums, strict=True)),
        }

    return worst(at, degrees)


def random_upstream(rows: int, seed: int = 0) -> Tensor:
    """(rows, 3) multiples of 1/64 in [-1, 1], which every number type holds exactly."""
    return torch.randint(-64, 65, (rows, 3), generator=torch.Generator().manual_seed(seed)) / 64.0


# ---------------------------------------------------------------------------- tests


@pytest.mark.parametrize(
    "bound, measure, setups",
    [
        pytest.param(*case, id=f"{title}: {name}")
        for title, cases in tables(**QUICK).items()
        for name, *case in cases
    ],
)
def test_every_error_is_rounding(bound, measure, setups):
    """A few ε each, more where many terms cancel: thousands of pixels, hundreds of harmonics."""
    errors = worst(measure, setups)
    assert errors and {name: error for name, error in errors.items() if not error <= bound} == {}


@pytest.mark.parametrize("lift", [extended, exact], ids=["extended", "exact"])
def test_the_references_harmonics_are_scipys_without_the_condon_shortley_sign(lift):
    directions = np.random.default_rng(0).normal(size=(20, 3))
    values = wide.basis(lift(directions.T), 6).astype(float)
    np.testing.assert_allclose(
        values, scipy_basis(directions, 6), rtol=0, atol=1e-14
    )  # scipy's own rounding


# ---------------------------------------------------------------------------- the tables


def main() -> int:
    """Print the tables, errors beyond their bounds in bold, of which there is any if the exit status is 1."""
    torch.set_num_threads(1)
    beyond = False
    for title, cases in tables(**QUICK if "--quick" in sys.argv else FULL).items():
        results = {name: (bound, worst(measure, setups)) for name, bound, measure, setups in cases}
        quantities = list(dict.fromkeys(name for _, errors in results.values() for name in errors))
        print(f"|{title}|{'|'.join(quantities)}|\n|-|{'-|' * len(quantities)}")
        for name, (bound, errors) in results.items():
            texts = {
                key: f"{error:.3g}" if error <= bound else f"**{error:.3g}**"
                for key, error in errors.items()
            }
            print(f"|{name}|{'|'.join(texts.get(key, '–') for key in quantities)}|", flush=True)
            beyond |= any(not error <= bound for error in errors.values())
        print()
    return int(beyond)


if __name__ == "__main__":
    sys.exit(main())
