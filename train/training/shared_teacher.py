"""A teacher that takes the frozen layers of its pupil, which saves one of two forward passes."""

from typing import Any

import torch
from torch import Tensor, nn

from augment.model_passes import eval_mode
from train.settings import ALL_BUT_LAST, TrainSettings
from train.system.device import PRECISIONS, MixedPrecision
from train.training.recipe import last_layer


class SharedTeacher(nn.Module):
    """The last layer of a teacher behind all other layers of its pupil.

    The two networks are copies of each other, and only the last layer of the
    pupil learns. The logits of the teacher are therefore those of its last
    layer for the features that the pupil has computed.

    Args:
        pupil: Network in training. It must be called before each call of the
            teacher, with the same images.
        teacher: Copy of the network before the training.
    """

    def __init__(self, pupil: MixedPrecision, teacher: MixedPrecision):
        super().__init__()
        name = last_layer(pupil.network)
        self.layer = teacher.network.get_submodule(name)
        self._dtype = PRECISIONS[teacher.precision]
        self._features: Tensor | None = None
        layer = pupil.network.get_submodule(name)
        self._hook = layer.register_forward_pre_hook(self._keep)

    @property
    def has_features(self) -> bool:
        """Whether the pupil has called its last layer."""
        return self._features is not None

    def release(self) -> None:
        """Stop keeping the features of the pupil."""
        self._hook.remove()

    def _keep(self, _: nn.Module, inputs: tuple[Any, ...]) -> None:
        """Keep the input of the last layer of the pupil. torch calls this hook before the layer.

        Args:
            inputs: Arguments of the layer. The first one has the features.
        """
        self._features = inputs[0].detach()

    def forward(self, images: Tensor) -> Tensor:
        """Return the logits of the teacher for the images that the pupil saw last.

        Args:
            images: These images, shape (B, 3, H, W).

        Returns:
            Logits, shape (B, C).
        """
        is_mixed = self._dtype != torch.float32
        with torch.autocast(images.device.type, self._dtype, enabled=is_mixed):
            return self.layer(self._features).float()


def share_layers(
    settings: TrainSettings, pupil: MixedPrecision, teacher: MixedPrecision, size: int
) -> nn.Module:
    """Return a teacher that shares the frozen layers of its pupil, if it answers the same.

    Args:
        settings: Settings of the training.
        pupil: Network in training.
        teacher: Copy of the network before the training, in evaluation mode.
        size: Pixels per side of the images.

    Returns:
        The shared teacher. Otherwise the given teacher: if more than the last
        layer learns, if the statistics of a batch count, or if the logits are
        not those of the last layer.
    """
    is_frozen = settings.freeze == ALL_BUT_LAST and settings.eval_mode
    is_compiled = any(isinstance(module, torch.jit.ScriptModule) for module in pupil.modules())
    if not is_frozen or is_compiled:
        return teacher
    shared = SharedTeacher(pupil, teacher)
    device = next(teacher.parameters()).device
    images = torch.linspace(0, 1, 6 * size**2, device=device).view(2, 3, size, size)
    with eval_mode(pupil), torch.no_grad():
        features_are_kept = pupil(images).equal(teacher(images)) and shared.has_features
        if features_are_kept and shared(images).equal(teacher(images)):
            return shared
    shared.release()
    return teacher
