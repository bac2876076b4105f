"""What only a GPU can answer: each open question a few lines of JSON, one way beside another that takes turns with it.

    python -m benchmarks.gpu --out gpu.jsonl

The command checks first (tests/train/system/test_gpu.py), then measures. A question that fails has a line
with its error, and the next one is asked. Meshes, data and networks are the project's own. Where there are
several GPUs, `training` runs on one and on all of them. --device cpu rehearses what needs no CUDA. A machine
without an index of packages installs what `pip download -d wheels ".[test]"` brings elsewhere: pip install
--no-index --find-links wheels ".[test]"
"""

import argparse
import multiprocessing
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import torch

import renderer
from augment import AugmentationService, AugmentationSettings, StepSettings
from augment.settings import TrainingAttackSettings
from benchmarks.common import Row, machine, medians, record
from benchmarks.training import last_epoch
from renderer.visibility.rasterizers import choose
from train.runs.saved_networks import load_run
from train.system.device import GraphedModel, MixedPrecision, choose_precision, set_deterministic

NETWORK, MESHES, VIEWS, STEPS, ROUNDS, SAMPLES = "pretrained/none", 2, 10, 10, 5, (64, 512, 2048)
SHAPE = {"geometry": StepSettings("linf", 0.002, "sign", 0.001)}


def ratio(question: str, way: str, value: float, than: str, reference: float) -> Row:
    return dict(question=question, way=way, value=value, than=than, reference=reference, ratio=value / reference)


def compared(question: str, calls: dict[str, Callable[[], object]], device: str) -> Iterator[Row]:
    """A row for each call but the first: its milliseconds, and those of the first."""
    (base, reference), *others = medians(calls, ROUNDS, device).items()
    yield from (ratio(question, name, value, base, reference) for name, value in others)


def network_on(device: str) -> MixedPrecision:
    return MixedPrecision(load_run(NETWORK).to(device), choose_precision("auto", torch.device(device)))


def solids(device: str, steps: int, margin: float = 1e3, **attack: StepSettings) -> AugmentationService:
    """Oranges × views × five backgrounds under attack, at 32 pixels per side. With the large margin no attack ends
    before its last step; with 0 the batch shrinks from step to step."""
    named = [(f"solid:orange:{seed}", load_run(NETWORK).label("orange")) for seed in range(MESHES)]
    settings = AugmentationSettings(attack=TrainingAttackSettings(max_steps=steps, margin=margin, **attack))
    return AugmentationService.from_meshes(named, 32, settings, views=VIEWS, samples=2, device=device)


def tests(device: str) -> Iterator[Row]:
    """The tests that are skipped without a GPU."""
    file = Path(__file__).parents[1] / "tests" / "train" / "system" / "test_gpu.py"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(file)]
    done = subprocess.run(command, cwd=file.parents[2], capture_output=True, text=True, check=False)
    printed = (done.stdout + done.stderr)[-2000:]
    yield {"question": "tests", "way": file.name, "value": done.returncode, "output": printed}


def rasterizers(device: str) -> Iterator[Row]:
    """Whether `auto` should take OpenGL rather than numba: a call makes its own context."""
    mesh, [camera] = renderer.solid("orange"), renderer.orbit_cameras(1, 2.2)
    for side in SAMPLES:
        drawn = camera.project(mesh.vertices)[None], mesh.faces, side, True
        calls = {name: partial(choose(name).rasterize, *drawn) for name in ("numba", "opengl")}
        yield from compared(f"rasterize {side}² samples", calls, device)


def attack(device: str) -> Iterator[Row]:
    """What an attack gains by channels last and by CUDA graphs."""
    service, network = solids(device, STEPS), network_on(device)
    channels_first = patch.object(torch, "channels_last", torch.contiguous_format)
    first = partial(service.regenerate, channels_first(network_on)(device), 0)
    calls = {"eager": partial(service.regenerate, network, 0), "eager, channels first": channels_first(first)}
    if device != "cpu":
        calls["CUDA graphs"] = partial(service.regenerate, GraphedModel(network), 0)
    yield from compared(f"attack of {STEPS} steps", calls, device)


def shrinking(device: str) -> Iterator[Row]:
    """Whether trials of cuDNN's algorithms pay, where the batch of an attack shrinks to sizes not seen before: seconds
    of the first three rounds of a new process, with `torch.backends.cudnn.benchmark` and without."""
    rounds = []
    for benchmark in (False, True):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            rounds.append(pool.submit(first_rounds, device, benchmark).result())
    for number, (without, trials) in enumerate(zip(*rounds, strict=True)):
        yield ratio(f"shrinking batches, round {number}", "cudnn.benchmark", trials, "without", without)


def first_rounds(device: str, benchmark: bool) -> list[float]:
    set_deterministic(False)
    torch.backends.cudnn.benchmark = benchmark
    service, network, seconds = solids(device, STEPS, margin=0.0), network_on(device), list[float]()
    _ = service.scene.stacks  # what is precomputed of each view
    for number in range(3):
        start = time.perf_counter()
        service.regenerate(network, number).images.cpu()
        seconds.append(time.perf_counter() - start)
    return seconds


def synchronizations(device: str) -> Iterator[Row]:
    """Where the host waits for the GPU in a step of an attack on light, and on shape, and how often."""
    for name, settings in {"light": {}, "shape": SHAPE}.items():
        places = Counter[str]()
        for steps, sign in ((6, 1), (2, -1)):
            service, network = solids(device, steps, **settings), network_on(device)
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


def training(device: str) -> Iterator[Row]:
    """`python -m train` on one GPU and on all, compiled and not: seconds of the second of two epochs."""
    for processes in dict.fromkeys((1, max(1, torch.cuda.device_count()))):
        for choice in ("never", "always") if device != "cpu" else ("never",):
            overrides = ["data=shapes", f"train.compile={choice}", f"train.device={device}"]
            launcher = ("-m", "torch.distributed.run", f"--nproc_per_node={processes}")
            with TemporaryDirectory() as folder:
                epoch = last_epoch(Path(folder, "run"), *overrides, launcher=launcher)
            row = {"question": f"training, processes: {processes}, train.compile={choice}"}
            yield from (row | {"way": phase, "value": epoch[f"seconds/{phase}"]} for phase in ("training", "attack"))


QUESTIONS = {ask.__name__: ask for ask in (tests, rasterizers, attack, shrinking, synchronizations, training)}
NEED_CUDA = ("tests", "synchronizations")


def answers(questions: Sequence[str], device: str) -> Iterator[Row]:
    yield {"machine": machine(device)}
    for name in questions:
        try:
            yield from QUESTIONS[name](device) if device != "cpu" or name not in NEED_CUDA else ()
        except Exception as error:  # an hour on a GPU is not lost to one question
            yield {"question": name, "error": f"{type(error).__name__}: {error}"[:2000]}


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cpu: a rehearsal")
    parser.add_argument("--questions", nargs="+", choices=QUESTIONS, default=list(QUESTIONS))
    parser.add_argument("--out", type=Path, help="a .jsonl or .csv file")
    options = parser.parse_args(arguments)
    if options.device != "cpu" and not torch.cuda.is_available():
        parser.error("torch finds no GPU here, which this benchmark needs: --device cpu rehearses what needs none")
    return record(answers(options.questions, options.device), options.out, options.device)


if __name__ == "__main__":
    main()
