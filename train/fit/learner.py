"""A network that learns, one step at a time: its optimizer, schedule, distortions and the average of its weights."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from renderer.errors import InputError, is_out_of_memory
from train.device import FixedSizes, MixedPrecision, compiles, training_pass
from train.distributed import replicated
from train.fit.distortions import distortion
from train.fit.recipe import SCHEDULES, Average, TrainSettings


class Learner:
    """attacked: the network that renders are found against; scored: `selected`, as it is validated. Either may be CUDA
    graphs."""

    def __init__(self, settings: TrainSettings, model: MixedPrecision, seed: int, label: int | None = None):
        """model: as the run begins, which a distillation holds to and each epoch of a soup begins with. label: the
        class that is ranked above hard negatives; InputError for a ranking without them."""
        if settings.ranking and label is None:
            raise InputError(
                f"train.ranking={settings.ranking} ranks hard negatives: name some in scene.hard_negatives"
            )
        self.settings = settings
        self.model = model
        self.device = next(model.parameters()).device
        self._average = Average(model, settings.averaging) if settings.averaging else None
        self._soup = Average(model) if settings.soup else None
        self._begun = deepcopy(model.state_dict()) if settings.soup else None
        teacher = deepcopy(model).eval().requires_grad_(False) if settings.distillation else None
        replica = replicated(model)  # whose parameters the optimizer is to have
        self.optimizer = torch.optim.SGD(
            model.parameters(),
            lr=settings.learning_rate,
            momentum=settings.momentum,
            weight_decay=settings.weight_decay,
            nesterov=settings.momentum > 0,
            fused=True,
        )
        compiled = compiles(settings.compile, self.device)
        self._training_pass = training_pass(
            replica, settings.label_smoothing, compiled, settings.ranking, label, settings.distillation, teacher
        )
        self._distort = distortion(settings.distortion, model, seed)
        self.attacked, self.scored = (FixedSizes(each) if compiled else each for each in (model, self.selected))

    @property
    def selected(self) -> MixedPrecision:
        """The network that is validated and kept: a soup or the average over steps, where there is one."""
        return self._soup.module if self._soup else self._trained

    @property
    def _trained(self) -> MixedPrecision:
        """What the epoch under way has made."""
        return self._average.module if self._average else self.model

    @property
    def learning_rate(self) -> float:
        """Of the last step."""
        return self.optimizer.param_groups[0]["lr"]

    def begin_epoch(self) -> None:
        """Of a soup: from the weights that the run began with, as if nothing had been learned."""
        if self._begun:
            self.model.load_state_dict(self._begun)
            self.optimizer.state.clear()
            if self._average:
                self._average.restart()

    def end_epoch(self) -> None:
        """Take the epoch's network into the soup, if there is one."""
        if self._soup:
            self._soup.update(self._trained)

    def step(self, images: Tensor, labels: Tensor, rendered: Tensor, progress: float, number: int) -> Tensor:
        """Learn from uint8 images (B, 3, H, W), labels (B,) and which are renders, (B,) bool: (2,) the sum of their
        losses, and how many were right.

        progress: the share of the schedule that is over, which the learning rate follows. number: the run's step.
        InputError where memory runs out.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * SCHEDULES[self.settings.schedule](progress)
        images = self._distort(images, labels, number)
        self.optimizer.zero_grad(set_to_none=True)
        try:
            loss, hits = self._training_pass(images, labels, rendered)
            loss.backward()
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            setting = f"train.batch_size={self.settings.batch_size}"
            raise InputError(f"{setting} needs more memory than there is: set a lower one") from error
        self.optimizer.step()
        if self._average:
            self._average.update(self.model)
        return torch.stack([loss.detach() * len(labels), hits])

    def require_finite(self, loss: float, epoch: int) -> None:
        """InputError naming what is NaN or infinite, before any of it is kept."""
        network = self.model.network
        tensors = {f"weight {name}": value for name, value in network.state_dict().items()}
        tensors |= {f"gradient of {name}": p.grad for name, p in network.named_parameters() if p.grad is not None}
        tensors["loss"] = torch.tensor(loss)
        finite = torch.stack([value.isfinite().all().to(self.device) for value in tensors.values()]).tolist()
        if not all(finite):
            name = list(tensors)[finite.index(False)]
            raise InputError(
                f"train.learning_rate={self.settings.learning_rate} with train.weight_decay="
                f"{self.settings.weight_decay} made the {name} NaN or infinite in epoch {epoch}: set lower ones; the "
                "checkpoint before, if any, is kept"
            )

    def state_dict(self) -> dict[str, Any]:
        """bfloat16 needs no loss scaler."""
        return {
            "model": self.model.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "average": self._average.state_dict() if self._average else None,
            "soup": self._soup.state_dict() if self._soup else None,
            "precision": self.model.precision,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """What `state_dict` gave, among other things."""
        self.model.network.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self._average:
            self._average.load_state_dict(state["average"])
        if self._soup:
            self._soup.load_state_dict(state["soup"])
        self.model.precision = self.selected.precision = state["precision"]
