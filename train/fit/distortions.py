"""What else may be done to every training image, instead of renders or beside them: the usual ways to robustness."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment import utils
from augment.utils import as_found, generator, stream_seed
from renderer.image import to_bytes, to_unit

Distort = Callable[[Tensor, Tensor, int], Tensor]  # uint8 images (B, 3, H, W), labels (B,) and the step to images

TRANSFORMS = ("color_jitter", "trivial_augment", "augmix")
DISTORTIONS = ("none", *TRANSFORMS, "pgd")
RADIUS, STEP, STEPS = 8 / 255, 4 / 255, 3  # of PGD, in the L∞ norm; Madry et al. 2018 take 7 steps of 2/255


def distortion(name: str, model: nn.Module, seed: int) -> Distort:
    """One of `DISTORTIONS`; model: that an adversarial one attacks.

    Every image is changed by draws of its own, which depend on the seed, the step and its place in the global batch
    alone.
    """
    if name == "none":
        return lambda images, labels, step: images
    if name == "pgd":
        return lambda images, labels, step: pgd(model, images, labels, generator(seed, step, "pgd", utils.rank()))
    transform = torchvision_transform(name)
    return lambda images, labels, step: _each(transform, images, seed, step)


def torchvision_transform(name: str) -> nn.Module:
    """One of `TRANSFORMS`, as torchvision has it; the jitter at half the strengths of Chen et al. 2020, as is usual
    for small images."""
    from torchvision.transforms import v2  # takes a second, as wherever torchvision is imported where it is used

    return {
        "color_jitter": v2.ColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.1),
        "trivial_augment": v2.TrivialAugmentWide(),
        "augmix": v2.AugMix(),
    }[name]


@torch.enable_grad()
def pgd(model: nn.Module, images: Tensor, labels: Tensor, draws: torch.Generator) -> Tensor:
    """Images in the L∞ ball around the given ones, by steps along the sign of the loss's gradient from a random start
    (Madry et al. 2018); the model is in eval mode meanwhile."""
    clean = to_unit(images)
    noise = torch.rand(clean.shape, generator=draws).to(clean)
    found = (clean + RADIUS * (2 * noise - 1)).clamp(0, 1)
    with as_found(model):
        for _ in range(STEPS):
            found.requires_grad_(True)
            (gradient,) = torch.autograd.grad(F.cross_entropy(model(found), labels, reduction="sum"), found)
            moved = found.detach() + STEP * gradient.sign()
            found = moved.clamp(clean - RADIUS, clean + RADIUS).clamp(0, 1)
    return to_bytes(found)


def _each(transform: nn.Module, images: Tensor, seed: int, step: int) -> Tensor:
    """torchvision's transforms draw once for a whole batch, and from the global generator."""
    first = utils.rank() * len(images)
    changed = []
    with torch.random.fork_rng(devices=[]):
        for place, image in enumerate(images, first):
            torch.manual_seed(stream_seed(seed, step, place, "distortion"))
            changed.append(transform(image))
    return torch.stack(changed)
