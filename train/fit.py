"""The training loop: each epoch regenerates the renders, trains on data and renders, validates and checkpoints."""

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import tqdm

from augment.model_state import eval_mode
from augment.phases import Phases
from augment.seeding import stream_seed
from augment.service import AugmentationService, Renders
from renderer.errors import InputError
from train import checkpoint
from train.batches import to_bytes, to_unit, training_batches
from train.data import Split
from train.logs import RunLog, console
from train.precision import MixedPrecision
from train.schedule import SCHEDULES, check_schedule

EVALUATION_BATCH = 500


@dataclass
class TrainSettings:
    """The recipe; the defaults are the paper's. device: auto, cpu, cuda or cuda:N. resume: go on from last.pt."""

    epochs: int = 150
    batch_size: int = 128
    learning_rate: float = 0.125
    momentum: float = 0.9
    weight_decay: float = 5e-4
    schedule: str = "step"
    precision: str = "auto"
    device: str = "auto"
    resume: bool = False

    def __post_init__(self):
        check_schedule(self.schedule)
        if self.epochs < 1 or self.batch_size < 1:
            raise InputError(f"train.epochs={self.epochs} and train.batch_size={self.batch_size} must be at least 1")
        if not (0 < self.learning_rate < math.inf and 0 <= self.momentum < 1 and 0 <= self.weight_decay < math.inf):
            raise InputError(
                f"train.learning_rate={self.learning_rate} must be positive, train.momentum={self.momentum} in [0, 1) "
                f"and train.weight_decay={self.weight_decay} not negative"
            )


class Trainer:
    """One run: its network, optimiser, augmentation and folder. `fit` trains; everything else is its parts."""

    def __init__(
        self,
        settings: TrainSettings,
        model: MixedPrecision,
        architecture: dict,
        service: AugmentationService,
        phases: Phases,
        folder: Path,
        seed: int,
    ):
        """architecture: what rebuilds the network from a checkpoint, classes included."""
        self.settings = settings
        self.model = model
        self.architecture = architecture
        self.service = service
        self.phases = phases
        self.folder = folder
        self.seed = seed
        self.epoch = 0
        self.best_accuracy = -1.0
        self.best_epoch = 0
        self.optimizer = torch.optim.SGD(
            model.parameters(),
            lr=settings.learning_rate,
            momentum=settings.momentum,
            weight_decay=settings.weight_decay,
            nesterov=settings.momentum > 0,
        )

    def fit(self, train: Split, validation: Split, log: RunLog) -> None:
        """Train to the last epoch; last.pt after every epoch, best.pt whenever validation improves.

        InputError where training diverges.
        """
        mixed = with_room(train, len(self.service))
        while self.epoch < self.settings.epochs:
            torch.manual_seed(stream_seed(self.seed, self.epoch, "dropout"))
            with self.phases("attack"):
                renders = self.service.regenerate(self.model, self.epoch)
                put_last(mixed, renders)
            with self.phases("training"):
                trained = self._train_epoch(mixed)
            with self.phases("evaluation"):
                validated = evaluate(self.model, validation)
            self.epoch += 1
            self._check_finite(trained["loss"] + validated["loss"])
            with self.phases("input_output"):
                if len(renders.labels):
                    log.renders(renders.images, self.epoch)
            self._report(log, trained, validated, renders)
            with self.phases("input_output"):  # after the epoch's line, so that a resumed run never lacks it
                self._save(validated["accuracy"])

    def resume(self) -> None:
        """Go on from the folder's last.pt; InputError where it is from another architecture."""
        path = self.folder / checkpoint.LAST
        state = checkpoint.load(path)
        if state["architecture"] != self.architecture:
            raise InputError(
                f"checkpoint {path} is from another architecture or other classes: resume with the settings of "
                f"{self.folder / 'config.yaml'}, or start in another folder with run="
            )
        self.model.network.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.service.load_state_dict(state["service"])
        self.model.precision = state["precision"]
        self.epoch, self.best_accuracy, self.best_epoch = (
            state[name] for name in ("epoch", "validation_accuracy_best", "epoch_best")
        )

    def _train_epoch(self, split: Split) -> dict[str, float]:
        self.model.train()
        total = math.ceil(len(split) / self.settings.batch_size)
        loss_sum, correct = torch.zeros(2, device=split.images.device)
        batches = training_batches(split.images, split.labels, self.settings.batch_size, self.seed, self.epoch)
        for step, (images, labels) in enumerate(_progress(batches, total, f"epoch {self.epoch + 1}")):
            self._set_learning_rate((self.epoch + step / total) / self.settings.epochs)
            logits = self.model(images)
            loss = F.cross_entropy(logits, labels)
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            loss_sum += loss.detach() * len(labels)
            correct += (logits.detach().argmax(1) == labels).sum()
        return {"loss": float(loss_sum) / len(split), "accuracy": float(correct) / len(split)}

    def _set_learning_rate(self, progress: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * SCHEDULES[self.settings.schedule](progress)

    def _check_finite(self, loss: float) -> None:
        if not math.isfinite(loss):
            raise InputError(
                f"train.learning_rate={self.settings.learning_rate} made the loss infinite in epoch {self.epoch}: "
                "set a lower one"
            )

    def _save(self, accuracy: float) -> None:
        weights = self.model.network.state_dict()
        improved = accuracy > self.best_accuracy
        if improved:
            self.best_accuracy, self.best_epoch = accuracy, self.epoch
        state = {
            "model": weights,
            "architecture": self.architecture,
            "epoch": self.epoch,
            "seed": self.seed,
            "arm": self.service.settings.arm,
            "validation_accuracy": accuracy,
        }
        if improved:
            checkpoint.save(self.folder / checkpoint.BEST, state)
        progress = {
            "optimizer": self.optimizer.state_dict(),
            "service": self.service.state_dict(),
            "precision": self.model.precision,
            "validation_accuracy_best": self.best_accuracy,
            "epoch_best": self.best_epoch,
        }
        checkpoint.save(self.folder / checkpoint.LAST, state | progress)

    def _report(self, log: RunLog, trained: dict, validated: dict, renders: Renders) -> None:
        seconds = self.phases.take()
        scalars = {
            **{f"train/{name}": value for name, value in trained.items()},
            **{f"validation/{name}": value for name, value in validated.items()},
            "train/learning_rate": self.optimizer.param_groups[0]["lr"],
            **{f"augment/{name}": value for name, value in renders.diagnostics.items()},
            **{f"seconds/{name}": value for name, value in seconds.items()},
        }
        log.scalars(scalars, self.epoch)
        fooled = renders.diagnostics.get("fooled")
        console.info(
            "epoch %d/%d  train loss %.3f accuracy %.3f  validation accuracy %.3f%s  %.0f s (attack %.1f s)",
            self.epoch,
            self.settings.epochs,
            trained["loss"],
            trained["accuracy"],
            validated["accuracy"],
            "" if fooled is None else f"  renders fooled {fooled:.2f}",
            seconds["training"] + seconds["evaluation"] + seconds["attack"] + seconds["input_output"],
            seconds["attack"],
        )


def with_room(split: Split, count: int) -> Split:
    """The split's pictures and, behind them, room for an epoch's renders."""
    images, labels = split.images, split.labels
    return Split(
        torch.cat([images, images.new_zeros(count, *images.shape[1:])]), torch.cat([labels, labels.new_zeros(count)])
    )


def put_last(split: Split, renders: Renders) -> None:
    """Overwrite the split's last pictures with the renders, as 8-bit pictures."""
    first = len(split) - len(renders.labels)
    split.images[first:] = to_bytes(renders.images)
    split.labels[first:] = renders.labels


@torch.inference_mode()
def evaluate(model: nn.Module, split: Split) -> dict[str, float]:
    """Mean cross entropy and top-1 accuracy in eval mode; the model's mode is restored."""
    loss_sum, correct = torch.zeros(2, device=split.images.device)
    with eval_mode(model):
        for images, labels in _batched(split):
            logits = model(to_unit(images))
            loss_sum += F.cross_entropy(logits, labels, reduction="sum")
            correct += (logits.argmax(1) == labels).sum()
    return {"loss": float(loss_sum) / len(split), "accuracy": float(correct) / len(split)}


def _batched(split: Split) -> Iterable[tuple[Tensor, Tensor]]:
    return zip(split.images.split(EVALUATION_BATCH), split.labels.split(EVALUATION_BATCH), strict=True)


def _progress(batches: Iterable, total: int, description: str) -> Iterable:
    """A progress bar on a terminal, nothing elsewhere."""
    return tqdm(batches, total=total, desc=description, leave=False, disable=not sys.stderr.isatty())
