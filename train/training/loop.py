"""The training loop.

An epoch consists of one or more rounds. At the start of a round, the training renders are rendered
anew. At the end of an epoch, the network is validated and a checkpoint is written. In a long epoch,
checkpoints are also written in between.
"""

import math
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from augment import distributed
from augment.network import compute_outputs, eval_mode
from augment.progress import progress, progress_message
from augment.random_streams import stream_seed
from augment.service import AugmentationService, Renders
from renderer.errors import InputError, single_line
from renderer.image import to_bytes, to_unit
from renderer.memory import require_memory
from train import checkpoints, console, run_folder
from train.checkpoints import random_state, restore_random_state
from train.data.batches import Round, TrainingImages, rounds_of_epoch, training_batches
from train.data.sets import Split
from train.device import GraphedModel, MixedPrecision, compiles
from train.processes import SignalHandler, all_reduce_sum, wrap_ddp
from train.results.epoch_metrics import epoch_metrics, format_epoch
from train.run_folder import PHASES
from train.settings import RELIGHT, TrainSettings
from train.system.user_errors import keyed
from train.training.averages import Averages
from train.training.baselines import Baseline
from train.training.loss import TrainingLoss
from train.training.recipe import build_optimizer, learning_rate, set_training_mode
from train.training.relit_batches import RelitBatches
from train.training.run_log import RunLog
from train.training.shared_teacher import share_layers

# Number of images in a pass of the validation.
EVALUATION_BATCH = 512
# Smallest number of seconds between two checkpoints within an epoch.
SAVING_EVERY = 60.0
# Largest fraction of the time of an epoch in which checkpoints are written.
SAVING_SHARE = 0.02

# Batch of training images: images, uint8, shape (B, 3, H, W), their labels, shape (B,), and
# whether each image is a render, bool, shape (B,).
Batch = tuple[Tensor, Tensor, Tensor]


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


@dataclass(frozen=True)
class EpochPlan:
    """Training images and rounds of an epoch.

    Attributes:
        split: Images and labels of the data.
        rows: Indices in `split` of the training images, shape (N,). The other
            images validate.
        rounds: Rounds of the epoch. A round has its own order of images.
        steps: Number of training steps in each round.
    """

    split: Split
    rows: Int[Tensor, " N"]
    rounds: list[Round]
    steps: list[int]

    @property
    def total(self) -> int:
        """Number of training steps in the whole epoch."""
        return sum(self.steps)


class Trainer:
    """Trainer of one network, which writes checkpoints to the folder of the run.

    `fit` trains the network. To continue a run, call `resume` before `fit`.

    Attributes:
        initial: Copy of the network before the training. None if the run begins
            with random weights. The copy is the teacher of a distillation loss,
            and each epoch of a model soup begins with its weights.
        averages: Moving average and model soup of the network.
        epoch: Number of finished epochs.
        history: Metrics of each finished epoch by name.
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
        """Check the settings, and build the optimizer."""
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

        # State of the epoch that has begun. None between two epochs.
        self._epoch_state: EpochState | None = None
        # States of the random generators at the checkpoint from which a run is resumed.
        self._random_state: dict[str, Any] = {}
        # Content of best.pt, until it is written.
        self._best: dict[str, Any] | None = None
        # Time at which the last checkpoint was written or, before that, of the start.
        self._saved_at = time.perf_counter()
        # Seconds that it took to write the last checkpoint.
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
            # The validation accuracy of data without labels is the agreement with the initial
            # network. It is highest before any training, and cannot choose an epoch.
            keeps_latest=not labeled,
        )
        self._build_step(labeled)

    def _build_step(self, labeled: bool) -> None:
        """Build the optimizer, the gradient scaler, the loss and the augmentation."""
        settings = self.settings
        positive_classes = self.service.positive_classes
        # `wrap_ddp` may replace layers of the network. The optimizer is built
        # afterwards, so that it has the parameters of the new layers.
        replica = wrap_ddp(self.model)
        # The first optimizer of a process imports the compiler of torch, which takes seconds.
        with progress_message("loading the optimizer"):
            self.optimizer = build_optimizer(self.model, settings)
        is_scaled = self.model.precision == "float16"
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=is_scaled)
        has_teacher = settings.distillation_weight or settings.consistency_weight
        teacher = self.initial if has_teacher else None
        with keyed(choice="compile"):
            is_compiled = compiles(settings.compile, self.device)
        # Module that computes the logits of the teacher. It may take the features from
        # the network in training.
        teacher_module: nn.Module | None = teacher
        if teacher is not None and not is_compiled:
            size = self.architecture["size"]
            teacher_module = share_layers(settings, self.model, teacher, size)
        loss = TrainingLoss(replica, settings, positive_classes, teacher_module, labeled)
        self._loss = loss.compute
        self._augmentation: Baseline | RelitBatches = Baseline(
            settings.augmentation,
            self.model,
            self.seed,
            positive_classes[1:],
        )
        if settings.augmentation == RELIGHT:
            self._augmentation = RelitBatches(settings, self.model, teacher, self.seed)
        self._attacked: nn.Module = self.model
        self._validated: nn.Module = self.averages.selected
        if is_compiled:
            self._compile()

    def _compile(self) -> None:
        """Record the loss, the attacked network and the validated network as CUDA graphs."""
        # torch limits the number of compiled functions in a process. Those of an
        # earlier run are removed.
        torch.compiler.reset()
        self._loss = torch.compile(self._loss, mode="reduce-overhead", dynamic=False)
        self._attacked = GraphedModel(self.model)
        self._validated = GraphedModel(self.averages.selected)

    @property
    def selected(self) -> MixedPrecision:
        """Network that is validated after each epoch: an average, or the network in training."""
        return self.averages.selected

    def fit(self, split: Split, held_out: Bool[Tensor, " N"], log: RunLog | None) -> None:
        """Train to the last epoch, and write checkpoints.

        Afterwards, best.pt contains the network of the epoch with the highest
        validation accuracy. For a model soup, and for data without labels, it
        contains the network after the last epoch. `held_out` marks the validation images, and `log`
        is None in all processes but the first one.
        """
        train = torch.nonzero(~held_out).squeeze(1)
        validation = torch.nonzero(held_out).squeeze(1)
        self._limit_batch_size(split, len(train))
        with SignalHandler() as signals:
            while self.epoch < self.settings.epochs:
                if self._train_epoch(split, train, signals, log):
                    self._end_epoch(split, validation, log)
                is_stopping = signals.requested()
                is_last = self.epoch == self.settings.epochs
                is_due = self.epoch % self.settings.checkpoint_every == 0
                if is_stopping or is_last or (is_due and self._epoch_state is None):
                    self._save()
                if is_stopping:
                    signals.stop()

    def _limit_batch_size(self, split: Split, image_count: int) -> None:
        """Limit the batch size to the images of a round, and check that a batch fits in memory.

        A larger batch would only hold copies of the images.
        """
        settings = self.settings
        limits = (settings.images_per_epoch, self.service.settings.regenerate_every)
        in_round = min([image_count, *(limit for limit in limits if limit)]) + len(self.service)
        # Each process divides its part of a batch into equal parts.
        shares = distributed.world_size() * settings.accumulation_steps
        largest = math.ceil(in_round / shares) * shares
        if settings.batch_size > largest:
            console.warning(
                "batch_size=%d is more than the %d images that a round shows: it is %d",
                settings.batch_size,
                in_round,
                largest,
            )
            self.settings = replace(settings, batch_size=largest)
        at_once = self.settings.batch_size // shares
        (image,) = split.squares([torch.zeros(1, dtype=torch.int64)])
        needed = at_once * activation_bytes(deepcopy(self.model), image.shape[-1])
        require_memory(f"the activations of batch_size={at_once}", needed, self.device)

    def _train_epoch(
        self,
        split: Split,
        rows: Int[Tensor, " N"],
        signals: SignalHandler,
        log: RunLog | None,
    ) -> bool:
        """Take the training steps of an epoch that remain.

        If the run was resumed within the epoch, some steps were taken before. Return False if a
        signal stopped the epoch before its last step.
        """
        plan = self._plan(split, rows)
        if self._epoch_state is None:
            self._epoch_state = self._begin_epoch(plan, log)
        else:
            # The run continues within an epoch, with the random numbers of the first attempt.
            restore_random_state(self._random_state)
        state = self._epoch_state
        with closing(self._remaining_batches(plan, state, log)) as batches:
            for batch in batches:
                step_in_run = self.epoch * plan.total + state.step
                state.sums += self._step(*batch, state.step / plan.total, step_in_run)
                state.step += 1
                if signals.requested():
                    return state.step == plan.total
                if state.step < plan.total and self._saving_is_due():
                    self._save()
        return True

    def _plan(self, split: Split, rows: Int[Tensor, " N"]) -> EpochPlan:
        """Divide the current epoch into rounds, and count the training steps of each round."""
        settings = self.settings
        rounds = rounds_of_epoch(
            image_count=len(rows),
            render_count=len(self.service),
            seed=self.seed,
            epoch=self.epoch,
            images_per_epoch=settings.images_per_epoch,
            images_per_round=self.service.settings.regenerate_every,
        )
        steps = [math.ceil(len(one.rows) / settings.batch_size) for one in rounds]
        return EpochPlan(split, rows, rounds, steps)

    def _begin_epoch(self, plan: EpochPlan, log: RunLog | None) -> EpochState:
        """Begin an epoch: render the images of its first round."""
        self.averages.begin_epoch(self.initial, self.optimizer)
        renders = self._regenerate(plan.rounds[0], log)
        return EpochState(renders, torch.zeros(2, device=self.device), [renders.diagnostics])

    def _remaining_batches(
        self, plan: EpochPlan, state: EpochState, log: RunLog | None
    ) -> Generator[Batch, None, None]:
        """Yield the remaining batches of an epoch, and render new images before each new round.

        `state` is updated when a round begins.
        """
        # `state.diagnostics` has an item for each round that has begun. The last of them
        # is the current round.
        current = len(state.diagnostics) - 1
        for index in range(current, len(plan.rounds)):
            is_new = index > current
            if is_new:
                state.renders = self._regenerate(plan.rounds[index], log)
                state.diagnostics.append(state.renders.diagnostics)
            with self.phases("training"):
                renders = Split(to_bytes(state.renders.images), state.renders.labels)
                set_training_mode(self.model, self.settings)
                # Number of the steps of this round that were taken before.
                first = state.step - sum(plan.steps[:index])
                batches = training_batches(
                    TrainingImages(plan.split, plan.rows, renders),
                    batch_size=self.settings.batch_size,
                    seed=self.seed,
                    this_round=plan.rounds[index],
                    flips=self.settings.flips,
                    first=first,
                )
                title = f"epoch {self.epoch + 1}"
                if len(plan.rounds) > 1:
                    title += f", round {index + 1} of {len(plan.rounds)}"
                yield from progress(batches, title, plan.steps[index], first)

    def _regenerate(self, now: Round, log: RunLog | None) -> Renders:
        """Render the training renders of a round anew, and log images of a few attacks on them."""
        torch.manual_seed(stream_seed(self.seed, now.number, "dropout"))
        with self.phases("attack"):
            renders = self.service.regenerate(self._attacked, now.number)
        if log and renders.attack_examples:
            # The images are written now, because a run that is resumed within this round
            # does not attack the renders again.
            with self.phases("input_output"):
                classes = self.architecture["classes"]
                log.attack_examples(renders.attack_examples, classes, self.epoch + 1)
        return renders

    def _step(
        self,
        images: UInt8[Tensor, "B 3 H W"],
        labels: Int[Tensor, " B"],
        rendered: Bool[Tensor, " B"],
        epoch_fraction: float,
        step_in_run: int,
    ) -> Float[Tensor, " 2"]:
        """Take a training step: change the weights by the gradient of the loss of a batch.

        Return the sum of the losses of the images, and the number of correct predictions.
        """
        settings = self.settings
        done = (self.epoch + epoch_fraction) / settings.epochs
        if settings.soup:
            # Each epoch of a model soup runs through the whole schedule of the
            # learning rate.
            done = epoch_fraction
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(settings, done)
        augmented = self._augmentation.apply(images, labels, step_in_run)
        tensors = [augmented, labels, rendered]
        if settings.consistency_weight:
            # The consistency term compares the images before and after the augmentation.
            tensors = [images, labels, rendered, augmented]
        self.optimizer.zero_grad(set_to_none=True)
        sums = self._add_gradients(tensors)
        if settings.clip_gradient:
            self.scaler.unscale_(self.optimizer)
            nn.utils.clip_grad_norm_(self.model.parameters(), settings.clip_gradient)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        self.averages.end_step()
        return sums

    def _add_gradients(self, tensors: Sequence[Tensor]) -> Float[Tensor, " 2"]:
        """Compute the gradient of the loss of a batch.

        The batch is divided into smaller batches to save memory. Their gradients
        are added. Return the sum of the losses of the images, and the number of hits.
        """
        count = self.settings.accumulation_steps
        sums = torch.zeros(2, device=self.device)
        # A list of chunks for each tensor. A smaller batch has one chunk of each tensor.
        chunks = [tensor.chunk(count) for tensor in tensors]
        for small_batch in zip(*chunks, strict=True):
            loss, hits = self._loss(*small_batch)
            self.scaler.scale(loss / count).backward()
            image_count = len(small_batch[0])
            sums += torch.stack([loss.detach() * image_count, hits])
        return sums

    def _end_epoch(self, split: Split, rows: Int[Tensor, " N"], log: RunLog | None) -> None:
        """Finish an epoch: validate the network, keep it if it is the best, and log the metrics."""
        state = cast(EpochState, self._epoch_state)
        self._epoch_state = None
        loss_sum, hits = all_reduce_sum(state.sums).tolist()
        self.averages.end_epoch()
        with self.phases("evaluation"):
            validated = evaluate(self._validated, split, rows)
        self.epoch += 1
        self._require_finite(loss_sum + validated["loss"], self.epoch)
        # The network of this epoch replaces the selected network if it is better, or if the
        # settings select the last network.
        if self.averages.is_kept(validated["accuracy"]):
            self._best = {
                "model": self.averages.weights(),
                **self._description(),
                "validation_accuracy": validated["accuracy"],
            }
        if log and len(state.renders.labels):
            with self.phases("input_output"):
                log.renders(state.renders.images, self.epoch)

        image_count = state.step * self.settings.batch_size
        trained = {
            "loss": loss_sum / image_count,
            "accuracy": hits / image_count,
            "learning_rate": self.optimizer.param_groups[0]["lr"],
        }
        # A phase that this process did not run counts as 0 seconds. The attack is such a
        # phase if the run was resumed after it.
        seconds = dict.fromkeys(PHASES, 0.0) | self.phases.take()
        metrics = epoch_metrics(trained, validated, state.diagnostics, seconds)
        self.history.append({"epoch": self.epoch, **metrics})
        if log:
            log.scalars(metrics, self.epoch)
        console.debug("%s", format_epoch(self.epoch, self.settings.epochs, metrics))

    def _require_finite(self, loss: float, epoch: int) -> None:
        """Raise InputError if the loss or a weight of the network is NaN or infinite."""
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
        """Write the checkpoint last.pt, and best.pt if there is a new best network.

        The former last.pt is renamed to previous.pt. Only the first process writes.
        """
        if self._epoch_state:
            self._require_finite(float(self._epoch_state.sums[0]), self.epoch + 1)
        with self.phases("input_output"):
            state = self.state_dict()
            best = self._best
            self._best = None
            if distributed.rank() > 0:
                return
            start = time.perf_counter()
            if best:
                checkpoints.save(self.folder / run_folder.BEST, best)
            previous = self.folder / run_folder.PREVIOUS
            checkpoints.save(self.folder / run_folder.LAST, state, previous)
            self._saved_at = time.perf_counter()
            self._saving_took = self._saved_at - start

    def _saving_is_due(self) -> bool:
        """Return whether it is time to write a checkpoint within an epoch.

        Without such checkpoints, a run that is killed would lose a whole epoch.
        A run with several processes writes none, because the processes would
        have to agree on the time.
        """
        if distributed.world_size() > 1:
            return False
        wait = max(SAVING_EVERY, self._saving_took / SAVING_SHARE)
        return time.perf_counter() - self._saved_at > wait

    def _description(self) -> dict[str, Any]:
        """Return the entries of a checkpoint that say which run and epoch its weights are from."""
        return {
            "architecture": self.architecture,
            "epoch": self.epoch,
            "seed": self.seed,
            "mode": self.service.settings.mode,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the content of a checkpoint, from which a run continues as if it never stopped.

        "under_way" is the epoch that has begun, or None between two epochs.
        """
        return {
            **self._description(),
            "model": self.model.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.scaler.state_dict(),
            **self.averages.state_dict(),
            "precision": self.model.precision,
            "service": self.service.state_dict(),
            "random_state": random_state(),
            "under_way": self._epoch_state.state_dict() if self._epoch_state else None,
            "history": self.history,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state of a run from the content of a checkpoint.

        The state of another run raises errors of many types.
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
        # The next attack begins with the values of the scene if no values are stored.
        if "values" in state["service"]:
            self.service.load_state_dict(state["service"])
        self._random_state = dict(state["random_state"])
        if state["under_way"]:
            self._epoch_state = self._restore_epoch(state["under_way"])

    def _restore_epoch(self, state: Mapping[str, Any]) -> EpochState:
        """Restore the state of an epoch that had begun when a checkpoint was written."""
        images = to_unit(state["images"]).to(self.device)
        labels = state["labels"].to(self.device)
        renders = Renders(images, labels, state["diagnostics"][-1])
        sums = state["sums"].to(self.device)
        if distributed.rank() > 0:
            # The stored sums are those of all processes together. Only the first process
            # continues with them, so that they are counted once.
            sums = torch.zeros_like(sums)
        return EpochState(renders, sums, state["diagnostics"], state["step"])

    def resume(self) -> None:
        """Restore the newest undamaged checkpoint in the folder of the run."""
        state, problem = checkpoints.load_newest(self.folder)
        try:
            self._require_own_architecture(state)
            self.load_state_dict(state)
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            reason = single_line(error)
            raise InputError(
                f"this run cannot continue from the checkpoint in {self.folder} ({reason}): "
                f"restore {run_folder.LAST}, or start in another folder",
            ) from error
        self._require_own_best()
        if problem:
            console.warning("%s: continuing from the checkpoint before it", problem)
            # last.pt is damaged. It is removed, since it would otherwise replace the
            # undamaged previous.pt when the next checkpoint is written.
            (self.folder / run_folder.LAST).unlink(missing_ok=True)
        steps = self._epoch_state.step if self._epoch_state else 0
        console.info("resumed %s after epoch %d and %d steps", self.folder, self.epoch, steps)

    def _require_own_best(self) -> None:
        """Raise InputError if best.pt is missing, damaged or of another run.

        The network in this file is scored after the training. A resumed run
        checks it before the training, so that no time is lost.
        """
        if not self.epoch:
            # best.pt is written at the end of the first epoch.
            return
        path = self.folder / run_folder.BEST
        try:
            best = checkpoints.load(path)
            self._require_own_architecture(best)
            own = self._description()
            # Earlier versions stored "mode" as "arm".
            mode = best.get("mode", best.get("arm"))
            if best["seed"] != own["seed"] or mode != own["mode"]:
                raise ValueError("it is of another run")
            # best.pt can be from an epoch after the checkpoint. This epoch is then trained
            # again, and its accuracy is not known yet.
            if best["epoch"] <= len(self.history):
                line = self.history[best["epoch"] - 1]
                if line["validation/accuracy"] != best["validation_accuracy"]:
                    raise ValueError("its accuracy is not the one that this run had")
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(
                f"{path} is not the best network of this run ({single_line(error)}): "
                f"restore {run_folder.BEST}, or start in another folder",
            ) from error

    def _require_own_architecture(self, state: Mapping[str, Any]) -> None:
        """Raise ValueError if a checkpoint has another architecture or other classes than the run.

        An older checkpoint may lack entries, which are then not compared.
        """
        if self.architecture | state["architecture"] != self.architecture:
            raise ValueError("it has another architecture or other classes")


def activation_bytes(model: nn.Module, size: int) -> int:
    """Measure the memory that a training step keeps for each image until its backward pass."""
    totals = []
    device = next(model.parameters()).device
    for count in (1, 2):
        kept: dict[int, int] = {}

        def keep(tensor: Tensor, kept: dict[int, int] = kept) -> Tensor:
            kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor)
        with eval_mode(model), torch.enable_grad(), hooks:
            # The result holds the kept tensors, whose addresses would otherwise be used again.
            result = model(torch.full((count, 3, size, size), 0.5, device=device))
        totals.append(sum(kept.values()))
        del result
    # The difference leaves out the weights, which all images share.
    return max(0, totals[1] - totals[0])


def _require_equal_shares(settings: TrainSettings) -> None:
    """Raise InputError if a batch cannot be divided equally.

    Each process gets an equal part of the batch, and divides it into
    `accumulation_steps` equal parts.
    """
    process_count = distributed.world_size()
    steps = settings.accumulation_steps
    if settings.batch_size % (process_count * steps):
        raise InputError(
            f"batch_size={settings.batch_size} is no multiple of {process_count} processes × "
            f"accumulation_steps={steps}: set it to a multiple of {process_count * steps}",
            "batch_size",
        )


@torch.no_grad()
def evaluate(
    model: nn.Module, split: Split, rows: Int[Tensor, " N"] | None = None
) -> dict[str, float]:
    """Measure the loss and the accuracy of a network in evaluation mode.

    If a run has several processes, each of them scores a part of the images, and
    all of them return the result for all images. Return the mean cross entropy as "loss" and the
    fraction of correct predictions as "accuracy".
    """
    device = split.labels.device
    if rows is None:
        rows = torch.arange(len(split))
    rows = rows.to(device)
    totals = torch.zeros(2, device=device)
    # Both numbers are views of `totals`: adding to them in place changes `totals`.
    loss_sum, hits = totals
    # Each of n processes scores every n-th image.
    own_rows = rows[distributed.rank() :: distributed.world_size()]
    batches = own_rows.split(EVALUATION_BATCH)
    shown = progress(split.squares(batches), f"{len(rows)} images", len(batches))
    all_logits = compute_outputs(model, shown, EVALUATION_BATCH, device)
    for batch, logits in zip(batches, all_logits.split(EVALUATION_BATCH), strict=True):
        labels = split.labels[batch]
        loss_sum += F.cross_entropy(logits, labels, reduction="sum")
        hits += (logits.argmax(1) == labels).sum()
    loss_sum, hits = all_reduce_sum(totals).tolist()
    return {"loss": loss_sum / len(rows), "accuracy": hits / len(rows)}
