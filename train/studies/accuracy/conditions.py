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
    of_development,
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
    for name, dtype in DTYPES.items():
        does = "Legendre recurrences in float64" if dtype == torch.float64 else "computed in float64, rounded once"
        yield Row(f"degree 0 to {degree}, {name}", of_harmonics(directions.to(dtype), range(degree + 1)), does)
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
    for name in ("float64", "float32"):
        info = torch.finfo(DTYPES[name])
        denormal = (directions / directions.norm(dim=1, keepdim=True)).to(DTYPES[name]) * (info.smallest_normal / 2)
        yield Row(
            f"denormal: length {info.smallest_normal / 2:.1e}, {name}, degree 1",
            of_harmonics(denormal, [1]),
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
    yield Row("a dented sphere of 320 faces, radius 1", by_both(Setup(ball, light())), "for comparison")
    scales = [10.0**power for power in (-6, -3, 3, 6)]
    yield Row(
        "scaled by 10⁻⁶, 10⁻³, 10³ and 10⁶, normalised to be seen, shaded as scaled",
        worst(by_both(placed(ball.vertices * scale)) for scale in scales),
        "divided by a power of two before edges are multiplied",
    )
    small = Setup(replace(ball, vertices=1e-6 * ball.vertices), light(), camera=framing(1e-6 * CAMERA.field_of_view))
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
    yield Row(
        "three faces without area beside each",
        by_both(Setup(shapes.with_faces_without_area(ball), light())),
        "never drawn, gradient 0",
    )
    yield Row(
        "faces that lose their area once rasterised: vertices moved together",
        by_geometry(Setup(ball, light(), vertices=merged(ball))),
        "a normal of zero, gradient 0",
    )
    twice = shapes.painted(ball.vertices, np.concatenate([ball.faces, ball.faces[:, ::-1]]))
    yield Row("every face twice", by_both(Setup(twice, light())), "depths tie: the lower index is seen")
    inside_out = shapes.painted(ball.vertices, ball.faces[:, ::-1])
    yield Row("inverted winding", by_both(Setup(inside_out, light())), "shaded on the side that is seen")
    yield Row("open, its inside seen", by_both(Setup(shapes.opened(ball), light())), "shaded on the side that is seen")
    yield Row(
        "not manifold: three faces on an edge, two solids in a point",
        by_both(Setup(shapes.non_manifold(), light())),
        "each face by itself",
    )
    yield Row("a single triangle", by_both(Setup(shapes.TRIANGLE, light())), "each face by itself")
    many, settings = shapes.sphere(subdivisions), ImageSettings(size=256, samples=1)
    yield Row(
        f"{len(many.faces):,} faces, thin ones, at 256²", by_both(Setup(many, light(), settings=settings)), SUMMED
    )
    yield Row("vertex normals", with_vertex_normals(Setup(ball, light())), "weighted with areas")
    single = Setup(rounded(ball, torch.float32), light(), dtype=torch.float32)
    yield Row("vertex normals, float32", with_vertex_normals(single), "normals in float64")


def framing(width: float) -> OrthographicCamera:
    return replace(CAMERA, field_of_view=width)


def of_nothing(mesh: Mesh) -> Errors:
    """Of what no sample sees."""
    setup = Setup(mesh, light())
    assert not len(setup.view().pixels)
    return by_both(setup)


def placed(vertices: np.ndarray, dtype: torch.dtype = torch.float64) -> Setup:
    """The sphere with other vertices, rounded to a dtype: normalised where it is seen, as it is where it is shaded."""
    mesh = rounded(replace(shapes.sphere(), vertices=vertices), dtype)
    return Setup(normalise(mesh), light(), vertices=mesh.vertices, dtype=dtype)


def merged(mesh: Mesh) -> np.ndarray:
    """Vertices of which some have come to lie where a neighbour is."""
    vertices = mesh.vertices.copy()
    for face in mesh.faces[::9]:
        vertices[face[1]] = vertices[face[2]]
    return vertices


def shadows() -> Iterator[Row]:
    lumpy, cast = shapes.lumpy(), "rays by Embree in float32, their sum in float64"
    for condition, mesh in {
        "closed and lumpy": lumpy,
        "open, self-touching, of several parts": shapes.heap(),
        "thin boards, 0.03 apart": shapes.boards(),
        "open, its inside seen": shapes.opened(shapes.sphere(1)),
        "not manifold": shapes.non_manifold(),
    }.items():
        yield Row(condition, by_transport(Setup(mesh, light())), cast)
    yield Row("convex", by_transport(Setup(shapes.box(), light())), "no ray is cast; the operator of direct light")
    small = replace(lumpy, vertices=1e-3 * lumpy.vertices)
    framed = Setup(small, light(), camera=framing(1e-3 * CAMERA.field_of_view))
    yield Row("scaled by 10⁻³, not normalised", by_transport(framed), "rays start 1e-5 of the mesh's extent above it")
    yield Row("float64", by_transport(Setup(lumpy, light()), dtype=torch.float64), cast)


def bounces() -> Iterator[Row]:
    lumpy, gathered = shapes.lumpy(), "what patches send in float64"
    conditions: list[tuple[str, Mesh, int, torch.dtype]] = [
        ("closed and lumpy, one bounce", lumpy, 1, torch.float32),
        ("closed and lumpy, three bounces", lumpy, 3, torch.float32),
        ("open, self-touching, of several parts, three bounces", shapes.heap(), 3, torch.float32),
        ("thin boards, 0.03 apart, three bounces", shapes.boards(), 3, torch.float32),
        ("open, its inside seen, three bounces", shapes.opened(shapes.sphere(1)), 3, torch.float32),
        ("not manifold, three bounces", shapes.non_manifold(), 3, torch.float32),
        ("float64, three bounces", lumpy, 3, torch.float64),
    ]
    for condition, mesh, count, dtype in conditions:
        setup = Setup(mesh, light(), settings=replace(SETTINGS, size=8))
        with quadrature(patches=2**6, of_patch=2**6):  # so few that the reference takes seconds
            errors = by_transport(setup, count, dtype)
        yield Row(condition, errors, gathered)


def thin_faces(count: int) -> Iterator[Row]:
    def measured(mesh: Mesh, dtype: torch.dtype) -> Errors:
        settings = ImageSettings(size=ceil(sqrt(len(mesh.faces))), samples=1)
        return by_both(Setup(mesh, light(), settings=settings, backend=shapes.Chart(), lift=exact, dtype=dtype))

    for power in (2, 4, 6, 8, 10, 12):
        thin = shapes.slivers(10.0**-power, count, TOWARDS)
        does = "rounding errors of differences and products are added back"
        yield Row(f"height / edge = {ten_to(-power)}", measured(thin, torch.float64), does)
    for power in (4, 6, 12):
        thin = rounded(shapes.slivers(10.0**-power, count, TOWARDS), torch.float32)
        does = f"the same; in float32 normals would be off by {in_float32_arithmetic(thin):.1g}"
        yield Row(f"height / edge = {ten_to(-power)}, rounded to float32", measured(thin, torch.float32), does)


def in_float32_arithmetic(mesh: Mesh) -> float:
    """How far the normals would be off, were they computed in float32 throughout."""
    corners = mesh.vertices[mesh.faces].transpose(1, 2, 0)
    wide, single = (unit_normals(corners.astype(dtype)) for dtype in (np.longdouble, np.float32))
    return float(abs(wide - single).max())


def lights(degree: int) -> Iterator[Row]:
    ball = rounded(shapes.sphere(), torch.float32)
    negative = "radiance is negative; `develop` clamps"
    kinds = [(f"coefficients of {ten_to(n)}", light() * 10.0**n, "linear in the light") for n in (-8, -4, 4, 8, 11)] + [
        ("all coefficients negative", -light().abs(), negative),
        ("radiance of −1 from everywhere", ambient(-torch.ones(3)), negative),
        ("all coefficients zero", 0 * light(), "image and vertex gradient exactly 0"),
    ]
    for condition, coefficients, does in kinds:
        yield Row(condition, by_both(Setup(ball, coefficients, dtype=torch.float32)), does)
    for name in ("float64", "float32"):
        mesh = rounded(shapes.box(), DTYPES[name])
        yield Row(
            f"lights of degree 0 to {degree} on a box, geometry in {name}",
            worst(by_both(Setup(mesh, light(l), dtype=DTYPES[name], lift=exact)) for l in range(degree + 1)),
            "operators and shading of any degree; odd bands from 3 on have a gradient of 0",
        )


def number_types() -> Iterator[Row]:
    for name, dtype in DTYPES.items():
        setup = Setup(rounded(shapes.sphere(), dtype), light(), dtype=dtype)
        half = torch.finfo(dtype).bits == 16
        does = "operators in this type; normals in float64, harmonics in " + ("float32" if half else "this type")
        yield Row(name, by_operator(setup, dtype) | by_geometry(setup), does)


def images(size: int) -> Iterator[Row]:
    ball = shapes.sphere()
    for samples in (1, 16):
        settings = ImageSettings(size=1, samples=samples)
        yield Row(
            f"1 × 1, {samples**2} sample{'s' * (samples > 1)}",
            by_both(Setup(ball, light(), settings=settings)),
            "one pixel",
        )
    settings = ImageSettings(size=size, samples=1)
    yield Row(f"{size} × {size}", by_both(Setup(ball, light(), settings=settings, camera=framing(6.0))), SUMMED)
    around = replace(ball, vertices=1.5 * ball.vertices + 1.2 * TOWARDS)
    yield Row(
        "the camera inside the mesh",
        by_both(Setup(around, light())),
        "what is nearer than the frame is cut away; the far wall is seen from inside",
    )
    close = Setup(ball, light(), camera=framing(1e-3))
    yield Row("a mesh far larger than the frame", by_both(close), "cut at the frame")
    aside = replace(ball, vertices=ball.vertices + 10 * CAMERA.axes()[0])
    yield Row("a mesh outside the frame", of_nothing(aside), "an empty image: P = 0, gradients of 0")
    behind = replace(ball, vertices=ball.vertices + 10 * TOWARDS)
    yield Row("a mesh behind the camera", of_nothing(behind), "an empty image")
    edge_on = shapes.painted([-0.5 * TOWARDS, 0.5 * TOWARDS, 0.5 * CAMERA.axes()[1]], [[0, 1, 2]])
    yield Row("a triangle seen edge on", of_nothing(edge_on), "an empty image")


def development() -> Iterator[Row]:
    inside = [0.0, -0.0, 1.0, 1e-45, 1e-8, 0.0031, 0.0032, 0.5, 0.999, 0.75]
    outside = [-1e8, -1.0, -1e-8, -1e-45, 1.001, 2.0, 1e8, 60.0, 0.5, 0.9]
    coverage = torch.tensor([[1.0] * 8 + [0.5] * 2], dtype=torch.float64)
    background = torch.tensor([[0.25]], dtype=torch.float64)
    for encoding in ("linear", "srgb"):
        for name, dtype in DTYPES.items():
            largest = min(1e8, torch.finfo(dtype).max)
            radiance = torch.tensor([inside, outside], dtype=torch.float64).clamp(-largest, largest)
            seen, covered, behind = (part.to(dtype) for part in (radiance, coverage, background))
            does = "clamped to [0, 1]" + ("; the sRGB curve's slope stays finite at 0" if encoding == "srgb" else "")
            yield Row(f"`{encoding}`, {name}", of_development(seen, covered, behind, encoding), does)


def ten_to(power: int) -> str:
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
