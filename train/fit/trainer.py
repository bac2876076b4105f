"""The training loop: each round regenerates the renders and trains on data and renders; an epoch of rounds ends with
validation and a checkpoint."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from augment import utils
from augment.service import AugmentationService, Renders
from augment.utils import Phases, progress, stream_seed
from renderer.errors import InputError
from train.data import Split
from train.device import MixedPrecision
from train.distributed import summed
from train.fit.epoch import EpochUnderWay, Round, batch_count, put_last, rounds_of_epoch, training_batches, with_room
from train.fit.evaluation import evaluate
from train.fit.learner import Learner
from train.fit.recipe import TrainSettings
from train.interruption import Interruption
from train.run_folder import checkpoint
from train.run_folder.checkpoint import random_state, restore_random_state
from train.run_folder.logs import PHASES, Log, console


class Trainer:
    """One run: its network, optimizer, augmentation and folder. `fit` trains; everything else is its parts."""

    def __init__(
        self,
        settings: TrainSettings,
        model: MixedPrecision,
        architecture: dict[str, Any],
        service: AugmentationService,
        phases: Phases,
        folder: Path,
        seed: int,
    ):
        """architecture: what rebuilds the network from a checkpoint, classes included.

        InputError where the run's processes cannot share a batch equally.
        """
        if settings.batch_size % utils.world_size():
            raise InputError(
                f"train.batch_size={settings.batch_size} is not a multiple of the {utils.world_size()} processes"
            )
        self.settings = settings
        self.learner = Learner(settings, model, seed, service.label)
        self.architecture = architecture
        self.service = service
        self.phases = phases
        self.folder = folder
        self.seed = seed
        self.epoch = 0
        self.best_accuracy = -1.0
        self.best_epoch = 0
        self.history: list[dict[str, float]] = []
        self._under_way: EpochUnderWay | None = None
        self._random_state: dict[str, Any] = {}  # where the epoch under way was left
        self._best: dict[str, Any] | None = None  # selected, but not written yet

    @property
    def part_of_epoch(self) -> str:
        """Of the epoch under way, in words; empty between two epochs."""
        return f" and {self._under_way.step} steps" if self._under_way else ""

    def fit(self, train: Split, validation: Split, log: Log) -> None:
        """Train to the last epoch; best.pt holds the network of the best validation, or a soup's last.

        InputError where training diverges. `Interrupted`, after a checkpoint, where a signal asked for it.
        """
        mixed = with_room(train, len(self.service))
        shown, every = self.settings.images_per_epoch, self.service.settings.every
        with Interruption() as interruption:
            while self.epoch < self.settings.epochs:
                rounds = rounds_of_epoch(len(train), len(self.service), self.seed, self.epoch, shown, every)
                if self._under_way is None:
                    self.learner.begin_epoch()
                    self._under_way = EpochUnderWay.begun(self._regenerate(rounds[0], log))
                else:
                    restore_random_state(self._random_state)
                if self._train(self._under_way, mixed, rounds, interruption, log):
                    now, self._under_way = self._under_way, None
                    self._end_epoch(now, validation, log)
                ending = interruption.requested()
                if ending or self._checkpoint_is_due():
                    if self._under_way:
                        self.learner.require_finite(float(self._under_way.sums[0]), self.epoch + 1)
                    with self.phases("input_output"):  # after the epoch's line, so that a resumed run never lacks it
                        self._save()
                if ending:
                    interruption.stop()

    def state_dict(self) -> dict[str, Any]:
        """All that a run needs to go on as if it had never ended."""
        return {
            **self._described(),
            **self.learner.state_dict(),
            "service": self.service.state_dict(),
            "random_state": random_state(),
            "under_way": self._under_way.state_dict() if self._under_way else None,
            "history": self.history,
            "validation_accuracy_best": self.best_accuracy,
            "epoch_best": self.best_epoch,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """What `state_dict` gave."""
        self.learner.load_state_dict(state)
        self.service.load_state_dict(state["service"])
        self._random_state = state["random_state"]
        if state["under_way"]:
            self._under_way = EpochUnderWay.from_state_dict(state["under_way"], self.learner.device)
        self.epoch, self.history = state["epoch"], state["history"]
        self.best_accuracy, self.best_epoch = state["validation_accuracy_best"], state["epoch_best"]

    def _regenerate(self, now: Round, log: Log) -> Renders:
        torch.manual_seed(stream_seed(self.seed, now.number, "dropout"))
        with self.phases("attack"):
            renders = self.service.regenerate(self.learner.attacked, now.number)
        if renders.attack_examples:
            with self.phases("input_output"):  # now, since a run that goes on within the epoch makes no others
                log.attack_examples(renders.attack_examples, self.architecture["classes"], self.epoch + 1)
        return renders

    def _train(
        self, so_far: EpochUnderWay, mixed: Split, rounds: Sequence[Round], interruption: Interruption, log: Log
    ) -> bool:
        """Take the steps of what is left of the epoch; whether all were taken, since a signal ends them early."""
        steps = [batch_count(len(each.rows), self.settings.batch_size) for each in rounds]
        while True:
            index = so_far.round
            with self.phases("training"):
                put_last(mixed, so_far.renders)
                self._train_round(so_far, mixed, rounds[index], sum(steps[:index]), sum(steps), interruption)
            if so_far.step == sum(steps):
                return True
            if interruption.requested():
                return False
            so_far.next_round(self._regenerate(rounds[index + 1], log))

    def _train_round(
        self, so_far: EpochUnderWay, mixed: Split, now: Round, before: int, total: int, interruption: Interruption
    ) -> None:
        """The rest of a round. before: the epoch's steps in earlier rounds; total: in all."""
        self.learner.model.train()
        settings = self.settings
        cycle = 1 if settings.soup else settings.epochs
        first = so_far.step - before
        batches = training_batches(
            mixed.images, mixed.labels, settings.batch_size, self.seed, now, settings.flips, first=first
        )
        for images, labels, rendered in progress(batches, f"epoch {self.epoch + 1}", total, so_far.step):
            over = (self.epoch % cycle + so_far.step / total) / cycle
            so_far.sums += self.learner.step(images, labels, rendered, over, self.epoch * total + so_far.step)
            so_far.step += 1
            if interruption.requested():
                break

    def _end_epoch(self, now: EpochUnderWay, validation: Split, log: Log) -> None:
        seen = now.step * self.settings.batch_size
        loss_sum, hits = summed(now.sums).tolist()
        trained = {"loss": loss_sum / seen, "accuracy": hits / seen}
        self.learner.end_epoch()
        with self.phases("evaluation"):
            validated = evaluate(self.learner.scored, validation)
        self.epoch += 1
        self.learner.require_finite(trained["loss"] + validated["loss"], self.epoch)
        self._select(validated["accuracy"])
        with self.phases("input_output"):
            if len(now.renders.labels):
                log.renders(now.renders.images, self.epoch)
        self._report(log, trained, validated, now.diagnostics)

    def _checkpoint_is_due(self) -> bool:
        """Between two epochs, or after the last."""
        every, last = self.settings.checkpoint_every, self.settings.epochs
        return self._under_way is None and (self.epoch % every == 0 or self.epoch == last)

    def _select(self, accuracy: float) -> None:
        """Remember the network where its validation accuracy is the best so far, and a soup with all epochs in it."""
        if accuracy > self.best_accuracy or self.settings.soup:
            self.best_accuracy, self.best_epoch = accuracy, self.epoch
            weights = self.learner.selected.network.state_dict()
            weights = {name: value.to("cpu", copy=True) for name, value in weights.items()}
            self._best = {"model": weights, **self._described(), "validation_accuracy": accuracy}

    def _described(self) -> dict[str, Any]:
        """What is kept beside the weights of a network."""
        return {
            "architecture": self.architecture,
            "epoch": self.epoch,
            "seed": self.seed,
            "arm": self.service.settings.arm,
        }

    def _save(self) -> None:
        """Write last.pt, keeping the one before, and best.pt where there is a better network, by the first process."""
        state, best, self._best = self.state_dict(), self._best, None
        if utils.rank() > 0:
            return
        if best:
            checkpoint.save(self.folder / checkpoint.BEST, best)
        checkpoint.save(self.folder / checkpoint.LAST, state, self.folder / checkpoint.PREVIOUS)

    def _report(
        self, log: Log, trained: dict[str, Any], validated: dict[str, Any], diagnostics: Mapping[str, float]
    ) -> None:
        seconds = dict.fromkeys(PHASES, 0.0) | self.phases.take()  # one resumed after its last attack has no more
        scalars = {
            **{f"train/{name}": value for name, value in trained.items()},
            **{f"validation/{name}": value for name, value in validated.items()},
            "train/learning_rate": self.learner.learning_rate,
            **{f"augment/{name}": value for name, value in diagnostics.items()},
            **{f"seconds/{name}": value for name, value in seconds.items()},
        }
        self.history.append({"epoch": self.epoch, **scalars})
        log.scalars(scalars, self.epoch)
        success = diagnostics.get("attack_success")
        console.info(
            "epoch %d/%d  train loss %.3f accuracy %.3f  validation accuracy %.3f%s  %.0f s (attack %.1f s)",
            self.epoch,
            self.settings.epochs,
            trained["loss"],
            trained["accuracy"],
            validated["accuracy"],
            "" if success is None else f"  renders fooled {success:.2f}",
            sum(seconds.get(name, 0.0) for name in PHASES),
            seconds.get("attack", 0.0),
        )
