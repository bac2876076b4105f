"""Who takes turns with what: both arms, the plain loop and the matrix products, on one data set."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf

from renderer.errors import require_range
from train.command_line.configuration import read_settings
from train.data import DataSet, Split, channel_statistics, stratified_split
from train.device import choose_precision
from train.experiment import load_data
from train.settings import ExperimentSettings
from train.studies.training_speed.arm import Arm
from train.studies.training_speed.baseline import Baseline, build_loader
from train.studies.training_speed.findings import ADVERSARIAL, BASELINE, PLAIN, PRODUCTS, Findings, Turn, Workload
from train.studies.training_speed.peak import forward_multiply_adds, products
from train.wideresnet import WideResNet

IMAGES, CLASSES, SIZE = 50_000, 100, 32  # CIFAR-100's
EPOCHS = {"cpu": 9, "cuda": 10}
STEPS = {"cpu": 4, "cuda": 0}
FEWER = 3
MOST_WORKERS = 8

Contestant = Callable[[], Turn]


@dataclass
class BenchmarkSettings:
    """conf/benchmark_training.yaml's own keys; None: what suits the device."""

    out: str
    epochs: int | None = None
    steps: int | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        for name, least, most in (("epochs", 1, 10**6), ("steps", 0, 10**6), ("workers", 0, 1024)):
            require_range(name, getattr(self, name), least, most)

    def on(self, device: torch.device) -> "BenchmarkSettings":
        """With a number for each None."""
        epochs = EPOCHS[device.type] if self.epochs is None else self.epochs
        steps = STEPS[device.type] if self.steps is None else self.steps
        workers = min(MOST_WORKERS, os.cpu_count() or 1) if self.workers is None else self.workers
        return BenchmarkSettings(self.out, epochs, steps, workers)


def load(config: DictConfig) -> DataSet:
    """The data that the configuration names or, without a path, random images like CIFAR-100's."""
    if config.data.path:
        return load_data(config)
    draws = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (IMAGES, 3, SIZE, SIZE), dtype=torch.uint8, generator=draws)
    split = Split(images, torch.arange(IMAGES) % CLASSES)
    classes = (config.label, *(f"class {index}" for index in range(1, CLASSES)))
    return DataSet(classes, split, split[:CLASSES])


def measure(settings: BenchmarkSettings, config: DictConfig, data: DataSet, device: torch.device) -> Findings:
    """All turns. settings: without None. config: of the experiment; both arms and the baseline train as it says."""
    plain, adversarial = (_with_arm(config, arm) for arm in ("none", "adversarial"))
    recipe = plain.train
    train, validation = stratified_split(data.train, plain.data.validation, seed=0)
    work = Workload(
        len(train), len(validation), adversarial.augment.examples or 0, recipe.batch_size, settings.steps or None
    )
    validation = validation[: work.validated].to(device)
    mean, std = channel_statistics(data.train.images)
    network = WideResNet(len(data.classes), **plain.model.shape, mean=(0, 0, 0), std=(1, 1, 1))
    multiply_adds = forward_multiply_adds(network, data.size)
    loader = build_loader(train[: work.trained], recipe.batch_size, mean, std, settings.workers or 0, device)
    with TemporaryDirectory() as folder:
        makers: dict[str, Callable[[], Contestant]] = {
            PLAIN: lambda: Arm(plain, data, Path(folder, "plain"), train[: work.trained].to(device), validation),
            BASELINE: lambda: Baseline(network, loader, recipe, device),
            PRODUCTS: lambda: partial(products, device),
            ADVERSARIAL: lambda: Arm(
                adversarial, data, Path(folder, "adversarial"), train[: work.beside_renders].to(device), validation
            ),
        }
        turns = compete(makers, settings.epochs or 1, device)
    return Findings(device.type, choose_precision(recipe.precision, device), multiply_adds, work, turns)


def compete(makers: Mapping[str, Callable[[], Contestant]], rounds: int, device: torch.device) -> dict[str, list[Turn]]:
    """On a CPU in turns, but for the adversarial arm, whose long attacks come after the others, in fewer rounds.

    On a GPU one after the other, and what torch.compile kept of the one before is dropped, as in a process of its own.
    """
    if device.type == "cpu":
        others = {name: make for name, make in makers.items() if name != ADVERSARIAL}
        return take_turns(others, rounds) | take_turns({ADVERSARIAL: makers[ADVERSARIAL]}, -(-rounds // FEWER))
    turns: dict[str, list[Turn]] = {}
    for name, make in makers.items():
        torch.compiler.reset()
        turns |= take_turns({name: make}, rounds)
    return turns


def take_turns(makers: Mapping[str, Callable[[], Contestant]], rounds: int) -> dict[str, list[Turn]]:
    """What each contestant's turns returned: a first one, which warms up, and one per round; all take turns."""
    contestants = {name: make() for name, make in makers.items()}
    turns: dict[str, list[Turn]] = {name: [] for name in makers}
    for past in range(rounds + 1):
        print(f"{', '.join(makers)}: {f'round {past} of {rounds}' if past else 'warming up'}", flush=True)
        for name, contestant in contestants.items():
            turns[name].append(contestant())
    return turns


def _with_arm(config: DictConfig, arm: str) -> ExperimentSettings:
    return read_settings(ExperimentSettings, cast(DictConfig, OmegaConf.merge(config, {"augment": {"arm": arm}})))
