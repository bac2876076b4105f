"""What a scene does not need and the renderer leaves out: time and bytes with and without, one line each."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from renderer import shading
from renderer.cache import OperatorCache
from renderer.camera import ring
from renderer.fragments import Fragments
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.transfer import COEFFICIENTS, Operator
from train.report.tables import markdown
from train.studies.renderer_speed.bench import SAMPLES, Bench
from train.studies.renderer_speed.results import times
from train.studies.renderer_speed.scenes import CAMERA, View
from train.studies.renderer_speed.steps import light_step, seen

BACKGROUNDS, FIELD_OF_VIEW = 5, 2.2  # the paper's 100 examples are two meshes from ten views over five backgrounds


@dataclass(frozen=True)
class Saving:
    """The same work with everything, and with what is needed only; megabytes: of both, where they have a meaning."""

    what: str
    everything: Callable[[], object]
    needed: Callable[[], object]
    megabytes: tuple[float | None, float | None] = (None, None)


def table(bench: Bench, meshes: Sequence[Mesh]) -> str:
    """All of them. meshes: of the scene whose operators are shared and cached."""
    lines = []
    for saving in _savings(bench, meshes):
        ms = bench.clock.medians({"all": saving.everything, "needed": saving.needed})
        lines.append((saving.what, ms["all"], ms["needed"], times(ms["all"] / ms["needed"]), *saving.megabytes))
    return markdown(["what", "ms with all", "ms without", "saved", "MB with all", "MB without"], lines)


def build_operators(bench: Bench, meshes: Sequence[Mesh], cache: OperatorCache) -> list[Operator]:
    """Of all meshes from all views at the small size, as the paper's scene has them."""
    cameras, settings = ring(bench.plan.views, FIELD_OF_VIEW), ImageSettings(bench.plan.small, SAMPLES)
    return [operator for mesh in meshes for operator in cache.operators(mesh, cameras, settings, bench.backends[0])]


def _savings(bench: Bench, meshes: Sequence[Mesh]) -> Iterator[Saving]:
    large = bench.view(bench.plan.mesh, bench.plan.large)
    operator = large.operator(1)
    _, live, pixels = operator.transfer.shape
    dead = f"{COEFFICIENTS - live} of {COEFFICIENTS} coefficients reach no surface"
    yield _products(bench, dead, (COEFFICIENTS, pixels), (live, pixels))
    background = f"{large.size**2 - pixels:,} of {large.size**2:,} pixels show background"
    yield _products(bench, background, (live, large.size**2), (live, pixels))
    yield _sharing(bench, operator, len(meshes) * bench.plan.views)
    with TemporaryDirectory() as folder:
        build_operators(bench, meshes, OperatorCache(Path(folder)))
        build, load = (partial(build_operators, bench, meshes, OperatorCache(each)) for each in (None, Path(folder)))
        yield Saving(f"{len(meshes) * bench.plan.views} operators loaded from disk instead of built", build, load)
    yield _unseen_faces(bench, large)
    points = CAMERA.project(large.mesh.vertices)[None]
    for backend in bench.backends:
        what = f"back faces of a closed mesh are not drawn: rasterising {large.size}², {backend.name}"
        draw = partial(backend.rasterise, points, large.mesh.faces, large.size)
        yield Saving(what, draw, partial(draw, closed=True))
    yield _rasterisation(bench, bench.view(bench.plan.mesh, bench.plan.small))


def _products(bench: Bench, what: str, everything: tuple[int, int], needed: tuple[int, int]) -> Saving:
    """Of float32 matrices with these shapes."""

    def call(shape: tuple[int, int]) -> Callable[[], object]:
        transfer = torch.rand(shape, device=bench.device)
        light, upstream = (torch.rand(3, count, device=bench.device) for count in shape)
        return lambda: (light @ transfer, upstream @ transfer.T)

    count, fewer = (4e-6 * shape[0] * shape[1] for shape in (everything, needed))
    return Saving(f"{what}: the product and its transpose", call(everything), call(needed), (count, fewer))


def _sharing(bench: Bench, operator: Operator, views: int) -> Saving:
    """The examples of a view differ in their lights and backgrounds alone."""
    lights = bench.light().expand(BACKGROUNDS, -1, -1)
    upstream = torch.rand(BACKGROUNDS, 3, len(operator.pixels), device=bench.device)
    copies = [replace(operator, transfer=operator.transfer.clone()) for _ in lights]

    def apart() -> list[torch.Tensor]:
        for copy, light in zip(copies, lights, strict=True):
            copy.radiance(light)
        return [copy.light_gradient(gradient) for copy, gradient in zip(copies, upstream, strict=True)]

    def together() -> torch.Tensor:
        operator.radiance(lights)
        return operator.light_gradient(upstream)

    what = f"{views * BACKGROUNDS} examples share {views} operators: light steps of one view's {BACKGROUNDS}"
    stored = operator.transfer.nbytes / 1e6
    return Saving(what, apart, together, (BACKGROUNDS * stored, stored))


def _unseen_faces(bench: Bench, view: View) -> Saving:
    light, variable = bench.light(), view.vertices().requires_grad_()
    needed, albedo, _ = seen(view, 1, variable)
    corners = torch.from_numpy(view.mesh.faces).to(bench.device)
    everything = replace(
        needed,
        faces=torch.arange(len(corners), device=bench.device),
        corners=corners,
        facing=torch.ones(len(corners), 1, dtype=torch.float64, device=bench.device),
        face=needed.faces[needed.face],
    )
    upstream = view.upstream(needed.pixels)

    def gradient(fragments: Fragments) -> torch.Tensor:
        shade = shading.radiance(fragments, variable, light, albedo)
        return torch.autograd.grad((shade * upstream).sum(), variable)[0]

    hidden = len(corners) - len(needed.faces)
    what = f"{hidden:,} of {len(corners):,} faces are seen by no sample: the gradient by the vertices"
    return Saving(what, partial(gradient, everything), partial(gradient, needed))


def _rasterisation(bench: Bench, view: View) -> Saving:
    light, kept = bench.light(), view.operator(SAMPLES)

    def rasterising() -> torch.Tensor:
        return light_step(view, view.operator(SAMPLES), light)()

    what = f"an attack on the light never rasterises: a step at {view.size}²"
    return Saving(what, rasterising, light_step(view, kept, light))
