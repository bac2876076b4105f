"""Usual augmentations of training images, with which training on renders is compared.

They are image transforms of torchvision, and adversarial attacks on pixels (PGD).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Int, UInt8
from torch import Tensor, nn

from augment import distributed
from augment.attacks.norm_ball import project, sample, take_step
from augment.losses import label_loss
from augment.network import frozen_eval_mode
from augment.parameter_settings import StepSettings
from augment.random_streams import generator, stream_seed
from renderer.image import to_bytes, to_unit
from renderer.light.ball import nearest_in_box

# Norm-ball and step size of the attack on pixels. Madry et al. (2018) use a radius of
# 8/255 on CIFAR-10.
PGD = StepSettings(norm="linf", radius=2 / 255, step="sign", step_size=1 / 255)
PGD_STEPS = 3


class Baseline:
    """Augmentation of training images, chosen by its name."""

    def __init__(self, name: str, model: nn.Module, seed: int, absent: Sequence[int] = ()):
        """Create the augmentation.

        "pgd" attacks the pixels of the images, and any other name but "none" is a transform of
        torchvision.
        """
        self._name = name
        self._model = model
        self._seed = seed
        self._absent = absent
        self._transform: Callable[[Tensor], Tensor] | None = None
        if name not in ("none", "pgd"):
            self._transform = _transform(name)

    def apply(
        self, images: UInt8[Tensor, "B 3 H W"], labels: Int[Tensor, " B"], step: int
    ) -> UInt8[Tensor, "B 3 H W"]:
        """Augment the images of a batch.

        The random numbers for an image depend on the seed, the step and the index of the image in
        the batch.
        """
        if self._name == "none":
            return images
        if self._transform is None:
            draws = generator(self._seed, step, "pgd", distributed.rank())
            return pgd(self._model, images, labels, draws, self._absent)
        # A transform of torchvision draws the same random numbers for all images of a batch, from
        # the global generator. So it is called for each image, with a seed of its own.
        transformed = []
        with torch.random.fork_rng(devices=[images.device] if images.is_cuda else []):
            # Each process has a part of the batch. This is the index of its first image.
            first = distributed.rank() * len(images)
            for index, image in enumerate(images, first):
                torch.manual_seed(stream_seed(self._seed, step, index, "distortion"))
                transformed.append(self._transform(image))
        return torch.stack(transformed)


def _transform(name: str) -> Any:
    """Create a transform of torchvision by its name in the setting `augmentation`."""
    # This import takes a second, and most runs need no transform.
    from torchvision.transforms import v2

    jitter = v2.ColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.1)
    if name == "color_jitter":
        return jitter
    if name == "trivial_augment":
        return v2.TrivialAugmentWide()
    if name == "augmix":
        return v2.AugMix()
    return v2.Compose([jitter, v2.AugMix()])


@torch.enable_grad()
def pgd(
    model: nn.Module,
    images: UInt8[Tensor, "B 3 H W"],
    labels: Int[Tensor, " B"],
    draws: torch.Generator,
    absent: Sequence[int] = (),
) -> UInt8[Tensor, "B 3 H W"]:
    """Attack images by projected gradient descent from a random start (Madry et al. 2018).

    All PGD_STEPS steps are taken, also if an image is misclassified earlier. A negative label is
    complementary: the image shows neither this class nor the classes `absent`.
    """
    clean = to_unit(images)
    clip_to_unit = partial(nearest_in_box, low=0, high=1)
    adversarial = project(PGD, sample(PGD, clean, draws), clean, clip_to_unit)
    with frozen_eval_mode(model):
        for _ in range(PGD_STEPS):
            adversarial.requires_grad_(True)
            cost = -label_loss(model(adversarial), labels, absent=absent).sum()
            (gradient,) = torch.autograd.grad(cost, adversarial)
            adversarial = take_step(PGD, adversarial.detach(), gradient, clean, clip_to_unit)
    return to_bytes(adversarial)
