"""Time against error of the renderer, in one run: python scripts/benchmark_renderer.py --peers

Writes docs/performance_renderer.md with docs/renderer_pareto.{png,csv} and docs/renderer_scaling.{png,csv}. Takes a few
minutes on one CPU thread; --peers adds Mitsuba 3 and, where it is installed, PyTorch3D.
"""

import argparse
import os
import sys
from dataclasses import asdict
from pathlib import Path

import torch
from benchmarks import comparison, panels, plots, report, results, scaling, skipping, targets
from benchmarks.measure import Clock, machine
from benchmarks.panels import QUICK, Bench, Plan
from benchmarks.reference import Converged
from benchmarks.report import Findings
from benchmarks.scenes import irradiance

from renderer.errors import InputError
from renderer.mesh import Mesh, load_mesh, normalise
from renderer.shapes import solid
from renderer.visibility import Backend, choose
from train.cli import command_line, one_sentence_errors
from train.outputs import save_page, writable_folder

DOCS = Path(__file__).parents[1] / "docs"


@one_sentence_errors
def main() -> None:
    arguments = _arguments()
    writable_folder(arguments.out, "--out")
    torch.set_num_threads(1)
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's software OpenGL, too, on the one thread
    device, plan = torch.device(arguments.device), QUICK if arguments.quick else Plan()
    description = machine(device)
    bench = Bench(plan, Clock(device, plan.rounds), _backends(), device)
    meshes = [normalise(load_mesh(path)) for path in arguments.meshes] or [solid("orange", 0), solid("orange", 1)]
    findings = _measure(bench, meshes, arguments.peers)
    _write(arguments.out, findings, description)
    for line in (*findings.notes, *report.verdicts(findings)):
        print(line)
    for target in findings.targets:
        met = {None: "not measured", True: "met", False: "NOT MET"}[target.passed]
        print(f"{met}: {target.what}: {target.asked}; {target.found}")
    print(f"written: {arguments.out / 'performance_renderer.md'}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", action="store_true", help="time other differentiable renderers, too")
    parser.add_argument("--quick", action="store_true", help="tiny settings, once each: to see that it runs")
    parser.add_argument("--device", default="cpu", help="where torch computes: cpu or cuda")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder to write to")
    parser.add_argument("--meshes", nargs="*", default=[], help="files whose operators are built, not solid oranges")
    return parser.parse_args()


def _backends() -> tuple[Backend, ...]:
    """The rasterisers that work here, the one that "auto" chooses first."""
    backends = [choose()]
    for name in ("software", "opengl"):
        if name != backends[0].name:
            try:
                backends.append(choose(name))
            except InputError:
                print(f"{name} does not rasterise here and is left out")
    return tuple(backends)


def _measure(bench: Bench, meshes: list[Mesh], with_peers: bool) -> Findings:
    plan = bench.plan
    peers, notes = comparison.installed_peers() if with_peers else ({}, ["Run with --peers to time other renderers."])
    print(f"rasterisers: {', '.join(backend.description for backend in bench.backends)}", flush=True)
    choices = [
        panels.light_steps(bench, plan.small),
        panels.light_steps(bench, plan.large),
        panels.builds(bench),
        panels.vertex_steps(bench),
    ]
    print("measured: choices", flush=True)
    compared = [
        comparison.by_light(bench, plan.small, peers),
        comparison.by_light(bench, plan.large, peers),
        comparison.by_vertices(bench, plan.large, peers),
    ]
    print("measured: comparisons", flush=True)
    workloads = [*(panels.workloads(bench, axis) for axis in ("size", "vertices")), panels.batches(bench)]
    print("measured: workloads", flush=True)
    reference = Converged(bench.view(plan.mesh, plan.large))
    return Findings(
        targets=[*targets.compared(compared), *targets.measured(bench, meshes)],
        choices=choices,
        descent=panels.refreshes(bench),
        comparisons=compared,
        workloads=workloads,
        savings=skipping.measure(bench, meshes),
        scaling=scaling.measure(bench),
        notes=notes,
        reference=(reference.samples, plan.large, reference.uncertainty(irradiance)),
    )


def _write(folder: Path, findings: Findings, description: str) -> None:
    command = command_line(sys.argv[1:])
    save_page(folder / "performance_renderer.md", report.page(findings, command, description))
    rows = [*results.records(findings.panels), *(asdict(row) for rows in findings.workloads for row in rows)]
    results.write_csv(folder / "renderer_pareto.csv", rows)
    results.write_csv(folder / "renderer_scaling.csv", [asdict(point) for point in findings.scaling])
    plots.draw_fronts(folder / "renderer_pareto.png", findings.panels)
    plots.draw_scaling(folder / "renderer_scaling.png", findings.scaling, findings.workloads)


if __name__ == "__main__":
    main()
