"""Run time against error of the renderer and of other ways to the same image and gradients.

    python -m benchmarks.renderer --mitsuba

writes renderer_pareto.csv and renderer_pareto.png in some minutes on one CPU thread. The scene is an ellipsoid of one
color under a light probe and a sun, whose bands never end, so that cutting the light off after a degree is an error,
too. Errors are root mean squares of the difference to a converged float64 reference, over the reference's: of the
radiance before clamping, and of the gradient of Σ image × normal random numbers, with visibility fixed.

Whole light steps (an image with background and clamp, a loss, and the loss's gradient by the light) are timed beside
autograd code that keeps all it can (`benchmarks.peer`) and beside the operator's step written out by hand, for two
meshes. Their images and gradients are equal, or the run stops. Ratios are to the first row of each group, the peer or
the loop. This table alone takes a few minutes:

    python -m benchmarks.renderer --whole-steps-only --rasterizer numba --out whole_steps
"""

import argparse
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from statistics import median
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks import reference, scene
from benchmarks.common import Row, machine, medians, quartiles_of_ratio, times_in_turn, write_csv
from benchmarks.peer import Peer
from benchmarks.scene import CAMERA, SAMPLES, Converged, Result, Step, View, coefficients
from renderer import rendering
from renderer.camera import orbit_cameras
from renderer.geometry.mesh import Mesh
from renderer.image import tonemap
from renderer.light.basis import COEFFICIENTS, DEGREE
from renderer.settings import RASTERIZERS, ImageSettings
from renderer.surface import shading
from renderer.surface.gloss import Gloss
from renderer.transport.operator_stacks import TransferOperators
from renderer.transport.operators import TransferOperator, build_operators
from renderer.visibility.fragments import Fragments
from renderer.visibility.rasterizers import Rasterizer, choose

BACKGROUND = 0.5
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float64": torch.float64}
DEGREES = (2, 4, 6, 8, 10, 12)  # of the harmonics
PER_SIDE = (1, 2, 4, 8, 16)  # samples per side of a pixel
STEP_SAMPLES = (2, 8)  # samples per side of a pixel in the whole light steps
MANY_VIEWS = (32, 100)  # pixels per side and number of views that are rendered in one call

Shading = Callable[[Fragments, Tensor, Tensor, Tensor], Tensor]
Call = Callable[[], object]
Lit = Callable[[Tensor], tuple[Tensor, Tensor]]  # a light to the covered pixels and their radiance
Contender = tuple[str, int, int, Step, Call]  # setting, samples per side, degree, what is right, what is timed


# ---------------------------------------------------------------------------- what is timed


def light_step(view: View, operator: TransferOperator, light: Tensor) -> Step:
    """Light → image → gradient of a scalar loss by the light."""
    upstream = view.upstream(operator.pixels, light.dtype)
    coverage, background = operator.coverage.to(light.dtype)[None], light.new_full((1, 1), BACKGROUND)

    def step() -> Result:
        variable = light.clone().requires_grad_()
        radiance = operator.radiance(variable)
        image = tonemap(radiance, coverage, background)
        [gradient] = torch.autograd.grad((image * upstream).sum(), variable)
        return operator.pixels, radiance.detach(), gradient

    return step


def vertex_step(
    view: View, samples: int, light: Tensor, shade: Shading = shading.radiance, cached: bool = False
) -> Step:
    """Vertices → image → gradient of a scalar loss by the vertices. cached: the mesh is not rasterized again."""
    vertices, background = view.vertices(light.dtype), light.new_full((1, 1), BACKGROUND)
    image_gradient, before = view.image_gradient.to(light.dtype), view.rasterized(samples, vertices)

    def step() -> Result:
        variable = vertices.clone().requires_grad_()
        fragments, albedo, coverage = before if cached else view.rasterized(samples, variable)
        radiance = shade(fragments, variable, light, albedo)
        image = tonemap(radiance, coverage, background)
        [gradient] = torch.autograd.grad((image * image_gradient[:, fragments.pixels]).sum(), variable)
        return fragments.pixels, radiance.detach(), gradient

    return step


def shade_by_face(fragments: Fragments, vertices: Tensor, light: Tensor, albedo: Tensor) -> Tensor:
    """`shading.radiance` by plain autograd at its cheapest: each face is shaded once, not each sample."""
    normals = reference.face_normals(vertices[fragments.corners])
    irradiance = reference.irradiance(normals * fragments.facing.to(vertices), light)
    shade = irradiance[fragments.face] * albedo / fragments.samples**2
    return shade.new_zeros(len(fragments.pixels), 3).index_add(0, fragments.pixel, shade).T


ANALYTIC, AUTOGRAD = "analytic", "plain autograd, face by face"
SHADINGS: dict[str, Shading] = {ANALYTIC: shading.radiance, AUTOGRAD: shade_by_face}


# ---------------------------------------------------------------------------- panels


def light_steps(view: View) -> Iterator[Contender]:
    """A step of an attack on the light, by degree and number type of the operator."""
    for degree, (name, dtype) in product(DEGREES, DTYPES.items()):
        light = coefficients(degree, torch.promote_types(dtype, torch.float32), view.device)
        step = light_step(view, view.operator(SAMPLES, degree, dtype), light)
        yield f"degree {degree}, {name}", SAMPLES, degree, step, step


def builds(view: View) -> Iterator[Contender]:
    """An operator of one view, by samples and degree."""
    for samples, degree in product(PER_SIDE, DEGREES):
        build = partial(view.operator, samples, degree)
        step = light_step(view, build(), coefficients(degree, torch.float32, view.device))
        yield f"{samples}² samples, degree {degree}", samples, degree, step, build


def light_gradients(view: View) -> Iterator[Contender]:
    """The gradient by the light: the operator, plain autograd with ever more computed once and kept."""
    light, vertices = coefficients(DEGREE, torch.float32, view.device), view.vertices()
    operator = view.operator()
    upstream = view.upstream(operator.pixels)

    def by_operator() -> Result:
        return operator.pixels, operator.radiance(light), operator.light_gradient(upstream)

    yield "operator", SAMPLES, DEGREE, by_operator, by_operator
    for samples, (kept, render) in [(s, item) for s in (1, SAMPLES) for item in lit_by_autograd(view, vertices, s)]:
        upstream_there = view.upstream(view.operator(samples).pixels)

        def by_autograd(render: Lit = render, upstream: Tensor = upstream_there) -> Result:
            variable = light.clone().requires_grad_()
            pixels, radiance = render(variable)
            return pixels, radiance.detach(), *torch.autograd.grad(radiance, variable, upstream)

        yield f"plain autograd, kept: {kept}", samples, DEGREE, by_autograd, by_autograd


def lit_by_autograd(view: View, vertices: Tensor, samples: int) -> Iterator[tuple[str, Lit]]:
    """What is kept from step to step, and a function of the light to the covered pixels and their radiance."""
    operator, (fragments, albedo, _) = view.operator(samples), view.rasterized(samples, vertices)
    pixels = fragments.pixels
    if samples == 1:  # with more, both take as many times as long

        def drawn(light: Tensor) -> tuple[Tensor, Tensor]:
            fragments, albedo, _ = view.rasterized(samples, vertices)
            return pixels, shade_by_face(fragments, vertices, light, albedo)

        yield "nothing", drawn
        yield "visibility", lambda light: (pixels, shade_by_face(fragments, vertices, light, albedo))
    peer = Peer(view.mesh, CAMERA, view.size, samples, DEGREE, view.rasterizer, BACKGROUND, view.device)
    yield "harmonics of the seen faces", lambda light: (pixels, peer.radiance(light))
    at_pixels = operator.transfer[0]
    pixel_major, pixel_albedo = at_pixels.T.contiguous(), operator.albedo.T.contiguous()
    yield "operator, pixels first", lambda light: (pixels, (pixel_major @ light[operator.nonzero] * pixel_albedo).T)
    yield "operator", lambda light: (pixels, light[operator.nonzero].T @ at_pixels * operator.albedo)


def vertex_gradients(view: View) -> Iterator[Contender]:
    """A step by the vertices: analytic and plain autograd, visibility cached or rasterized anew."""
    light = coefficients(DEGREE, torch.float32, view.device)
    for samples, (name, shade) in product([s for s in PER_SIDE if s <= SAMPLES], SHADINGS.items()):
        if samples > 2 and name != ANALYTIC:
            continue  # 64 times the work of one sample
        step = vertex_step(view, samples, light, shade)
        yield f"{name}, rasterized in every step", samples, DEGREE, step, step
        if samples == 1:
            step = vertex_step(view, samples, light, shade, cached=True)
            yield f"{name}, visibility cached", samples, DEGREE, step, step


PANELS = {  # contenders, the reference's irradiance and gradient
    "light step": (light_steps, scene.whole_irradiance, "by_light"),
    "building an operator": (builds, scene.whole_irradiance, "by_light"),
    "gradient by the light": (light_gradients, scene.cut_irradiance, "by_light"),
    "gradient by the vertices": (vertex_gradients, scene.cut_irradiance, "by_vertices"),
}
MITSUBA = {"gradient by the light": "light.data", "gradient by the vertices": "mesh.vertex_positions"}


def measure(panel: str, view: View, options: argparse.Namespace) -> list[Row]:
    """A row per contender, marked where no other is as fast and as accurate, and better in one of the two."""
    contenders, irradiance, gradient = PANELS[panel]
    exact, rows, calls = Converged(view, irradiance), [], []
    measured = list(contenders(view))
    if options.mitsuba and panel in MITSUBA:
        step = scene.mitsuba_step(view, MITSUBA[panel])
        measured.append(("Mitsuba 3", scene.MITSUBA_SAMPLES, DEGREE, step, step))
    defaults = {"operator", f"degree {DEGREE}, float32", f"{ANALYTIC}, rasterized in every step"}
    defaults |= {f"{SAMPLES}² samples, degree {DEGREE}"}
    for setting, samples, degree, step, call in measured:
        row = {"panel": f"{panel}, {view.size}²", "setting": setting, "time_ms": None}
        row |= {"degree": degree, "samples": samples**2, "size": view.size}
        row["default"] = samples == SAMPLES and setting in defaults
        rows.append(row | exact.errors(step, getattr(exact, gradient)))
        calls.append(call)
    for index, time in medians(dict(enumerate(calls)), options.rounds, options.device).items():
        rows[index]["time_ms"] = time
    points = [(row["time_ms"], error_of(row)) for row in rows]
    for row, p in zip(rows, points, strict=True):
        row["front"] = not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points)
    print(f"{panel}, {view.size}²: {len(rows)} settings", flush=True)
    return rows


def error_of(row: Row) -> float:
    """The larger of the two, to the three digits that the reference is good for."""
    return float(f"{max(row['image_error'], row['gradient_error']):.3g}")


# ---------------------------------------------------------------------------- whole light steps


AUTOGRAD_STEP = "image and autograd.grad"
DIRECT_STEP = "image_and_gradient"
HAND_STEP = "by hand"
PEER_STEP = "plain autograd that keeps all it can"
LOOP = "loop over operators"

WholeStep = Callable[[], tuple[Tensor, Tensor]]  # the image, and the gradient of the loss by the light


@dataclass(frozen=True)
class Loss:
    """Σ image × weights, with weights (3, size, size), as code would compute it with autograd and without."""

    weights: Tensor

    def step(self, image: Callable[[Tensor], Tensor], light: Tensor) -> WholeStep:
        """Return a step that renders a light and differentiates the loss by it with autograd."""

        def step() -> tuple[Tensor, Tensor]:
            variable = light.clone().requires_grad_()
            shown = image(variable)
            [gradient] = torch.autograd.grad((shown * self.weights).sum(), variable)
            return shown.detach(), gradient

        return step

    def gradient(self, image: Tensor) -> Tensor:
        """Compute the loss, and return its gradient by the image."""
        _ = (image * self.weights).sum()
        return self.weights


class ByHand:
    """The practical limit of a whole light step: an operator's products, background, clamp mask and gradient, written
    out for one light of its dtype, a gray background and linear values, without checks and without autograd."""

    def __init__(self, operator: TransferOperator, background: float):
        self.shape = 3, operator.settings.size, operator.settings.size
        self.pixels, self.coefficients = operator.pixels, operator.nonzero
        self.rows = operator.pixels.expand(3, -1)
        self.transfer, self.albedo = operator.transfer[0], operator.albedo
        self.behind = (1 - operator.coverage) * background
        self.canvas = operator.coverage.new_full((3, self.shape[1] ** 2), background)

    def step(self, light: Tensor, loss: Loss) -> tuple[Tensor, Tensor]:
        """Compute the image (3, size, size) and the gradient of the loss by the light."""
        reaching = light.index_select(0, self.coefficients).mT
        values = (reaching @ self.transfer).mul_(self.albedo).add_(self.behind)
        clamped = values.clamp(0, 1)
        passing = values.eq_(clamped)
        image = self.canvas.clone().scatter_(1, self.rows, clamped).view(self.shape)
        covered = loss.gradient(image).reshape(3, -1).index_select(1, self.pixels)
        product = torch.nn.functional.linear(covered.mul_(passing).mul_(self.albedo), self.transfer)
        return image, torch.zeros_like(light).index_copy_(0, self.coefficients, product.mT)


def whole_steps(view: View, samples: int, options: argparse.Namespace) -> list[Row]:
    """Measure a whole light step and its preparation by the operator, by hand and by `Peer`, which agree to rounding.

    The columns ratio, ratio_low and ratio_high hold the median and the quartiles over the rounds of each time over that
    of the table's first row.
    """
    light = coefficients(DEGREE, torch.float32, view.device)
    loss = Loss(view.image_gradient.to(light.dtype).view(3, view.size, view.size))
    build_operator = partial(view.operator, samples)
    build_peer = partial(Peer, view.mesh, CAMERA, view.size, samples, DEGREE, view.rasterizer, BACKGROUND, view.device)
    operator, peer = build_operator(), build_peer()
    steps: dict[str, WholeStep] = {
        PEER_STEP: loss.step(peer.image, light),
        AUTOGRAD_STEP: loss.step(partial(operator.image, background=BACKGROUND), light),
        DIRECT_STEP: partial(operator.image_and_gradient, light, loss.gradient, BACKGROUND),
        HAND_STEP: partial(ByHand(operator, BACKGROUND).step, light, loss),
    }
    for setting in (AUTOGRAD_STEP, DIRECT_STEP):
        require_equal(steps[setting](), steps[PEER_STEP]())
        require_bits(steps[setting](), steps[HAND_STEP]())
    builds = {PEER_STEP: build_peer, "operator": build_operator}
    common = {"degree": DEGREE, "samples": samples**2, "size": view.size, "faces": len(view.mesh.faces)}
    rows = timed_in_turn(f"whole light step, {view.size}²", steps, common, options)
    return rows + timed_in_turn(f"building for whole light steps, {view.size}²", builds, common, options)


def many_views(mesh: Mesh, rasterizer: Rasterizer, options: argparse.Namespace) -> list[Row]:
    """Measure whole light steps of many views in a loop over the operators, and in one call of all."""
    size, count = MANY_VIEWS
    settings, cameras = ImageSettings(size, 2), orbit_cameras(count, CAMERA.width)
    operators = TransferOperators(build_operators(mesh, cameras, settings, rasterizer)).to(options.device)
    light = coefficients(DEGREE, torch.float32, options.device)
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(count, 3, size, size, generator=generator).to(options.device)

    def stacked_images(variable: Tensor) -> Tensor:
        return torch.stack([operator.image(variable, BACKGROUND) for operator in operators])

    def one_by_one() -> tuple[Tensor, Tensor]:
        single = [Loss(weight).step(op.image, light)() for op, weight in zip(operators, weights, strict=True)]
        return torch.stack([image for image, _ in single]), torch.stack([gradient for _, gradient in single]).sum(0)

    loss = Loss(weights)
    steps: dict[str, WholeStep] = {
        LOOP: one_by_one,
        "loop over operators, one gradient": loss.step(stacked_images, light),
        "image of all, and autograd.grad": loss.step(partial(operators.image, background=BACKGROUND), light),
        "image_and_gradient of all": partial(operators.image_and_gradient, light, loss.gradient, BACKGROUND),
    }
    for step in steps.values():
        require_equal(step(), steps[LOOP]())
    common = {"degree": DEGREE, "samples": settings.samples**2, "size": size, "faces": len(mesh.faces)}
    return timed_in_turn(f"{count} views, {size}²", steps, common, options)


def timed_in_turn(panel: str, calls: Mapping[str, Call], common: Row, options: argparse.Namespace) -> list[Row]:
    """Time calls in turn, and return a row for each, with the quartiles of the ratios to the first call."""
    times = times_in_turn(calls, options.rounds, options.device)
    first = next(iter(times.values()))
    rows = []
    for setting, milliseconds in times.items():
        low, middle, high = quartiles_of_ratio(milliseconds, first)
        row = {"panel": panel, "setting": setting, "time_ms": median(milliseconds), **common}
        rows.append(row | {"ratio": middle, "ratio_low": low, "ratio_high": high})
        print(f"{panel}, {common}: {setting} {rows[-1]['time_ms']:.3f} ms, {middle:.2f} [{low:.2f}, {high:.2f}]")
    return rows


def require_bits(found: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    """Stop the run unless the tensors are equal to the bit."""
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value, other, rtol=0, atol=0)


def require_equal(found: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    """Stop the run unless the tensors are equal up to the rounding of sums in float32."""
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value, other, rtol=0, atol=2e-5 * float(other.abs().max()))


# ---------------------------------------------------------------------------- what a scene does not need


def savings(view: View) -> Iterator[tuple[str, Call, Call]]:
    """What is skipped, the work with everything, and with what is needed."""
    operator, size = view.operator(), view.size
    _, nonzero, pixels = operator.transfer.shape

    def products(count: int, pixels: int) -> Call:
        """Of a transfer matrix of so many coefficients and pixels: radiance, and gradient by the light."""
        shapes = (count, pixels), (3, count), (3, pixels)
        transfer, light, upstream = (torch.rand(shape, device=view.device) for shape in shapes)
        return lambda: (light @ transfer, upstream @ transfer.T)

    unlit = f"{COEFFICIENTS - nonzero} of {COEFFICIENTS} coefficients reach no surface"
    yield unlit, products(COEFFICIENTS, pixels), products(nonzero, pixels)
    background = f"{size**2 - pixels:,} of {size**2:,} pixels show background"
    yield background, products(nonzero, size**2), products(nonzero, pixels)
    points = CAMERA.project(view.mesh.vertices)[None]
    draw = partial(view.rasterizer.rasterize, points, view.mesh.faces, size)
    yield f"back faces of a closed mesh are not drawn, {view.rasterizer.name}", draw, partial(draw, closed=True)
    step = light_step(view, operator, coefficients(DEGREE, torch.float32, view.device))
    yield "a step by the light does not rasterize", lambda: (view.operator(), step()), step
    light, shiny = coefficients(DEGREE, torch.float32, view.device), replace(view, mesh=Gloss(0.4).on(view.mesh))
    glossy, vertices = shiny.operator(), view.vertices()
    by_light = light_step(view, glossy, light)
    yield "a step by the light without gloss", by_light, step
    dense = replace(glossy, transfer=torch.rand_like(glossy.transfer))
    yield "as many coefficients and channels without gloss", by_light, light_step(view, dense, light)
    yield "building an operator without gloss", shiny.operator, view.operator

    def by_vertices(mesh: Mesh, **options: Any) -> Call:
        moved = vertices.clone().requires_grad_()
        options["rasterizer"] = view.rasterizer.name
        image = partial(rendering.render, mesh, CAMERA, light, view.size, vertices=moved, **options)
        return lambda: torch.autograd.grad(image().sum(), moved)

    yield "a step by the vertices without gloss", by_vertices(shiny.mesh), by_vertices(view.mesh)
    gloss = [torch.tensor(value, device=view.device, requires_grad=True) for value in (0.4, 0.0, 1.0)]
    given: dict[str, Any] = {"gloss": Gloss(*gloss), "rasterizer": view.rasterizer.name}
    image = partial(rendering.render, view.mesh, CAMERA, light, view.size, **given)
    yield (
        "a step by the vertices, not by the material",
        lambda: torch.autograd.grad(image().sum(), gloss),
        by_vertices(view.mesh),
    )
    for normals, samples in product(("flat", "smooth"), (8, 2)):
        everything, needed = (
            by_vertices(view.mesh, silhouettes=moves, normals=normals, samples=samples) for moves in (True, False)
        )
        yield f"a step by the vertices with fixed outlines, {normals}, {samples}² samples", everything, needed


# ---------------------------------------------------------------------------- results


def draw(path: Path, panels: Sequence[Sequence[Row]]) -> None:
    """A set of axes per panel: all settings, their front and the default."""
    lines = -(-len(panels) // 4)
    figure = Figure(figsize=(24, 6 * lines))
    for ax, rows in zip(figure.subplots(lines, 4, squeeze=False).flat, panels, strict=False):
        by_degree = len({row["degree"] for row in rows}) > 1
        points: dict[str, list[tuple[float, float]]] = {"front": [], "default": []}
        for row in sorted(rows, key=lambda row: row["time_ms"]):
            names = [f"degree {row['degree']}" if by_degree else row["setting"]]
            for name in names + [mark for mark in ("front", "default") if row[mark]]:
                points.setdefault(name, []).append((row["time_ms"], error_of(row)))
        for name, group in points.items():
            style, size, layer = {"front": ("k-", 5, 3), "default": ("r*", 14, 3)}.get(name, ("o", 5, 2))
            ax.loglog(*zip(*group, strict=True), style, label=name, ms=size, zorder=layer)
        ax.set(title=rows[0]["panel"], xlabel="milliseconds", ylabel="relative error")
        ax.legend(fontsize=7)
    figure.savefig(path, dpi=100)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write renderer_pareto.csv and renderer_pareto.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    parser.add_argument("--mitsuba", action="store_true", help="time Mitsuba 3, too (needs LLVM)")
    parser.add_argument("--rasterizer", choices=RASTERIZERS, default="auto")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 224], help="of images, in pixels")
    parser.add_argument("--subdivisions", type=int, default=5, help="of the icosahedron; 5 make 10,242 vertices")
    parser.add_argument("--rounds", type=int, default=21, help="in which all settings take turns")
    parser.add_argument("--step-sizes", type=int, nargs="+", default=[32, 64, 224], help="of whole light steps")
    parser.add_argument("--coarse", type=int, default=3, help="subdivisions of the second mesh of whole light steps")
    parser.add_argument("--whole-steps-only", action="store_true", help="write whole_steps.csv alone")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's software OpenGL on the one thread, too
    print(machine(options.device))
    rasterizer = choose(options.rasterizer)
    mesh = scene.ellipsoid(options.subdivisions)
    steps = []
    for shown in (scene.ellipsoid(options.coarse), mesh):
        for size, samples in product(options.step_sizes, STEP_SAMPLES):
            steps += whole_steps(View(shown, size, rasterizer, options.device), samples, options)
        steps += many_views(shown, rasterizer, options)
    if options.whole_steps_only:
        write_csv(options.out / "whole_steps.csv", steps)
        return
    panels, skipped = [], []
    for size in options.sizes:
        view = View(mesh, size, rasterizer, options.device)
        panels += [measure(panel, view, options) for panel in PANELS]
        for name, everything, needed in savings(view):
            slow, fast = medians({0: everything, 1: needed}, options.rounds, options.device).values()
            skipped += [{"panel": f"skipped, {size}²", "setting": name, "time_ms": fast, "saved": slow / fast}]
    write_csv(options.out / "renderer_pareto.csv", [*chain.from_iterable(panels), *skipped, *steps])
    draw(options.out / "renderer_pareto.png", panels)


if __name__ == "__main__":
    main()
