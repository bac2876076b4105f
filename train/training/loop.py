"""The training loop.

An epoch has one or more rounds. Each round begins with fresh renders. Validation ends an epoch,
and so does a checkpoint. Checkpoints are also written within an epoch that takes long.
"""

import math
import time
from collections.abc import Generator, Mapping
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment import distributed
from augment.model_passes import eval_mode
from augment.progress import progress, progress_message
from augment.random_streams import stream_seed
from augment.service import AugmentationService, Renders
from renderer.errors import InputError, single_line
from renderer.image import to_bytes, to_unit
from train import console
from train.data.batches import Round, TrainingImages, rounds_of_epoch, training_batches
from train.data.sets import Split
from train.runs import checkpoint
from train.runs.checkpoint import random_state, restore_random_state
from train.runs.epoch_metrics import epoch_metrics, format_epoch
from train.runs.run_log import PHASES, RunLog
from train.settings import RELIGHT, TrainSettings
from train.system.device import GraphedModel, MixedPrecision, compiles
from train.system.processes import SignalHandler, all_reduce_sum, wrap_ddp
from train.system.user_errors import keyed
from train.training.averages import Averages
from train.training.baselines import Baseline
from train.training.loss import TrainingLoss
from train.training.recipe import build_optimizer, learning_rate
from train.training.relit_batches import RelitBatches
from train.training.shared_teacher import share_layers

# Images that are evaluated at a time.
EVALUATION_BATCH = 512
# `Trainer` waits at least this many seconds between two checkpoints within an epoch.
SAVING_EVERY = 60.0
# The largest share of an epoch's time that its checkpoints take.
SAVING_SHARE = 0.02

# Images (B, 3, H, W) uint8, labels (B,), and which of them are renders (B,).
Batch = tuple[Tensor, Tensor, Tensor]


@dataclass
class EpochState:
    """State of an epoch that has begun.

    Attributes:
        renders: The renders of the current round.
        sums: Two sums over the images that this process has trained on in this
            epoch, shape (2,): of the loss, and of the correct predictions.
        diagnostics: For each round so far, values of the attack by name.
        step: Number of steps that were taken in this epoch.
    """

    renders: Renders
    sums: Tensor
    diagnostics: list[Mapping[str, float]]
    step: int = 0

    def state_dict(self) -> dict[str, Any]:
        """Return plain values and tensors, summed over all processes.

        The renders are bytes, as they are when the network is trained on them.
        """
        return {
            "images": to_bytes(self.renders.images),
            "labels": self.renders.labels,
            "diagnostics": [dict(diagnostics) for diagnostics in self.diagnostics],
            "sums": all_reduce_sum(self.sums.clone()),
            "step": self.step,
        }


@dataclass(frozen=True)
class EpochPlan:
    """Images and rounds of an epoch.

    Attributes:
        split: The images.
        rows: Indices of the images in the split that the network learns from,
            shape (N,). The rounds draw some of them.
        rounds: The rounds.
        steps: The number of steps of each round.
    """

    split: Split
    rows: Tensor
    rounds: list[Round]
    steps: list[int]

    @property
    def total(self) -> int:
        """Count the steps of all rounds."""
        return sum(self.steps)


class Trainer:
    """Trainer of one network. It writes checkpoints to the folder of the run.

    `fit` trains the network. `resume` restores the newest checkpoint before.

    Args:
        settings: Settings of the training.
        model: Network to train.
        architecture: Arguments that build the network, with its classes. They
            are stored in checkpoints.
        service: Service that renders the training examples anew for each round.
        folder: Folder of the run.
        labeled: Whether the labels of the data are known.

    Attributes:
        initial: Copy of the network before the training. None if the run begins
            with random weights. The copy is the teacher of a distillation loss,
            and each epoch of a model soup begins with it.
        averages: Moving average and soup of the network.
        epoch: Number of finished epochs.
        history: Metrics of each finished epoch.

    Raises:
        InputError: If a batch cannot be divided equally among the processes, or
            if there are no hard negatives for a ranking loss.
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
        _require_equal_shares(settings)
        if settings.ranking_weight and not service.positive_classes:
            raise InputError(
                f"ranking_weight={settings.ranking_weight} requires hard negatives: "
                "add some to the scene, or set a folder of images that has some",
                "ranking_weight",
            )
        self.settings = settings
        self.architecture = architecture
        self.service = service
        self.folder = folder
        self.phases = service.phases
        self.seed = service.seed
        self.epoch = 0
        self.history: list[dict[str, float]] = []

        # The epoch that has begun.
        self._under_way: EpochState | None = None
        # The random state at a checkpoint within an epoch.
        self._random_state: dict[str, Any] = {}
        # The network that is selected, but not yet written.
        self._best: dict[str, Any] | None = None
        # Time of the last checkpoint or, before the first one, of the start.
        self._saved_at = time.perf_counter()
        # Seconds that writing the last checkpoint took.
        self._saving_took = 0.0

        self.model = model
        self.device = next(model.parameters()).device
        self.initial: MixedPrecision | None = None
        if settings.init_from:
            self.initial = deepcopy(model).eval().requires_grad_(False)
        self.averages = Averages(
            model,
            settings.ema_decay,
            settings.soup,
            # Validation without labels measures the agreement with the initial
            # network, which is best before any training.
            keeps_latest=not labeled,
        )
        self._build_step(labeled)

    def _build_step(self, labeled: bool) -> None:
        """Build the optimizer, the gradient scaler, the loss and the augmentation.

        Args:
            labeled: Whether the labels of the data are known.
        """
        settings = self.settings
        positive_classes = self.service.positive_classes
        # `wrap_ddp` may replace layers of the network. The optimizer is built
        # afterwards, so that it has the parameters of the new layers.
        replica = wrap_ddp(self.model)
        with progress_message("loading the optimizer"):  # torch imports its compiler here: seconds.
            self.optimizer = build_optimizer(self.model, settings)
        is_scaled = self.model.precision == "float16"
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=is_scaled)
        has_teacher = settings.distillation_weight or settings.consistency_weight
        teacher = self.initial if has_teacher else None
        with keyed(choice="compile"):
            is_compiled = compiles(settings.compile, self.device)
        # The module that computes the logits of the teacher. It may reuse frozen
        # layers of the network in training.
        answering: nn.Module | None = teacher
        if teacher is not None and not is_compiled:
            answering = share_layers(settings, self.model, teacher, self.architecture["size"])
        self._loss = TrainingLoss(replica, settings, positive_classes, answering, labeled).compute
        self._baseline: Baseline | RelitBatches = Baseline(
            settings.augmentation,
            self.model,
            self.seed,
            positive_classes[1:],
        )
        if settings.augmentation == RELIGHT:
            self._baseline = RelitBatches(settings, self.model, teacher, self.seed)
        self._attacked: nn.Module = self.model
        self._validated: nn.Module = self.averages.selected
        if is_compiled:
            torch.compiler.reset()  # torch limits the graphs of all runs of a process.
            self._loss = torch.compile(self._loss, mode="reduce-overhead", dynamic=False)
            self._attacked = GraphedModel(self.model)
            self._validated = GraphedModel(self.averages.selected)

    @property
    def selected(self) -> MixedPrecision:
        """Network that is validated and kept."""
        return self.averages.selected

    def fit(self, split: Split, held_out: Tensor, log: RunLog | None) -> None:
        """Train to the last epoch.

        Afterwards, best.pt holds the network with the highest validation
        accuracy. For a soup, and for data without labels, it holds the last
        network.

        Args:
            split: Images and labels, on the device of the network.
            held_out: Mask of the images that validate, bool on the CPU, shape
                (N,).
            log: Log of the run. None in all processes but the first one.

        Raises:
            InputError: If the training diverges.
            Interrupted: If a signal ended the training. A checkpoint was
                written before.
        """
        train = torch.nonzero(~held_out).squeeze(1)
        validation = torch.nonzero(held_out).squeeze(1)
        with SignalHandler() as signals:
            while self.epoch < self.settings.epochs:
                if self._train_epoch(split, train, signals, log):
                    self._end_epoch(split, validation, log)
                is_stopping = signals.requested()
                is_last = self.epoch == self.settings.epochs
                is_due = self.epoch % self.settings.checkpoint_every == 0
                if is_stopping or is_last or (is_due and self._under_way is None):
                    self._save()
                if is_stopping:
                    signals.stop()

    def _train_epoch(
        self,
        split: Split,
        rows: Tensor,
        signals: SignalHandler,
        log: RunLog | None,
    ) -> bool:
        """Take the remaining steps of an epoch.

        Args:
            split: Images and labels.
            rows: Indices of the images to learn from, shape (N,).
            signals: Signals that ask the run to stop.
            log: Log of the run. None in all processes but the first one.

        Returns:
            Whether all steps were taken. False if a signal came before the last
            step.
        """
        plan = self._plan(split, rows)
        if self._under_way is None:
            self._under_way = self._begin_epoch(plan, log)
        else:
            restore_random_state(self._random_state)
        state = self._under_way
        with closing(self._remaining_batches(plan, state, log)) as batches:
            for batch in batches:
                # The number of the step in the whole run.
                number = self.epoch * plan.total + state.step
                state.sums += self._step(*batch, state.step / plan.total, number)
                state.step += 1
                if signals.requested():
                    return state.step == plan.total
                if state.step < plan.total and self._saving_is_due():
                    self._save()
        return True

    def _plan(self, split: Split, rows: Tensor) -> EpochPlan:
        """Divide the current epoch into rounds, and count the steps of each.

        Args:
            split: Images and labels.
            rows: Indices of the images to learn from, shape (N,).
        """
        settings = self.settings
        rounds = rounds_of_epoch(
            len(rows),
            len(self.service),
            self.seed,
            self.epoch,
            settings.images_per_epoch,
            self.service.settings.regenerate_every,
        )
        steps = [math.ceil(len(part.rows) / settings.batch_size) for part in rounds]
        return EpochPlan(split, rows, rounds, steps)

    def _begin_epoch(self, plan: EpochPlan, log: RunLog | None) -> EpochState:
        """Render the images of the first round of an epoch, and return the new state."""
        self.averages.begin_epoch(self.initial, self.optimizer)
        renders = self._regenerate(plan.rounds[0], log)
        return EpochState(renders, torch.zeros(2, device=self.device), [renders.diagnostics])

    def _remaining_batches(
        self, plan: EpochPlan, state: EpochState, log: RunLog | None
    ) -> Generator[Batch, None, None]:
        """Yield the remaining batches of an epoch.

        Before each round but the first one of the epoch, new images are rendered.

        Args:
            plan: Images and rounds of the epoch.
            state: State of the epoch. The renders and diagnostics of each new
                round are stored in it.
            log: Log of the run. None in all processes but the first one.
        """
        # Each round that has begun has diagnostics.
        current = len(state.diagnostics) - 1
        for index in range(current, len(plan.rounds)):
            if index == len(state.diagnostics):
                state.renders = self._regenerate(plan.rounds[index], log)
                state.diagnostics.append(state.renders.diagnostics)
            with self.phases("training"):
                renders = Split(to_bytes(state.renders.images), state.renders.labels)
                self.model.train(not self.settings.eval_mode)
                first = state.step - sum(plan.steps[:index])
                batches = training_batches(
                    TrainingImages(plan.split, plan.rows, renders),
                    self.settings.batch_size,
                    self.seed,
                    plan.rounds[index],
                    self.settings.flips,
                    first,
                )
                title = f"epoch {self.epoch + 1}"
                if len(plan.rounds) > 1:
                    title += f", round {index + 1} of {len(plan.rounds)}"
                yield from progress(batches, title, plan.steps[index], first)

    def _regenerate(self, now: Round, log: RunLog | None) -> Renders:
        """Render the images of a round, and log a few of the attacked ones."""
        torch.manual_seed(stream_seed(self.seed, now.number, "dropout"))
        with self.phases("attack"):
            renders = self.service.regenerate(self._attacked, now.number)
        if log and renders.attack_examples:
            # A run that is resumed within the epoch does not attack these renders
            # again, so their images are written now.
            with self.phases("input_output"):
                classes = self.architecture["classes"]
                log.attack_examples(renders.attack_examples, classes, self.epoch + 1)
        return renders

    def _step(
        self,
        images: Tensor,
        labels: Tensor,
        rendered: Tensor,
        progress: float,
        number: int,
    ) -> Tensor:
        """Change the weights by the gradient of the loss of a batch.

        Args:
            images: The images, uint8, shape (B, 3, H, W).
            labels: Their classes, shape (B,).
            rendered: Which of them are renders, bool, shape (B,).
            progress: The fraction of the epoch that is done.
            number: The number of the step in the run, from 0.

        Returns:
            The sum of the losses and the number of correct predictions, shape (2,).
        """
        settings = self.settings
        # Each epoch of a soup runs through the whole schedule.
        done = progress if settings.soup else (self.epoch + progress) / settings.epochs
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(settings, done)
        augmented = self._baseline.apply(images, labels, number)
        # The consistency term compares both versions. Otherwise only one is shown.
        tensors = [augmented, labels, rendered]
        if settings.consistency_weight:
            tensors = [images, labels, rendered, augmented]
        self.optimizer.zero_grad(set_to_none=True)
        sums = torch.zeros(2, device=self.device)
        # Each tensor is divided along the batch. A part has one chunk of each tensor.
        # The gradients of all parts are added.
        chunks = [tensor.chunk(settings.accumulation_steps) for tensor in tensors]
        parts = zip(*chunks, strict=True)
        for part in parts:
            loss, hits = self._loss(*part)
            self.scaler.scale(loss / settings.accumulation_steps).backward()
            count = len(part[0])
            sums += torch.stack([loss.detach() * count, hits])
        if settings.clip_gradient:
            self.scaler.unscale_(self.optimizer)
            nn.utils.clip_grad_norm_(self.model.parameters(), settings.clip_gradient)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        self.averages.end_step()
        return sums

    def _end_epoch(self, split: Split, rows: Tensor, log: RunLog | None) -> None:
        """Validate the network, remember it if it is the best, and log the metrics.

        Args:
            split: Images and labels.
            rows: Indices of the images that validate, shape (N,).
            log: Log of the run. None in all processes but the first one.
        """
        state = cast(EpochState, self._under_way)
        self._under_way = None
        loss_sum, hits = all_reduce_sum(state.sums).tolist()
        self.averages.end_epoch()
        with self.phases("evaluation"):
            validated = evaluate(self._validated, split, rows)
        self.epoch += 1
        self._require_finite(loss_sum + validated["loss"], self.epoch)
        if self.averages.is_kept(validated["accuracy"]):
            self._best = {
                "model": self.averages.weights(),
                **self._description(),
                "validation_accuracy": validated["accuracy"],
            }
        if log and len(state.renders.labels):
            with self.phases("input_output"):
                log.renders(state.renders.images, self.epoch)

        images = state.step * self.settings.batch_size
        trained = {
            "loss": loss_sum / images,
            "accuracy": hits / images,
            "learning_rate": self.optimizer.param_groups[0]["lr"],
        }
        # If a run was resumed after the last attack of the epoch, no time of the phase
        # "attack" was measured. It then counts as 0 seconds.
        seconds = dict.fromkeys(PHASES, 0.0) | self.phases.take()
        metrics = epoch_metrics(trained, validated, state.diagnostics, seconds)
        self.history.append({"epoch": self.epoch, **metrics})
        if log:
            log.scalars(metrics, self.epoch)
        console.debug("%s", format_epoch(self.epoch, self.settings.epochs, metrics))

    def _require_finite(self, loss: float, epoch: int) -> None:
        """Raise InputError if the loss or a weight is NaN or infinite.

        Args:
            loss: Sum of losses.
            epoch: Number of the epoch, from 1, for the error.
        """
        weights = self.model.network.state_dict().values()
        is_finite = torch.stack([value.isfinite().all() for value in weights]).all()
        if not (math.isfinite(loss) and is_finite):
            settings = self.settings
            raise InputError(
                f"learning_rate={settings.learning_rate} with weight_decay={settings.weight_decay} "
                f"made the loss or weights NaN or infinite in epoch {epoch}: "
                "set lower values",
                "learning_rate",
            )

    def _save(self) -> None:
        """Write the checkpoint last.pt, and best.pt if a network was selected since the last time.

        The former last.pt is kept as previous.pt. Only the first process writes.
        """
        if self._under_way:
            self._require_finite(float(self._under_way.sums[0]), self.epoch + 1)
        # The line of the epoch in metrics.jsonl is written before the checkpoint, so
        # that a resumed run never lacks this line.
        with self.phases("input_output"):
            state = self.state_dict()
            best = self._best
            self._best = None
            if distributed.rank() > 0:
                return
            start = time.perf_counter()
            if best:
                checkpoint.save(self.folder / checkpoint.BEST, best)
            previous = self.folder / checkpoint.PREVIOUS
            checkpoint.save(self.folder / checkpoint.LAST, state, previous)
            self._saved_at = time.perf_counter()
            self._saving_took = self._saved_at - start

    def _saving_is_due(self) -> bool:
        """Return whether to write a checkpoint within the epoch.

        If the run is killed, it then loses about a minute. Several processes
        would have to agree on the moment, so they write only at the end of an
        epoch or after a signal.
        """
        wait = max(SAVING_EVERY, self._saving_took / SAVING_SHARE)
        return distributed.world_size() == 1 and time.perf_counter() - self._saved_at > wait

    def _description(self) -> dict[str, Any]:
        """Return the facts that are stored with the weights of a network."""
        return {
            "architecture": self.architecture,
            "epoch": self.epoch,
            "seed": self.seed,
            "mode": self.service.settings.mode,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the state from which a run continues as if it had not stopped."""
        return {
            **self._description(),
            "model": self.model.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.scaler.state_dict(),
            **self.averages.state_dict(),
            "precision": self.model.precision,
            "service": self.service.state_dict(),
            "random_state": random_state(),
            "under_way": self._under_way.state_dict() if self._under_way else None,
            "history": self.history,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state that `state_dict` returned.

        Args:
            state: State of the same network. Any other value raises errors of
                many types.
        """
        self.epoch = state["epoch"]
        self.history = state["history"]
        accuracies = [line["validation/accuracy"] for line in self.history]
        self.model.network.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.scaler.load_state_dict(state["scaler"])
        self.averages.load_state_dict(state, accuracies)
        for network in (self.model, self.initial, self.selected):
            if network:
                network.precision = state["precision"]
        # If there are no values, the next attack begins at those of the scene.
        if "values" in state["service"]:
            self.service.load_state_dict(state["service"])
        self._random_state = dict(state["random_state"])
        if state["under_way"]:
            self._under_way = self._restored_epoch(state["under_way"])

    def _restored_epoch(self, state: Mapping[str, Any]) -> EpochState:
        """Restore the state within an epoch from a checkpoint.

        Args:
            state: Values that `EpochState.state_dict` returned.
        """
        images = to_unit(state["images"]).to(self.device)
        labels = state["labels"].to(self.device)
        renders = Renders(images, labels, state["diagnostics"][-1])
        # The stored sums are over all processes. The first process takes them, and
        # the others begin at 0, so that a later sum over processes counts them once.
        sums = state["sums"].to(self.device) * (distributed.rank() == 0)
        return EpochState(renders, sums, state["diagnostics"], state["step"])

    def resume(self) -> None:
        """Continue from the newest undamaged checkpoint in the folder.

        Raises:
            InputError: If the checkpoint does not belong to this run.
        """
        state, problem = checkpoint.load_newest(self.folder)
        try:
            self._require_own_architecture(state)
            self.load_state_dict(state)
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            reason = single_line(error)
            raise InputError(
                f"the checkpoint in {self.folder} is not one that this run can go on from "
                f"({reason}): "
                f"restore {checkpoint.LAST}, or start in another folder",
            ) from error
        self._require_own_best()
        if problem:
            console.warning("%s: going on from the one before", problem)
            # The next checkpoint keeps this file as previous.pt. A damaged file
            # must not replace the whole one there.
            (self.folder / checkpoint.LAST).unlink(missing_ok=True)
        steps = self._under_way.step if self._under_way else 0
        console.info("resumed %s after epoch %d and %d steps", self.folder, self.epoch, steps)

    def _require_own_best(self) -> None:
        """Raise InputError if best.pt is missing, damaged or of another run.

        At the end, the network in this file is scored. The check comes before
        the training. The file exists from the end of the first epoch.
        """
        if not self.epoch:
            return
        path = self.folder / checkpoint.BEST
        try:
            best = checkpoint.load(path)
            self._require_own_architecture(best)
            own = self._description()
            if (best["seed"], best.get("mode", best.get("arm"))) != (own["seed"], own["mode"]):
                raise ValueError("it is of another run")
            # The file may be newer than the checkpoint. A later network is then found again.
            if best["epoch"] <= len(self.history):
                line = self.history[best["epoch"] - 1]
                if line["validation/accuracy"] != best["validation_accuracy"]:
                    raise ValueError("its accuracy is not the one that this run had")
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(
                f"{path} is not the network that this run kept ({single_line(error)}): "
                f"restore {checkpoint.BEST}, or start in another folder",
            ) from error

    def _require_own_architecture(self, state: Mapping[str, Any]) -> None:
        """Raise ValueError if the network of a checkpoint is not the network of this run."""
        if self.architecture | state["architecture"] != self.architecture:
            raise ValueError("it has another architecture or other classes")


def _require_equal_shares(settings: TrainSettings) -> None:
    """Raise InputError if a batch cannot be divided equally among processes and parts."""
    processes = distributed.world_size()
    if settings.batch_size % (processes * settings.accumulation_steps):
        divisor = f"{processes} processes × accumulation_steps={settings.accumulation_steps}"
        message = f"batch_size={settings.batch_size} is no multiple of {divisor}"
        raise InputError(message, "batch_size")


@torch.no_grad()
def evaluate(model: nn.Module, split: Split, rows: Tensor | None = None) -> dict[str, float]:
    """Score a network in eval mode. Each process scores a part of the images.

    Args:
        model: The network, from images in [0, 1] to logits.
        split: The images and labels.
        rows: The rows of the split to score, shape (N,). None for all.

    Returns:
        Mapping with two keys: "loss", the mean cross entropy, and "accuracy",
        the fraction of images whose class is right.
    """
    device = split.labels.device
    if rows is None:
        rows = torch.arange(len(split))
    rows = rows.to(device)
    totals = torch.zeros(2, device=device)
    # Both are views of `totals`, so adding to them changes `totals`.
    loss_sum, hits = totals
    batches = rows[distributed.rank() :: distributed.world_size()].split(EVALUATION_BATCH)
    shown = progress(batches, f"{len(rows)} images")
    with eval_mode(model):
        for batch, images in zip(shown, split.squares(batches), strict=True):
            logits = model(to_unit(images.to(device)))
            labels = split.labels[batch]
            loss_sum += F.cross_entropy(logits, labels, reduction="sum")
            hits += (logits.argmax(1) == labels).sum()
    loss_sum, hits = all_reduce_sum(totals).tolist()
    return {"loss": loss_sum / len(rows), "accuracy": hits / len(rows)}
