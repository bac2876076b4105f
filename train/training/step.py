"""One training step: augment a batch, compute the gradient of its loss, and change the weights."""

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from augment import distributed
from augment.network import device_of, eval_mode
from augment.progress import progress_message
from augment.service import AugmentationService
from augment.tasks.detection import Detection
from renderer.errors import InputError, keyed, require_memory
from train import console
from train.data.batches import Batch
from train.device import MixedPrecision, compiles, wrap_ddp
from train.settings import TrainSettings
from train.training.augmentations import Augmentation
from train.training.detection import DetectionLoss
from train.training.recipe import TrainingLoss, build_optimizer, learning_rate, share_layers


@dataclass(eq=False)
class TrainingStep:
    """Loss, augmentation and optimizer of a network, with which it takes training steps.

    Attributes:
        teacher: Network before the training. None without distillation.
    """

    settings: TrainSettings
    model: MixedPrecision
    teacher: MixedPrecision | None
    service: AugmentationService
    size: int
    labeled: bool

    def __post_init__(self) -> None:
        """Build the optimizer, the loss and the augmentation."""
        settings, model, teacher, service = self.settings, self.model, self.teacher, self.service
        device = next(model.parameters()).device
        # `wrap_ddp` may replace layers of the network. The optimizer is built
        # afterwards, so that it has the parameters of the new layers.
        replica = wrap_ddp(model)
        # The first optimizer of a process imports the compiler of torch, which takes seconds.
        with progress_message("loading the optimizer"):
            self.optimizer = build_optimizer(model, settings)
        self.scaler = torch.amp.GradScaler(device.type, enabled=model.precision == "float16")
        classes = service.positive_classes
        self._augmentation = Augmentation(settings, model, teacher, service.seed, classes[1:])
        with keyed(choice="compile"):
            is_compiled = compiles(settings.compile, device)
        self._loss: Callable[..., tuple[Tensor, Tensor]]
        if isinstance(service.task, Detection):
            if settings.relight_steps:
                raise InputError("relight_steps attacks classifiers: set it to 0", "relight_steps")
            is_compiled = False
            self._loss = DetectionLoss(replica, settings, teacher, service.task).compute
        else:
            # Module that computes the logits of the teacher. It may take the features from
            # the network in training.
            pupil: nn.Module | None = teacher
            if teacher is not None and not is_compiled:
                pupil = share_layers(settings, model, teacher, self.size)
            self._loss = TrainingLoss(replica, settings, classes, pupil, self.labeled).compute
        if is_compiled:
            # torch limits the number of compiled functions in a process. Those of an
            # earlier run are removed.
            torch.compiler.reset()
            self._loss = torch.compile(self._loss, mode="reduce-overhead", dynamic=False)

    def take(self, batch: Batch, done: float, number: int) -> Float[Tensor, " 2"]:
        """Change the weights by the gradient of the loss of a batch.

        `done` is the fraction of the training that is done, and `number` the number of earlier
        steps of the run. Return the sum of the losses of the images, and the number of correct
        predictions.
        """
        settings = self.settings
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(settings, done)
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

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the optimizer and of the gradient scaler for a checkpoint."""
        return {"optimizer": self.optimizer.state_dict(), "scaler": self.scaler.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the optimizer and the gradient scaler from a checkpoint."""
        self.optimizer.load_state_dict(state["optimizer"])
        self.scaler.load_state_dict(state["scaler"])


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
