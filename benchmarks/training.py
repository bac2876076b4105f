
"""The speed of training, and what adversarial renders cost.

    python -m benchmarks.training speed --data cifar100.npz --csv speed.csv
    python -m benchmarks.training renders --numbers 100 1000 10000 --csv renders.csv
    python -m benchmarks.training moved --views 2 --rounds 5 --csv moved.csv

`speed` lets three contestants take turns, so that a busy machine slows all alike: `python -m train` without renders and
with adversarial ones, each a process whose second epoch counts, and the loop that one writes with torchvision: a
DataLoader over PIL images and torch's own dropout, in float32, in bfloat16 with channels last, and without a network.
`renders` measures one round of attacks over the number of renders and of meshes, at 32 pixels per side, each in a
process of its own, whose peak memory is then its own. `moved` measures rounds of `experiment=best`, where each render
has a view and a light of its own, shaded directly and by operators.
"""

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
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
from augment.random_streams import generator
from augment.scene.build import build_scene
from augment.scene.variation import vary
from augment.settings import TrainingAttackSettings
from benchmarks.common import Row, record, with_median
from train.__main__ import main as train_command
from train.networks import Dropout, WideResNet
from train.runs import checkpoint
from train.system.device import MixedPrecision

EPOCH_IMAGES = 45_000  # that a whole epoch of CIFAR-100 trains on: nine tenths of its training set
BACKGROUNDS = 5  # of each view
SURE = 30.0  # a logit beyond all others, whose gradient float32 still holds: every attack takes all its steps


def last_epoch(run: Path, *overrides: str, launcher: Sequence[str] = ()) -> dict[str, float]:
    """The metrics of the second of two epochs of `python -m train`; the first compiles and warms up."""
    command = [sys.executable, *launcher, "-m", "train", "experiment=paper", "train.epochs=2", f"run={run}"]
    subprocess.run([*command, *overrides], check=True, stdout=subprocess.DEVNULL)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return next(line for line in reversed(lines) if "epoch" in line)


def train(run: Path, options: argparse.Namespace, *overrides: str) -> dict[str, float]:
    settings = ["data=npz", f"data.path={options.data}", "data.validation=0.05", f"scene.meshes={options.meshes}"]
    settings += [f"train.images_per_epoch={options.images}", f"train.device={options.device}"]
    settings += [f"model.depth={options.depth}", f"model.width={options.width}"]
    return last_epoch(run, *settings, *overrides, *options.overrides)


def make_sure(head: dict[str, Tensor], label: int = 0) -> None:
    """Edit a network's last layer so that it predicts one class for every image, with a gradient left."""
    head["weight"][label] = 0
    head["bias"][label] = SURE


def collate(transform: Callable[[Image.Image], Tensor], batch: list[tuple[Image.Image, int]]) -> tuple[Tensor, Tensor]:
    return torch.stack([transform(image) for image, _ in batch]), torch.tensor([label for _, label in batch])


def plain_loop(options: argparse.Namespace) -> dict[str, Callable[[], float]]:
    """Functions that train one epoch and return its seconds, eager, on the same network as `train`'s, by number type,
    which for bfloat16 has its channels last; "data" loads the batches alone."""
    with np.load(options.data, allow_pickle=False) as archive:
        pixels, labels = (archive[f"train_{name}"][: options.images] for name in ("images", "labels"))
        count = len(archive["classes"])
    crop = transforms.RandomCrop(pixels.shape[-1], padding=4, padding_mode="reflect")
    mean, std = (getattr(pixels / 255, name)((0, 2, 3)).tolist() for name in ("mean", "std"))
    steps = [crop, transforms.RandomHorizontalFlip(), transforms.ToTensor(), transforms.Normalize(mean, std)]
    images = [Image.fromarray(image) for image in pixels.transpose(0, 2, 3, 1)]
    more = {"collate_fn": partial(collate, transforms.Compose(steps)), "pin_memory": options.device == "cuda"}
    more |= {"num_workers": options.workers, "persistent_workers": options.workers > 0}
    loader = DataLoader(list(zip(images, labels, strict=True)), batch_size=128, shuffle=True, **more)
    network = WideResNet(count, options.depth, options.width, 0.3, mean=(0, 0, 0), std=(1, 1, 1))
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, Dropout):
                setattr(parent, name, nn.Dropout(child.p))
    networks = {name: deepcopy(network).to(options.device).train() for name in ("float32", "bfloat16")}
    networks["bfloat16"] = MixedPrecision(networks["bfloat16"], "bfloat16")

    def epoch(network: nn.Module | None) -> float:
        start = time.perf_counter()
        optimizer = network and torch.optim.SGD(network.parameters(), 0.125, 0.9, weight_decay=5e-4, nesterov=True)
        for batch, classes in loader:
            if network is None or optimizer is None:
                continue
            loss = F.cross_entropy(network(batch.to(options.device)), classes.to(options.device))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        if options.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    return {name: partial(epoch, network) for name, network in {**networks, "data": None}.items()}


def speed(options: argparse.Namespace) -> Iterator[Row]:
    """Images per second from stored images to updated weights, and the attack's fraction of a whole epoch."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        loops = plain_loop(options)
        train(folder / "sure", options, "augment=none")
        state = checkpoint.load(folder / "sure" / checkpoint.BEST)
        make_sure({name: state["model"][f"head.{name}"] for name in ("weight", "bias")})
        checkpoint.save(folder / "sure" / checkpoint.BEST, state)
        attacked = ("augment=adversarial", f"train.init_from={folder}/sure", "train.learning_rate=1e-6")
        for loop in loops.values():
            loop()  # warms up
        for number in range(options.rounds):
            none = train(folder / f"none_{number}", options, "augment=none")
            adversarial = train(folder / f"adversarial_{number}", options, *attacked)
            ours, attack = none["seconds/training"], adversarial["seconds/attack"]
            row: Row = {"round": number, "train_images_per_second": options.images / ours}
            for name, seconds in {name: loop() for name, loop in loops.items()}.items():
                row |= {f"{name}_images_per_second": options.images / seconds, f"{name}_ratio": seconds / ours}
            row |= {"attack_seconds": attack, "attack_steps": adversarial["augment/steps"]}
            row["attack_fraction_of_epoch"] = attack / (attack + ours * EPOCH_IMAGES / options.images)
            yield row


def peak_memory() -> int:
    """Bytes. What `getrusage` reports begins with the peak of the process that started this one."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")))


def attack_cost(renders: int, meshes: int, steps: int) -> Row:
    """Seconds of one core that one round of attacks takes, against a WideResNet-10-1 that is sure of the class."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network, views = WideResNet(10, 10, 1, 0.0).eval(), renders // (meshes * BACKGROUNDS)
    make_sure(network.head.state_dict())
    solids = [(f"solid:orange:{seed}", 0) for seed in range(meshes)]
    settings = AugmentationSettings(attack=TrainingAttackSettings(max_steps=steps))
    before, start = peak_memory(), time.process_time()
    service = AugmentationService.from_meshes(solids, 32, settings, views=views, samples=2, rasterizer="numpy")
    _ = service.scene.stacks  # what is precomputed of each view
    built = time.process_time()
    service.regenerate(network, 0)
    attack = time.process_time() - built
    row = {"renders": renders, "meshes": meshes, "views": views * meshes, "steps": steps}
    row |= {"precompute_seconds": built - start, "attack_seconds": attack}
    row["ms_per_render_and_pass"] = 1e3 * attack / (renders * (steps + 1))
    estimated = service.scene.attack_bytes + sum(stack.transfer.nbytes for stack in service.scene.stacks)
    return row | {"memory_mb": (peak_memory() - before) / 1e6, "estimated_mb": estimated / 1e6}


def renders(options: argparse.Namespace) -> Iterator[Row]:
    """A row per number of renders, and per number of meshes with the first number of renders of each."""
    few, meshes = options.numbers[0], options.meshes[0]
    loads = [(number, meshes) for number in options.numbers] + [(few * count, count) for count in options.meshes]
    for load in dict.fromkeys(loads):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            yield pool.submit(attack_cost, *load, options.steps).result()


def moved(options: argparse.Namespace) -> Iterator[Row]:
    """Milliseconds of one core per render, by rounds; what one draws and shades, without the classifier's part."""
    torch.set_num_threads(1)
    overrides = ["experiment=best", "train.init_from=-", "run=-", f"scene.views={options.views}"]
    overrides.append(f"scene.meshes={['solid:orange'] * 10}")
    settings = train_command.read(overrides)
    chosen = {"scene": settings.scene, "renderer": settings.renderer}
    scene = build_scene(list(settings.objects.values()), 32, settings.views, **chosen)
    for number in range(options.rounds + 1):
        row: Row = {"round": number, "renders": len(scene)}
        for name, once in (("direct", True), ("operators", False)):
            start = time.process_time()
            varied, everything = vary(scene, settings.augment.vary, generator(number), once), torch.arange(len(scene))
            varied.render(varied.conditions(everything), everything)
            row[f"ms_per_render_{name}"] = 1e3 * (time.process_time() - start) / len(scene)
        if number:  # the first warms up
            yield row


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("speed", help="against a plain loop, and the attack's fraction of an epoch")
    command.set_defaults(measure=lambda options: with_median(speed(options)))
    command.add_argument("--data", type=Path, required=True, help=".npz file, as data=npz reads it")
    command.add_argument("--meshes", default="[solid:orange:0,solid:orange:1]", help="a list, as scene.meshes takes it")
    command.add_argument("--images", type=int, default=512, help="per epoch that is timed")
    command.add_argument("--rounds", type=int, default=5)
    command.add_argument("--depth", type=int, default=16)
    command.add_argument("--width", type=int, default=4)
    command.add_argument("--workers", type=int, default=min(8, os.cpu_count() or 1), help="of the plain loop's loader")
    command.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    command.add_argument("--overrides", nargs="*", default=[], help="further ones of `python -m train`")
    command = commands.add_parser("renders", help="the cost of attacks over the number of renders")
    command.set_defaults(measure=renders, device="cpu")
    command.add_argument("--numbers", nargs="+", type=int, default=[100, 1000, 10_000], help="multiples of 5 × meshes")
    command.add_argument("--meshes", nargs="+", type=int, default=[1, 2, 4, 8])
    command.add_argument("--steps", type=int, default=1)
    command = commands.add_parser("moved", help="renders of a view and a light each, directly and by operators")
    command.set_defaults(measure=lambda options: with_median(moved(options)), device="cpu")
    command.add_argument("--views", type=int, default=20, help="of each mesh")
    command.add_argument("--rounds", type=int, default=3)
    for command in commands.choices.values():
        command.add_argument("--csv", type=Path)
    options = parser.parse_args(arguments)
    return record(options.measure(options), options.csv, options.device)


if __name__ == "__main__":
    main()
