"""The renderer's time against its error, in one run."""

import os
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from augment.objects import load_object
from renderer.errors import InputError
from renderer.mesh import Mesh
from renderer.shapes import solid
from renderer.visibility import NAMES, Backend, choose
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_folder
from train.device import choose_device
from train.settings import SceneSettings, read_object
from train.studies.page import machine, write
from train.studies.renderer_speed import (
    comparison,
    figures,
    mitsuba_peer,
    panels,
    results,
    scaling,
    shaped,
    skipping,
    targets,
    vertices,
)
from train.studies.renderer_speed.measure import Clock
from train.studies.renderer_speed.page import Findings, page
from train.studies.renderer_speed.panels import QUICK, Bench, Plan
from train.studies.renderer_speed.reference import Converged
from train.studies.renderer_speed.scenes import irradiance

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
    if settings.only not in (None, "vertices"):
        raise InputError(f"only={settings.only}: choose vertices, or null for the whole page")
    if settings.only and not (out / PAGE).is_file():
        raise InputError(f"only={settings.only}: there is no {out / PAGE} to put the section into")
    torch.set_num_threads(1)
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's software OpenGL, too, on the one thread
    device, plan = choose_device(settings.device), QUICK if settings.quick else Plan()
    description = machine(device)
    bench = Bench(plan, Clock(device, plan.rounds), _backends(), device)
    if settings.only:
        found = vertices.measure(bench, _mitsuba_starts(settings.peers)[0])
        section = vertices.section(found, command_line(), description)
        return write(out / PAGE, vertices.put(section, (out / PAGE).read_text("utf-8")))
    named = [read_object(item, "", index) for index, item in enumerate(settings.scene.meshes)]
    meshes = [load_object(item).mesh for item in named] or [solid("orange", seed) for seed in (0, 1)]
    findings = _measure(bench, meshes, settings.peers)
    _write(out, findings, description)


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


def _mitsuba_starts(asked: bool) -> tuple[bool, list[str]]:
    """(whether Mitsuba is timed, and why not)."""
    if not asked:
        return False, ["Run with peers=true to time Mitsuba 3, too."]
    try:
        mitsuba_peer.on_one_thread()
    except InputError as error:
        return False, [f"{mitsuba_peer.NAME} was not timed: {error}."]
    return True, []


def _measure(bench: Bench, meshes: list[Mesh], peers: bool) -> Findings:
    plan = bench.plan
    with_mitsuba, notes = _mitsuba_starts(peers)
    print(f"rasterisers: {', '.join(backend.description for backend in bench.backends)}", flush=True)
    choices = [
        panels.light_steps(bench, plan.small),
        panels.light_steps(bench, plan.large),
        panels.builds(bench),
        panels.vertex_steps(bench),
        *shaped.builds(bench),
    ]
    print("measured: choices", flush=True)
    compared = [
        comparison.by_light(bench, plan.small, with_mitsuba),
        comparison.by_light(bench, plan.large, with_mitsuba),
    ]
    print("measured: comparisons", flush=True)
    of_vertices = vertices.measure(bench, with_mitsuba)
    print("measured: vertices", flush=True)
    workloads = [*(panels.workloads(bench, axis) for axis in ("size", "vertices")), panels.batches(bench)]
    print("measured: workloads", flush=True)
    reference = Converged(bench.view(plan.mesh, plan.large))
    return Findings(
        targets=[*targets.by_light(*compared), *targets.measured(bench, meshes)],
        choices=choices,
        descent=panels.refreshes(bench),
        comparisons=compared,
        vertices=of_vertices,
        workloads=workloads,
        savings=skipping.measure(bench, meshes),
        scaling=scaling.measure(bench),
        notes=notes,
        reference=(reference.samples, plan.large, reference.uncertainty(irradiance)),
    )


def _write(folder: Path, findings: Findings, description: str) -> None:
    text = page(findings, command_line(), description)
    write(folder / PAGE, text)
    rows = [*results.records(findings.panels), *(asdict(row) for rows in findings.workloads for row in rows)]
    results.write_csv(folder / "renderer_pareto.csv", rows)
    results.write_csv(folder / "renderer_scaling.csv", [asdict(point) for point in findings.scaling])
    figures.draw_fronts(folder / "renderer_pareto.png", findings.panels)
    figures.draw_scaling(folder / "renderer_scaling.png", findings.scaling, findings.workloads)
