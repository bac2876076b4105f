"""The augmentations that renders are compared with: image transforms, and attacks on pixels."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from augment import distributed
from augment.attacks.norm_ball import project, sample, take_step
from augment.losses import label_loss
from augment.model_passes import frozen_eval_mode
from augment.parameter_settings import StepSettings
from augment.random_streams import generator, stream_seed
from renderer.image import to_bytes, to_unit
from renderer.light.ball import nearest_in_box

# Norm-ball and steps of `pgd`. Madry et al. 2018 have a radius of 8/255 on CIFAR-10.
PGD = StepSettings(norm="linf", radius=2 / 255, step="sign", step_size=1 / 255)
PGD_STEPS = 3


class Baseline:
    """An augmentation of training images.

    Args:
        name: "none"; "pgd", an attack on pixels; or one of torchvision's transforms:
            "color_jitter" (at half the strengths of Chen et al. 2020, as is usual for small
            images), "trivial_augment", "augmix" or "color_jitter+augmix".
        model: The network that PGD attacks.
        seed: The seed of the run.
        absent: Other classes that no image with a complementary label shows. See
            `label_loss`.
    """

    def __init__(self, name: str, model: nn.Module, seed: int, absent: Sequence[int] = ()):
        self._name = name
        self._model = model
        self._seed = seed
        self._absent = absent
        self._transform: Callable[[Tensor], Tensor] | None = None
        if name not in ("none", "pgd"):
            self._transform = _transform(name)

    def apply(self, images: Tensor, labels: Tensor, step: int) -> Tensor:
        """Change the images of a batch.

        The draws for an image depend on the seed, the step and the image's index in the batch.

        Args:
            images: The images, uint8, shape (B, 3, H, W).
            labels: Their classes, shape (B,).
            step: The number of the step in the run.

        Returns:
            The changed images, uint8, shape (B, 3, H, W).
        """
        if self._name == "none":
            return images
        if self._transform is None:
            draws = generator(self._seed, step, "pgd", distributed.rank())
            return pgd(self._model, images, labels, draws, self._absent)
        # torchvision's transforms draw once for a whole batch, and from the global generator.
        transformed = []
        with torch.random.fork_rng(devices=[images.device] if images.is_cuda else []):
            # Index of the first image of this process in the batch of all processes.
            first = distributed.rank() * len(images)
            for index, image in enumerate(images, first):
                torch.manual_seed(stream_seed(self._seed, step, index, "distortion"))
                transformed.append(self._transform(image))
        return torch.stack(transformed)


def _transform(name: str) -> Any:
    """Return the transform of torchvision that a name of `Baseline` stands for."""
    from torchvision.transforms import v2  # torchvision takes a second to import

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
    images: Tensor,
    labels: Tensor,
    draws: torch.Generator,
    absent: Sequence[int] = (),
) -> Tensor:
    """Attack images by projected gradient descent from a random start (Madry et al. 2018).

    The steps are those of an attack on the pixels of a scene
    (`norm_ball.take_step`), without a criterion to stop at.

    Args:
        model: Classifier of images in [0, 1], which is in eval mode meanwhile.
        images: Images, shape (B, 3, H, W), uint8.
        labels: Labels, shape (B,); see `augment.losses.label_loss`.
        draws: CPU generator of the random start.
        absent: Classes that an image with a complementary label certainly does
            not show, besides the class of this label.

    Returns:
        Images within the norm-balls of `PGD`, rounded to 8 bits,
        shape (B, 3, H, W), uint8.
    """
    clean = to_unit(images)
    possible = partial(nearest_in_box, low=0, high=1)
    adversarial = project(PGD, sample(PGD, clean, draws), clean, possible)
    with frozen_eval_mode(model):
        for _ in range(PGD_STEPS):
            adversarial.requires_grad_(True)
            cost = -label_loss(model(adversarial), labels, absent=absent).sum()
            (gradient,) = torch.autograd.grad(cost, adversarial)
            adversarial = take_step(PGD, adversarial.detach(), gradient, clean, possible)
    return to_bytes(adversarial)
