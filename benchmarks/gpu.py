"""Questions about speed that only a GPU can answer.

    python -m benchmarks.gpu --out gpu.jsonl

The answer to each question is a few lines of JSON. A line compares one way with
another, and the two take turns. The command first runs the tests of
tests/train/test_gpu.py, and then measures. If a question fails, its line
has the error, and the command continues with the next question. Meshes, data
and networks are the project's own. If there are several GPUs, `training` runs
on one and on all of them. --device cpu rehearses the questions that need no
CUDA.

A machine without access to a package index installs wheels that
`pip download -d wheels ".[test]"` downloaded elsewhere:

    pip install --no-index --find-links wheels ".[test]"
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
from augment.augmentation_settings import TrainingAttackSettings
from benchmarks.common import Row, machine, medians, record
from benchmarks.training import last_epoch, precompute
from renderer.visibility import choose
from train.checkpoints import load_run
from train.device import MixedPrecision, choose_precision, set_deterministic

NETWORK = "pretrained/none"
MESH_COUNT = 2
VIEW_COUNT = 10
# Steps of each attack.
STEPS = 10
# Steps of the two attacks that the question `synchronizations` compares.
FEWER_STEPS = 2
MORE_STEPS = 6
# Rounds in which the ways of a question take turns.
ROUNDS = 5
# Samples per side of the images that the question `rasterizers` draws.
SAMPLES_PER_SIDE = (64, 512, 2048)
# An attack ends when its margin is reached. No logit reaches this margin, so
# that every attack takes all its steps.
ENDLESS_MARGIN = 1e3
# Longest text of an error, or of the end of an output, in characters.
MAX_TEXT = 2000
ROOT = Path(__file__).parents[1]
SHAPE = {"geometry": StepSettings("linf", 0.002, "sign", 0.001)}


# ---------------------------------------------------------------------------- helpers


def compare_values(
    question: str, way: str, value: float, reference_way: str, reference: float
) -> Row:
    """Make a row that compares a way with a reference.

    Args:
        question: Name of the question.
        way: Name of the way.
        value: Time of the way.
        reference_way: Name of the reference.
        reference: Time of the reference, in the same unit.

    Returns:
        Row with both times and their ratio.
    """
    return {
        "question": question,
        "way": way,
        "value": value,
        "than": reference_way,
        "reference": reference,
        "ratio": value / reference,
    }


def compare_calls(
    question: str, calls: dict[str, Callable[[], object]], device: str
) -> Iterator[Row]:
    """Time calls in turns, and compare each call with the first.

    Args:
        question: Name of the question.
        calls: Calls by the names of their ways.
        device: Device that the calls use.

    Yields:
        A row for each call but the first, with times in milliseconds.
    """
    times = medians(calls, ROUNDS, device)
    first_way, *other_ways = times
    for way in other_ways:
        yield compare_values(question, way, times[way], first_way, times[first_way])


def load_on(device: str) -> MixedPrecision:
    """Load the network that is attacked, in the precision that suits the device."""
    network = load_run(NETWORK).to(device)
    return MixedPrecision(network, choose_precision("auto", torch.device(device)))


def make_service(
    device: str, steps: int, margin: float = ENDLESS_MARGIN, **attack: StepSettings
) -> AugmentationService:
    """Make a service that attacks oranges from several views before five backgrounds.

    Args:
        device: Device of the attacks.
        steps: Largest number of steps.
        margin: Margin by which an attack must succeed before it ends. With 0,
            the batch shrinks from step to step.
        **attack: Step settings of the attacked parameters. The default is the
            light.

    Returns:
        Service of renders with 32 pixels per side.
    """
    label = load_run(NETWORK).label("orange")
    meshes = [(f"solid:orange:{seed}", label) for seed in range(MESH_COUNT)]
    attack_settings = TrainingAttackSettings(max_steps=steps, margin=margin, **attack)
    settings = AugmentationSettings(attack=attack_settings)
    return AugmentationService.from_meshes(
        meshes, 32, settings, views=VIEW_COUNT, samples=2, device=device
    )


# ---------------------------------------------------------------------------- questions


def tests(device: str) -> Iterator[Row]:
    """Run the tests that are skipped without a GPU.

    Args:
        device: Not used, because the tests choose their device.

    Yields:
        A row with pytest's exit status and the end of its output.
    """
    file = ROOT / "tests" / "train" / "test_gpu.py"
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:benchmark",
        str(file),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    yield {
        "question": "tests",
        "way": file.name,
        "value": done.returncode,
        "output": (done.stdout + done.stderr)[-MAX_TEXT:],
    }


def rasterizers(device: str) -> Iterator[Row]:
    """Ask whether rasterizer=auto should choose OpenGL instead of numba.

    Each call of OpenGL makes a context of its own.

    Args:
        device: Device of the clock.

    Yields:
        A row for each number of samples.
    """
    mesh = renderer.solid("orange")
    [camera] = renderer.orbit_cameras(1, 2.2)
    points = camera.project(mesh.vertices)[None]
    for side in SAMPLES_PER_SIDE:
        calls = {
            name: partial(choose(name).rasterize, points, mesh.faces, side, True)
            for name in ("numba", "opengl")
        }
        yield from compare_calls(f"rasterize {side}² samples", calls, device)


def attack(device: str) -> Iterator[Row]:
    """Ask what an attack gains by channels last.

    Args:
        device: Device of the attack.

    Yields:
        A row for each way.
    """
    service = make_service(device, STEPS)
    network = load_on(device)
    # The network and the attack ask torch for channels last by this name.
    channels_first = patch.object(torch, "channels_last", torch.contiguous_format)
    with channels_first:
        channels_first_network = load_on(device)
    regenerate_channels_first = partial(service.regenerate, channels_first_network, 0)
    calls: dict[str, Callable[[], object]] = {
        "eager": partial(service.regenerate, network, 0),
        "eager, channels first": channels_first(regenerate_channels_first),
    }
    yield from compare_calls(f"attack of {STEPS} steps", calls, device)


def shrinking(device: str) -> Iterator[Row]:
    """Ask whether cuDNN should try its algorithms when batches shrink to new sizes.

    Args:
        device: Device of the attacks.

    Yields:
        A row for each of the first three rounds of a new process, with the
        seconds with and without `torch.backends.cudnn.benchmark`.
    """
    seconds = {}
    for is_benchmark in (False, True):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            task = pool.submit(time_first_rounds, device, is_benchmark)
            seconds[is_benchmark] = task.result()
    rounds = zip(seconds[False], seconds[True], strict=True)
    for number, (without_trials, with_trials) in enumerate(rounds):
        question = f"shrinking batches, round {number}"
        yield compare_values(question, "cudnn.benchmark", with_trials, "without", without_trials)


def time_first_rounds(device: str, is_benchmark: bool) -> list[float]:
    """Return the seconds of three rounds of attacks whose batches shrink from step to step.

    Args:
        device: Device of the attacks.
        is_benchmark: Value of `torch.backends.cudnn.benchmark`.
    """
    set_deterministic(False)
    torch.backends.cudnn.benchmark = is_benchmark
    service = make_service(device, STEPS, margin=0.0)
    network = load_on(device)
    precompute(service.scene)
    seconds = []
    for number in range(3):
        start = time.perf_counter()
        # Copying the images waits until they are rendered.
        service.regenerate(network, number).images.cpu()
        seconds.append(time.perf_counter() - start)
    return seconds


def synchronizations(device: str) -> Iterator[Row]:
    """Ask where and how often the host waits for the GPU in a step of an attack.

    Args:
        device: Device of the attacks, a GPU.

    Yields:
        A row for each place in the code, with the number of waits per step.
        There are rows of an attack on the light, and of one on the shape.
    """
    attacked_parameters: dict[str, dict[str, StepSettings]] = {"light": {}, "shape": SHAPE}
    for name, parameters in attacked_parameters.items():
        counts = count_synchronizations(device, MORE_STEPS, parameters)
        # Waits before and after the steps are in both counts, and cancel.
        counts.subtract(count_synchronizations(device, FEWER_STEPS, parameters))
        for place, count in counts.most_common():
            yield {
                "question": f"synchronizations in a step on {name}",
                "way": place,
                "value": count / (MORE_STEPS - FEWER_STEPS),
            }


def count_synchronizations(
    device: str, steps: int, parameters: dict[str, StepSettings]
) -> Counter[str]:
    """Count how often the host waits for the GPU at each line of code.

    Args:
        device: Device of the attack, a GPU.
        steps: Number of steps of the attack.
        parameters: Step settings of the attacked parameters.

    Returns:
        Number of times by place, such as "descent.py:120".
    """
    service = make_service(device, steps, **parameters)
    network = load_on(device)
    # The first attack builds what later attacks use again.
    service.regenerate(network, 0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        service.regenerate(network, 0)
        torch.cuda.set_sync_debug_mode("default")
    return Counter(f"{Path(warning.filename).name}:{warning.lineno}" for warning in caught)


def training(device: str) -> Iterator[Row]:
    """Measure `python -m train` on one GPU and on all, with and without compilation.

    Args:
        device: Device of the training.

    Yields:
        A row for the training and one for the attack of each run, with the
        seconds of the second of two epochs.
    """
    process_counts = {1, max(1, torch.cuda.device_count())}
    choices = ["never"] if device == "cpu" else ["never", "always"]
    for processes in sorted(process_counts):
        launcher = ["-m", "torch.distributed.run", f"--nproc_per_node={processes}"]
        for choice in choices:
            overrides = ["data=shapes", f"train.compile={choice}", f"train.device={device}"]
            with TemporaryDirectory() as folder:
                epoch = last_epoch(Path(folder, "run"), *overrides, launcher=launcher)
            for phase in ("training", "attack"):
                yield {
                    "question": f"training, processes: {processes}, train.compile={choice}",
                    "way": phase,
                    "value": epoch[f"seconds/{phase}"],
                }


QUESTIONS: dict[str, Callable[[str], Iterator[Row]]] = {
    "tests": tests,
    "rasterizers": rasterizers,
    "attack": attack,
    "shrinking": shrinking,
    "synchronizations": synchronizations,
    "training": training,
}
NEED_CUDA = ("tests", "synchronizations")


# ---------------------------------------------------------------------------- command


def answers(questions: Sequence[str], device: str) -> Iterator[Row]:
    """Answer questions one after the other.

    Args:
        questions: Keys of `QUESTIONS`.
        device: Device. On "cpu", the questions that need CUDA are left out.

    Yields:
        A row that describes the machine, and the rows of the questions. If a
        question fails, its last row has the error.
    """
    yield {"machine": machine(device)}
    for name in questions:
        if device == "cpu" and name in NEED_CUDA:
            continue
        try:
            yield from QUESTIONS[name](device)
        except Exception as error:
            # An error in one question must not end an hour on a GPU.
            message = f"{type(error).__name__}: {error}"
            yield {"question": name, "error": message[:MAX_TEXT]}


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    """Answer the questions of the command line, and print and write the rows.

    Args:
        arguments: Words of the command line. None takes those of the process.

    Returns:
        All rows.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", help="cpu: a rehearsal")
    parser.add_argument("--questions", nargs="+", choices=QUESTIONS, default=list(QUESTIONS))
    parser.add_argument("--out", type=Path, help="a .jsonl or .csv file")
    options = parser.parse_args(arguments)
    if options.device != "cpu" and not torch.cuda.is_available():
        parser.error(
            "torch finds no GPU here, which this benchmark needs: "
            "--device cpu rehearses what needs none"
        )
    return record(answers(options.questions, options.device), options.out, options.device)


if __name__ == "__main__":
    main()
