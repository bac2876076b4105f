"""The rows of docs/accuracy.md: a condition, the renderer's largest errors under it, and what the code does."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import ceil, sqrt

import numpy as np
import torch

from renderer.camera import OrthographicCamera
from renderer.image import ImageSettings
from renderer.lights import ambient
from renderer.mesh import Mesh, normalise
from train.studies.accuracy import shapes
from train.studies.accuracy.measure import (
    CAMERA,
    SETTINGS,
    Errors,
    Setup,
    by_both,
    by_geometry,
    by_operator,
    by_transport,
    light,
    of_harmonics,
    with_vertex_normals,
    worst,
)
from train.studies.accuracy.reference import exact, unit_normals
from train.studies.quadrature import quadrature

DTYPES = {"float64": torch.float64, "float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
TOWARDS = CAMERA.axes()[2]
SUMMED = "a sum over many pixels with terms of either sign costs digits"


@dataclass(frozen=True)
class Row:
    condition: str
    errors: Errors
    behaviour: str


def rounded(mesh: Mesh, dtype: torch.dtype) -> Mesh:
    return replace(mesh, vertices=torch.from_numpy(mesh.vertices).to(dtype).double().numpy())


def harmonics(degree: int) -> Iterator[Row]:
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 3)))

    def in_types(*dtypes: torch.dtype) -> Errors:
        return worst(of_harmonics(directions.to(dtype), range(degree + 1)) for dtype in dtypes)

    yield Row(f"degree 0 to {degree}, float64", in_types(torch.float64), "Legendre recurrences in float64")
    narrow = in_types(torch.float32, torch.bfloat16, torch.float16)
    yield Row(f"degree 0 to {degree}, float32, bfloat16, float16", narrow, "computed in float64, rounded once")
    tilts = [(0, 1), (0, -1), (1e-1, 1), (1e-4, -1), (1e-8, 1), (1e-300, -1)]
    poles = torch.tensor([[0.6 * tilt, 0.8 * tilt, pole] for tilt, pole in tilts], dtype=torch.float64)
    yield Row(
        f"0 and 10⁻¹ to 10⁻³⁰⁰ rad from a pole, degree {degree}",
        of_harmonics(poles, [degree]),
        "polynomials in x, y, z: no polar angle whose derivative is infinite",
    )
    signed = torch.tensor([[-0.0, 0.0, 1.0], [0.0, -0.0, -1.0], [-0.0, 1.0, -0.0], [-1.0, -0.0, 0.0]]).double()
    yield Row(f"components of −0, degree {degree}", of_harmonics(signed, [degree]), "the same as +0")
    lengths = directions * torch.tensor([[1e-29], [1e-15], [1e-3], [1e3], [1e15], [1e29]])
    yield Row(
        "lengths of 10⁻²⁹ to 10²⁹, degree 6",
        of_harmonics(lengths, [6]),
        "only the direction counts; the gradient falls with 1 / length",
    )
    units = directions / directions.norm(dim=1, keepdim=True)
    yield Row(
        "denormal: half the smallest normal length, float64 and float32, degree 1",
        worst(
            of_harmonics(units.to(dtype) * (torch.finfo(dtype).smallest_normal / 2), [1])
            for dtype in (torch.float64, torch.float32)
        ),
        "scaled up before they are squared",
    )
    shortest = torch.finfo(torch.float32).smallest_normal * torch.finfo(torch.float32).eps
    yield Row(
        f"denormal: length {shortest:.1e}, float32, degree 6",
        of_harmonics(shortest * torch.tensor([[0.0, 0, 1], [1, -1, 1], [1, 2, 0]]), [6]),
        "a gradient beyond the largest number is that number",
    )
    zero = torch.zeros(1, 3, dtype=torch.float64)
    yield Row("a direction of zero, degree 6", of_harmonics(zero, [6]), "the polynomials at 0; a gradient of 0")


def meshes(subdivisions: int) -> Iterator[Row]:
    ball = shapes.sphere()
    yield Row("a dented sphere of 320 faces, radius 1", by_both(Setup(ball)), "for comparison")
    scales = [10.0**power for power in (-6, -3, 3, 6)]
    yield Row(
        "scaled by 10⁻⁶, 10⁻³, 10³ and 10⁶, normalised to be seen, shaded as scaled",
        worst(by_both(placed(ball.vertices * scale)) for scale in scales),
        "divided by a power of two before edges are multiplied",
    )
    small = Setup(replace(ball, vertices=1e-6 * ball.vertices), camera=framing(1e-6 * CAMERA.field_of_view))
    yield Row("scaled by 10⁻⁶, not normalised, in as small a frame", by_both(small), "the frame's width is the unit")
    offsets = [1e6 * np.array(axis) for axis in ([1, 0, 0], [0, -1, 0], [1, -1, 1])]
    yield Row(
        "moved by 10⁶, normalised to be seen, shaded where it is",
        worst(by_both(placed(ball.vertices + offset)) for offset in offsets),
        "positions enter through differences only",
    )
    yield Row(
        "the same with float32 vertices, which are 1/16 apart there",
        worst(by_both(placed(ball.vertices + offset, torch.float32)) for offset in offsets),
        "right for the vertices as rounded; what is lost, the input lost",
    )
    yield Row(
        "scaled or moved by 10⁶, not normalised",
        worst(of_nothing(replace(ball, vertices=v)) for v in (ball.vertices * 1e6, ball.vertices + 1e6)),
        "beyond the frame's depth: an empty image",
    )
    without_area, does = shapes.with_faces_without_area(ball), "never drawn, gradient 0"
    yield Row("three faces without area beside each", by_both(Setup(without_area)), does)
    condition = "faces that lose their area once rasterised: vertices moved together"
    yield Row(condition, by_geometry(Setup(ball, vertices=merged(ball))), "a normal of zero, gradient 0")
    twice = shapes.painted(ball.vertices, np.concatenate([ball.faces, ball.faces[:, ::-1]]))
    yield Row("every face twice", by_both(Setup(twice)), "depths tie: the lower index is seen")
    inside_out = shapes.painted(ball.vertices, ball.faces[:, ::-1])
    yield Row("inverted winding", by_both(Setup(inside_out)), "shaded on the side that is seen")
    yield Row("open, its inside seen", by_both(Setup(shapes.opened(ball))), "shaded on the side that is seen")
    condition = "not manifold: three faces on an edge, two solids in a point"
    yield Row(condition, by_both(Setup(shapes.non_manifold())), "each face by itself")
    yield Row("a single triangle", by_both(Setup(shapes.TRIANGLE)), "each face by itself")
    many, settings = shapes.sphere(subdivisions), ImageSettings(size=256, samples=1)
    yield Row(f"{len(many.faces):,} faces, thin ones, at 256²", by_both(Setup(many, settings=settings)), SUMMED)
    yield Row("vertex normals", with_vertex_normals(Setup(ball)), "weighted with areas")
    single = Setup(rounded(ball, torch.float32), dtype=torch.float32)
    yield Row("vertex normals, float32", with_vertex_normals(single), "normals in float64")


def framing(width: float) -> OrthographicCamera:
    return replace(CAMERA, field_of_view=width)


def of_nothing(mesh: Mesh) -> Errors:
    """Of what no sample sees."""
    setup = Setup(mesh)
    assert not len(setup.view().pixels)
    return by_both(setup)


def placed(vertices: np.ndarray, dtype: torch.dtype = torch.float64) -> Setup:
    """The sphere with other vertices, rounded to a dtype: normalised where it is seen, as it is where it is shaded."""
    mesh = rounded(replace(shapes.sphere(), vertices=vertices), dtype)
    return Setup(normalise(mesh), vertices=mesh.vertices, dtype=dtype)


def merged(mesh: Mesh) -> np.ndarray:
    """Vertices of which some have come to lie where a neighbour is."""
    vertices = mesh.vertices.copy()
    for face in mesh.faces[::9]:
        vertices[face[1]] = vertices[face[2]]
    return vertices


def transports() -> Iterator[Row]:
    lumpy, cast = shapes.lumpy(), "rays in float32, sums in float64"
    for condition, mesh in {
        "closed and lumpy": lumpy,
        "open, self-touching, of several parts": shapes.heap(),
        "thin boards, 0.03 apart": shapes.boards(),
        "open, its inside seen": shapes.opened(shapes.sphere(1)),
        "not manifold": shapes.non_manifold(),
    }.items():
        yield Row(condition, by_transports(Setup(mesh)), cast)
    yield Row("convex", by_transport(Setup(shapes.box())), "no ray is cast; the operator of direct light")
    small = Setup(replace(lumpy, vertices=1e-3 * lumpy.vertices), camera=framing(1e-3 * CAMERA.field_of_view))
    does = "rays start 1e-5 of the mesh's extent above it"
    yield Row("scaled by 10⁻³, not normalised", by_transports(small), does)
    yield Row("closed and lumpy, float64", by_transports(Setup(lumpy), torch.float64), cast)


def by_transports(setup: Setup, dtype: torch.dtype = torch.float32) -> Errors:
    """Of shadows, and of three bounces between so few patches that the reference takes seconds."""
    smaller = replace(setup, settings=replace(SETTINGS, size=8))
    with quadrature(patches=2**6, of_patch=2**6):
        bounces = by_transport(smaller, 3, dtype)
    return by_transport(setup, 0, dtype) | bounces


def thin_faces(count: int) -> Iterator[Row]:
    def measured(mesh: Mesh, dtype: torch.dtype) -> Errors:
        settings = ImageSettings(size=ceil(sqrt(len(mesh.faces))), samples=1)
        return by_both(Setup(mesh, settings=settings, backend=shapes.Chart(), lift=exact, dtype=dtype))

    thin = {power: shapes.slivers(10.0**-power, count, TOWARDS) for power in (2, 4, 6, 8, 10, 12)}
    yield Row(
        "height / edge = 10⁻² to 10⁻¹²",
        worst(measured(mesh, torch.float64) for mesh in thin.values()),
        "rounding errors of differences and products are added back",
    )
    single = [rounded(thin[power], torch.float32) for power in (4, 6, 12)]
    least, *_, most = map(in_float32_arithmetic, single)
    yield Row(
        "height / edge = 10⁻⁴ to 10⁻¹², rounded to float32",
        worst(measured(mesh, torch.float32) for mesh in single),
        f"the same; in float32 normals would be off by {least:.1g} to {most:.1g}",
    )


def in_float32_arithmetic(mesh: Mesh) -> float:
    """How far the normals would be off, were they computed in float32 throughout."""
    corners = mesh.vertices[mesh.faces].transpose(1, 2, 0)
    wide, single = (unit_normals(corners.astype(dtype)) for dtype in (np.longdouble, np.float32))
    return float(abs(wide - single).max())


def lights(degree: int) -> Iterator[Row]:
    ball = rounded(shapes.sphere(), torch.float32)

    def lit(*lights: torch.Tensor) -> Errors:
        return worst(by_both(Setup(ball, each, dtype=torch.float32)) for each in lights)

    scaled = [light() * 10.0**power for power in (-8, -4, 4, 8, 11)]
    yield Row("coefficients of 10⁻⁸ to 10¹¹", lit(*scaled), "linear in the light")
    negative = -light().abs(), ambient(-torch.ones(3))
    yield Row("coefficients, or all radiance, negative", lit(*negative), "radiance is negative; `develop` clamps")
    yield Row("all coefficients zero", lit(0 * light()), "image and vertex gradient exactly 0")
    boxes = [Setup(rounded(shapes.box(), each), dtype=each, lift=exact) for each in (torch.float64, torch.float32)]
    yield Row(
        f"lights of degree 0 to {degree} on a box, geometry in float64 and float32",
        worst(by_both(replace(box, light=light(l))) for box in boxes for l in range(degree + 1)),
        "operators and shading of any degree; odd bands from 3 on have a gradient of 0",
    )


def number_types() -> Iterator[Row]:
    for name, dtype in DTYPES.items():
        setup = Setup(rounded(shapes.sphere(), dtype), dtype=dtype)
        half = torch.finfo(dtype).bits == 16
        does = "operators in this type; normals in float64, harmonics in " + ("float32" if half else "this type")
        yield Row(name, by_operator(setup, dtype) | by_geometry(setup), does)


def images(size: int) -> Iterator[Row]:
    ball = shapes.sphere()
    tiny = [ImageSettings(size=1, samples=samples) for samples in (1, 16)]
    errors = worst(by_both(Setup(ball, settings=settings)) for settings in tiny)
    yield Row("1 × 1, 1 and 256 samples", errors, "one pixel")
    settings = ImageSettings(size=size, samples=1)
    yield Row(f"{size} × {size}", by_both(Setup(ball, settings=settings, camera=framing(6.0))), SUMMED)
    around = replace(ball, vertices=1.5 * ball.vertices + 1.2 * TOWARDS)
    yield Row(
        "the camera inside the mesh",
        by_both(Setup(around)),
        "what is nearer than the frame is cut away; the far wall is seen from inside",
    )
    close = Setup(ball, camera=framing(1e-3))
    yield Row("a mesh far larger than the frame", by_both(close), "cut at the frame")
    aside, behind = (replace(ball, vertices=ball.vertices + 10 * axis) for axis in (CAMERA.axes()[0], TOWARDS))
    edge_on = shapes.painted([-0.5 * TOWARDS, 0.5 * TOWARDS, 0.5 * CAMERA.axes()[1]], [[0, 1, 2]])
    yield Row(
        "a mesh outside the frame, one behind the camera, a triangle seen edge on",
        worst(map(of_nothing, (aside, behind, edge_on))),
        "an empty image: P = 0, gradients of 0",
    )
