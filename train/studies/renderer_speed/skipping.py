"""What a scene does not need and the renderer leaves out: time and bytes with and without, one line each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
from train.studies.renderer_speed.panels import SAMPLES, Bench
from train.studies.renderer_speed.scenes import CAMERA, View
from train.studies.renderer_speed.steps import light_step, seen

BACKGROUNDS, FIELD_OF_VIEW = 5, 2.2  # the paper's 100 examples are two meshes from ten views over five backgrounds


@dataclass(frozen=True)
class Saving:
    """Median milliseconds and bytes with everything, and with what is needed only; None where it has no meaning."""

    what: str
    all_ms: float
    needed_ms: float
    all_bytes: int | None = None
    needed_bytes: int | None = None


def measure(bench: Bench, meshes: Sequence[Mesh]) -> list[Saving]:
    """All of them. meshes: of the scene whose operators are shared and cached."""
    large = bench.view(bench.plan.mesh, bench.plan.large)
    operator = large.operator(1)
    return [
        _dead_bands(bench, operator),
        _background(bench, operator, large.size**2),
        _sharing(bench, operator, len(meshes)),
        _cache(bench, meshes),
        _unseen_faces(bench, large),
        *_back_faces(bench, large),
        _rasterisation(bench, bench.view(bench.plan.mesh, bench.plan.small)),
    ]


def build_operators(bench: Bench, meshes: Sequence[Mesh], cache: OperatorCache) -> list[Operator]:
    """Of all meshes from all views at the small size, as the paper's scene has them."""
    cameras, settings = ring(bench.plan.views, FIELD_OF_VIEW), ImageSettings(bench.plan.small, SAMPLES)
    return [operator for mesh in meshes for operator in cache.operators(mesh, cameras, settings, bench.backends[0])]


def _dead_bands(bench: Bench, operator: Operator) -> Saving:
    _, live, pixels = operator.transfer.shape
    what = f"{COEFFICIENTS - live} of {COEFFICIENTS} coefficients reach no surface: the product and its transpose"
    return _products(bench, what, (COEFFICIENTS, pixels), (live, pixels))


def _background(bench: Bench, operator: Operator, everything: int) -> Saving:
    _, live, pixels = operator.transfer.shape
    what = f"{everything - pixels:,} of {everything:,} pixels show background: the product and its transpose"
    return _products(bench, what, (live, everything), (live, pixels))


def _products(bench: Bench, what: str, everything: tuple[int, int], needed: tuple[int, int]) -> Saving:
    """Of float32 matrices with these shapes."""

    def call(shape: tuple[int, int]) -> Callable[[], tuple[torch.Tensor, torch.Tensor]]:
        transfer = torch.rand(shape, device=bench.device)
        light, upstream = (torch.rand(3, count, device=bench.device) for count in shape)
        return lambda: (light @ transfer, upstream @ transfer.T)

    times = bench.clock.medians({shape: call(shape) for shape in (everything, needed)})
    count, fewer = (4 * shape[0] * shape[1] for shape in (everything, needed))
    return Saving(what, times[everything], times[needed], count, fewer)


def _sharing(bench: Bench, operator: Operator, meshes: int) -> Saving:
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

    times = bench.clock.medians({"apart": apart, "together": together})
    views = meshes * bench.plan.views
    what = f"{views * BACKGROUNDS} examples share {views} operators: light steps of one view's {BACKGROUNDS}"
    stored = operator.transfer.numel() * operator.transfer.element_size()
    return Saving(what, times["apart"], times["together"], BACKGROUNDS * stored, stored)


def _cache(bench: Bench, meshes: Sequence[Mesh]) -> Saving:
    with TemporaryDirectory() as folder:
        build_operators(bench, meshes, OperatorCache(Path(folder)))
        calls = {
            "build": lambda: build_operators(bench, meshes, OperatorCache()),
            "load": lambda: build_operators(bench, meshes, OperatorCache(Path(folder))),
        }
        times = bench.clock.medians(calls, max(1, bench.clock.rounds // 3))
    what = f"{len(meshes) * bench.plan.views} operators loaded from disk instead of built"
    return Saving(what, times["build"], times["load"])


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

    times = bench.clock.medians({"all": lambda: gradient(everything), "needed": lambda: gradient(needed)})
    hidden = len(corners) - len(needed.faces)
    what = f"{hidden:,} of {len(corners):,} faces are seen by no sample: the gradient by the vertices"
    return Saving(what, times["all"], times["needed"])


def _back_faces(bench: Bench, view: View) -> list[Saving]:
    """For closed meshes only: of others, back faces can be seen."""
    points, faces, savings = CAMERA.project(view.mesh.vertices)[None], view.mesh.faces, []
    for backend in bench.backends:
        calls = {
            closed: lambda closed=closed, backend=backend: backend.rasterise(points, faces, view.size, closed=closed)
            for closed in (False, True)
        }
        times = bench.clock.medians(calls)
        what = f"back faces of a closed mesh are not drawn: rasterising {view.size}², {backend.name}"
        savings.append(Saving(what, times[False], times[True]))
    return savings


def _rasterisation(bench: Bench, view: View) -> Saving:
    light, operator = bench.light(), view.operator(SAMPLES)

    def rasterising() -> torch.Tensor:
        return light_step(view, view.operator(SAMPLES), light)()

    times = bench.clock.medians({"all": rasterising, "needed": light_step(view, operator, light)})
    return Saving(f"an attack on the light never rasterises: a step at {view.size}²", times["all"], times["needed"])
