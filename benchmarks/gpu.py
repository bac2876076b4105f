"""What only a GPU can answer: each open question a few rows, which set one way beside another that takes turns with it.

    python -m benchmarks.gpu --csv gpu.csv

Data, meshes and network are made up and small. With --device cpu it is a dry run of what needs no CUDA. Where there are
several GPUs, `training` runs on one and on all of them.
"""

import argparse
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import torch

import renderer
from augment import StepSettings
from benchmarks.common import Row, medians, record
from benchmarks.training import attacked_solids, estimated_bytes, last_epoch, sure_network
from renderer.errors import InputError
from renderer.rasterizer import choose, opengl
from train.device import GraphedModel, MixedPrecision, choose_precision

DEPTH, STEPS, ROUNDS = 16, 10, 5  # of the WideResNet, of an attack, of a comparison
SAMPLES = (64, 512, 2048)  # per side, rasterized
SHAPE = {"geometry": StepSettings("linf", 0.002, "sign", 0.001)}


def compared(question: str, calls: dict[str, Callable[[], object]], device: str) -> Iterator[Row]:
    """A row for each call but the first: its milliseconds, and those of the first."""
    (base, reference), *others = medians(calls, ROUNDS, device).items()
    for name, value in others:
        row = {"question": question, "way": name, "value": value, "than": base, "reference": reference}
        yield row | {"ratio": value / reference}


def network_on(device: str) -> MixedPrecision:
    return MixedPrecision(sure_network(DEPTH, 4).to(device), choose_precision("auto", torch.device(device)))


def rasterizers(device: str) -> Iterator[Row]:
    """Whether OpenGL is worth its context, and what EGL's devices are."""
    mesh, [camera] = renderer.solid("orange"), renderer.orbit_cameras(1, 2.2)
    for side in SAMPLES:
        drawn = camera.project(mesh.vertices)[None], mesh.faces, side, True
        calls = {name: partial(choose(name).rasterize, *drawn) for name in ("numba", "opengl")}
        yield from compared(f"rasterize {side}² samples", calls, device)
    for index in count():
        with patch.dict("os.environ", GLCONTEXT_DEVICE_INDEX=str(index)):
            try:
                yield {"question": f"EGL device {index}", "way": opengl.device()}
            except InputError:
                return


def attack(device: str) -> Iterator[Row]:
    """What an attack gains by channels last and by CUDA graphs."""
    service, network = attacked_solids(2, 10, device, max_steps=STEPS), network_on(device)
    channels_first = patch.object(torch, "channels_last", torch.contiguous_format)
    first = partial(service.regenerate, channels_first(network_on)(device), 0)
    calls = {"eager": partial(service.regenerate, network, 0), "eager, channels first": channels_first(first)}
    if device != "cpu":
        calls["CUDA graphs"] = partial(service.regenerate, GraphedModel(network), 0)
    yield from compared(f"attack of {STEPS} steps", calls, device)


def synchronizations(device: str) -> Iterator[Row]:
    """Where the host waits for the GPU in a step of an attack on light, and on shape."""
    for name, settings in {"light": {}, "shape": SHAPE}.items():
        places = Counter[str]()
        for steps, sign in ((6, 1), (2, -1)):
            service, network = attacked_solids(2, 10, device, max_steps=steps, **settings), network_on(device)
            service.regenerate(network, 0)  # builds what stays
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                torch.cuda.set_sync_debug_mode("warn")
                service.regenerate(network, 0)
                torch.cuda.set_sync_debug_mode("default")
            for warning in caught:
                places[f"{Path(warning.filename).name}:{warning.lineno}"] += sign
        for place, times in places.most_common():
            yield {"question": f"synchronizations in a step on {name}", "way": place, "value": times / 4}


def memory(device: str) -> Iterator[Row]:
    """The peak of an attack, network aside, over what `Scene` estimates for it and its operators."""
    network = network_on(device)
    torch.cuda.reset_peak_memory_stats()
    before, service = torch.cuda.memory_allocated(), attacked_solids(2, 10, device, max_steps=STEPS)
    service.regenerate(network, 0)
    peak, estimate = (torch.cuda.max_memory_allocated() - before) / 1e9, estimated_bytes(service) / 1e9
    row = {"question": "GB of an attack", "way": "peak", "value": peak, "than": "estimate", "reference": estimate}
    yield row | {"ratio": peak / estimate}


def training(device: str) -> Iterator[Row]:
    """`python -m train` on one GPU and on all, compiled and not: seconds of the second of two epochs."""
    for processes in dict.fromkeys((1, max(1, torch.cuda.device_count()))):
        for choice in ("never", "always") if device != "cpu" else ("never",):
            overrides = ["data=shapes", f"train.compile={choice}", f"train.device={device}", f"model.depth={DEPTH}"]
            launcher = ("-m", "torch.distributed.run", f"--nproc_per_node={processes}")
            with TemporaryDirectory() as folder:
                epoch = last_epoch(Path(folder, "run"), *overrides, launcher=launcher)
            row = {"question": f"training, processes: {processes}, train.compile={choice}"}
            yield from (row | {"way": phase, "value": epoch[f"seconds/{phase}"]} for phase in ("training", "attack"))


QUESTIONS = {ask.__name__: ask for ask in (rasterizers, attack, synchronizations, memory, training)}


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--questions", nargs="+", choices=QUESTIONS, default=list(QUESTIONS))
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args(arguments)
    if options.device == "cpu":
        options.questions = [name for name in options.questions if name not in ("synchronizations", "memory")]
    rows = (row for name in options.questions for row in QUESTIONS[name](options.device))
    return record(rows, options.csv, options.device)


if __name__ == "__main__":
    main()
