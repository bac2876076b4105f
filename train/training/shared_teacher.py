"""A teacher network that shares layers with the network in training.

If only the last layer is trained, the features before it are the same in both networks. To compute
them once saves one of two forward passes.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from augment.network import eval_mode
from train.device import PRECISIONS, MixedPrecision
from train.train_settings import ALL_BUT_LAST, TrainSettings
from train.training.recipe import last_layer


class SharedTeacher(nn.Module):
    """Teacher that applies its last layer to the features of another network, its pupil.

    The teacher is a copy of the pupil before the training, in which only the last
    layer changes. Both networks therefore compute the same features before it.

    Args:
        pupil: Network in training. It must be called before each call of the
            teacher, with the same images.
        teacher: Copy of the network before the training.
    """

    def __init__(self, pupil: MixedPrecision, teacher: MixedPrecision):
        """Store what the last layer of the pupil, the network in training, gets as its input."""
        super().__init__()
        name = last_layer(pupil.network)
        self.layer = teacher.network.get_submodule(name)
        self._dtype = PRECISIONS[teacher.precision]
        self._features: Tensor | None = None
        layer = pupil.network.get_submodule(name)
        self._hook = layer.register_forward_pre_hook(self._store_features)

    @property
    def has_features(self) -> bool:
        """Whether the hook has stored features of the pupil."""
        return self._features is not None

    def release(self) -> None:
        """Remove the hook that stores the features of the pupil."""
        self._hook.remove()

    def _store_features(self, _: nn.Module, inputs: tuple[Any, ...]) -> None:
        """Store the input of the last layer of the pupil. torch calls this before the layer."""
        self._features = inputs[0].detach()

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B classes"]:
        """Return the logits of the teacher for the images with which the pupil was called last."""
        is_mixed = self._dtype != torch.float32
        with torch.autocast(images.device.type, self._dtype, enabled=is_mixed):
            return self.layer(self._features).float()


def share_layers(
    settings: TrainSettings, pupil: MixedPrecision, teacher: MixedPrecision, size: int
) -> nn.Module:
    """Return a teacher that shares layers with its pupil, if that does not change its logits.

    They are shared if only the last layer learns, and if the logits for two test images stay equal.
    """
    # The features would depend on the statistics of the batch in training mode.
    is_frozen = settings.freeze == ALL_BUT_LAST and settings.eval_mode
    # `SharedTeacher` registers a hook, which modules of TorchScript do not support.
    has_script = any(isinstance(module, torch.jit.ScriptModule) for module in pupil.modules())
    if not is_frozen or has_script:
        return teacher
    shared = SharedTeacher(pupil, teacher)
    device = next(teacher.parameters()).device
    # Two test images with a color gradient.
    images = torch.linspace(0, 1, 6 * size**2, device=device).view(2, 3, size, size)
    with eval_mode(pupil), torch.no_grad():
        expected = teacher(images)
        is_equal = pupil(images).equal(expected) and shared.has_features
        if is_equal and shared(images).equal(expected):
            return shared
    shared.release()
    return teacher
