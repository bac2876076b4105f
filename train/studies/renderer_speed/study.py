"""The renderer's time against its error, in one run."""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from augment.objects import load_object
from renderer.errors import InputError, require_choice
from renderer.mesh import Mesh
from renderer.shapes import solid
from renderer.visibility import NAMES, Backend, choose
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_folder
from train.device import choose_device
from train.report.tables import markdown, shown
from train.settings import SceneSettings, read_object
from train.studies.page import filled, joined, machine, wrapped, write, write_section
from train.studies.renderer_speed import (
    comparison,
    figures,
    mitsuba_peer,
    panels,
    results,
    scaling,
    skipping,
    targets,
    vertices,
)
from train.studies.renderer_speed.bench import QUICK, Bench, Plan
from train.studies.renderer_speed.measure import Clock
from train.studies.renderer_speed.reference import Converged
from train.studies.renderer_speed.scenes import irradiance
from train.studies.targets import table_of

PAGE = "performance_renderer.md"


@dataclass
class RendererSpeedSettings:
    """conf/benchmark_renderer.yaml. out: a folder. peers: whether Mitsuba 3 is timed, too. quick: tiny settings, once.
    only: null, or vertices, whose section of the page is measured anew and the rest kept.

    scene.meshes: those whose operators are built; none: two solid oranges as they are, not normalised.
    """

    out: str
    device: str
    peers: bool
    quick: bool
    only: str | None
    scene: SceneSettings


def run(settings: RendererSpeedSettings) -> None:
    """Measure, and write the page, its figures and its numbers."""
    out = writable_folder(settings.out, "out")
    if settings.only is not None:
        require_choice("only", settings.only, ["vertices"])
        if not (out / PAGE).is_file():
            raise InputError(f"only={settings.only}: there is no {out / PAGE} to put the section into")
    torch.set_num_threads(1)
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's software OpenGL, too, on the one thread
    device, plan = choose_device(settings.device), QUICK if settings.quick else Plan()
    description = machine(device)
    bench = Bench(plan, Clock(device, plan.rounds), _backends(), device)
    without = _without_mitsuba(settings.peers)
    if settings.only:
        _, section = vertices.measure(bench, not without, description)
        return write_section(out / PAGE, section)
    named = [read_object(item, "", index) for index, item in enumerate(settings.scene.meshes)]
    meshes = [load_object(item).mesh for item in named] or [solid("orange", seed) for seed in (0, 1)]
    _measure(bench, meshes, out, description, without)


def _backends() -> tuple[Backend, ...]:
    """The rasterisers that work here, the one that "auto" chooses first."""
    backends = [choose()]
    for name in NAMES[1:]:
        if name != backends[0].name:
            try:
                backends.append(choose(name))
            except InputError:
                print(f"{name} does not rasterise here and is left out")
    return tuple(backends)


def _without_mitsuba(asked: bool) -> str:
    """Why Mitsuba is not timed; nothing where it is."""
    if not asked:
        return "Run with peers=true to time Mitsuba 3, too."
    try:
        mitsuba_peer.on_one_thread()
    except InputError as error:
        return f"{mitsuba_peer.NAME} was not timed: {error}."
    return ""


def _measure(bench: Bench, meshes: Sequence[Mesh], out: Path, description: str, without: str) -> None:
    """Everything. meshes: whose operators are built. description: of the machine. without: why Mitsuba is not timed."""
    plan = bench.plan
    print(f"rasterisers: {', '.join(backend.description for backend in bench.backends)}", flush=True)
    choices, descent = panels.measure(bench), panels.refreshes(bench)
    print("measured: choices", flush=True)
    by_light = [bench.timed(comparison.by_light(bench, size, not without)) for size in (plan.small, plan.large)]
    of_vertices, section = vertices.measure(bench, not without, description)
    print("measured: comparisons", flush=True)
    workloads, by_lights = [scaling.workloads(bench, axis) for axis in ("size", "vertices")], scaling.batches(bench)
    points, reference = scaling.measure(bench), Converged(bench.view(plan.mesh, plan.large))
    print("measured: workloads", flush=True)
    text = filled(
        __file__,
        command=command_line(),
        machine=description,
        without=without,
        reference_samples=reference.samples,
        reference_size=plan.large,
        small=plan.small,
        uncertainty=shown(reference.uncertainty(irradiance)),
        targets=table_of([*targets.by_light(*by_light), *targets.measured(bench, meshes)]),
        choices=results.defaults(choices),
        descent=markdown(
            ["visibility", "ms per step", "final image's error", "share of the cost that is left"],
            [(row.setting, row.time_ms, row.image_error, row.cost) for row in descent],
        ),
        by_light="\n\n".join(map(results.compared, by_light)),
        vertices=section,
        savings=skipping.table(bench, meshes),
        by_lights=", ".join(f"{row.setting} {shown(row.time_ms)} ms" for row in by_lights),
        by_variables=scaling.table(points),
    )
    write(out / PAGE, joined([wrapped(text)]))
    fronts = [*choices, descent, *by_light, of_vertices]
    growth = (asdict(row) for rows in (*workloads, by_lights) for row in rows)
    results.write_csv(out / "renderer_pareto.csv", [*results.records(fronts), *growth])
    results.write_csv(out / "renderer_scaling.csv", [asdict(point) for point in points])
    figures.draw_fronts(out / "renderer_pareto.png", fronts)
    figures.draw_scaling(out / "renderer_scaling.png", points, workloads)
