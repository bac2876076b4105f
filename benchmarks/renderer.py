"""Run time against error of the renderer and of other ways to the same image and gradients.

    python -m benchmarks.renderer --mitsuba

writes renderer_pareto.csv and renderer_pareto.png in some minutes on one CPU thread. The scene is an ellipsoid of one
color under a light probe and a sun, whose bands never end, so that cutting the light off after a degree is an error,
too. Errors are root mean squares of the difference to a converged float64 reference, over the reference's: of the
radiance before clamping, and of the gradient of Σ radiance × normal random numbers, with visibility fixed.
"""

import argparse
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

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


@dataclass(frozen=True)
class Bench:
    """Options of the command, and the rasterizers, the default first."""

    options: argparse.Namespace
    rasterizers: tuple[Rasterizer, ...]

    def view(self, vertices: int, size: int) -> View:
        return View(ellipsoid(vertices), size, self.rasterizers[0], self.options.device)

    def light(self, degree: int = DEGREE, dtype: torch.dtype = torch.float32) -> Tensor:
        return coefficients(degree, dtype, self.options.device)

    def timed(self, entries: Entries, slowness: int = 1) -> list[Row]:
        """Rows with their times. slowness: by which the rounds are divided."""
        rows, calls = zip(*entries, strict=True)
        times = medians(dict(enumerate(calls)), max(1, self.options.rounds // slowness), self.options.device)
        print(f"{rows[0]['panel']}: {len(rows)} settings", flush=True)
        return [row | {"time_ms": times[index]} for index, row in enumerate(rows)]


def row_of(view: View, panel: str, setting: str, samples: int, **more: Any) -> Row:
    """samples: per side of a pixel in, of a whole pixel in the row."""
    axes = {"degree": DEGREE, "samples": samples**2, "size": view.size, "vertices": len(view.mesh.vertices)}
    return {"panel": panel, "setting": setting, "time_ms": None, **axes} | more


def light_steps(bench: Bench, view: View) -> Entries:
    """A step of an attack on the light, by degree and number type of the operator."""
    exact = Converged(view)
    for degree, (name, dtype) in product(bench.options.degrees, DTYPES.items()):
        operator, light = view.operator(SAMPLES, degree, dtype), bench.light(degree)
        light = light.to(torch.promote_types(dtype, torch.float32))
        default, errors = (degree, name) == (DEGREE, "float32"), exact.of_operator(operator, light)
        row = row_of(
            view, f"light step, {view.name}", f"degree {degree}, {name}", SAMPLES, degree=degree, default=default
        )
        yield row | errors, light_step(view, operator, light)


def builds(bench: Bench, view: View) -> Entries:
    """An operator of one view, by samples, degree and rasterizer."""
    exact, panel = Converged(view), f"building an operator, {view.name}"
    for choice in product(bench.rasterizers, bench.options.samples, bench.options.degrees):
        rasterizer, samples, degree = choice
        build = partial(replace(view, rasterizer=rasterizer).operator, samples, degree)
        setting, default = f"{samples}² samples, degree {degree}, {rasterizer.name}", choice[1:] == (SAMPLES, DEGREE)
        row = row_of(
            view, panel, setting, samples, degree=degree, default=default and rasterizer == bench.rasterizers[0]
        )
        yield row | exact.of_operator(build(), bench.light(degree)), build


def light_gradients(bench: Bench, view: View) -> Entries:
    """The gradient by the light: operator, operator rasterized in every step, plain autograd, Mitsuba."""
    light, operator, exact = bench.light(), view.operator(), Converged(view, cut_irradiance)
    upstream, expected = view.upstream(operator.pixels), exact.by_light[: len(light)]
    panel, errors = f"gradient by the light, {view.name}", exact.of_operator(operator, light)

    def differentiate(operator: TransferOperator) -> Tensor:
        operator.radiance(light)
        return operator.light_gradient(upstream)

    yield row_of(view, panel, "operator", SAMPLES, default=True) | errors, lambda: differentiate(operator)
    again = row_of(view, panel, "operator, rasterized in every step", SAMPLES)
    yield again | errors, lambda: differentiate(view.operator())
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
    if bench.options.mitsuba:
        peer = MitsubaView(view)
        row = row_of(view, panel, "Mitsuba 3", peer.samples)
        yield row | exact.errors(peer.image(), peer.light_gradient(), expected), peer.light_gradient


def vertex_gradients(bench: Bench, view: View) -> Entries:
    """A step by the vertices: analytic and plain autograd, visibility cached or rasterized anew, and Mitsuba."""
    light, exact, panel = bench.light(), Converged(view, cut_irradiance), f"gradient by the vertices, {view.name}"
    for samples, (name, shade) in product([s for s in bench.options.samples if s <= SAMPLES], SHADINGS.items()):
        if samples > 2 and name != "analytic":
            continue  # 64 times the work of one sample
        errors, default = exact.of_shading(samples, light, shade), (name, samples) == ("analytic", SAMPLES)
        row = row_of(view, panel, f"{name}, rasterized in every step", samples, default=default)
        yield row | errors, vertex_step(view, samples, light, shade)
        if samples == 1:
            row = row_of(view, panel, f"{name}, visibility cached", samples)
            yield row | errors, vertex_step(view, samples, light, shade, cached=True)
    if bench.options.mitsuba:
        peer = MitsubaView(view)
        row = row_of(view, panel, "Mitsuba 3", peer.samples)
        yield row | exact.errors(peer.image(), peer.vertex_gradient(), exact.by_vertices), peer.vertex_gradient


def skipped(bench: Bench, view: View) -> list[Row]:
    """What a scene does not need: the same work with everything, and with what is needed only."""
    rows = []
    for what, everything, needed in savings(bench, view):
        entries = {"with everything": everything, "with what is needed": needed}
        panel = f"skipped, {view.name}: {what}"
        rows += bench.timed((row_of(view, panel, setting, SAMPLES), call) for setting, call in entries.items())
    return rows


def savings(bench: Bench, view: View) -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """(what is skipped, the work with it, the work without)"""
    light, operator, size = bench.light(), view.operator(), view.size
    _, reaching, pixels = operator.transfer.shape
    products = {
        f"{COEFFICIENTS - reaching} of {COEFFICIENTS} coefficients reach no surface": (COEFFICIENTS, pixels),
        f"{size**2 - pixels:,} of {size**2:,} pixels show background": (reaching, size**2),
    }
    needed = matrix_products(bench, (reaching, pixels))
    for what, shape in products.items():
        yield f"{what} (product and transpose)", matrix_products(bench, shape), needed
    yield (
        "the mesh is not rasterized in a step by the light",
        lambda: light_step(view, view.operator(), light)(),
        (light_step(view, operator, light)),
    )
    with TemporaryDirectory() as folder:
        load = partial(paper_operators, bench, size, OperatorCache(Path(folder)))
        load()
        build = partial(paper_operators, bench, size, OperatorCache(None))
        yield f"{2 * VIEWS} operators are loaded, not built", build, load
    yield unseen_faces(bench, view)
    points = CAMERA.project(view.mesh.vertices)[None]
    for rasterizer in bench.rasterizers:
        draw = partial(rasterizer.rasterize, points, view.mesh.faces, size)
        yield f"back faces of a closed mesh are not drawn, {rasterizer.name}", draw, partial(draw, closed=True)


def matrix_products(bench: Bench, shape: tuple[int, int]) -> Callable[[], object]:
    """Of a float32 transfer matrix of this shape: radiance, and gradient by the light."""
    transfer, *sides = (torch.rand(size, device=bench.options.device) for size in (shape, (3, shape[0]), (3, shape[1])))
    return lambda: (sides[0] @ transfer, sides[1] @ transfer.T)


def paper_operators(bench: Bench, size: int, cache: OperatorCache) -> list[TransferOperator]:
    """Two meshes from ten views."""
    settings, cameras = ImageSettings(size, SAMPLES), orbit_cameras(VIEWS, 2.2)
    meshes = [solid("orange", seed) for seed in (0, 1)]
    return [each for mesh in meshes for each in cache.operators(mesh, cameras, settings, bench.rasterizers[0])]


def unseen_faces(bench: Bench, view: View) -> tuple[str, Callable[[], object], Callable[[], object]]:
    """The gradient by the vertices of all faces, and of those that a sample sees."""
    light, variable = bench.light(), view.vertices().requires_grad_()
    needed, albedo, _ = view.rasterized(1, variable)
    corners, upstream = torch.from_numpy(view.mesh.faces).to(bench.options.device), view.upstream(needed.pixels)
    everything = replace(
        needed,
        faces=torch.arange(len(corners), device=bench.options.device),
        corners=corners,
        facing=torch.ones(len(corners), 1, dtype=torch.float64, device=bench.options.device),
        face=needed.faces[needed.face],
    )

    def gradient(fragments: Fragments) -> Tensor:
        shade = shading.radiance(fragments, variable, light, albedo)
        return torch.autograd.grad((shade * upstream).sum(), variable)[0]

    what = f"{len(corners) - len(needed.faces):,} of {len(corners):,} faces are unseen (gradient by the vertices)"
    return what, partial(gradient, everything), partial(gradient, needed)


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
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    lines = -(-len(panels) // 3)
    figure, axes = plt.subplots(lines, 3, figsize=(16, 6 * lines), squeeze=False, layout="constrained")
    for ax in axes.flat[len(panels) :]:
        ax.axis("off")
    for ax, rows in zip(axes.flat, panels, strict=False):
        front = sorted((row for row in rows if row["front"]), key=lambda row: row["time_ms"])
        ax.plot([row["time_ms"] for row in front], [error_of(row) for row in front], "k-", lw=1, label="front")
        named = "degree" if len({row["degree"] for row in rows}) > 1 else "setting"
        for name in dict.fromkeys(row[named] for row in rows):
            group, label = [row for row in rows if row[named] == name], f"degree {name}" if named == "degree" else name
            ax.plot([row["time_ms"] for row in group], [error_of(row) for row in group], "o", ms=5, label=label)
        for row in rows:
            if row.get("default"):
                ax.plot(row["time_ms"], error_of(row), "*", ms=15, color="#c62f2f", label="default")
        ax.set(title=rows[0]["panel"], xlabel="milliseconds", ylabel="relative error", xscale="log", yscale="log")
        for axis in (ax.xaxis, ax.yaxis):
            low, high = axis.get_view_interval()
            axis.set_major_locator(LogLocator(subs=range(1, 10) if high < 5 * low else (1, 2, 5), numticks=12))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.12g}"))
            axis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4 if named == "degree" else 1)
    figure.savefig(path, dpi=100)
    plt.close(figure)


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
    parser.add_argument("--vertices", type=int, nargs="+", default=[10_000], help="of meshes, about")
    parser.add_argument("--degrees", type=int, nargs="+", default=[2, 4, 6, 8, 10, 12], help="of the harmonics")
    parser.add_argument("--samples", type=int, nargs="+", default=[1, 2, 4, 8, 16], help="per side of a pixel")
    parser.add_argument("--rounds", type=int, default=21, help="in which all settings take turns")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's software OpenGL on the one thread, too
    print(machine(options.device))
    bench = Bench(options, rasterizers())
    scenes = [bench.view(vertices, size) for vertices in options.vertices for size in options.sizes]
    panels = [bench.timed(panel(bench, view)) for panel in (light_steps, light_gradients) for view in scenes]
    panels += [bench.timed(panel(bench, view), slowness=2) for panel in (builds, vertex_gradients) for view in scenes]
    fronts = [with_front(rows) for rows in panels]
    savings = [row for view in scenes for row in skipped(bench, view)]
    write_csv(options.out / "renderer_pareto.csv", [*(row for rows in fronts for row in rows), *savings])
    draw(options.out / "renderer_pareto.png", fronts)


if __name__ == "__main__":
    main()
