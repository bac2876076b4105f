"""The training loop.

An epoch consists of one or more rounds. At the start of a round, the training renders are rendered
anew. A step augments a batch, computes the gradient of its loss, and changes the weights. At the
end of an epoch, the network is validated and a checkpoint is written. In a long epoch, checkpoints
are also written in between.
"""

import math
import time
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, cuda, nn

from augment import distributed
from augment.network import compute_outputs, device_of, eval_mode
from augment.progress import progress, progress_message
from augment.random_streams import stream_seed
from augment.renders import Renders
from augment.service import AugmentationService
from augment.tasks.detection import Detection
from renderer.errors import InputError, explained, keyed, require_memory
from renderer.image import to_bytes, to_unit
from train import checkpoints, console, run_folder
from train.data.batches import Batch, round_size, rounds_of_epoch, training_batches
from train.data.sets import Split
from train.device import MixedPrecision, SignalHandler, all_reduce_sum, compiles, wrap_ddp
from train.settings import TrainSettings
from train.training import recipe
from train.training.augmentations import Augmentation
from train.training.averages import Averages
from train.training.detection import DetectionLoss, object_maps, validate
from train.training.run_log import RunLog, epoch_metrics, format_epoch

# Number of images in a pass of the validation.
EVALUATION_BATCH = 512
# Smallest number of seconds between two checkpoints within an epoch.
SAVING_EVERY = 60.0
# Largest fraction of the time of an epoch in which checkpoints are written.
SAVING_SHARE = 0.02


@dataclass
class EpochState:
    """State of an epoch that has begun.

    Attributes:
        renders: Renders of the current round.
        sums: Sum of the losses, and number of correct predictions, over all
            images on which this process has trained in this epoch, shape (2,).
        diagnostics: Measurements of the attack on the renders by name, for each
            round that has begun.
        step: Number of training steps that were taken in this epoch.
    """

    renders: Renders
    sums: Float[Tensor, " 2"]
    diagnostics: list[Mapping[str, float]]
    step: int = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint, with sums over all processes.

        The renders are rounded to 8 bits, as for the training.
        """
        return {
            "images": to_bytes(self.renders.images),
            "labels": self.renders.labels,
            "diagnostics": [dict(diagnostics) for diagnostics in self.diagnostics],
            "sums": all_reduce_sum(self.sums.clone()),
            "step": self.step,
        }


@dataclass(eq=False)
class Trainer:
    """Trainer of one network, which writes checkpoints to the folder of the run.

    `fit` trains the network. To continue a run, call `resume` before `fit`.

    Attributes:
        has_initial: Whether the first weights of `model` are those of an initial network.
        initial: Copy of the network before the training. None if the run begins
            with random weights. The copy is the teacher of a distillation loss,
            and each epoch of a model soup begins with its weights.
        averages: Moving average and model soup of the network.
        selected: Network that is validated after each epoch: an average, or the network in
            training.
        is_detector: Whether the network finds boxes. The accuracy of a detector is the fraction of
            the boxes of `initial` that it finds.
        epoch: Number of finished epochs.
        history: Metrics of each finished epoch by name.
        best: Content of best.pt, the network that the training selected. It is empty before the
            end of the first epoch.
    """

    settings: TrainSettings
    model: MixedPrecision
    architecture: dict[str, Any]
    service: AugmentationService
    folder: Path
    labeled: bool = True
    has_initial: bool = False

    def __post_init__(self) -> None:
        """Check the settings, and build the optimizer."""
        settings, model, service = self.settings, self.model, self.service
        # Each process gets an equal share of a batch.
        if settings.batch_size % distributed.world_size():
            advice = f"set a multiple of {distributed.world_size()}, the number of processes"
            raise InputError(f"batch_size={settings.batch_size}: {advice}", "batch_size")
        if settings.ranking_weight and not service.positive_classes:
            raise InputError("ranking_weight requires hard negatives: add some", "ranking_weight")
        # Largest numbers of images of the data set in an epoch and in a round.
        self._limits = settings.images_per_epoch, service.settings.regenerate_every
        self.phases = service.phases
        self.seed = service.seed
        self.is_detector = isinstance(service.task, Detection)
        self.epoch = 0
        self.history: list[dict[str, float]] = []
        self.best: dict[str, Any] = {}

        self._log: RunLog | None = None
        # State of the epoch that has begun. None between two epochs.
        self._epoch_state: EpochState | None = None
        # States of the random generators at the checkpoint from which a run is resumed.
        self._random_state: dict[str, Any] = {}
        # Whether best.pt has yet to be written.
        self._best_is_new = False
        # Time of the last checkpoint or, before that, of the start; and seconds that it took.
        self._saved_at, self._saving_took = time.perf_counter(), 0.0

        self.device = device_of(model)
        self.initial = deepcopy(model).eval().requires_grad_(False) if self.has_initial else None
        self.averages = Averages(model, settings.ema_decay, settings.soup)
        self.selected = self.averages.selected
        has_teacher = settings.distillation_weight or settings.consistency_weight
        teacher = self.initial if has_teacher else None
        # `wrap_ddp` may replace layers of the network. The optimizer is built
        # afterwards, so that it has the parameters of the new layers.
        replica = wrap_ddp(model, None if self.is_detector else self.architecture["size"])
        # The first optimizer of a process imports the compiler of torch, which takes seconds.
        with progress_message("loading the optimizer"):
            self.optimizer = recipe.build_optimizer(model, settings)
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=model.precision == "float16")
        absent = service.positive_classes[1:]
        self._augmentation = Augmentation(settings, model, teacher, service.seed, absent)
        self._loss = self._build_loss(replica, teacher)

    def _build_loss(
        self, replica: nn.Module, teacher: MixedPrecision | None
    ) -> Callable[..., tuple[Tensor, Tensor]]:
        """Build the function that computes the loss of a batch. None is no teacher."""
        settings, service = self.settings, self.service
        with keyed(choice="compile"):
            is_compiled = compiles(settings.compile, self.device)
        if isinstance(service.task, Detection):
            return DetectionLoss(replica, settings, teacher, service.task).compute
        if settings.augmentation == "pgd" and not self.labeled:
            fault = "augmentation=pgd attacks labels, which the photographs lack"
            raise InputError(f"{fault}: choose another", "augmentation")
        classes = service.positive_classes
        loss = recipe.TrainingLoss(replica, settings, classes, teacher, self.labeled)
        sees_same = loss.learns_unchanged or not settings.consistency_weight
        if teacher is not None and sees_same and not is_compiled:
            # The teacher takes the features from the network in training, if they are equal.
            size = self.architecture["size"]
            loss.teacher = recipe.share_layers(settings, self.model, teacher, size)
        if not is_compiled:
            return loss.compute
        # torch limits the number of compiled functions in a process. Those of an
        # earlier run are removed.
        torch.compiler.reset()
        return torch.compile(loss.compute, mode="reduce-overhead", dynamic=False)

    def fit(self, train: Split, validation: Split, log: RunLog | None) -> None:
        """Train to the last epoch, and write checkpoints.

        Afterwards, best.pt contains the network of the epoch with the highest
        validation accuracy. For a model soup, and for data without labels, it
        contains the network after the last epoch. `log` is None in all processes but the first one.
        """
        self._log = log
        # The batch size is limited to the images of a round and to the memory.
        in_round = round_size(len(train), *self._limits) + len(self.service)
        batch_size = fitting_batch_size(self.settings, self.model, in_round, train.images.shape[-1])
        self.settings = replace(self.settings, batch_size=batch_size)
        with SignalHandler() as signals:
            # `_train_epoch` returns False if a signal stopped it, and the epoch is then not ended.
            while self.epoch < self.settings.epochs:
                if self._train_epoch(train, signals):
                    self._end_epoch(validation)
                is_stopping = signals.requested()
                is_last = self.epoch == self.settings.epochs
                is_due = self.epoch % self.settings.checkpoint_every == 0
                if is_stopping or is_last or is_due:
                    self._save()
                if is_stopping:
                    signals.stop()

    def _train_epoch(self, split: Split, signals: SignalHandler) -> bool:
        """Take the training steps of an epoch that remain.

        If the run was resumed within the epoch, some steps were taken before. Return False if a
        signal stopped the epoch before its last step.
        """
        settings = self.settings
        counts = (len(split), len(self.service))
        rounds = rounds_of_epoch(*counts, self.seed, self.epoch, *self._limits)
        # Number of training steps in each round.
        steps = [math.ceil(len(one.rows) / settings.batch_size) for one in rounds]
        if self._epoch_state:
            # A resumed run continues within an epoch, with the random numbers of the first attempt.
            torch.set_rng_state(self._random_state["cpu"])
            # Surplus states or GPUs are ignored.
            cuda.set_rng_state_all(self._random_state["cuda"][: cuda.device_count()])
        else:
            self.averages.begin_epoch(self.initial, self.optimizer)
            renders = self._regenerate(rounds[0].number)
            sums = torch.zeros(2, device=self.device)
            self._epoch_state = EpochState(renders, sums, [renders.diagnostics])
        state = self._epoch_state
        # The state has the diagnostics of each round that has begun.
        begun = len(state.diagnostics)
        for index, now in [*enumerate(rounds)][begun - 1 :]:
            if index >= begun:
                state.renders = self._regenerate(now.number)
                state.diagnostics.append(state.renders.diagnostics)
            title = f"epoch {self.epoch + 1}"
            if len(rounds) > 1:
                title += f", round {index + 1} of {len(rounds)}"
            # Number of the steps of this round that were taken before.
            first = state.step - sum(steps[:index])
            shown = Split(to_bytes(state.renders.images), state.renders.labels)
            with self.phases("training"):
                has_losses = self.is_detector and getattr(self.service.task, "decode", None) is None
                recipe.set_training_mode(self.model, settings, has_losses)
                options = settings.batch_size, self.seed, now, settings.flips, first
                batches = training_batches(split, shown, *options)
                for batch in progress(batches, title, steps[index], first):
                    # Fraction of the training that is done, on which the learning rate depends.
                    done = state.step / sum(steps)
                    # Each epoch of a soup runs through the whole schedule of the learning rate.
                    if not settings.soup:
                        done = (self.epoch + done) / settings.epochs
                    state.sums += self._take_step(batch, done, self.epoch * sum(steps) + state.step)
                    self.averages.end_step()
                    state.step += 1
                    # After its last step, the epoch counts as trained, even if a signal came.
                    if signals.requested():
                        return state.step == sum(steps)
                    if state.step < sum(steps) and self._saving_is_due():
                        self._save()
        return True

    def _take_step(self, batch: Batch, done: float, number: int) -> Float[Tensor, " 2"]:
        """Change the weights by the gradient of the loss of a batch.

        `done` is the fraction of the training that is done, and `number` the number of earlier
        steps of the run. Return the sum of the losses of the images, and the number of correct
        predictions.
        """
        settings = self.settings
        for group in self.optimizer.param_groups:
            group["lr"] = recipe.learning_rate(settings, done)
        images, labels, rendered = batch
        augmented = self._augmentation.apply(images, labels, number)
        tensors = [augmented, labels, rendered]
        if settings.consistency_weight:
            # The consistency term compares the images before and after the augmentation.
            tensors = [images, labels, rendered, augmented]
        self.optimizer.zero_grad(set_to_none=True)
        loss, hits = self._loss(*tensors)
        self.scaler.scale(loss).backward()
        # The gradient is scaled for float16, and its true norm is clipped.
        if settings.clip_gradient:
            self.scaler.unscale_(self.optimizer)
            nn.utils.clip_grad_norm_(self.model.parameters(), settings.clip_gradient)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        return torch.stack([loss.detach() * len(images), hits])

    def _regenerate(self, number: int) -> Renders:
        """Render the training renders of a round anew, and log images of a few attacks on them."""
        torch.manual_seed(stream_seed(self.seed, number, "dropout"))
        with self.phases("attack"):
            renders = self.service.regenerate(self.model, number)
        if renders.targets is not None:
            renders = replace(renders, labels=object_maps(renders.targets).to(self.device))
        if self._log and renders.attack_examples:
            # The images are written now, because a run that is resumed within this round
            # does not attack the renders again.
            with self.phases("input_output"):
                classes = self.architecture["classes"]
                self._log.attack_examples(renders.attack_examples, classes, self.epoch + 1)
        return renders

    def _end_epoch(self, split: Split) -> None:
        """Finish an epoch: validate the network, keep it if it is the best, and log the metrics."""
        state = cast(EpochState, self._epoch_state)
        self._epoch_state = None
        loss_sum, hits = all_reduce_sum(state.sums).tolist()
        self.averages.end_epoch()
        with self.phases("evaluation"):
            validated = self.evaluate(split)
        self.epoch += 1
        self._require_finite(loss_sum + validated["loss"], self.epoch)
        accuracy = validated["accuracy"]
        # The network of this epoch replaces the selected network if it is better. The last network
        # of a soup is selected, and that of data without labels, whose validation accuracy is the
        # agreement with the initial network: it is highest before any training.
        highest = max((line["validation/accuracy"] for line in self.history), default=-1.0)
        if accuracy > highest or self.settings.soup or not self.labeled:
            self._best_is_new = True
            self.best = {"model": self.averages.weights(), **self._description()}
            self.best["validation_accuracy"] = accuracy
        if self._log and len(state.renders.labels):
            with self.phases("input_output"):
                self._log.renders(state.renders.images, self.epoch)
        image_count = state.step * self.settings.batch_size
        trained = {"loss": loss_sum / image_count, "accuracy": hits / image_count}
        trained["learning_rate"] = self.optimizer.param_groups[0]["lr"]
        # A phase that this process did not run counts as 0 seconds. The attack is such a
        # phase if the run was resumed after it.
        seconds = dict.fromkeys(run_folder.PHASES, 0.0) | self.phases.take()
        metrics = epoch_metrics(trained, validated, state.diagnostics, seconds)
        self.history.append({"epoch": self.epoch, **metrics})
        if self._log:
            self._log.scalars(metrics, self.epoch)
        console.debug("%s", format_epoch(self.epoch, self.settings.epochs, metrics))

    def evaluate(self, split: Split) -> dict[str, float]:
        """Measure the loss and the accuracy of the selected network."""
        if self.is_detector and self.initial is not None:
            return validate(self.selected, self.initial, cast(Detection, self.service.task), split)
        return evaluate(self.selected, split)

    def _require_finite(self, loss: float, epoch: int) -> None:
        """Raise InputError if the loss or a weight of the network is NaN or infinite."""
        weights = self.model.network.state_dict().values()
        is_finite = torch.stack([value.isfinite().all() for value in weights]).all()
        if not (math.isfinite(loss) and is_finite):
            rate, decay = self.settings.learning_rate, self.settings.weight_decay
            fault = f"learning_rate={rate} with weight_decay={decay} diverged in epoch {epoch}"
            raise InputError(f"{fault}: set lower values", "learning_rate")

    def _save(self) -> None:
        """Write last.pt (the former becomes previous.pt), and best.pt, in the first process."""
        # No checkpoint is written of a run that has diverged.
        if self._epoch_state:
            self._require_finite(float(self._epoch_state.sums[0]), self.epoch + 1)
        with self.phases("input_output"):
            # All processes add to the sums in the state, but only the first one writes it.
            state = self.state_dict()
            if distributed.rank() > 0:
                return
            start = time.perf_counter()
            if self._best_is_new:
                checkpoints.save(self.folder / run_folder.BEST, self.best)
                self._best_is_new = False
            previous = self.folder / run_folder.PREVIOUS
            checkpoints.save(self.folder / run_folder.LAST, state, previous)
            self._saved_at = time.perf_counter()
            self._saving_took = self._saved_at - start

    def _saving_is_due(self) -> bool:
        """Return whether it is time to write a checkpoint within an epoch.

        Without such checkpoints, a run that is killed would lose a whole epoch. A run with several
        processes writes none, because the processes would have to agree on the time.
        """
        if distributed.world_size() > 1:
            return False
        wait = max(SAVING_EVERY, self._saving_took / SAVING_SHARE)
        return time.perf_counter() - self._saved_at > wait

    def _description(self) -> dict[str, Any]:
        """Return the entries of a checkpoint that say which run and epoch its weights are from."""
        names = {"architecture": self.architecture, "epoch": self.epoch, "seed": self.seed}
        return {**names, "mode": self.service.settings.mode}

    def state_dict(self) -> dict[str, Any]:
        """Return the content of a checkpoint, from which a run continues as if it never stopped.

        "under_way" is the epoch that has begun, or None between two epochs.
        """
        states_of_gpus = cuda.get_rng_state_all() if cuda.is_available() else []
        return {
            **self._description(),
            "model": self.model.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.scaler.state_dict(),
            **self.averages.state_dict(),
            "precision": self.model.precision,
            "service": self.service.state_dict(),
            "random_state": {"cpu": torch.get_rng_state(), "cuda": states_of_gpus},
            "under_way": self._epoch_state.state_dict() if self._epoch_state else None,
            "history": self.history,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state of a run from the content of a checkpoint.

        The state of another run raises errors of many types.
        """
        self.epoch = state["epoch"]
        self.history = state["history"]
        self.model.network.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.scaler.load_state_dict(state["scaler"])
        self.averages.load_state_dict(state)
        for network in (self.model, self.initial, self.selected):
            if network:
                network.precision = state["precision"]
        # The next attack begins with the values of the scene if no values are stored.
        if "values" in state["service"]:
            self.service.load_state_dict(state["service"])
        self._random_state = dict(state["random_state"])
        begun = state["under_way"]
        if begun:
            # The stored sums are those of all processes together. Only the first process
            # continues with them, so that they are counted once.
            sums = begun["sums"].to(self.device) * (distributed.rank() == 0)
            images = to_unit(begun["images"]).to(self.device)
            renders = Renders(images, begun["labels"].to(self.device), begun["diagnostics"][-1])
            self._epoch_state = EpochState(renders, sums, begun["diagnostics"], begun["step"])

    def resume(self) -> None:
        """Restore the newest undamaged checkpoint in the folder of the run."""
        state, problem = checkpoints.load_newest(self.folder)
        fault = f"{self.folder} has a checkpoint of another run"
        with explained(fault, f"restore {run_folder.LAST}, or start elsewhere"):
            # An older checkpoint may lack entries, which are then not compared.
            if self.architecture | state["architecture"] != self.architecture:
                raise ValueError("it has another architecture or other classes")
            self.load_state_dict(state)
        if self.epoch:
            # It is read before the training, so that no time is lost if it is damaged.
            self.best = checkpoints.load(self.folder / run_folder.BEST)
        if problem:
            console.warning("%s: continuing from the checkpoint before it", problem)
            # last.pt is damaged. It is removed, since it would otherwise replace the
            # undamaged previous.pt when the next checkpoint is written.
            (self.folder / run_folder.LAST).unlink(missing_ok=True)
        steps = self._epoch_state.step if self._epoch_state else 0
        console.info("resumed %s after epoch %d and %d steps", self.folder, self.epoch, steps)


@torch.no_grad()
def evaluate(model: nn.Module, split: Split) -> dict[str, float]:
    """Measure the loss and the accuracy of a network in evaluation mode.

    If a run has several processes, each of them scores a part of the images, and
    all of them return the result for all images. Return the mean cross entropy as "loss" and the
    fraction of correct predictions as "accuracy".
    """
    device = split.labels.device
    # Each of n processes scores every n-th image.
    rows = torch.arange(len(split), device=device)[distributed.rank() :: distributed.world_size()]
    batches = rows.split(EVALUATION_BATCH)
    sums = torch.zeros(2, device=device)
    # With few images, a process has none, and not every network takes an empty batch.
    if len(rows):
        shown = progress(split.squares(batches), f"{len(split)} images", len(batches))
        logits = compute_outputs(model, shown, EVALUATION_BATCH, device)
        labels = split.labels[rows]
        loss_sum = F.cross_entropy(logits, labels, reduction="sum")
        sums = torch.stack([loss_sum, (logits.argmax(1) == labels).sum()])
    loss_sum, hits = all_reduce_sum(sums).tolist()
    return {"loss": loss_sum / len(split), "accuracy": hits / len(split)}


def fitting_batch_size(settings: TrainSettings, model: nn.Module, in_round: int, size: int) -> int:
    """Limit the batch size to the images of a round, and check that a batch fits in memory.

    A larger batch would only hold copies of the images.
    """
    shares = distributed.world_size()
    # The images of a round, rounded up to a multiple of the number of processes.
    batch_size = min(settings.batch_size, math.ceil(in_round / shares) * shares)
    if batch_size < settings.batch_size:
        fault = "batch_size=%d is more than the %d images that a round shows: it is %d"
        console.warning(fault, settings.batch_size, in_round, batch_size)
    at_once = batch_size // shares
    needed = at_once * activation_bytes(deepcopy(model), size)
    require_memory(f"the activations of batch_size={at_once}", needed, device_of(model))
    return batch_size


def activation_bytes(model: nn.Module, size: int) -> int:
    """Measure the memory that a training step keeps for each image until its backward pass."""
    totals = []
    for count in (1, 2):
        kept: dict[int, int] = {}

        def keep(tensor: Tensor, kept: dict[int, int] = kept) -> Tensor:
            kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor)
        with eval_mode(model), torch.enable_grad(), hooks:
            # The result holds the kept tensors, whose addresses would otherwise be used again.
            result = model(torch.full((count, 3, size, size), 0.5, device=device_of(model)))
        totals.append(sum(kept.values()))
        del result
    # The difference leaves out the weights, which all images share.
    return max(0, totals[1] - totals[0])
