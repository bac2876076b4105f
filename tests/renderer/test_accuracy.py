"""The renderer under numerically hard conditions, against a second implementation in wider numbers.

Errors are the largest difference anywhere in an image or gradient over the largest magnitude in it, in units of ε, the
spacing at 1 of the number type. Gradients are of Σ upstream × image, with random upstream gradients of either sign.

    python tests/renderer/test_accuracy.py            # prints the table as Markdown, in some minutes
    python tests/renderer/test_accuracy.py --quick    # with the sizes of the test
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import extended_precision as wide
import hard_meshes as hard
import numpy as np
import pytest
import torch
from extended_precision import exact, extended
from scipy.integrate import quad
from scipy.special import eval_legendre, sph_harm_y
from torch import Tensor

from renderer.albedo import surface_albedo
from renderer.camera import OrthographicCamera
from renderer.fragments import Fragments, build_fragments
from renderer.image import ImageSettings
from renderer.light.basis import Harmonics
from renderer.light.harmonics import basis, basis_gradient
from renderer.light.presets import ambient
from renderer.mesh import Mesh, normalize
from renderer.rasterizer import Rasterizer, choose
from renderer.shading import radiance
from renderer.transfer import build_operators
from renderer.transport import radiosity, rays
from renderer.transport.surface import Surface

RASTERIZER = choose("numpy")
CAMERA = OrthographicCamera(polar=1.0, azimuth=0.5, width=2.2)
TOWARDS = CAMERA.axes()[2]
SETTINGS = ImageSettings(size=16, samples=2)
DTYPES = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
QUICK = {"degree": 6, "subdivisions": 2, "size": 64, "slivers": 1}
FULL = {"degree": 20, "subdivisions": 8, "size": 4096, "slivers": 16}

Errors = dict[str, float]  # quantity → units of ε


@dataclass(frozen=True)
class Condition:
    """bound: on every error of `measure`. reason: what the renderer does under this condition."""

    name: str
    bound: float
    measure: Callable[[], Errors]
    reason: str


# ---------------------------------------------------------------------------- conditions


def of_harmonics(degree: int) -> Iterator[Condition]:
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 3)))
    tilts = [(0, 1), (0, -1), (1e-1, 1), (1e-4, -1), (1e-8, 1), (1e-300, -1)]
    poles = torch.tensor([[0.6 * tilt, 0.8 * tilt, pole] for tilt, pole in tilts], dtype=torch.float64)
    signed = torch.tensor([[-0.0, 0.0, 1.0], [0.0, -0.0, -1.0], [-0.0, 1.0, -0.0], [-1.0, -0.0, 0.0]]).double()
    lengths = directions * torch.tensor([[1e-29], [1e-15], [1e-3], [1e3], [1e15], [1e29]])
    units = directions / directions.norm(dim=1, keepdim=True)
    denormal = [units.to(dtype) * (torch.finfo(dtype).smallest_normal / 2) for dtype in DTYPES[:2]]
    shortest = torch.finfo(torch.float32).smallest_normal * torch.finfo(torch.float32).eps
    tiny = shortest * torch.tensor([[0.0, 0, 1], [1, -1, 1], [1, 2, 0]])

    def row(name: str, bound: float, rows: list[Tensor], degrees: Iterable[int], reason: str) -> Condition:
        return Condition(name, bound, lambda: worst(harmonics_errors(each, degrees) for each in rows), reason)

    every, rounding = range(degree + 1), 8.0 * degree  # a recurrence adds a rounding per band
    yield row(f"degree 0 to {degree}, float64", rounding, [directions], every, "Legendre recurrences in float64")
    narrow = [directions.to(dtype) for dtype in DTYPES[1:]]
    yield row(f"degree 0 to {degree}, narrower types", 1, narrow, every, "computed in float64, rounded once")
    reason = "polynomials in x, y, z: no polar angle whose derivative is infinite"
    yield row(f"0 and 10⁻¹ to 10⁻³⁰⁰ rad from a pole, degree {degree}", rounding, [poles], [degree], reason)
    yield row(f"components of −0, degree {degree}", rounding, [signed], [degree], "the same as +0")
    reason = "only the direction counts; the gradient falls with 1 / length"
    yield row("lengths of 10⁻²⁹ to 10²⁹, degree 6", 16, [lengths], [6], reason)
    name = "denormal: half the smallest normal length, float64 and float32, degree 1"
    yield row(name, 4, denormal, [1], "scaled up before they are squared")
    reason = "a gradient beyond the largest number is that number"
    yield row(f"denormal: length {shortest:.1e}, float32, degree 6", 1, [tiny], [6], reason)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    yield row("a direction of zero, degree 6", 1, [zero], [6], "the polynomials at 0; a gradient of 0")


def of_meshes(subdivisions: int) -> Iterator[Condition]:
    ball = hard.sphere()
    flipped, opened = hard.painted(ball.vertices, ball.faces[:, ::-1]), hard.opened(ball)
    twice = hard.painted(ball.vertices, np.concatenate([ball.faces, ball.faces[:, ::-1]]))
    offsets = [1e6 * np.array(axis) for axis in ([1, 0, 0], [0, -1, 0], [1, -1, 1])]
    small = Setup(replace(ball, vertices=1e-6 * ball.vertices), camera=framing(1e-6 * CAMERA.width))
    away = [replace(ball, vertices=vertices) for vertices in (ball.vertices * 1e6, ball.vertices + 1e6)]
    yield case("a dented sphere of 320 faces, radius 1", 8, [Setup(ball)], "the baseline")
    scaled = [moved(ball.vertices * 10.0**power) for power in (-6, -3, 3, 6)]
    name = "scaled by 10⁻⁶, 10⁻³, 10³ and 10⁶, normalized to be seen, shaded as scaled"
    yield case(name, 8, scaled, "divided by a power of two before edges are multiplied")
    yield case("scaled by 10⁻⁶, not normalized, in as small a frame", 8, [small], "the frame's width is the unit")
    far = [moved(ball.vertices + offset) for offset in offsets]
    name = "moved by 10⁶, normalized to be seen, shaded in its place"
    yield case(name, 8, far, "positions enter through differences only")
    single = [moved(ball.vertices + offset, torch.float32) for offset in offsets]
    name = "the same with float32 vertices, which are 1/16 apart there"
    yield case(name, 8, single, "right for the rounded vertices")
    name = "scaled or moved by 10⁶, not normalized"
    yield case(name, 0, map(Setup, away), "outside the range of depths: an empty image", both, empty=True)
    flat = Setup(hard.with_faces_without_area(ball))
    yield case("three faces without area beside each", 12, [flat], "never drawn, gradient 0")
    name = "faces that lose their area after rasterization: vertices moved together"
    yield case(name, 8, [Setup(ball, vertices=merged(ball))], "a normal of zero, gradient 0", by_geometry)
    yield case("every face twice", 8, [Setup(twice)], "depths tie: the lower index is seen")
    yield case("inverted winding", 8, [Setup(flipped)], "shaded on the visible side")
    yield case("open, its inside visible", 8, [Setup(opened)], "shaded on the visible side")
    name = "not manifold: three faces on an edge, two solids in a point"
    yield case(name, 8, [Setup(hard.non_manifold())], "each face by itself")
    yield case("a single triangle", 8, [Setup(hard.TRIANGLE)], "each face by itself")

    def many() -> Errors:  # the mesh takes a while to make
        return both(Setup(hard.sphere(subdivisions), settings=ImageSettings(size=256, samples=1)))

    name = f"{20 * 4**subdivisions:,} faces at 256²"
    yield Condition(name, 64, many, "a sum over many pixels with terms of either sign costs digits")
    yield case("vertex normals", 8, [Setup(ball)], "weighted with areas", with_vertex_normals)
    single = [Setup(rounded(ball, torch.float32), dtype=torch.float32)]
    yield case("vertex normals, float32", 20, single, "normals in float64", with_vertex_normals)


def of_thin_faces(count: int) -> Iterator[Condition]:
    heights = {power: hard.slivers(10.0**-power, count, TOWARDS) for power in (2, 4, 6, 8, 10, 12)}

    def setup(mesh: Mesh, dtype: torch.dtype) -> Setup:
        settings = ImageSettings(size=math.ceil(math.sqrt(len(mesh.faces))), samples=1)
        return Setup(mesh, settings=settings, rasterizer=hard.Chart(), lift=exact, dtype=dtype)

    double = [setup(mesh, torch.float64) for mesh in heights.values()]
    reason = "rounding errors of differences and products are added back"
    yield case("height / edge = 10⁻² to 10⁻¹²", 8, double, reason)
    single = [setup(rounded(heights[power], torch.float32), torch.float32) for power in (4, 6, 12)]
    yield case("height / edge = 10⁻⁴ to 10⁻¹², rounded to float32", 8, single, reason)


def of_lights(degree: int) -> Iterator[Condition]:
    ball = rounded(hard.sphere(), torch.float32)

    def lit(*lights: Tensor) -> list[Setup]:
        return [Setup(ball, each, dtype=torch.float32) for each in lights]

    scaled = lit(*(light() * 10.0**power for power in (-8, -4, 4, 8, 11)))
    yield case("coefficients of 10⁻⁸ to 10¹¹", 8, scaled, "linear in the light")
    negative = lit(-light().abs(), ambient(-torch.ones(3)))
    yield case(
        "coefficients, or all radiance, negative", 8, negative, "radiance is negative; the image is clamped last"
    )
    yield case("all coefficients zero", 8, lit(0 * light()), "image and vertex gradient exactly 0")
    boxes = [Setup(rounded(hard.box(), dtype), dtype=dtype, lift=exact) for dtype in DTYPES[:2]]
    every = [replace(box, light=light(l)) for box in boxes for l in range(degree + 1)]
    name = f"lights of degree 0 to {degree} on a box, geometry in float64 and float32"
    yield case(name, 12, every, "operators and shading of any degree; odd bands from 3 on have a gradient of 0")


def of_number_types() -> Iterator[Condition]:
    for dtype in DTYPES:
        setup = Setup(rounded(hard.sphere(), dtype), dtype=dtype)
        half = torch.finfo(dtype).bits == 16
        reason = f"normals in float64, harmonics in {'float32' if half else 'this type'}"
        name = str(dtype).removeprefix("torch.")
        yield case(name, 1 if half else 8, [setup], reason, lambda each: both(each, each.dtype))


def of_images(size: int) -> Iterator[Condition]:
    ball = hard.sphere()
    tiny = [Setup(ball, settings=ImageSettings(size=1, samples=samples)) for samples in (1, 16)]
    yield case("1 × 1, 1 and 256 samples", 8, tiny, "one pixel")
    large = Setup(ball, settings=ImageSettings(size=size, samples=1), camera=framing(6.0))
    reason = "a sum over many pixels with terms of either sign costs digits"
    yield case(f"{size} × {size}", 8 + size / 16, [large], reason)
    around = replace(ball, vertices=1.5 * ball.vertices + 1.2 * TOWARDS)
    reason = "surfaces before the frame are cut away; the far wall is seen from inside"
    yield case("the camera inside the mesh", 8, [Setup(around)], reason)
    close = Setup(ball, camera=framing(1e-3))
    yield case("a mesh far larger than the frame", 8, [close], "cut at the frame")
    aside, behind = (replace(ball, vertices=ball.vertices + 10 * axis) for axis in (CAMERA.axes()[0], TOWARDS))
    edge_on = hard.painted([-0.5 * TOWARDS, 0.5 * TOWARDS, 0.5 * CAMERA.axes()[1]], [[0, 1, 2]])
    name = "a mesh outside the frame, one behind the camera, a triangle seen edge on"
    reason = "an empty image: no covered pixels, gradients of 0"
    yield case(name, 0, map(Setup, (aside, behind, edge_on)), reason, both, empty=True)


def of_transport() -> Iterator[Condition]:
    lumpy, reason = hard.lumpy(), "rays in float32, sums in float64"
    meshes = {
        "closed and lumpy": lumpy,
        "open, self-touching, of several parts": hard.heap(),
        "thin boards, 0.03 apart": hard.boards(),
        "open, its inside visible": hard.opened(hard.sphere(1)),
        "not manifold": hard.non_manifold(),
    }
    for name, mesh in meshes.items():
        yield case(name, 8, [Setup(mesh)], reason, shadows_and_bounces)
    reason_of_convex = "no ray is cast; the operator of direct light"
    yield case("convex", 8, [Setup(hard.box())], reason_of_convex, by_transport)
    small = Setup(replace(lumpy, vertices=1e-3 * lumpy.vertices), camera=framing(1e-3 * CAMERA.width))
    reason_of_scale = "rays start 1e-5 of the mesh's extent above it"
    yield case("scaled by 10⁻³, not normalized", 8, [small], reason_of_scale, shadows_and_bounces)
    yield case("closed and lumpy, float64", 8, [Setup(lumpy)], reason, double_shadows_and_bounces)


def tables(degree: int, subdivisions: int, size: int, slivers: int) -> dict[str, Iterator[Condition]]:
    return {
        "Spherical harmonics": of_harmonics(degree),
        "Meshes": of_meshes(subdivisions),
        "Thin faces": of_thin_faces(slivers),
        "Lights": of_lights(degree),
        "Number types": of_number_types(),
        "Images and cameras": of_images(size),
        "Shadows and bounces": of_transport(),
    }


def case(
    name: str,
    bound: float,
    setups: "Iterable[Setup]",
    reason: str,
    measure: "Callable[[Setup], Errors] | None" = None,
    empty: bool = False,
) -> Condition:
    """The worst of several setups. empty: no sample may see the mesh."""
    setups = list(setups)

    def measured() -> Errors:
        assert not empty or not any(len(setup.view().pixels) for setup in setups)
        return worst(map(measure or both, setups))

    return Condition(name, bound, measured, reason)


def framing(width: float) -> OrthographicCamera:
    return replace(CAMERA, width=width)


def rounded(mesh: Mesh, dtype: torch.dtype) -> Mesh:
    return replace(mesh, vertices=torch.from_numpy(mesh.vertices).to(dtype).double().numpy())


def moved(vertices: np.ndarray, dtype: torch.dtype = torch.float64) -> "Setup":
    """The sphere with other vertices, rounded to a dtype: normalized for the camera, as they are for the shading."""
    mesh = rounded(replace(hard.sphere(), vertices=vertices), dtype)
    return Setup(normalize(mesh), vertices=mesh.vertices, dtype=dtype)


def merged(mesh: Mesh) -> np.ndarray:
    """Vertices of which some have moved onto a neighbor."""
    vertices = mesh.vertices.copy()
    for face in mesh.faces[::9]:
        vertices[face[1]] = vertices[face[2]]
    return vertices


def light(degree: int = 6) -> Tensor:
    """Coefficients of order one, also in the bands that no diffuse surface reflects."""
    return torch.randn((degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(degree), dtype=torch.float64)


# ---------------------------------------------------------------------------- measurement


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
        return torch.from_numpy(self.mesh.vertices if self.vertices is None else self.vertices).to(self.dtype)

    def view(self) -> wide.View:
        mesh, samples, lift = self.mesh, self.settings.samples, self.lift
        points = self.camera.project(mesh.vertices)
        closed = mesh.closed and bool((points[:, 2] >= -1).all())
        [ids] = self.rasterizer.rasterize(points[None], mesh.faces, self.settings.size * samples, closed=closed)
        albedo, vertices = mesh.corner_colors[:, 0].astype(np.float64), self.shaded().double().numpy()
        return wide.view(ids, samples, mesh.vertices, vertices, mesh.faces, albedo, self.camera.axes()[2], lift)

    def fragments(self) -> Fragments:
        mesh = self.mesh
        return build_fragments(mesh.vertices, mesh.faces, [self.camera], self.settings, self.rasterizer, mesh.closed)[0]


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


def worst(several: Iterable[Errors]) -> Errors:
    several = list(several)
    return {name: max(errors[name] for errors in several) for name in several[0]}


def both(setup: Setup, dtype: torch.dtype = torch.float32) -> Errors:
    return by_operator(setup, dtype) | by_geometry(setup)


def by_operator(setup: Setup, dtype: torch.dtype = torch.float32, lost: np.ndarray | None = None) -> Errors:
    """Image and its gradient by the light, through an operator in `dtype`. lost: (P, (degree + 1)², 3) what the image
    loses to shadows per unit of each coefficient."""
    [operator] = build_operators(
        setup.mesh, [setup.camera], setup.settings, setup.rasterizer, basis=Harmonics(setup.degree), dtype=dtype
    )
    view, light = setup.view(), setup.light.to(dtype)
    upstream = random_upstream(len(view.pixels))
    lit, above = setup.lift(light.double().numpy()), setup.lift(upstream.double().numpy())
    image, gradient = wide.image(view, lit), wide.light_gradient(view, above, setup.degree)
    if lost is not None:
        image, gradient = image - (lost * lit).sum(axis=1), gradient - (lost * above[:, None]).sum(axis=0)
    return {
        "image": units(operator.radiance(light).T, image),
        "light gradient": units(operator.light_gradient(upstream.to(dtype).T), gradient),
    }


def by_geometry(setup: Setup) -> Errors:
    """Image and its gradient by the vertices, through `renderer.shading`."""
    view, vertices, light = setup.view(), setup.shaded().requires_grad_(), setup.light.to(setup.dtype)
    fragments, upstream = setup.fragments(), random_upstream(len(view.pixels))
    image = radiance(fragments, vertices, light, surface_albedo(setup.mesh, fragments, "linear"))
    (gradient,) = torch.autograd.grad(image, vertices, upstream.T.to(image))
    light, above = (setup.lift(part.double().numpy()) for part in (light, upstream))
    return {
        "image by geometry": units(image.T, wide.image(view, light)),
        "vertex gradient": units(gradient, wide.vertex_gradient(view, above, light, len(vertices))),
    }


def with_vertex_normals(setup: Setup) -> Errors:
    """`by_geometry` with interpolated normals; the gradient as its product with one random move of the vertices."""
    view, vertices, light = setup.view(), setup.shaded().requires_grad_(), setup.light.to(setup.dtype)
    fragments, upstream = setup.fragments(), random_upstream(len(view.pixels))
    albedo, faces = surface_albedo(setup.mesh, fragments, "linear"), torch.from_numpy(setup.mesh.faces)
    image = radiance(fragments, vertices, light, albedo, smooth_faces=faces)
    (gradient,) = torch.autograd.grad(image, vertices, upstream.T.to(image))
    move = random_upstream(len(vertices), seed=1)
    parts = vertices.detach().double(), fragments.barycentric, light.double(), upstream, move
    positions, barycentric, lit, above, along = (extended(part.numpy()) for part in parts)

    def shade(vertices: np.ndarray) -> np.ndarray:
        return wide.smooth_image(view, vertices, setup.mesh.faces, barycentric, lit)

    slope = (above * wide.derivative(shade(wide.stepped(positions, along)))).sum()
    product = (gradient.double() * move).sum().to(image)
    return {"image by geometry": units(image.T, shade(positions)), "vertex gradient": units(product, np.asarray(slope))}


def by_transport(setup: Setup, bounces: int = 0, dtype: torch.dtype = torch.float32) -> Errors:
    """`by_operator` with shadows or bounces and one sample per pixel, which then casts all rays. The reference takes
    the rays, their origins and the patches from the renderer."""
    mesh, kind = setup.mesh, "bounces" if bounces else "shadows"
    settings = replace(setup.settings, samples=1, shadows=True, bounces=bounces)
    setup = replace(setup, settings=settings)
    view, directions = setup.view(), extended(rays.sphere(rays.DIRECTIONS).numpy())
    points = ray_origins(Surface.of(mesh, setup.fragments(), settings), rays.Rays(mesh))
    lost = wide.shadow(view, points, extended(mesh.vertices[mesh.faces]), directions, setup.degree)
    if bounces:
        patches, patch_directions = wide_patches(mesh)
        sent = wide.radiosity(patches, patch_directions, setup.degree, bounces)
        lost = lost - wide.bounced(view, points, patches, sent, directions)
    return {f"{name}, {kind}": error for name, error in by_operator(setup, dtype, lost).items()}


def shadows_and_bounces(setup: Setup, dtype: torch.dtype = torch.float32) -> Errors:
    """Three bounces are between few patches of few directions, so that the reference takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(radiosity, "PATCHES", 64)
        patch.setattr(radiosity, "DIRECTIONS", 64)
        bounces = by_transport(replace(setup, settings=replace(SETTINGS, size=8)), 3, dtype)
    return by_transport(setup, 0, dtype) | bounces


def double_shadows_and_bounces(setup: Setup) -> Errors:
    return shadows_and_bounces(setup, torch.float64)


def ray_origins(surface: Surface, caster: rays.Rays) -> np.ndarray:
    """(S, 3) of a surface's samples."""
    return extended((surface.points + caster.offset * surface.planes).numpy())


def wide_patches(mesh: Mesh) -> tuple[wide.Patches, np.ndarray]:
    """The renderer's patches of a mesh, and the directions of their rays."""
    made, directions = radiosity.Patches.of(mesh), rays.sphere(radiosity.DIRECTIONS)
    view, pieces, caster = made.view, made.pieces, rays.Rays(made.pieces)
    surface = Surface(view, torch.from_numpy(pieces.vertices))
    looks = list(caster.hits(surface, directions))
    patches = wide.Patches(
        corners=extended(pieces.vertices[pieces.faces]),
        albedo=extended(pieces.corner_colors[:, 0]),
        points=ray_origins(surface, caster),
        face=view.faces[view.face].numpy(),
        side=view.facing[view.face, 0].numpy(),
        patch=view.pixel.numpy(),
        share=extended(made.fractions[:, 0].numpy()),
        looking=np.concatenate([each.pixels.numpy() for each in looks]),
        dealt=np.concatenate([each.sample.numpy() for each in looks]),
        of_side=made.of_side.numpy(),
    )
    return patches, extended(directions.numpy())


def harmonics_errors(directions: Tensor, degrees: Iterable[int]) -> Errors:
    """Basis, gradient and the gradient of a sum by autograd: the worst of directions (N, 3) and degrees.

    Gradients count relative to each direction's own, since they fall with its length.
    """
    degrees = list(degrees)
    rows = exact(directions.double().numpy()).T
    values_to, gradient_to = wide.basis(rows, max(degrees)), wide.basis_gradient(rows, max(degrees))
    largest = torch.finfo(directions.dtype).max

    def by_direction(ours: Tensor, theirs: np.ndarray) -> float:
        return max(units(*pair) for pair in zip(ours, theirs.clip(-largest, largest), strict=True))

    def at(degree: int) -> Errors:
        variable = directions.clone().requires_grad_()
        upstream = random_upstream((degree + 1) ** 2)[:, 0].to(directions)
        values, slopes = basis(variable, degree), basis_gradient(directions, degree)
        (summed,) = torch.autograd.grad(values @ upstream, variable, torch.ones_like(variable[:, 0]))
        gradient = gradient_to[:, : values.shape[1]]
        sums = (gradient * exact(upstream.double().numpy())[:, None]).sum(axis=1)
        return {
            "basis": units(values, values_to[:, : values.shape[1]]),
            "gradient": by_direction(slopes, gradient),
            "gradient by autograd": by_direction(summed, sums),
        }

    return worst(at(degree) for degree in degrees)


def random_upstream(rows: int, seed: int = 0) -> Tensor:
    """(rows, 3) multiples of 1/64 in [-1, 1], which every number type holds exactly."""
    return torch.randint(-64, 65, (rows, 3), generator=torch.Generator().manual_seed(seed)) / 64.0


# ---------------------------------------------------------------------------- tests


@pytest.mark.parametrize(
    "condition",
    [
        pytest.param(condition, id=f"{title}: {condition.name}")
        for title, conditions in tables(**QUICK).items()
        for condition in conditions
    ],
)
def test_every_error_is_rounding(condition):
    """A few ε each, more where many terms cancel: thousands of pixels, hundreds of harmonics."""
    errors = condition.measure()
    assert errors and {name: error for name, error in errors.items() if not error <= condition.bound} == {}


DIRECTIONS = np.random.default_rng(0).normal(size=(3, 20))
BOTH = pytest.mark.parametrize("lift", [extended, exact], ids=["extended", "exact"])


@BOTH
def test_the_references_harmonics_are_scipys_without_the_condon_shortley_sign(lift):
    x, y, z = DIRECTIONS
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    values = wide.basis(lift(DIRECTIONS), 6).astype(float)
    for l in range(7):
        for m in range(-l, l + 1):
            complex_value = sph_harm_y(l, abs(m), polar, azimuth)
            part = complex_value.real if m >= 0 else complex_value.imag
            expected = part * (1 if m == 0 else math.sqrt(2) * (-1) ** m)
            np.testing.assert_allclose(values[:, l * l + l + m], expected, rtol=0, atol=1e-14)  # scipy's own rounding


def test_the_references_clamped_cosine_is_its_integral():
    for l in range(21):
        expected, _ = quad(lambda z, l=l: eval_legendre(l, z) * z, 0, 1)
        assert float(wide.lambertian(l)) == pytest.approx(expected, abs=1e-14)


@BOTH
def test_the_references_basis_gradient_is_its_difference_quotient(lift):
    """Off by the third derivative × step² / 6, some 1e-9, and by the rounding of 1 over the step, 1e-13."""
    directions, step = lift(DIRECTIONS), lift(1e-6)
    gradient = wide.basis_gradient(directions, 6)
    for axis in range(3):
        ahead, behind = (wide.basis(directions + sign * step * wide.AXES[axis], 6) for sign in (1, -1))
        assert abs(gradient[..., axis] - (ahead - behind) / (2 * step)).max() < 1e-8


@BOTH
def test_the_references_gradients_are_those_of_its_image(lift):
    """By the light, in which the image is linear; by the vertices, against a difference quotient (float64 vertices,
    so off by 1e-16 over the step)."""
    rng, mesh = np.random.default_rng(1), hard.sphere(1)
    setup = Setup(mesh, light(), lift=lift)
    view, coefficients = setup.view(), lift(light().numpy())
    upstream, move = lift(rng.normal(size=(len(view.pixels), 3))), rng.normal(size=mesh.vertices.shape)
    by_light = wide.light_gradient(view, upstream, 6)
    loss = (upstream * wide.image(view, coefficients)).sum()
    assert abs((by_light * coefficients).sum() - loss) < 1e-14 * abs(loss)

    ahead, behind = (replace(setup, vertices=mesh.vertices + step * move).view() for step in (1e-6, -1e-6))
    change = wide.image(ahead, coefficients) - wide.image(behind, coefficients)
    gradient = wide.vertex_gradient(view, upstream, coefficients, len(mesh.vertices))
    assert float((gradient * move).sum()) == pytest.approx(float((upstream * change).sum()) / 2e-6, rel=1e-8)


# ---------------------------------------------------------------------------- the table


def main(arguments: list[str] | None = None) -> int:
    """Print the table; exit status 1 where an error is beyond its bound."""
    parser = argparse.ArgumentParser(description="Print the table of errors as Markdown, in units of ε.")
    parser.add_argument("--quick", action="store_true", help="the sizes of the test")
    parser.add_argument("--only", help="the title of one table")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    beyond = False
    for title, conditions in tables(**QUICK if options.quick else FULL).items():
        if options.only in (None, title):
            beyond |= print_table(title, conditions)
    return int(beyond)


def print_table(title: str, conditions: Iterable[Condition]) -> bool:
    """Whether an error is beyond its bound, which is then in bold."""
    rows = [(condition, condition.measure()) for condition in conditions]
    quantities = list(dict.fromkeys(name for _, errors in rows for name in errors))
    print(f"## {title}\n\n| condition | {' | '.join(quantities)} | what the code does |")
    print("| --- " * (len(quantities) + 2) + "|")
    for condition, errors in rows:
        cells = [("{:.3g}" if e <= condition.bound else "**{:.3g}**").format(e) for e in errors.values()]
        by_name = dict(zip(errors, cells, strict=True))
        cells = [by_name.get(name, "–") for name in quantities]
        print(f"| {condition.name} | {' | '.join(cells)} | {condition.reason} |")
    print(flush=True)
    return any(not error <= condition.bound for condition, errors in rows for error in errors.values())


if __name__ == "__main__":
    sys.exit(main())
