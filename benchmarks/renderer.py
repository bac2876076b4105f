"""Run time against error of the renderer and of other ways to the same image and gradients.

    python -m benchmarks.renderer --mitsuba

writes renderer_pareto.csv and renderer_pareto.png in some minutes on one CPU thread. The scene is an ellipsoid of one
color under a light probe and a sun, whose bands never end, so that cutting the light off after a degree is an error,
too. Errors are root mean squares of the difference to a converged float64 reference, over the reference's: of the
radiance before clamping, and of the gradient of Σ radiance × normal random numbers, with visibility fixed.
"""

import argparse
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import chain, product
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from benchmarks.common import machine, medians, write_csv
from benchmarks.mitsuba_view import MitsubaView
from benchmarks.scene import CAMERA, SAMPLES, Converged, Row, Shading, View, coefficients, cut_irradiance, ellipsoid
from renderer import reference, shading
from renderer.cache import OperatorCache
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.fragments import Fragments
from renderer.image import ImageSettings, tonemap
from renderer.rasterizer import NAMES, Rasterizer, choose
from renderer.shapes import solid
from renderer.transfer import COEFFICIENTS, DEGREE, TransferOperator

BACKGROUND = 0.5
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float64": torch.float64}
VIEWS = 10  # of each of the paper's two meshes

DEGREES = (2, 4, 6, 8, 10, 12)  # of the harmonics
PER_SIDE = (1, 2, 4, 8, 16)  # samples per side of a pixel

Pair = tuple[Callable[[], object], Callable[[], object]]
Entries = Iterable[tuple[Row, Callable[[], object]]]


# ---------------------------------------------------------------------------- what is timed


def light_step(view: View, operator: TransferOperator, light: Tensor) -> Callable[[], Tensor]:
    """Light → image → gradient of a scalar loss by the light."""
    upstream = view.upstream(operator.pixels, light.dtype)
    coverage, background = operator.coverage.to(light.dtype)[None], light.new_full((1, 1), BACKGROUND)

    def step() -> Tensor:
        variable = light.clone().requires_grad_()
        image = tonemap(operator.radiance(variable), coverage, background)
        return torch.autograd.grad((image * upstream).sum(), variable)[0]

    return step


def vertex_step(
    view: View, samples: int, light: Tensor, shade: Shading = shading.radiance, cached: bool = False
) -> Callable[[], Tensor]:
    """Vertices → image → gradient of a scalar loss by the vertices. cached: the mesh is not rasterized again."""
    vertices, background = view.vertices(light.dtype), light.new_full((1, 1), BACKGROUND)
    image_gradient, before = view.image_gradient.flatten(1).to(light.dtype), view.rasterized(samples, vertices)

    def step() -> Tensor:
        variable = vertices.clone().requires_grad_()
        fragments, albedo, coverage = before if cached else view.rasterized(samples, variable)
        image = tonemap(shade(fragments, variable, light, albedo), coverage, background)
        return torch.autograd.grad((image * image_gradient[:, fragments.pixels]).sum(), variable)[0]

    return step


def shade_by_face(fragments: Fragments, vertices: Tensor, light: Tensor, albedo: Tensor) -> Tensor:
    """`reference.radiance` with each face shaded once, not each sample: plain autograd at its cheapest."""
    normals = reference.unit(reference.doubled_area_vectors(vertices[fragments.corners]))
    irradiance = reference.irradiance(normals * fragments.facing.to(vertices), light)
    shade = irradiance[fragments.face] * albedo / fragments.samples**2
    return shade.new_zeros(len(fragments.pixels), 3).index_add(0, fragments.pixel, shade).T


SHADINGS: dict[str, Shading] = {
    "analytic": shading.radiance,
    "plain autograd, face by face": shade_by_face,
    "plain autograd, sample by sample": reference.radiance,
}


# ---------------------------------------------------------------------------- panels


def row_of(view: View, panel: str, setting: str, samples: int, default: bool = False, degree: int = DEGREE) -> Row:
    """samples: per side of a pixel in, of a whole pixel in the row."""
    row = {"panel": f"{panel}, {view.size}²", "setting": setting, "time_ms": None}
    return row | {"degree": degree, "samples": samples**2, "size": view.size, "default": default}


def light_steps(view: View) -> Entries:
    """A step of an attack on the light, by degree and number type of the operator."""
    exact = Converged(view)
    for degree, (name, dtype) in product(DEGREES, DTYPES.items()):
        operator = view.operator(SAMPLES, degree, dtype)
        light = coefficients(degree, torch.promote_types(dtype, torch.float32), view.device)
        default = (degree, name) == (DEGREE, "float32")
        row = row_of(view, "light step", f"degree {degree}, {name}", SAMPLES, default, degree)
        yield row | exact.of_operator(operator, light), light_step(view, operator, light)


def builds(view: View) -> Entries:
    """An operator of one view, by samples, degree and rasterizer."""
    exact, first = Converged(view), view.rasterizer
    for rasterizer, samples, degree in product(rasterizers(), PER_SIDE, DEGREES):
        build = partial(replace(view, rasterizer=rasterizer).operator, samples, degree)
        default = (rasterizer.name, samples, degree) == (first.name, SAMPLES, DEGREE)
        setting = f"{samples}² samples, degree {degree}, {rasterizer.name}"
        row = row_of(view, "building an operator", setting, samples, default, degree)
        yield row | exact.of_operator(build(), coefficients(degree, torch.float32, view.device)), build


def light_gradients(view: View, mitsuba: bool) -> Entries:
    """The gradient by the light: operator, plain autograd with cached visibility, Mitsuba."""
    light, operator = coefficients(DEGREE, torch.float32, view.device), view.operator()
    exact, panel = Converged(view, cut_irradiance), "gradient by the light"
    upstream, expected = view.upstream(operator.pixels), exact.by_light[: len(light)]

    def by_operator() -> Tensor:
        operator.radiance(light)
        return operator.light_gradient(upstream)

    yield row_of(view, panel, "operator", SAMPLES, default=True) | exact.of_operator(operator, light), by_operator
    vertices = view.vertices()
    fragments, albedo, _ = view.rasterized(1, vertices)
    sparse_upstream = view.upstream(fragments.pixels)

    def by_autograd() -> Tensor:
        variable = light.clone().requires_grad_()
        radiance = shade_by_face(fragments, vertices, variable, albedo)
        return torch.autograd.grad((radiance * sparse_upstream).sum(), variable)[0]

    image = view.canvas(shade_by_face(fragments, vertices, light, albedo), fragments.pixels)
    row = row_of(view, panel, "plain autograd, face by face, visibility cached", 1)
    yield row | exact.errors(image, by_autograd(), expected), by_autograd
    if mitsuba:
        peer = MitsubaView(view)
        row = row_of(view, panel, "Mitsuba 3", peer.samples)
        yield row | exact.errors(peer.image(), peer.light_gradient(), expected), peer.light_gradient


def vertex_gradients(view: View, mitsuba: bool) -> Entries:
    """A step by the vertices: analytic and plain autograd, visibility cached or rasterized anew, and Mitsuba."""
    light, exact = coefficients(DEGREE, torch.float32, view.device), Converged(view, cut_irradiance)
    panel = "gradient by the vertices"
    for samples, (name, shade) in product([s for s in PER_SIDE if s <= SAMPLES], SHADINGS.items()):
        if samples > 2 and name != "analytic":
            continue  # 64 times the work of one sample
        errors, default = exact.of_shading(samples, light, shade), (name, samples) == ("analytic", SAMPLES)
        row = row_of(view, panel, f"{name}, rasterized in every step", samples, default)
        yield row | errors, vertex_step(view, samples, light, shade)
        if samples == 1:
            row = row_of(view, panel, f"{name}, visibility cached", samples)
            yield row | errors, vertex_step(view, samples, light, shade, cached=True)
    if mitsuba:
        peer = MitsubaView(view)
        row = row_of(view, panel, "Mitsuba 3", peer.samples)
        yield row | exact.errors(peer.image(), peer.vertex_gradient(), exact.by_vertices), peer.vertex_gradient


def savings(view: View, folder: Path) -> dict[str, Pair]:
    """What a scene does not need: the same work with everything, and with what is needed only. folder: for a cache."""
    light, operator, size = coefficients(DEGREE, torch.float32, view.device), view.operator(), view.size
    _, nonzero, pixels = operator.transfer.shape

    def products(count: int, pixels: int) -> Callable[[], object]:
        """Of a transfer matrix of so many coefficients and pixels: radiance, and gradient by the light."""
        transfer, light, upstream = (
            torch.rand(shape, device=view.device) for shape in ((count, pixels), (3, count), (3, pixels))
        )
        return lambda: (light @ transfer, upstream @ transfer.T)

    needed, step = products(nonzero, pixels), light_step(view, operator, light)
    works = {
        f"{COEFFICIENTS - nonzero} of {COEFFICIENTS} coefficients reach no surface": (
            products(COEFFICIENTS, pixels), needed
        ),
        f"{size**2 - pixels:,} of {size**2:,} pixels show background": (products(nonzero, size**2), needed),
        "a step by the light does not rasterize": (lambda: light_step(view, view.operator(), light)(), step),
        **unseen_faces(view, light),
    }  # fmt: skip
    points = CAMERA.project(view.mesh.vertices)[None]
    for rasterizer in rasterizers():
        draw = partial(rasterizer.rasterize, points, view.mesh.faces, size)
        works[f"back faces of a closed mesh are not drawn, {rasterizer.name}"] = draw, partial(draw, closed=True)
    load = partial(paper_operators, view, OperatorCache(folder))
    load()
    works[f"{2 * VIEWS} operators are loaded, not built"] = partial(paper_operators, view, OperatorCache(None)), load
    return works


def paper_operators(view: View, cache: OperatorCache) -> None:
    """Two meshes from ten views."""
    for seed in (0, 1):
        cameras, settings = orbit_cameras(VIEWS, 2.2), ImageSettings(view.size, SAMPLES)
        cache.operators(solid("orange", seed), cameras, settings, view.rasterizer)


def unseen_faces(view: View, light: Tensor) -> dict[str, Pair]:
    """The gradient by the vertices of all faces, and of those that a sample sees."""
    variable = view.vertices().requires_grad_()
    needed, albedo, _ = view.rasterized(1, variable)
    corners, upstream = torch.from_numpy(view.mesh.faces).to(view.device), view.upstream(needed.pixels)
    everything = replace(
        needed,
        faces=torch.arange(len(corners), device=view.device),
        corners=corners,
        facing=torch.ones(len(corners), 1, dtype=torch.float64, device=view.device),
        face=needed.faces[needed.face],
    )

    def gradient(fragments: Fragments) -> Tensor:
        shade = shading.radiance(fragments, variable, light, albedo)
        return torch.autograd.grad((shade * upstream).sum(), variable)[0]

    name = f"{len(corners) - len(needed.faces):,} of {len(corners):,} faces are unseen (gradient by the vertices)"
    return {name: (partial(gradient, everything), partial(gradient, needed))}


# ---------------------------------------------------------------------------- results


def error_of(row: Row) -> float:
    """The larger of the two, to the three digits that the reference is good for."""
    return float(f"{max(row['image_error'], row['gradient_error']):.3g}")


def with_front(rows: Sequence[Row]) -> list[Row]:
    """Rows of one panel, marked where no other is as fast and as accurate, and better in one of the two."""

    def beaten(row: Row) -> bool:
        own = row["time_ms"], error_of(row)
        others = [(other["time_ms"], error_of(other)) for other in rows]
        return any(other != own and other[0] <= own[0] and other[1] <= own[1] for other in others)

    return [row | {"front": not beaten(row)} for row in rows]


def draw(path: Path, panels: Sequence[Sequence[Row]]) -> None:
    """A set of axes per panel: all settings, their front and the default."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lines = -(-len(panels) // 4)
    figure, axes = plt.subplots(lines, 4, figsize=(21, 6 * lines), squeeze=False, layout="constrained")
    for ax, rows in zip(axes.flat, panels, strict=False):
        front = sorted((row for row in rows if row["front"]), key=lambda row: row["time_ms"])
        ax.plot([row["time_ms"] for row in front], [error_of(row) for row in front], "k-", lw=1, label="front")
        named = "degree" if len({row["degree"] for row in rows}) > 1 else "setting"
        for name in dict.fromkeys(row[named] for row in rows):
            group, label = [row for row in rows if row[named] == name], f"degree {name}" if named == "degree" else name
            ax.plot([row["time_ms"] for row in group], [error_of(row) for row in group], "o", ms=5, label=label)
        [default] = [row for row in rows if row["default"]]
        ax.plot(default["time_ms"], error_of(default), "*", ms=15, color="#c62f2f", label="default")
        ax.set(title=rows[0]["panel"], xlabel="milliseconds", ylabel="relative error", xscale="log", yscale="log")
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4 if named == "degree" else 1)
    figure.savefig(path, dpi=100)
    plt.close(figure)


@cache
def rasterizers() -> tuple[Rasterizer, ...]:
    """Those that work here, the one that "auto" chooses first."""
    rasterizers = [choose()]
    for name in NAMES[1:]:
        try:
            rasterizers += [choose(name)] if name != rasterizers[0].name else []
        except InputError:
            print(f"{name} does not rasterize here and is left out")
    return tuple(rasterizers)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write renderer_pareto.csv and renderer_pareto.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    parser.add_argument("--mitsuba", action="store_true", help="time Mitsuba 3, too (needs LLVM)")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 224], help="of images, in pixels")
    parser.add_argument("--subdivisions", type=int, default=5, help="of the icosahedron; 5 make 10,242 vertices")
    parser.add_argument("--rounds", type=int, default=21, help="in which all settings take turns")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's software OpenGL on the one thread, too
    print(machine(options.device))
    mesh, panels, skipped = ellipsoid(options.subdivisions), [], []

    def timed(entries: Entries) -> list[Row]:
        rows, calls = zip(*entries, strict=True)
        times = medians(dict(enumerate(calls)), options.rounds, options.device)
        print(f"{rows[0]['panel']}: {len(rows)} settings", flush=True)
        return [row | {"time_ms": times[index]} for index, row in enumerate(rows)]

    for size in options.sizes:
        view = View(mesh, size, rasterizers()[0], options.device)
        panels += [with_front(timed(entries)) for entries in (light_steps(view), builds(view))]
        for gradients in (light_gradients, vertex_gradients):
            panels.append(with_front(timed(gradients(view, options.mitsuba))))
        with TemporaryDirectory() as folder:
            for name, pair in savings(view, Path(folder)).items():
                settings = ("with everything", "with what is needed")
                rows = [row_of(view, f"skipped: {name}", setting, SAMPLES) for setting in settings]
                skipped += timed(zip(rows, pair, strict=True))
    write_csv(options.out / "renderer_pareto.csv", [*chain.from_iterable(panels), *skipped])
    draw(options.out / "renderer_pareto.png", panels)


if __name__ == "__main__":
    main()
