"""Run time against error of the renderer and of other ways to the same image and gradients.

    python -m benchmarks.renderer --mitsuba

writes renderer_pareto.csv and renderer_pareto.png in some minutes on one CPU
thread. The scene is an ellipsoid of one color under a light probe and a sun.
The sun has harmonics of every degree, so cutting the light off after a degree
is an error, too.

Errors are relative to a converged float64 reference: the root mean square of
the difference, divided by the root mean square of the reference. They are
measured on the radiance before clamping, and on the gradient of
Σ image × normal random numbers, with visibility fixed.

The panel "rasterizing" times each rasterizer. The panel "shadows" times the
building of operators of a cup with shadows (`benchmarks.lights`), and its
reference has more samples and ray directions. The panel "random light" times
`nb.RandomLighting` for one image (`benchmarks.transforms`), and its reference is
the same formula in float64. These panels alone, with all other rows kept, take
about 15 minutes of processor time:

    python -m benchmarks.renderer --panels rasterizing shadows "random light" --seconds 60

Whole light steps (an image with background and clamp, a loss, and the loss's
gradient by the light) are timed beside autograd code that keeps all it can
(`benchmarks.peer`) and beside the operator's step written out by hand, for two
meshes. Their images and gradients are equal, or the run stops. Ratios are to
the first row of each group, which is the peer or the loop. This table alone
takes a few minutes:

    python -m benchmarks.renderer --whole-steps-only --rasterizer numba --out whole_steps
"""

import argparse
import csv
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks import common, scene
from benchmarks.common import Row, machine, quartiles, times_in_turn, write_csv
from benchmarks.lights import shadow_builds
from benchmarks.peer import Peer
from benchmarks.savings import measure_savings
from benchmarks.scene import (
    BACKGROUND,
    CAMERA,
    SAMPLES,
    Contender,
    Converged,
    MitsubaStep,
    Result,
    Step,
    View,
    coefficients,
)
from benchmarks.steps import ANALYTIC, SHADINGS, LightStep, VertexStep, shade_by_face
from benchmarks.transforms import random_lights
from benchmarks.whole_steps import measure_many_views, measure_whole_steps
from renderer.errors import InputError
from renderer.light.basis import DEGREE
from renderer.mesh import Mesh
from renderer.settings import RASTERIZERS
from renderer.visibility import Rasterizer, choose

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float64": torch.float64}
# Degrees of the spherical harmonics that are compared.
DEGREES = (2, 4, 6, 8, 10, 12)
# Samples per side of a pixel that are compared.
SAMPLES_PER_SIDE = (1, 2, 4, 8, 16)
# Samples per side of a pixel in the whole light steps.
WHOLE_STEP_SAMPLES = (2, 8)
# Plain autograd by the vertices takes at most so many samples per side of a
# pixel. With the 8 samples of pnb-train, it has 64 times the work of one.
MAX_AUTOGRAD_SAMPLES = 2
PANELS_PER_ROW = 4


# ---------------------------------------------------------------------------- contenders


def light_steps(view: View) -> Iterator[Contender]:
    """Yield a step of an attack on the light for each degree and type of the operator."""
    for degree, (name, dtype) in product(DEGREES, DTYPES.items()):
        light_dtype = torch.promote_types(dtype, torch.float32)
        light = coefficients(degree, light_dtype, view.device)
        step = LightStep(view, view.operator(SAMPLES, degree, dtype), light)
        yield Contender(
            setting=f"degree {degree}, {name}", samples=SAMPLES, degree=degree, step=step, call=step
        )


def builds(view: View) -> Iterator[Contender]:
    """Yield the building of an operator for each number of samples and degree."""
    for samples, degree in product(SAMPLES_PER_SIDE, DEGREES):
        build = partial(view.operator, samples, degree)
        light = coefficients(degree, torch.float32, view.device)
        yield Contender(
            setting=f"{samples}² samples, degree {degree}",
            samples=samples,
            degree=degree,
            step=LightStep(view, build(), light),
            call=build,
        )


def light_gradients(view: View) -> Iterator[Contender]:
    """Yield ways to the gradient by the light.

    The first is the operator. The others are plain autograd, which computes
    more and more once and keeps it.
    """
    step: Step = OperatorGradient(view)
    yield Contender("operator", SAMPLES, DEGREE, step, step)
    for samples in (1, SAMPLES):
        for kept, render in LightRenders(view, samples).by_kept_part().items():
            step = AutogradGradient(view, samples, render)
            yield Contender(f"plain autograd, kept: {kept}", samples, DEGREE, step, step)


class OperatorGradient:
    """Radiance, and the gradient of the loss by the light from the operator itself."""

    def __init__(self, view: View):
        self.operator = view.operator()
        self.light = coefficients(DEGREE, torch.float32, view.device)
        self.image_gradient = view.image_gradient_at(self.operator.pixels)

    def __call__(self) -> Result:
        """Return the radiance and the gradient by the light."""
        return Result(
            pixels=self.operator.pixels,
            radiance=self.operator.radiance(self.light),
            gradient=self.operator.light_gradient(self.image_gradient),
        )


class AutogradGradient:
    """Radiance, and the gradient of the loss by the light from autograd.

    Args:
        view: View to render.
        samples: Samples per side of a pixel.
        render: Function from a light to the radiance of the P covered pixels,
            shape (3, P).
    """

    def __init__(self, view: View, samples: int, render: Callable[[Tensor], Tensor]):
        self.render = render
        self.light = coefficients(DEGREE, torch.float32, view.device)
        self.pixels = view.operator(samples).pixels
        self.image_gradient = view.image_gradient_at(self.pixels)

    def __call__(self) -> Result:
        """Return the radiance and the gradient by the light."""
        light = self.light.clone().requires_grad_()
        radiance = self.render(light)
        [gradient] = torch.autograd.grad(radiance, light, self.image_gradient)
        return Result(self.pixels, radiance.detach(), gradient)


class LightRenders:
    """Functions from a light to the radiance of the P covered pixels, shape (3, P).

    They differ in what they compute once and keep for all lights.

    Args:
        view: View to render.
        samples: Samples per side of a pixel.
    """

    def __init__(self, view: View, samples: int):
        self.view = view
        self.samples = samples
        self.vertices = view.vertices()
        self.surface = view.visible_surface(samples, self.vertices)
        self.operator = view.operator(samples)
        self.transfer = self.operator.transfer[0]
        self.transfer_of_pixels = self.transfer.T.contiguous()
        self.albedo_of_pixels = self.operator.albedo.T.contiguous()

    def by_kept_part(self) -> dict[str, Callable[[Tensor], Tensor]]:
        """Return the functions by the name of what they keep, from nothing to the operator."""
        view = self.view
        peer = Peer(
            view.mesh,
            CAMERA,
            view.size,
            self.samples,
            DEGREE,
            view.rasterizer,
            BACKGROUND,
            view.device,
        )
        renders: dict[str, Callable[[Tensor], Tensor]] = {}
        if self.samples == 1:
            # The time of these two grows in proportion to the samples, so that
            # one sample per pixel is enough to know it.
            renders["nothing"] = self.rasterize_and_shade
            renders["visibility"] = self.shade
        renders["harmonics of the seen faces"] = peer.radiance
        renders["operator, pixels first"] = self.multiply_pixels_first
        renders["operator"] = self.multiply
        return renders

    def rasterize_and_shade(self, light: Tensor) -> Tensor:
        """Rasterize the mesh, and shade its visible faces."""
        surface = self.view.visible_surface(self.samples, self.vertices)
        return shade_by_face(surface.fragments, self.vertices, light, surface.albedo)

    def shade(self, light: Tensor) -> Tensor:
        """Shade the faces that were visible at the beginning."""
        return shade_by_face(self.surface.fragments, self.vertices, light, self.surface.albedo)

    def multiply_pixels_first(self, light: Tensor) -> Tensor:
        """Multiply the transfer matrix, shape (P, K), with the light, shape (K, 3)."""
        irradiance = self.transfer_of_pixels @ light[self.operator.nonzero]
        return (irradiance * self.albedo_of_pixels).T

    def multiply(self, light: Tensor) -> Tensor:
        """Multiply the light, shape (3, K), with the transfer matrix, shape (K, P)."""
        irradiance = light[self.operator.nonzero].T @ self.transfer
        return irradiance * self.operator.albedo


def vertex_gradients(view: View) -> Iterator[Contender]:
    """Yield steps by the vertices.

    Their gradients are analytic or from plain autograd. The mesh is rasterized
    in every step or, with one sample per pixel, also once for all steps.
    """
    light = coefficients(DEGREE, torch.float32, view.device)
    for samples, (name, shade) in product(SAMPLES_PER_SIDE, SHADINGS.items()):
        if samples > SAMPLES:
            continue
        if samples > MAX_AUTOGRAD_SAMPLES and name != ANALYTIC:
            continue
        step = VertexStep(view, samples, light, shade)
        yield Contender(f"{name}, rasterized in every step", samples, DEGREE, step, step)
        if samples == 1:
            step = VertexStep(view, samples, light, shade, is_rasterized_once=True)
            yield Contender(f"{name}, visibility cached", samples, DEGREE, step, step)


def rasterizers(view: View) -> Iterator[Contender]:
    """Yield each rasterizer that works here, with each number of samples.

    Points are on the device of the view, so the time on a GPU includes copies to the CPU.
    """
    points = torch.from_numpy(CAMERA.project(view.mesh.vertices))[None].to(view.device)
    light = coefficients(DEGREE, torch.float32, view.device)
    found = []
    for name in RASTERIZERS:
        with suppress(InputError):
            found += [choose(name)] if name != "auto" else []
    for rasterizer, samples in product(found, SAMPLES_PER_SIDE):
        operator = replace(view, rasterizer=rasterizer).operator(samples)
        resolution = view.size * samples
        call = partial(
            rasterizer.rasterize, points, view.mesh.faces, resolution, closed=view.mesh.closed
        )
        step = LightStep(view, operator, light)
        yield Contender(rasterizer.name, samples, DEGREE, step, call)


# ---------------------------------------------------------------------------- panels


@dataclass(frozen=True)
class Panel:
    """Contenders that are compared with each other.

    Attributes:
        contenders: Function that yields the contenders for a view.
        irradiance: Irradiance of the converged reference: a function from unit
            normals (N, 3) to irradiance (N, 3). None if contenders have references.
        is_by_vertices: Whether the gradient is by the vertices, and not by the
            light.
        mitsuba_parameter: Mitsuba's name of what the gradient is by. None if
            the panel has no row of Mitsuba.
        has_front: Whether all contenders do the same work.
    """

    contenders: Callable[[View], Iterator[Contender]]
    irradiance: Callable[[Tensor], Tensor] | None = None
    is_by_vertices: bool = False
    mitsuba_parameter: str | None = None
    has_front: bool = True


PANELS = {
    "light step": Panel(light_steps, scene.whole_irradiance),
    "building an operator": Panel(builds, scene.whole_irradiance),
    "gradient by the light": Panel(
        light_gradients, scene.cut_irradiance, mitsuba_parameter="light.data"
    ),
    "gradient by the vertices": Panel(
        vertex_gradients,
        scene.cut_irradiance,
        is_by_vertices=True,
        mitsuba_parameter="mesh.vertex_positions",
    ),
    "rasterizing": Panel(rasterizers, scene.cut_irradiance),
    "shadows": Panel(shadow_builds),
    "random light": Panel(random_lights, has_front=False),
}

# Panels of `benchmarks.rivals` that are drawn. Its attacks change all images in two steps.
RIVAL_PANELS = ("spherical harmonics",)

# Names of the contenders that pnb-train uses by default, with SAMPLES per side
# of a pixel. nb.render has fewer samples.
TRAINING_SETTINGS = {
    "operator",
    f"degree {DEGREE}, float32",
    f"{ANALYTIC}, rasterized in every step",
    f"{SAMPLES}² samples, degree {DEGREE}",
    "numba",
    "2,048 directions",
}


def measure(title: str, view: View, rounds: int, with_mitsuba: bool, seconds: float) -> list[Row]:
    """Measure the time and the errors of all contenders of a panel.

    Args:
        title: Key of `PANELS`.
        view: View to render.
        rounds: Number of rounds.
        with_mitsuba: Whether Mitsuba 3 is a contender, too.
        seconds: Time after which no further round begins.

    Returns:
        A row for each contender, with the column "front" of `mark_front`, and the quartiles of
        the time.
    """
    panel = PANELS[title]
    exact = None
    if panel.irradiance is not None:
        converged = Converged(view, panel.irradiance)
        gradient = converged.by_vertices if panel.is_by_vertices else converged.by_light
        exact = converged.result(gradient)
    contenders = list(panel.contenders(view))
    if with_mitsuba and panel.mitsuba_parameter is not None:
        step = MitsubaStep(view, panel.mitsuba_parameter)
        contenders.append(Contender("Mitsuba 3", scene.MITSUBA_SAMPLES, DEGREE, step, step))
    rows: list[Row] = []
    for contender in contenders:
        row = describe_contender(contender, f"{title}, {view.size}²", view.size)
        rows.append(row | contender.step().errors(contender.exact or exact))
    calls = {index: contender.call for index, contender in enumerate(contenders)}
    for index, times in times_in_turn(calls, rounds, view.device, seconds).items():
        low, middle, high = quartiles(times)
        rows[index] |= {"time_ms": middle, "time_ms_low": low, "time_ms_high": high}
    if panel.has_front:
        mark_front(rows)
    print(f"{title}, {view.size}²: {len(rows)} settings", flush=True)
    return rows


def describe_contender(contender: Contender, panel: str, size: int) -> Row:
    """Return the row of a contender without its time and errors.

    Args:
        contender: Contender to describe.
        panel: Title of the panel with the size.
        size: Pixels per side of the image.
    """
    of_training = contender.samples == SAMPLES and contender.setting in TRAINING_SETTINGS
    return {
        "panel": panel,
        "setting": contender.setting,
        # None keeps the place of the column until the time is measured.
        "time_ms": None,
        "degree": contender.degree,
        "samples": contender.samples and contender.samples**2,
        "size": size,
        "pnb-train": of_training,
    }


def mark_front(rows: Sequence[Row]) -> None:
    """Set the column "front", which says that no other contender beats a contender.

    Another contender beats it with a smaller time and no larger error, or with a
    smaller error and no larger time.
    """
    points = [(row["time_ms"], error_of(row)) for row in rows]
    for row, point in zip(rows, points, strict=True):
        time, error = point
        is_beaten = [other != point and other[0] <= time and other[1] <= error for other in points]
        row["front"] = not any(is_beaten)


def error_of(row: Row) -> float:
    """Return the larger of a row's two errors, to three significant digits.

    The reference is not accurate enough for more digits.
    """
    largest = max(row["image_error"], row.get("gradient_error", 0.0))
    return float(f"{largest:.3g}")


# ---------------------------------------------------------------------------- results


@dataclass(frozen=True)
class Style:
    """Style of the points of a group in a figure.

    Attributes:
        line: Color, marker and line in matplotlib's short form.
        marker_size: Size of the markers in points.
        layer: Order of drawing. Higher layers cover lower ones.
    """

    line: str
    marker_size: int
    layer: int


STYLES = {"front": Style("k-", 5, 3), "pnb-train": Style("r*", 14, 3)}


def read_rows(path: Path) -> list[Row]:
    """Read rows of measurements as text, without the columns that they lack."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [{name: text for name, text in row.items() if text} for row in rows]


def write_panels(folder: Path, measured: Sequence[Row]) -> None:
    """Write the rows of some panels, keep those of all others, and draw the figure anew."""
    path = folder / "renderer_pareto.csv"
    replaced = {row["panel"] for row in measured}
    kept = [row for row in read_rows(path) if row["panel"] not in replaced]
    write_csv(path, [*kept, *measured])
    draw(path.with_suffix(".png"), read_rows(path))


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw the time and the error of all settings, with axes for each panel and size."""
    panels: list[list[Row]] = []
    for title in (*PANELS, *RIVAL_PANELS):
        of_title = [row for row in rows if row["panel"].rpartition(", ")[0] == title]
        for size in dict.fromkeys(row["panel"] for row in of_title):
            panels.append([parse_row(row) for row in of_title if row["panel"] == size])
    row_count = -(-len(panels) // PANELS_PER_ROW)
    figure = Figure(figsize=(20, 5 * row_count), layout="constrained")
    all_axes = figure.subplots(row_count, PANELS_PER_ROW, squeeze=False)
    for axes in all_axes.flat[len(panels) :]:
        axes.set_axis_off()
    for axes, panel in zip(all_axes.flat, panels, strict=False):
        draw_panel(axes, panel)
    figure.savefig(path, dpi=120)


def parse_row(row: Row) -> Row:
    """Convert the columns that are drawn from text."""
    numbers = ("time_ms", "image_error", "gradient_error")
    marks = ("front", "pnb-train")
    return (
        row
        | {name: float(row[name]) for name in numbers if name in row}
        | {name: row.get(name) == "True" for name in marks}
    )


def draw_panel(axes: Axes, rows: Sequence[Row]) -> None:
    """Draw the points of a panel by setting or, if the degrees differ, by degree.

    Settings that differ in the type in parentheses are one group. Settings that differ in a degree
    in parentheses are a curve, whose points have the degree beside them. References, whose error is
    0, have no point.
    """
    has_degrees = len({row.get("degree") for row in rows}) > 1
    shown = [row for row in rows if error_of(row) > 0]
    # The front and the settings of pnb-train come first in the legend.
    points: dict[str, list[tuple[float, float]]] = {"front": [], "pnb-train": []}
    for row in shown:
        row["group"] = row["setting"].partition(" (")[0]
        if degree := re.search(r"\(degree (\d+), ", row["setting"]):
            row["group"] = row["setting"].replace(degree[0], "(")
            axes.annotate(degree[1], (row["time_ms"], error_of(row)), fontsize=7)
        if has_degrees:
            row["group"] = f"degree {row['degree']}"
        points.setdefault(row["group"], [])
    for row in sorted(shown, key=lambda row: row["time_ms"]):
        marks = [mark for mark in ("front", "pnb-train") if row[mark]]
        for group in [row["group"], *marks]:
            points[group].append((row["time_ms"], error_of(row)))
    for number, (group, group_points) in enumerate(points.items()):
        if not group_points:
            continue
        # There are ten colors, and then other markers. The first two groups are in STYLES.
        marker = "o" if number < 12 else "s"
        style = STYLES.get(group, Style(f"{marker}-" if "(" in group else marker, 5, 2))
        times, errors = zip(*group_points, strict=True)
        axes.loglog(
            times, errors, style.line, label=group, ms=style.marker_size, zorder=style.layer
        )
    axes.set(title=rows[0]["panel"], xlabel="milliseconds", ylabel="relative error")
    axes.tick_params(which="minor", labelsize=6)
    axes.legend(fontsize=7)


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = common.make_parser(__doc__)
    add = parser.add_argument
    add("--out", type=Path, default=Path("docs"), help="folder of the results")
    add("--mitsuba", action="store_true", help="time Mitsuba 3, too, which needs LLVM")
    add("--rasterizer", choices=RASTERIZERS, default="auto")
    add("--device", default="cpu", help="cpu or cuda")
    add(
        "--subdivisions",
        type=int,
        default=5,
        help="subdivisions of the icosahedron; 5 make 10,242 vertices",
    )
    add(
        "--step-sizes",
        type=int,
        nargs="+",
        default=[32, 64, 224],
        help="pixels per side of the images in whole light steps",
    )
    add(
        "--coarse", type=int, default=3, help="subdivisions of the second mesh of whole light steps"
    )
    add("--whole-steps-only", action="store_true", help="write whole_steps.csv alone")
    add("--panels", nargs="+", choices=PANELS, help="measure these panels, and keep other rows")
    add(
        "--seconds",
        type=float,
        default=common.MAX_COMPARISON_SECONDS,
        help="time of a panel after which no further round begins",
    )
    return parser


def measure_steps_of_meshes(
    meshes: Sequence[Mesh], rasterizer: Rasterizer, options: argparse.Namespace
) -> list[Row]:
    """Measure whole light steps of one view and of many views."""
    rows = []
    for mesh in meshes:
        for size, samples in product(options.step_sizes, WHOLE_STEP_SAMPLES):
            view = View(mesh, size, rasterizer, options.device)
            rows += measure_whole_steps(view, samples, options.rounds)
        rows += measure_many_views(mesh, rasterizer, options.rounds, options.device)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write renderer_pareto.csv and renderer_pareto.png.

    Args:
        arguments: Words of the command line. None takes those of the process.
    """
    options = make_parser().parse_args(arguments)
    torch.set_num_threads(1)
    # Mesa's software OpenGL then runs on the same thread.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    print(machine(options.device))
    rasterizer = choose(options.rasterizer)
    mesh = scene.ellipsoid(options.subdivisions)
    step_rows = []
    if not options.panels:
        meshes = [scene.ellipsoid(options.coarse), mesh]
        step_rows = measure_steps_of_meshes(meshes, rasterizer, options)
    if options.whole_steps_only:
        write_csv(options.out / "whole_steps.csv", step_rows)
        return
    measured = []
    saving_rows = []
    for size in options.sizes:
        view = View(mesh, size, rasterizer, options.device)
        for title in options.panels or PANELS:
            measured += measure(title, view, options.rounds, options.mitsuba, options.seconds)
        if not options.panels:
            saving_rows += measure_savings(view, options.rounds)
    write_panels(options.out, [*measured, *saving_rows, *step_rows])


if __name__ == "__main__":
    main()
