"""The speed of training, and what adversarial renders cost.

    python -m benchmarks.training speed --data cifar100.npz --csv speed.csv
    python -m benchmarks.training renders --numbers 100 1000 10000 --csv renders.csv
    python -m benchmarks.training moved --views 2 --rounds 5 --csv moved.csv
    python -m benchmarks.training files --count 96 --rounds 3 --csv files.csv

`speed` compares `python -m train` without renders, `python -m train` with
adversarial renders, and a plain loop. They take turns, so that a busy machine
slows all alike. Each training is a process, and its second epoch counts. The
loop is what one writes with torchvision: a DataLoader over PIL images, and
torch's own dropout. It runs in float32, in bfloat16 with channels last, and
without a network.

`renders` measures one round of attacks, for several numbers of renders and of
meshes, at 32 pixels per side. Each round runs in a process of its own, so that
the peak memory of the process is that of the round.

`moved` measures rounds of `experiment=patterns`, in which each render has its own
view and light. They are shaded directly and by operators.

`files` measures `pnb-render` with its defaults, at 224 pixels per side and with
PNG files: renders per second of one core, with and without maps.
"""

import argparse
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from copy import deepcopy
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader
from torchvision import transforms

from augment import AugmentationService, AugmentationSettings
from augment.augmentation_settings import TrainingAttackSettings
from augment.dataset import BLOCK
from augment.random_streams import generator
from augment.scene.build import build_scene
from augment.scene.scene import Scene
from augment.scene.vary import vary
from benchmarks.common import Row, record, with_median
from train import checkpoints, run_folder
from train.__main__ import main as train_command
from train.command_settings import DATA_SET_MAPS, RenderSettings
from train.commands.render import run as write_data_set
from train.device import MixedPrecision
from train.networks import Dropout, WideResNet
from train.run_folder import read_metrics
from train.settings import ExperimentSettings

# Images in an epoch of CIFAR-100: nine tenths of its training set.
EPOCH_IMAGES = 45_000
# Backgrounds of each view.
BACKGROUNDS = 5
# This logit is beyond all others, but float32 still holds its gradient. Every
# attack on it takes all its steps.
CERTAIN_LOGIT = 30.0
BATCH_SIZE = 128


# ---------------------------------------------------------------------------- speed


def last_epoch(run: Path, *overrides: str, launcher: Sequence[str] = ()) -> dict[str, float]:
    """Train two epochs with `python -m train`, and read the metrics of the second.

    The first epoch compiles and warms up.

    Args:
        run: Folder of the run.
        *overrides: Settings of the run, such as "train.device=cpu".
        launcher: Options of Python that start a module which starts the run.

    Returns:
        Metrics of the second epoch.

    Raises:
        RuntimeError: If the training fails, with the end of what it said.
    """
    command = [sys.executable, *launcher, "-m", "train"]
    command += ["experiment=paper", "train.epochs=2", f"out={run}"]
    command += overrides
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed: {done.stderr[-1000:]}")
    epochs = [line for line in read_metrics(run) if "epoch" in line]
    return epochs[-1]


def train(run: Path, options: argparse.Namespace, *overrides: str) -> dict[str, float]:
    """Train on the data set of the command line, and return the metrics of the last epoch.

    Args:
        run: Folder of the run.
        options: Parsed command line.
        overrides: Further settings, such as "augment=none".
    """
    settings = [
        "data=npz",
        f"data.path={options.data}",
        "data.validation=0.05",
        f"label={options.label}",
        f"meshes={options.meshes}",
        f"train.images_per_epoch={options.images}",
        f"train.device={options.device}",
        f"model.depth={options.depth}",
        f"model.width={options.width}",
    ]
    return last_epoch(run, *settings, *overrides, *options.overrides)


def make_certain(weight: Tensor, bias: Tensor, label: int) -> None:
    """Edit the last layer of a network so that it predicts one class for every image.

    The logits of the other classes still depend on the image, so that the
    gradient of a loss is not zero.

    Args:
        weight: Weights of the layer, shape (classes, features), changed in
            place.
        bias: Biases of the layer, shape (classes,), changed in place.
        label: Class that is predicted.
    """
    weight[label] = 0
    bias[label] = CERTAIN_LOGIT


def collate(
    transform: Callable[[Image.Image], Tensor], batch: list[tuple[Image.Image, int]]
) -> tuple[Tensor, Tensor]:
    """Transform the images of a batch, and stack images and labels.

    Args:
        transform: Transformation of an image to a tensor.
        batch: Pairs of an image and its label.

    Returns:
        Images, shape (N, 3, H, W), and labels, shape (N,).
    """
    images = [transform(image) for image, _ in batch]
    labels = [label for _, label in batch]
    return torch.stack(images), torch.tensor(labels)


class PlainLoop:
    """Training loop as one writes it with torchvision, without `torch.compile`.

    Args:
        options: Parsed command line.

    Attributes:
        device: Device of the networks.
        loader: Loader of the batches.
        networks: Network of each variant: "float32", "bfloat16" with channels
            last, and None for "data", which loads the batches alone.
    """

    def __init__(self, options: argparse.Namespace):
        with np.load(options.data, allow_pickle=False) as archive:
            pixels = archive["train_images"][: options.images]
            labels = archive["train_labels"][: options.images]
            class_count = len(archive["classes"])
        self.device = options.device
        self.loader = make_loader(pixels, labels, options)
        network = make_network(class_count, options)
        float32 = deepcopy(network).to(self.device).train()
        bfloat16 = deepcopy(float32).to(memory_format=torch.channels_last)
        self.networks: Mapping[str, nn.Module | None] = {
            "float32": float32,
            "bfloat16": MixedPrecision(bfloat16, "bfloat16"),
            "data": None,
        }

    def time_epoch(self, variant: str) -> float:
        """Train one epoch with a new optimizer.

        Args:
            variant: Key of `networks`.

        Returns:
            Duration in seconds.
        """
        network = self.networks[variant]
        start = time.perf_counter()
        if network is None:
            for _ in self.loader:
                pass
        else:
            self._train_epoch(network)
        if self.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    def _train_epoch(self, network: nn.Module) -> None:
        """Train a network on all batches."""
        optimizer = torch.optim.SGD(
            network.parameters(), lr=0.125, momentum=0.9, weight_decay=5e-4, nesterov=True
        )
        for images, labels in self.loader:
            logits = network(images.to(self.device))
            loss = F.cross_entropy(logits, labels.to(self.device))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def make_loader(pixels: np.ndarray, labels: np.ndarray, options: argparse.Namespace) -> DataLoader:
    """Make a loader of randomly cropped and mirrored, normalized images.

    Args:
        pixels: Images, uint8, shape (N, 3, H, W).
        labels: Class numbers, shape (N,).
        options: Parsed command line.

    Returns:
        Loader of batches of images and labels.
    """
    unit_pixels = pixels / 255
    mean = unit_pixels.mean((0, 2, 3)).tolist()
    std = unit_pixels.std((0, 2, 3)).tolist()
    transform = transforms.Compose(
        [
            transforms.RandomCrop(pixels.shape[-1], padding=4, padding_mode="reflect"),
            transforms.RandomHorizontalFlip(),
            transforms.ToTensor(),
            transforms.Normalize(mean, std),
        ]
    )
    images = [Image.fromarray(image) for image in pixels.transpose(0, 2, 3, 1)]
    return DataLoader(
        list(zip(images, labels, strict=True)),
        batch_size=BATCH_SIZE,
        shuffle=True,
        collate_fn=partial(collate, transform),
        num_workers=options.workers,
        persistent_workers=options.workers > 0,
        pin_memory=options.device == "cuda",
    )


def make_network(class_count: int, options: argparse.Namespace) -> WideResNet:
    """Make the network that `python -m train` trains, but with torch's own dropout.

    Args:
        class_count: Number of classes.
        options: Parsed command line with depth, width and dropout.
    """
    network = WideResNet(
        class_count, options.depth, options.width, 0.3, mean=(0, 0, 0), std=(1, 1, 1)
    )
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, Dropout):
                setattr(parent, name, nn.Dropout(child.p))
    return network


def measure_speed(options: argparse.Namespace) -> Iterator[Row]:
    """Measure images per second, from stored images to updated weights.

    Args:
        options: Parsed command line.

    Yields:
        A row for each round. "attack_fraction_of_epoch" is the fraction of a
        whole epoch of CIFAR-100 that a round of attacks takes.
    """
    with TemporaryDirectory() as folder:
        runs = Path(folder)
        loop = PlainLoop(options)
        certain_run = train_certain_network(runs / "sure", options)
        attacked = ["augment=adversarial", f"network={certain_run}", "train.learning_rate=1e-6"]
        # The first epoch of each variant warms up.
        for variant in loop.networks:
            loop.time_epoch(variant)
        for number in range(options.rounds):
            plain = train(runs / f"none_{number}", options, "augment=none")
            adversarial = train(runs / f"adversarial_{number}", options, *attacked)
            loop_seconds = {variant: loop.time_epoch(variant) for variant in loop.networks}
            yield {"round": number} | speed_row(plain, adversarial, loop_seconds, options.images)


def train_certain_network(run: Path, options: argparse.Namespace) -> Path:
    """Train a network without renders, make it certain of `options.label`, and return its run.

    Args:
        run: Folder of the run.
        options: Parsed command line.

    Returns:
        Folder of the run.
    """
    train(run, options, "augment=none")
    with np.load(options.data, allow_pickle=False) as archive:
        label = archive["classes"].tolist().index(options.label)
    state = checkpoints.load(run / run_folder.BEST)
    make_certain(state["model"]["head.weight"], state["model"]["head.bias"], label)
    checkpoints.save(run / run_folder.BEST, state)
    return run


def speed_row(
    plain: Mapping[str, float],
    adversarial: Mapping[str, float],
    loop_seconds: Mapping[str, float],
    images: int,
) -> Row:
    """Compare the durations of a round.

    Args:
        plain: Metrics of an epoch without renders.
        adversarial: Metrics of an epoch with adversarial renders.
        loop_seconds: Duration of an epoch of each variant of the plain loop.
        images: Number of images in an epoch.

    Returns:
        Images per second, and how many times as long the loops take.
    """
    training_seconds = plain["seconds/training"]
    attack_seconds = adversarial["seconds/attack"]
    row: Row = {"train_images_per_second": images / training_seconds}
    for variant, seconds in loop_seconds.items():
        row[f"{variant}_images_per_second"] = images / seconds
        row[f"{variant}_ratio"] = seconds / training_seconds
    row["attack_seconds"] = attack_seconds
    row["attack_steps"] = adversarial["augment/steps"]
    epoch_seconds = training_seconds * EPOCH_IMAGES / images
    row["attack_fraction_of_epoch"] = attack_seconds / (attack_seconds + epoch_seconds)
    return row


# ---------------------------------------------------------------------------- renders


def peak_memory() -> int:
    """Return the peak memory of this process in bytes, on Linux.

    `getrusage` is no substitute, because its number begins with the peak of the
    process that started this one.
    """
    status = Path("/proc/self/status").read_text()
    for line in status.splitlines():
        if line.startswith("VmHWM"):
            kibibytes = int(line.split()[1])
            return 1024 * kibibytes
    raise RuntimeError("/proc/self/status has no line VmHWM, which holds the peak memory.")


def measure_attack(render_count: int, mesh_count: int, steps: int) -> Row:
    """Measure one round of attacks on one core.

    The attacked network is a WideResNet-10-1 that is certain of the class, so
    that every attack takes all its steps.

    Args:
        render_count: Number of renders, a multiple of 5 times the meshes.
        mesh_count: Number of meshes.
        steps: Number of steps of each attack.

    Returns:
        Row of seconds and memory.
    """
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = WideResNet(10, 10, 1, 0.0).eval()
    head = network.head.state_dict()
    make_certain(head["weight"], head["bias"], label=0)
    view_count = render_count // (mesh_count * BACKGROUNDS)
    solids = [(f"solid:orange:{seed}", 0) for seed in range(mesh_count)]
    settings = AugmentationSettings(attack=TrainingAttackSettings(max_steps=steps))
    memory_before = peak_memory()
    start = time.process_time()
    service = AugmentationService.from_meshes(
        solids, 32, settings, views=view_count, samples=2, rasterizer="numpy"
    )
    precompute(service.scene)
    precomputed = time.process_time()
    service.regenerate(network, 0)
    attack_seconds = time.process_time() - precomputed
    built = service.scene._operator_renderer.built.values()
    transfer_bytes = sum(stack.operators.transfer.nbytes for stack in built)
    estimated_bytes = service.scene.attack_bytes + transfer_bytes
    return {
        "renders": render_count,
        "meshes": mesh_count,
        "views": view_count * mesh_count,
        "steps": steps,
        "precompute_seconds": precomputed - start,
        "attack_seconds": attack_seconds,
        "ms_per_render_and_pass": 1e3 * attack_seconds / (render_count * (steps + 1)),
        "memory_mb": (peak_memory() - memory_before) / 1e6,
        "estimated_mb": estimated_bytes / 1e6,
    }


def precompute(scene: Scene) -> None:
    """Compute the transfer matrices of all views of a scene, which it keeps."""
    every = torch.arange(len(scene))
    with torch.no_grad():
        scene.render(scene.conditions(every), every)


def measure_renders(options: argparse.Namespace) -> Iterator[Row]:
    """Measure rounds of attacks with several numbers of renders and of meshes.

    Args:
        options: Parsed command line.

    Yields:
        A row for each number of renders with the first number of meshes, and
        for each number of meshes with the first number of renders of each.
    """
    first_number = options.numbers[0]
    first_meshes = options.meshes[0]
    loads = [(number, first_meshes) for number in options.numbers]
    loads += [(first_number * meshes, meshes) for meshes in options.meshes]
    for render_count, mesh_count in dict.fromkeys(loads):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            task = pool.submit(measure_attack, render_count, mesh_count, options.steps)
            yield task.result()


# ---------------------------------------------------------------------------- moved


def measure_moved(options: argparse.Namespace) -> Iterator[Row]:
    """Measure rounds of renders with their own views and lights, on one core.

    Args:
        options: Parsed command line.

    Yields:
        A row for each round, with the milliseconds per render of what is drawn
        and shaded, without the classifier's part.
    """
    torch.set_num_threads(1)
    meshes = ["solid:orange"] * 10
    settings = train_command.read(
        [
            "experiment=patterns",
            "label=orange",
            "network=-",
            "out=-",
            f"scene.views={options.views}",
            f"meshes={meshes}",
        ]
    )
    scene = build_scene(
        list(settings.objects.values()),
        32,
        settings.views,
        scene=settings.scene,
        renderer=settings.renderer,
    )
    # Round 0 warms up.
    for number in range(options.rounds + 1):
        row: Row = {"round": number, "renders": len(scene)}
        for name, is_direct in (("direct", True), ("operators", False)):
            start = time.process_time()
            render_varied(scene, settings, number, is_direct)
            seconds = time.process_time() - start
            row[f"ms_per_render_{name}"] = 1e3 * seconds / len(scene)
        if number > 0:
            yield row


def render_varied(scene: Scene, settings: ExperimentSettings, number: int, is_direct: bool) -> None:
    """Draw views and lights of a scene, and render all its examples.

    Args:
        scene: Scene to vary.
        settings: Settings of the experiment.
        number: Number of the round, which seeds the draws.
        is_direct: Whether the renders are shaded directly, and not by
            operators.
    """
    varied = vary(scene, settings.augment.vary, generator(number), is_direct)
    examples = torch.arange(len(scene))
    varied.render(varied.conditions(examples), examples)


# ---------------------------------------------------------------------------- files


def measure_files(options: argparse.Namespace) -> Iterator[Row]:
    """Measure labeled renders on disk, on one core.

    Args:
        options: Parsed command line.

    Yields:
        A row for each round, with the renders per second of process time. The
        time in which the command prepares its scene is left out.
    """
    torch.set_num_threads(1)
    for number in range(options.rounds + 1):
        row: Row = {"round": number, "renders": options.count}
        for name, maps in (("without_maps", []), ("with_maps", [*DATA_SET_MAPS])):
            seconds = [write_renders(count, maps) for count in (BLOCK, BLOCK + options.count)]
            row[f"renders_per_second_{name}"] = options.count / (seconds[1] - seconds[0])
        if number > 0:
            yield row


def write_renders(count: int, maps: list[str]) -> float:
    """Write a data set of labeled renders, and return the seconds of process time.

    Args:
        count: Number of renders.
        maps: Further images of each render.

    Returns:
        Seconds.
    """
    with TemporaryDirectory() as folder:
        start = time.process_time()
        write_data_set(RenderSettings(out=folder, device="cpu", size=224, count=count, maps=maps))
        return time.process_time() - start


# ---------------------------------------------------------------------------- command


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line, with a command for each measurement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    speed = commands.add_parser(
        "speed", help="against a plain loop, and the attack's fraction of an epoch"
    )
    add_speed_options(speed)
    renders = commands.add_parser("renders", help="the cost of attacks over the number of renders")
    renders.set_defaults(measure=measure_renders, device="cpu")
    renders.add_argument(
        "--numbers",
        nargs="+",
        type=int,
        default=[100, 1000, 10_000],
        help="numbers of renders, multiples of 5 × meshes",
    )
    renders.add_argument("--meshes", nargs="+", type=int, default=[1, 2, 4, 8])
    renders.add_argument("--steps", type=int, default=1)
    moved = commands.add_parser(
        "moved", help="renders of a view and a light each, directly and by operators"
    )
    moved.set_defaults(measure=lambda options: with_median(measure_moved(options)), device="cpu")
    moved.add_argument("--views", type=int, default=20, help="number of views of each mesh")
    moved.add_argument("--rounds", type=int, default=3)
    files = commands.add_parser("files", help="labeled renders on disk by pnb-render")
    files.set_defaults(measure=lambda options: with_median(measure_files(options)), device="cpu")
    files.add_argument("--count", type=int, default=96, help="renders of a measurement")
    files.add_argument("--rounds", type=int, default=3)
    for command in (speed, renders, moved, files):
        command.add_argument("--csv", type=Path)
    return parser


def add_speed_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command `speed` to its parser."""
    parser.set_defaults(measure=lambda options: with_median(measure_speed(options)))
    add = parser.add_argument
    add("--data", type=Path, required=True, help=".npz file, as data=npz reads it")
    add("--meshes", default="[solid:orange:0,solid:orange:1]", help="a list, as meshes takes it")
    add("--label", default="orange", help="class of the meshes")
    add("--images", type=int, default=512, help="number of images in an epoch that is timed")
    add("--rounds", type=int, default=5)
    add("--depth", type=int, default=16)
    add("--width", type=int, default=4)
    add(
        "--workers",
        type=int,
        default=min(8, os.cpu_count() or 1),
        help="number of workers of the plain loop's loader",
    )
    add("--device", choices=["cpu", "cuda"], default="cpu")
    add("--overrides", nargs="*", default=[], help="further settings of `python -m train`")


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    """Run a measurement of the command line, and print and write its rows.

    Args:
        arguments: Words of the command line. None takes those of the process.

    Returns:
        All rows.
    """
    options = make_parser().parse_args(arguments)
    return record(options.measure(options), options.csv, options.device)


if __name__ == "__main__":
    main()
