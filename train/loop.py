"""The training loop: an epoch has one or more rounds, each with fresh renders; validation and a checkpoint end it."""

import math
import time
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_swa_avg_fn
from tqdm import tqdm

from augment import utils
from augment.service import AugmentationService, Renders
from augment.utils import announced, eval_mode, progress, stream_seed
from renderer.errors import InputError, in_one_line
from renderer.image import to_bytes, to_unit
from train import checkpoint, console
from train.batches import Round, TrainingImages, rounds_of_epoch, training_batches
from train.checkpoint import random_state, restore_random_state
from train.data import Split
from train.device import GraphedModel, MixedPrecision, compiles
from train.processes import Interruption, replicated, summed
from train.recipe import MovingAverage, TrainSettings, augmentation, build_optimizer, training_loss
from train.run_folder import PHASES, RunLog

EVALUATION_BATCH = 512  # images at a time
SAVING_EVERY = 60.0  # seconds between checkpoints within an epoch, at least
SAVING_SHARE = 0.02  # of the time of an epoch that goes to its checkpoints, at most
SHOWN = ("attack_success_before", "attack_success", "steps")  # of each round's diagnostics in metrics.jsonl


@dataclass
class EpochState:
    """How far an epoch has come."""

    renders: Renders  # of the current round
    sums: Tensor  # (2,) loss and hits over the images that this process has trained on
    diagnostics: list[Mapping[str, float]]  # of the renders of each round so far
    step: int = 0  # steps taken, in all rounds

    def state_dict(self) -> dict[str, Any]:
        """Plain values and tensors, over all processes; the renders as bytes, as they are trained on."""
        renders = {"images": to_bytes(self.renders.images), "labels": self.renders.labels}
        diagnostics = [dict(diagnostics) for diagnostics in self.diagnostics]
        return {**renders, "diagnostics": diagnostics, "sums": summed(self.sums.clone()), "step": self.step}


class Trainer:
    """One run's network, optimizer, augmentation service and folder. `fit` trains; `resume` goes on with the folder.

    model: the network that is trained. initial: a copy as the run began, where that was with another's weights: the
    teacher, and where a soup's epochs begin. ema, soup: averages, if any. selected: that which is validated and kept.
    """

    def __init__(
        self,
        settings: TrainSettings,
        model: MixedPrecision,
        architecture: dict[str, Any],
        service: AugmentationService,
        folder: Path,
        labeled: bool = True,
    ):
        """architecture: what rebuilds the network from a checkpoint, classes included. labeled: whether the data are.

        InputError where the processes cannot share a batch equally, or for a ranking without hard negatives.
        """
        processes, parts = utils.world_size(), settings.accumulate
        if settings.batch_size % (processes * parts):
            divisor = f"{processes} processes × train.accumulate={parts}"
            raise InputError(f"train.batch_size={settings.batch_size} is no multiple of {divisor}")
        if settings.ranking and not service.studied:
            raise InputError("train.ranking ranks hard negatives: name some in scene.hard_negatives or augment.folder")
        self.settings, self.architecture, self.service, self.folder = settings, architecture, service, folder
        self.phases, self.seed, self.epoch = service.phases, service.seed, 0
        self.history: list[dict[str, float]] = []  # the metrics of each epoch
        self._under_way: EpochState | None = None  # of the epoch that has begun
        self._random_state: dict[str, Any] = {}  # where a checkpoint within an epoch left it
        self._best: dict[str, Any] | None = None  # selected, but not written yet
        self._saved_at = time.perf_counter()  # when the last checkpoint was written, or the training began
        self._saving_took = 0.0  # seconds

        self.model, self.device = model, next(model.parameters()).device
        self.initial = deepcopy(model).eval().requires_grad_(False) if settings.init_from else None
        self.ema = MovingAverage(model, settings.ema_decay) if settings.ema_decay else None
        mean = {"avg_fn": get_swa_avg_fn(), "use_buffers": True}  # Wortsman et al. 2022, "Model soups"
        self.soup = AveragedModel(model, **mean) if settings.soup else None
        self._latest = settings.soup or not labeled  # a soup has all epochs in it; agreement is best with no training
        average = self.soup or self.ema
        self.selected = cast(MixedPrecision, average.module) if average else model
        replica = replicated(model)  # may replace layers, so the optimizer comes after it
        with announced("loading the optimizer"):  # torch imports its compiler here: seconds
            self.optimizer = build_optimizer(model, settings)
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=model.precision == "float16")
        compiled = compiles(settings.compile, self.device)
        teacher = self.initial if settings.distillation else None
        self._loss = training_loss(replica, settings, service.studied, teacher, labeled)
        if compiled:
            torch.compiler.reset()  # since torch limits the graphs of all runs of a process
            self._loss = torch.compile(self._loss, mode="reduce-overhead", dynamic=False)
        self._augment = augmentation(settings.augmentation, model, self.seed, service.studied[1:])
        self._attacked: nn.Module = GraphedModel(model) if compiled else model
        self._validated: nn.Module = GraphedModel(self.selected) if compiled else self.selected

    def fit(self, split: Split, held_out: Tensor, log: RunLog | None) -> None:
        """Train to the last epoch; best.pt holds the network of the best validation, or the last of a soup or without
        labels.

        split: on the trainer's device. held_out: (N,) bool on the CPU, which of its images validate. log: of the
        process that writes. InputError where training diverges; `Interrupted`, after a checkpoint, by a signal.
        """
        train, validation = (torch.nonzero(chosen).squeeze(1) for chosen in (~held_out, held_out))
        with Interruption() as interruption:
            while self.epoch < self.settings.epochs:
                if self._train_epoch(split, train, interruption, log):
                    self._end_epoch(split, validation, log)
                stopping = interruption.requested()
                due = self._under_way is None and self.epoch % self.settings.checkpoint_every == 0
                if stopping or due or self.epoch == self.settings.epochs:
                    self._save()
                if stopping:
                    interruption.stop()

    def _train_epoch(self, split: Split, rows: Tensor, interruption: Interruption, log: RunLog | None) -> bool:
        """Take the epoch's remaining steps, on some rows; whether all were taken, since a signal ends them early."""
        settings, shown, every = self.settings, self.settings.images_per_epoch, self.service.settings.every
        rounds = rounds_of_epoch(len(rows), len(self.service), self.seed, self.epoch, shown, every)
        steps = [math.ceil(len(part.rows) / settings.batch_size) for part in rounds]
        total = sum(steps)
        if self._under_way is None:
            if self.soup and self.initial:
                self.model.load_state_dict(self.initial.state_dict())
                self.optimizer.state.clear()
                if self.ema:
                    self.ema.n_averaged.zero_()
            renders = self._regenerate(rounds[0], log)
            self._under_way = EpochState(renders, torch.zeros(2, device=self.device), [renders.diagnostics])
        else:
            restore_random_state(self._random_state)
        state = self._under_way
        for index in range(len(state.diagnostics) - 1, len(rounds)):
            if index == len(state.diagnostics):
                state.renders = self._regenerate(rounds[index], log)
                state.diagnostics.append(state.renders.diagnostics)
            with self.phases("training"):
                images = TrainingImages(split, rows, Split(to_bytes(state.renders.images), state.renders.labels))
                self.model.train(not settings.eval_mode)
                first = state.step - sum(steps[:index])
                batches = training_batches(images, settings.batch_size, self.seed, rounds[index], settings.flips, first)
                name = f"epoch {self.epoch + 1}" + f", round {index + 1} of {len(rounds)}" * (len(rounds) > 1)
                for batch in progress(batches, name, steps[index], first):
                    state.sums += self._step(*batch, state.step / total, self.epoch * total + state.step)
                    state.step += 1
                    if interruption.requested():
                        return state.step == total
                    if state.step < total and self._saving_is_due():
                        self._save()
        return True

    def _regenerate(self, now: Round, log: RunLog | None) -> Renders:
        torch.manual_seed(stream_seed(self.seed, now.number, "dropout"))
        with self.phases("attack"):
            renders = self.service.regenerate(self._attacked, now.number)
        if log and renders.attack_examples:
            with self.phases("input_output"):  # now, since a run that is resumed within the epoch makes no others
                log.attack_examples(renders.attack_examples, self.architecture["classes"], self.epoch + 1)
        return renders

    def _step(self, images: Tensor, labels: Tensor, rendered: Tensor, progress: float, number: int) -> Tensor:
        """Learn from a batch of `training_batches` at a fraction of the epoch, in the run's step of that number.

        Returns (2,) the sum of the losses, and how many predictions were correct.
        """
        settings = self.settings
        if not settings.soup:
            progress = (self.epoch + progress) / settings.epochs
        for group in self.optimizer.param_groups:
            group["lr"] = settings.rate(progress)
        images = self._augment(images, labels, number)
        self.optimizer.zero_grad(set_to_none=True)
        sums = torch.zeros(2, device=self.device)
        for batch in zip(*(part.chunk(settings.accumulate) for part in (images, labels, rendered)), strict=True):
            loss, hits = self._loss(*batch)
            self.scaler.scale(loss / settings.accumulate).backward()
            sums += torch.stack([loss.detach() * len(batch[0]), hits])
        if settings.clip_gradient:
            self.scaler.unscale_(self.optimizer)
            nn.utils.clip_grad_norm_(self.model.parameters(), settings.clip_gradient)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        if self.ema:
            self.ema.update_parameters(self.model)
        return sums

    def _end_epoch(self, split: Split, rows: Tensor, log: RunLog | None) -> None:
        """Validate on the split's rows, remember the best network, and log the epoch's metrics."""
        state, self._under_way = cast(EpochState, self._under_way), None
        images = state.step * self.settings.batch_size
        loss_sum, hits = summed(state.sums).tolist()
        if self.soup:
            self.soup.update_parameters(self.ema.module if self.ema else self.model)
        with self.phases("evaluation"):
            validated = evaluate(self._validated, split, rows)
        self.epoch += 1
        self._require_finite(loss_sum + validated["loss"], self.epoch)
        before = [line["validation/accuracy"] for line in self.history]
        if validated["accuracy"] > max(before, default=-1) or self._latest:
            weights = {name: value.to("cpu", copy=True) for name, value in self.selected.network.state_dict().items()}
            self._best = {"model": weights, **self._description(), "validation_accuracy": validated["accuracy"]}
        if log and len(state.renders.labels):
            with self.phases("input_output"):
                log.renders(state.renders.images, self.epoch)
        diagnostics = {name: fmean(part[name] for part in state.diagnostics) for name in state.diagnostics[0]}
        seconds = dict.fromkeys(PHASES, 0.0) | self.phases.take()  # one resumed after its last attack has no more
        rate = self.optimizer.param_groups[0]["lr"]
        trained = {"loss": loss_sum / images, "accuracy": hits / images, "learning_rate": rate}
        groups = {"train": trained, "validation": validated, "augment": diagnostics, "seconds": seconds}
        for number, part in enumerate(state.diagnostics if len(state.diagnostics) > 1 else [], 1):
            groups[f"round_{number}"] = {name: part[name] for name in SHOWN if name in part}
        metrics = {f"{group}/{name}": value for group, values in groups.items() for name, value in values.items()}
        self.history.append({"epoch": self.epoch, **metrics})
        if log:
            log.scalars(metrics, self.epoch)
        total = sum(seconds[name] for name in PHASES)
        left = total * (self.settings.epochs - self.epoch)
        success, correct = attack_success(diagnostics), 1 - diagnostics.get("attack_success_before", 1)
        console.info(
            f"epoch {self.epoch}/{self.settings.epochs}  train loss {trained['loss']:.3f} accuracy "
            f"{trained['accuracy']:.3f}  validation accuracy {validated['accuracy']:.3f}"
            f"{'' if success is None else f'  attack success {success:.2f} of the {correct:.0%} clean-correct'}"
            f"  {total:.0f} s (renders {seconds['attack']:.1f} s)"
            f"{f'; about {tqdm.format_interval(left)} left' if left else ''}"
        )

    def _require_finite(self, loss: float, epoch: int) -> None:
        """InputError where the loss or a weight is NaN or infinite, before either is kept."""
        settings, weights = self.settings, self.model.network.state_dict().values()
        if not (math.isfinite(loss) and torch.stack([value.isfinite().all() for value in weights]).all()):
            rates = f"train.learning_rate={settings.learning_rate} with train.weight_decay={settings.weight_decay}"
            raise InputError(f"{rates} made the loss or weights NaN or infinite in epoch {epoch}: set lower ones")

    def _save(self) -> None:
        """Write last.pt, keeping the one before, and best.pt where there is a better network, by the first process."""
        if self._under_way:
            self._require_finite(float(self._under_way.sums[0]), self.epoch + 1)
        with self.phases("input_output"):  # after the epoch's line, so that a resumed run never lacks it
            state, best, self._best = self.state_dict(), self._best, None
            if utils.rank() > 0:
                return
            start = time.perf_counter()
            if best:
                checkpoint.save(self.folder / checkpoint.BEST, best)
            checkpoint.save(self.folder / checkpoint.LAST, state, self.folder / checkpoint.PREVIOUS)
            self._saved_at = time.perf_counter()
            self._saving_took = self._saved_at - start

    def _saving_is_due(self) -> bool:
        """Say whether to write a checkpoint within the epoch, so that a killed run loses no more than a minute or so.

        Several processes would have to agree on the moment: they write at the end of an epoch, or on a signal.
        """
        wait = max(SAVING_EVERY, self._saving_took / SAVING_SHARE)
        return utils.world_size() == 1 and time.perf_counter() - self._saved_at > wait

    def _description(self) -> dict[str, Any]:
        """What is stored beside the weights of a network."""
        arm = self.service.settings.arm
        return {"architecture": self.architecture, "epoch": self.epoch, "seed": self.seed, "arm": arm}

    def state_dict(self) -> dict[str, Any]:
        """All that a run needs to go on as if it had never ended."""
        return {
            **self._description(),
            "model": self.model.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.scaler.state_dict(),
            "ema": self.ema.state_dict() if self.ema else None,
            "soup": self.soup.state_dict() if self.soup else None,
            "precision": self.model.precision,
            "service": self.service.state_dict(),
            "random_state": random_state(),
            "under_way": self._under_way.state_dict() if self._under_way else None,
            "history": self.history,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """What `state_dict` gave; many kinds of error for anything else."""
        self.model.network.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.scaler.load_state_dict(state["scaler"])
        if self.ema:
            self.ema.load_state_dict(state["ema"])
        if self.soup:
            self.soup.load_state_dict(state["soup"])
        for network in filter(None, (self.model, self.initial, self.selected)):
            network.precision = state["precision"]
        if "values" in state["service"]:  # otherwise the next attack begins at the scene, which settings may change
            self.service.load_state_dict(state["service"])
        self._random_state = dict(state["random_state"])
        if begun := state["under_way"]:
            images, labels = to_unit(begun["images"]).to(self.device), begun["labels"].to(self.device)
            renders = Renders(images, labels, begun["diagnostics"][-1])
            sums = begun["sums"].to(self.device) * (utils.rank() == 0)
            self._under_way = EpochState(renders, sums, begun["diagnostics"], begun["step"])
        self.epoch, self.history = state["epoch"], state["history"]

    def _require_own_best(self) -> None:
        """Raise InputError where best.pt is missing, damaged or another run's, before any training.

        The scores at the end are those of its network. It is first written at the end of an epoch.
        """
        if not self.epoch:
            return
        path = self.folder / checkpoint.BEST
        try:
            best = checkpoint.load(path)
            own = self._description()
            if self.architecture | best["architecture"] != self.architecture:
                raise ValueError("it has another architecture or other classes")
            if (best["seed"], best["arm"]) != (own["seed"], own["arm"]):
                raise ValueError("it is of another run")
            epochs = self.history[: best["epoch"]]  # a later network is found again
            if len(epochs) == best["epoch"] and epochs[-1]["validation/accuracy"] != best["validation_accuracy"]:
                raise ValueError("its accuracy is not the one that this run had")
        except (LookupError, TypeError, ValueError) as error:
            reason = in_one_line(error)
            remedy = f"restore {checkpoint.BEST}, or start in another folder with run="
            raise InputError(f"{path} is not the network that this run kept ({reason}): {remedy}") from error

    def resume(self) -> None:
        """Go on from the folder's newest whole checkpoint; InputError where it does not belong to this run."""
        state, problem = checkpoint.load_newest(self.folder)
        try:
            if self.architecture | state["architecture"] != self.architecture:
                raise ValueError("it has another architecture or other classes")
            self.load_state_dict(state)
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            fault = f"the checkpoint in {self.folder} is not one that this run can go on from ({in_one_line(error)})"
            remedy = f"restore {checkpoint.LAST}, or start in another folder with run="
            raise InputError(f"{fault}: {remedy}") from error
        self._require_own_best()
        if problem:
            console.warning("%s: going on from the one before", problem)
            (self.folder / checkpoint.LAST).unlink(missing_ok=True)  # or it would take the place of the whole one
        steps = self._under_way.step if self._under_way else 0
        console.info("resumed %s after epoch %d and %d steps", self.folder, self.epoch, steps)


def attack_success(diagnostics: Mapping[str, float], prefix: str = "") -> float | None:
    """The fraction of the examples that are correct before the attack on which it succeeds; None without any."""
    before = diagnostics.get(f"{prefix}attack_success_before", 1.0)
    return (diagnostics[f"{prefix}attack_success"] - before) / (1 - before) if before < 1 else None


@torch.no_grad()
def evaluate(model: nn.Module, split: Split, rows: Tensor | None = None) -> dict[str, float]:
    """Mean cross entropy and top-1 accuracy in eval mode on a split, or its rows; each process scores a shard."""
    device = split.labels.device
    rows = (torch.arange(len(split)) if rows is None else rows).to(device)
    loss_sum, hits = totals = torch.zeros(2, device=device)
    batches = rows[utils.rank() :: utils.world_size()].split(EVALUATION_BATCH)
    with eval_mode(model):
        for batch, images in zip(progress(batches, f"{len(rows)} images"), split.squares(batches), strict=True):
            logits, labels = model(to_unit(images.to(device))), split.labels[batch]
            loss_sum += F.cross_entropy(logits, labels, reduction="sum")
            hits += (logits.argmax(1) == labels).sum()
    loss_sum, hits = summed(totals).tolist()
    return {"loss": loss_sum / len(rows), "accuracy": hits / len(rows)}
