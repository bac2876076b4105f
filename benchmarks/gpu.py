"""Questions about speed that only a GPU can answer.

    python -m benchmarks.gpu --out gpu.jsonl

The answer to each question is a few lines of JSON. A line compares one way with
another, and the two take turns. The command first runs the tests of
tests/train/test_gpu.py, and then measures. Each question is answered by a
process of its own. All of them together take at most --minutes. Given once more, the
command answers the questions that are left. If a question fails, its
line has the error, and the command continues with the next question. Meshes,
data and networks are the project's own. If there are several GPUs, `training` runs
on one and on all of them. --device cpu rehearses the questions that need no
CUDA.

A machine without access to a package index installs wheels that
`pip download -d wheels ".[test]"` downloaded elsewhere:

    pip install --no-index --find-links wheels ".[test]"
"""

import argparse
import json
import multiprocessing
import os
import resource
import signal
import statistics
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from unittest.mock import patch

import numpy as np
import torch

import renderer
from augment import AugmentationService, AugmentationSettings, StepSettings
from augment.augmentation_settings import TrainingAttackSettings
from augment.dataset import render_dataset
from augment.lighting import RandomLighting
from augment.scene.lights import MODELS
from benchmarks.common import (
    Row,
    machine,
    medians,
    quartiles,
    quartiles_of_ratio,
    record,
    times_in_turn,
)
from benchmarks.training import last_epoch, precompute
from renderer.visibility import choose
from train.checkpoints import load_run
from train.device import MixedPrecision, choose_precision, set_deterministic
from train.networks import WideResNet

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
# Labeled renders of 224² of the question `labels`.
LABELED_COUNT = 10_000
# Samples per side of the images that the question `rasterizers` draws.
SAMPLES_PER_SIDE = (64, 512, 2048)
# An attack ends when its margin is reached. No logit reaches this margin, so
# that every attack takes all its steps.
ENDLESS_MARGIN = 1e3
# Pixels per side and number of views of the question `rates`, and lights for each view.
IMAGES = {32: 1000, 128: 250, 224: 100}
LIGHTS_PER_VIEW = 20
# Floating-point operations of a training step of the WideResNet for an image, and epochs of the
# paper's experiment.
FLOP_PER_IMAGE = 2.5e9
PAPER_EPOCHS = 150
# Longest text of an error, or of the end of an output, in characters.
MAX_TEXT = 2000
# Seconds between two readings of the used memory of a GPU.
READING_SECONDS = 0.1
# Seconds that a process has to stop what it started.
STOP_SECONDS = 10.0
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
        A row for each call but the first, with medians of times in milliseconds, and with the
        first quartile, the median and the third quartile of times and of their ratio.
    """
    times = times_in_turn(calls, ROUNDS, device)
    first_way, *other_ways = times
    middle = {way: statistics.median(values) for way, values in times.items()}
    for way in other_ways:
        row = compare_values(question, way, middle[way], first_way, middle[first_way])
        row |= {"quartiles": quartiles(times[way]), "than_quartiles": quartiles(times[first_way])}
        yield row | {"ratio_quartiles": quartiles_of_ratio(times[way], times[first_way])}


def load_on(device: str) -> MixedPrecision:
    """Load the network that is attacked, in the precision that suits the device."""
    network = load_run(NETWORK).to(device).to(memory_format=torch.channels_last)
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
    """Ask whether rasterizer=auto should choose OpenGL or torch instead of numba.

    Each call of OpenGL makes a context of its own. Numba and OpenGL give face
    indices on the CPU, and torch on the device.

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
        on_device = torch.from_numpy(points).to(device)
        calls["torch"] = partial(choose("torch").rasterize, on_device, mesh.faces, side, True)
        yield from compare_calls(f"rasterize {side}² samples", calls, device)


def attack(device: str) -> Iterator[Row]:
    """Ask what an attack gains by channels last.

    Args:
        device: Device of the attack.

    Yields:
        A row for each way.
    """
    steps = STEPS if device != "cpu" else 1
    service = make_service(device, steps)
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
    yield from compare_calls(f"attack of {steps} steps", calls, device)


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
    service = make_service(device, STEPS if device != "cpu" else 2, margin=0.0)
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


def rates(device: str) -> Iterator[Row]:
    """Ask how many images a second are rendered in new light, in new poses, and with a gradient.

    Args:
        device: Device of the light.

    Yields:
        A row for each size and way, with images per second and the peak of the GPU's memory.
    """
    mesh = renderer.solid("orange")
    for size, count in IMAGES.items():
        cameras = renderer.orbit_cameras(count if device != "cpu" else 4, 2.2)
        light = renderer.load_light("grace").to(device)
        lights = light.expand(LIGHTS_PER_VIEW if device != "cpu" else 4, -1, -1)
        build = partial(renderer.precompute_transfer, mesh, cameras, size, device=device)
        operators = build()

        def new_pose(
            needs_gradient: bool = False,
            size: int = size,
            cameras: Sequence[renderer.Camera] = cameras,
            light: torch.Tensor = light,
        ) -> None:
            """Render moved vertices, which are rasterized anew."""
            vertices = torch.from_numpy(mesh.vertices).to(light).requires_grad_(needs_gradient)
            images = renderer.render(mesh, cameras, light, size, vertices=vertices)
            if needs_gradient:
                images.sum().backward()

        ways: dict[str, tuple[int, Callable[[], object]]] = {
            "new light": (len(lights) * len(cameras), partial(operators.image, lights)),
            "new pose": (len(cameras), new_pose),
            "new pose with gradient": (len(cameras), partial(new_pose, True)),
            "operators": (len(cameras), build),
        }
        for way, (image_count, call) in ways.items():
            yield rate(f"{size}²", way, image_count, call, device)


def rate(question: str, way: str, count: int, call: Callable[[], object], device: str) -> Row:
    """Time a call that makes `count` things, and read the peak of the GPU's memory.

    Args:
        question: Name of the question.
        way: Name of the way.
        count: Number of things.
        call: The call.
        device: Device that it uses.

    Returns:
        Row with things per second. The memory is that of torch on a GPU, and of `used_memory` on
        a CPU.
    """
    call()
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    milliseconds = times_in_turn({way: call}, ROUNDS, device)[way]
    peak = used_memory(device) if device == "cpu" else torch.cuda.max_memory_allocated()
    rates = quartiles([1e3 * count / each for each in milliseconds])
    row = {"question": question, "way": way, "per_second": rates[1], "quartiles": rates}
    return row | {"count": count, "peak_bytes": peak}


def used_memory(device: str) -> int:
    """Return the used bytes of a GPU, or the peak of this process and those that it waited for."""
    if device == "cpu":
        processes = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
        return 1024 * max(resource.getrusage(each).ru_maxrss for each in processes)
    free, total = torch.cuda.mem_get_info()
    return total - free


def watch_memory(device: str, is_over: Event) -> int:
    """Return the largest `used_memory` until an event."""
    peak = 0
    while not is_over.wait(READING_SECONDS):
        peak = max(peak, used_memory(device))
    return max(peak, used_memory(device))


def regeneration(device: str) -> Iterator[Row]:
    """Ask how long 100 attacked renders take, and whether two rounds have equal bits.

    Args:
        device: Device of the attacks.

    Yields:
        One row.
    """
    set_deterministic(True)
    network = load_on(device)
    steps = STEPS if device != "cpu" else 1
    services = [make_service(device, steps) for _ in range(2)]
    first, second = (service.regenerate(network, 0).images for service in services)
    row = rate(
        "regeneration", "renders", len(first), partial(services[0].regenerate, network, 0), device
    )
    set_deterministic(False)
    yield row | {"equal_bits": torch.equal(first, second)}


def labels(device: str) -> Iterator[Row]:
    """Ask how long it takes to make labeled renders of 224², without files.

    Args:
        device: Device of the renders.

    Yields:
        A row with the seconds of all renders.
    """
    count = LABELED_COUNT if device != "cpu" else 10
    meshes = [(f"solid:orange:{seed}", "orange") for seed in range(MESH_COUNT)]
    renders = render_dataset(meshes, 224, count, maps=False, device=device)
    start = time.perf_counter()
    made = sum(1 for _ in renders)
    seconds = time.perf_counter() - start
    yield {"question": "labels", "way": f"{made} renders", "value": seconds}


def light_on_images(device: str) -> Iterator[Row]:
    """Ask how many images of 256² a second each light model of `nb.RandomLighting` transforms.

    Args:
        device: Device of the images.

    Yields:
        A row for each model.
    """
    count = 256 if device != "cpu" else 4
    images = torch.randint(0, 256, (count, 3, 256, 256), dtype=torch.uint8, device=device)
    for name in MODELS:
        yield rate("transforms", name, count, partial(RandomLighting(name), images), device)


def peak(device: str) -> Iterator[Row]:
    """Ask which part of the rate of a large matrix product in bfloat16 a training step reaches.

    Args:
        device: Device of the training.

    Yields:
        A row with the rates in TFLOP/s. "value" is the step, and "reference" the product.
    """
    side, batch = (8192, 512) if device != "cpu" else (512, 8)
    matrix = torch.randn(side, side, device=device, dtype=torch.bfloat16)
    network = WideResNet(100).to(device, memory_format=torch.channels_last)
    images = torch.randn(batch, 3, 32, 32, device=device)
    images = images.contiguous(memory_format=torch.channels_last)
    compiled = torch.compile(network) if device != "cpu" else network

    def step() -> None:
        """Compute the gradient of a loss, as a training step does."""
        with torch.autocast(torch.device(device).type, torch.bfloat16):
            loss = compiled(images).square().mean()
        loss.backward()

    step()
    times = medians({"step": step, "product": lambda: matrix @ matrix}, ROUNDS, device)
    reached = batch * FLOP_PER_IMAGE / times["step"] / 1e9
    yield compare_values(
        "peak", "training step", reached, "product", 2 * side**3 / times["product"] / 1e9
    )


def paper(device: str) -> Iterator[Row]:
    """Ask for the seconds of an epoch of experiment=paper, alone and four runs at once.

    The images are random, as many as those of CIFAR-100.

    Args:
        device: Device of the training.

    Yields:
        A row for one run, and one for four. "total" is the time of all epochs.
    """
    train_count, test_count = (50_000, 10_000) if device != "cpu" else (2000, 200)
    for count in (1, 4):
        with TemporaryDirectory() as folder, ThreadPoolExecutor(count) as pool:
            random = np.random.default_rng(0)
            file = Path(folder, "random.npz")
            np.savez(
                file,
                train_images=random.integers(0, 256, (train_count, 3, 32, 32), dtype=np.uint8),
                train_labels=np.arange(train_count) % 100,
                test_images=random.integers(0, 256, (test_count, 3, 32, 32), dtype=np.uint8),
                test_labels=np.arange(test_count) % 100,
                classes=np.array(load_run(NETWORK).classes),
            )
            overrides = ["data=npz", f"data.path={file}", f"train.device={device}"]
            runs = [Path(folder, str(number)) for number in range(count)]
            epochs = list(pool.map(last_epoch, runs, *([value] * count for value in overrides)))
        seconds = max(epoch["seconds/training"] + epoch["seconds/attack"] for epoch in epochs)
        yield {
            "question": "paper",
            "way": f"{count} at once",
            "value": seconds,
            "total": PAPER_EPOCHS * seconds,
        }


QUESTIONS: dict[str, Callable[[str], Iterator[Row]]] = {
    "tests": tests,
    "rates": rates,
    "regeneration": regeneration,
    "labels": labels,
    "transforms": light_on_images,
    "peak": peak,
    "rasterizers": rasterizers,
    "attack": attack,
    "shrinking": shrinking,
    "synchronizations": synchronizations,
    "training": training,
    "paper": paper,
}
NEED_CUDA = ("tests", "synchronizations")


# ---------------------------------------------------------------------------- command


def answers(
    questions: Sequence[str],
    device: str,
    minutes: float,
    ask: Callable[[str, float], Iterator[Row]],
) -> Iterator[Row]:
    """Answer questions one after the other.

    Args:
        questions: Keys of `QUESTIONS`.
        device: Device. On "cpu", the questions that need CUDA are left out.
        minutes: Time after which no other question begins.
        ask: Function that answers a question within the minutes that are left.

    Yields:
        A row that describes the machine, and the rows of the questions.
    """
    yield {"machine": machine(device)}
    start = time.monotonic()
    for name in questions:
        if device == "cpu" and name in NEED_CUDA:
            continue
        left = minutes - (time.monotonic() - start) / 60
        yield from ask(name, left) if left > 0 else [{"left": name}]


def answer(device: str, name: str, _minutes: float) -> Iterator[Row]:
    """Answer a question in this process, without a limit of time.

    Yields:
        The rows of the question. The last one has its seconds and the peak of the memory, on a
        GPU that of all processes. If the question fails, the last one has the error.
    """
    begin = time.monotonic()
    is_over = Event()
    with ThreadPoolExecutor(1) as pool:
        peak = pool.submit(watch_memory, device, is_over)
        try:
            yield from QUESTIONS[name](device)
        except Exception as error:
            # An error in one question must not end a session on a GPU.
            message = f"{type(error).__name__}: {error}"
            yield {"question": name, "error": message[:MAX_TEXT]}
            return
        finally:
            is_over.set()
    seconds = round(time.monotonic() - begin)
    yield {"answered": name, "seconds": seconds, "peak_bytes": peak.result()}


def answer_apart(device: str, out: Path | None, name: str, minutes: float) -> Iterator[Row]:
    """Answer a question in a process of its own, which writes its rows to the file.

    An error of the GPU ends that process alone. After the minutes, it is stopped with all that
    it started.

    Yields:
        A row with an error if the process did not end by itself.
    """
    command = [sys.executable, "-m", "benchmarks.gpu", "--here", "--device", device]
    command += ["--questions", name, *(["--out", str(out)] if out else [])]
    process = subprocess.Popen(command, start_new_session=True)
    try:
        if process.wait(60 * minutes):
            yield {"question": name, "error": f"the process ended with {process.returncode}"}
    except subprocess.TimeoutExpired:
        yield {"question": name, "error": f"stopped after the {minutes:.1f} minutes that were left"}
    finally:
        # torchrun stops its workers, which are no part of the group, if it gets some time.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
            time.sleep(STOP_SECONDS)
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def answered(path: Path | None) -> set[str]:
    """Read which questions a file answers already."""
    if path is None or not path.exists():
        return set()
    rows = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    return {row["answered"] for row in rows if "answered" in row}


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
    parser.add_argument("--minutes", type=float, default=9.0, help="limit for all questions")
    parser.add_argument("--here", action="store_true", help="in this process, without that limit")
    parser.add_argument("--out", type=Path, help="a .jsonl file, to which lines are added")
    options = parser.parse_args(arguments)
    if options.out and options.out.suffix != ".jsonl":
        parser.error(f"--out={options.out} is no .jsonl file: give one")
    if options.device != "cpu" and not torch.cuda.is_available():
        parser.error(
            "torch finds no GPU here, which this benchmark needs: "
            "--device cpu rehearses what needs none"
        )
    known = answered(options.out)
    questions = [name for name in options.questions if name not in known]
    apart = partial(answer_apart, options.device, options.out)
    ask = partial(answer, options.device) if options.here else apart
    rows = answers(questions, options.device, options.minutes, ask)
    return record(rows, options.out, options.device)


if __name__ == "__main__":
    main()
