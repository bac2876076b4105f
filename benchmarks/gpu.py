"""What reading cannot settle about GPUs: each open question a row, with the ratio of two ways that take turns.

    python -m benchmarks.gpu --csv gpu.csv

Data, meshes and network are made up and small. Without a GPU, or with --device cpu, it is a dry run, which leaves out
what only a GPU can answer. Where there are several GPUs, `training` runs on one and on all of them.
"""

import argparse
import json
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from torch import nn

import renderer
from augment import AugmentationService, AugmentationSettings, StepSettings
from augment.service import TrainingAttackSettings
from augment.utils import Phases
from benchmarks.common import Row, machine, medians, write_csv
from benchmarks.training import make_sure
from renderer.errors import InputError
from renderer.rasterizer import choose, opengl
from train.device import GraphedModel, MixedPrecision, choose_precision
from train.networks import WideResNet

SHAPE = {"geometry": StepSettings("linf", 0.002, "sign", 0.001)}


def compared(options: argparse.Namespace, question: str, calls: dict[str, Callable[[], object]]) -> Iterator[Row]:
    """A row for each call but the first: its milliseconds, and those of the first."""
    times = medians(calls, options.rounds, options.device)
    base, *others = times
    for name in others:
        yield {"question": question, "way": name, "value": times[name], "than": base, "reference": times[base]}


def made_up(options: argparse.Namespace, device: str, steps: int | None = None, **attack: Any) -> AugmentationService:
    """Two meshes × views × five backgrounds, under attack."""
    settings = AugmentationSettings(attack=TrainingAttackSettings(max_steps=steps or options.steps, **attack))
    meshes = [("solid:orange:0", 0), ("solid:orange:1", 0)]
    of_scene = {"views": options.views, "samples": 2, "rasterizer": "numpy", "device": device}
    return AugmentationService.from_meshes(meshes, options.pixels, settings, **of_scene)


def sure_network(options: argparse.Namespace, device: str, precision: str = "auto") -> MixedPrecision:
    """A network that is sure of class 0, so that every attack takes all its steps."""
    torch.manual_seed(0)
    network = WideResNet(10, options.depth, 4, 0.0).eval()
    make_sure(network.head.state_dict())
    return MixedPrecision(network.to(device), choose_precision(precision, torch.device(device)))


def rasterizers(options: argparse.Namespace) -> Iterator[Row]:
    """Whether OpenGL is worth its context, or would be if a context were kept; and what EGL's devices are."""
    mesh, [camera] = renderer.solid("orange"), renderer.orbit_cameras(1, 2.2)
    for side in options.samples:
        drawn = camera.project(mesh.vertices)[None], mesh.faces, side, True
        calls = {name: partial(choose(name).rasterize, *drawn) for name in ("numba", "opengl")}
        [row] = compared(options, f"rasterize {side}² samples", calls)
        with opengl._context() as context:
            kept = medians({"kept": partial(opengl._draw, context, *drawn)}, options.rounds, options.device)
        yield from (row, row | {"way": "opengl, context kept", "value": kept["kept"]})
    for index in count():
        with patch.dict("os.environ", GLCONTEXT_DEVICE_INDEX=str(index)):
            try:
                yield {"question": f"EGL device {index}", "way": opengl.device()}
            except InputError:
                return


def attack(options: argparse.Namespace) -> Iterator[Row]:
    """What an attack gains by CUDA graphs, channels last, cuDNN's trials of algorithms, and without timers."""
    service, model = made_up(options, options.device), sure_network(options, options.device)

    def run(network: nn.Module = model, trials: bool = False) -> None:
        torch.backends.cudnn.benchmark = trials
        service.regenerate(network, 0)

    channels_first = patch.object(torch, "channels_last", torch.contiguous_format)
    calls = {"eager": run, "eager, cudnn.benchmark": partial(run, trials=True)}
    calls["eager, channels first"] = channels_first(partial(run, channels_first(sure_network)(options, options.device)))
    calls["eager, without timers"] = patch.object(Phases, "_now", lambda phases: 0.0)(run)
    if options.device != "cpu":
        calls["CUDA graphs"] = partial(run, GraphedModel(model))
    yield from compared(options, f"attack of {options.steps} steps", calls)


def synchronizations(options: argparse.Namespace) -> Iterator[Row]:
    """Where the host waits for the GPU in a step of an attack on light, and on shape."""
    for name, settings in {"light": {}, "shape": SHAPE}.items():
        places = Counter[str]()
        for steps, sign in ((6, 1), (2, -1)):
            service, model = made_up(options, options.device, steps, **settings), sure_network(options, options.device)
            service.regenerate(model, 0)  # builds what stays
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                torch.cuda.set_sync_debug_mode("warn")
                service.regenerate(model, 0)
                torch.cuda.set_sync_debug_mode("default")
            for warning in caught:
                places[f"{Path(warning.filename).name}:{warning.lineno}"] += sign
        for place, times in places.most_common():
            yield {"question": f"synchronizations in a step on {name}", "way": place, "value": times / 4}


def memory(options: argparse.Namespace) -> Iterator[Row]:
    """The peak of an attack, network aside, over what `Scene` estimates for it and its operators."""
    model = sure_network(options, options.device)
    torch.cuda.reset_peak_memory_stats()
    before, service = torch.cuda.memory_allocated(), made_up(options, options.device)
    service.regenerate(model, 0)
    assert service.scene is not None
    estimate = service.scene.attack_bytes + sum(stack.transfer.nbytes for stack in service.scene.stacks)
    row = {"question": "GB of an attack", "way": "peak", "value": (torch.cuda.max_memory_allocated() - before) / 1e9}
    yield row | {"than": "estimate", "reference": estimate / 1e9}


def agreement(options: argparse.Namespace) -> Iterator[Row]:
    """How far the device's images after an attack in float32 are from the CPU's."""
    cpu, other = (
        made_up(options, device).regenerate(sure_network(options, device, "float32"), 0).images.cpu()
        for device in ("cpu", options.device)
    )
    difference = (cpu - other).abs()
    for way, value in {"largest": difference.max(), "median": difference.median()}.items():
        yield {"question": f"difference of images, {options.device} and CPU", "way": way, "value": float(value)}


def shading(options: argparse.Namespace) -> Iterator[Row]:
    """Whether moved vertices, which are shaded in float64, are shaded faster on the device or on the CPU."""

    def step(service: AugmentationService) -> None:
        assert service.scene is not None
        problem = service.settings.attack.problem(service.scene)
        few = problem.everything[:5]
        values = problem.start[few].requires_grad_()
        torch.autograd.grad(problem.render(values, few).sum(), values)

    calls = {device: partial(step, made_up(options, device, **SHAPE)) for device in ("cpu", options.device)}
    yield from compared(options, "render of 5 shapes and gradient", calls)


def training(options: argparse.Namespace) -> Iterator[Row]:
    """`python -m train` on one GPU and on all, compiled and not: seconds of the second of two epochs."""
    for processes in dict.fromkeys((1, max(1, torch.cuda.device_count()))):
        for choice in ("never", "always") if options.device != "cpu" else ("never",):
            with TemporaryDirectory() as folder:
                command = [
                    sys.executable,
                    "-m",
                    "torch.distributed.run",
                    f"--nproc_per_node={processes}",
                    "-m",
                    "train",
                ]
                command += ["experiment=paper", "data=shapes", f"run={folder}/run", f"train.compile={choice}"]
                command += [f"train.device={options.device}", f"model.depth={options.depth}", "train.epochs=2"]
                ended = subprocess.run([*command, *options.overrides], stdout=subprocess.DEVNULL).returncode
                row = {"question": f"training, processes: {processes}, train.compile={choice}"}
                lines = (Path(folder) / "run" / "metrics.jsonl").read_text().splitlines() if not ended else ["{}"]
            last = [line for line in map(json.loads, lines) if "epoch" in line][-1:]
            for phase in ("training", "attack"):  # None where the command failed
                yield row | {"way": phase, "value": last[0][f"seconds/{phase}"] if last else None}


QUESTIONS = {ask.__name__: ask for ask in (rasterizers, attack, synchronizations, memory, agreement, shading, training)}


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--questions", nargs="+", choices=QUESTIONS, default=list(QUESTIONS))
    parser.add_argument("--pixels", type=int, default=32, help="per side of a render")
    parser.add_argument("--views", type=int, default=10, help="of each of two meshes, before five backgrounds each")
    parser.add_argument("--samples", nargs="+", type=int, default=[64, 512, 2048], help="per side, rasterized")
    parser.add_argument("--depth", type=int, default=16, help="of the WideResNet")
    parser.add_argument("--steps", type=int, default=10, help="of an attack")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--overrides", nargs="*", default=[], help="of `python -m train`")
    parser.add_argument("--csv", type=Path)
    options, rows = parser.parse_args(arguments), list[Row]()
    print(machine(options.device))
    for name in options.questions:
        if options.device == "cpu" and name in ("synchronizations", "memory"):
            print(f"{name}: only a GPU can answer")
            continue
        for row in QUESTIONS[name](options):
            rows.append(row | ({"ratio": row["value"] / row["reference"]} if row.get("reference") else {}))
            print("  ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in rows[-1].values()), flush=True)
    if options.csv:
        write_csv(options.csv, rows)
    return rows


if __name__ == "__main__":
    main()
