"""How a network is trained: settings, learning-rate schedules, the loss, averaged weights, baseline augmentations."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from augment import distributed
from augment.attacks.norm_ball import StepSettings
from augment.batches import as_found
from augment.classifiers.adapter import nearest
from augment.losses import divergence, is_right, label_loss, ranking_loss
from augment.random_streams import generator, stream_seed
from renderer.errors import FACTOR, InputError, require_choice, require_range
from renderer.image import to_bytes, to_unit
from renderer.light.basis import nearest_in_box
from train.batches import FLIPS
from train.device import COMPILE

Augment = Callable[[Tensor, Tensor, int], Tensor]  # uint8 images (B, 3, H, W), labels (B,) and the step to images
Loss = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

TRANSFORMS = ("color_jitter", "trivial_augment", "augmix")
OPTIMIZERS = ("sgd", "adamw")
AUGMENTATIONS = ("none", *TRANSFORMS, "pgd")
ALL_BUT_LAST = "all_but_last"  # of train.freeze: only the last layer learns, as in Kirichenko et al. 2023
# Norm-ball and steps of `pgd`. Madry et al. 2018 have a radius of 8/255 on
# CIFAR-10.
PGD = StepSettings(norm="linf", radius=2 / 255, step="sign", step_size=1 / 255)
PGD_STEPS = 3
LARGEST = dict(
    epochs=10**6, images_per_epoch=10**9, batch_size=10**6, accumulate=10**6, checkpoint_every=10**6, threads=1024
)

# Factors of the learning rate at a fraction of the training: ×0.2 at 30, 60 and 80 % (Zagoruyko and Komodakis 2016: at
# epochs 60, 120 and 160 of 200); half a cosine; up over the first fifth and down, the most from a few epochs.
SCHEDULES: dict[str, Callable[[float], float]] = {
    "step": lambda done: 0.2 ** sum(done >= milestone for milestone in (0.3, 0.6, 0.8)),
    "cosine": lambda done: (1 + math.cos(math.pi * done)) / 2,
    "one_cycle": lambda done: 0.1 + 0.9 * done / 0.2 if done < 0.2 else (1 - done) / 0.8,
}


@dataclass
class TrainSettings:
    """The defaults are the paper's recipe; conf/train.yaml says what each key does."""

    init_from: str | None = None
    epochs: int = 150
    images_per_epoch: int | None = None
    batch_size: int = 128
    accumulate: int = 1
    optimizer: str = "sgd"
    learning_rate: float = 0.125
    momentum: float = 0.9
    weight_decay: float = 5e-4
    clip_gradient: float | None = None
    freeze: str | None = None
    schedule: str = "step"
    flips: str = "random"
    augmentation: str = "none"
    label_smoothing: float = 0.0
    ranking: float = 0.0
    distillation: float = 0.0
    ema_decay: float = 0.0
    soup: bool = False
    eval_mode: bool | None = None
    precision: str = "auto"
    device: str = "auto"
    threads: int | None = None
    compile: str = "auto"
    deterministic: bool = False
    checkpoint_every: int = 1
    resume: bool = False
    cache: str | None = "auto"

    def __post_init__(self) -> None:
        choices = {"schedule": SCHEDULES, "flips": FLIPS, "augmentation": AUGMENTATIONS}
        for name, known in {**choices, "compile": COMPILE, "optimizer": OPTIMIZERS}.items():
            require_choice(name, getattr(self, name), known)
        for name, largest in LARGEST.items():
            require_range(name, getattr(self, name), 1, largest)
        for name in ("momentum", "label_smoothing", "ema_decay"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name}={getattr(self, name)} must be at least 0 and below 1")
        for name in ("ranking", "distillation", "weight_decay"):
            require_range(name, getattr(self, name), 0, FACTOR)
        if (self.distillation or self.soup or self.eval_mode) and not self.init_from:
            raise InputError("distillation, soup and eval_mode need a network to begin with: set init_from")
        for name in ("learning_rate", "clip_gradient"):
            if (value := getattr(self, name)) is not None and not 0 < value <= FACTOR:
                raise InputError(f"{name}={value} must be positive and at most {FACTOR:g}")

    def rate(self, done: float) -> float:
        """The learning rate where that fraction of the training is done."""
        return self.learning_rate * SCHEDULES[self.schedule](done)


def build_optimizer(model: nn.Module, settings: TrainSettings) -> torch.optim.Optimizer:
    """SGD with Nesterov's momentum, as the paper's, which decays all weights; or AdamW (Loshchilov and Hutter 2019),
    which does not decay biases and the weights of norms, as is usual with it, and has its own two momenta."""
    rate, decay = settings.learning_rate, settings.weight_decay
    if settings.optimizer == "sgd":
        nesterov = settings.momentum > 0
        options: dict[str, Any] = {"momentum": settings.momentum, "weight_decay": decay, "nesterov": nesterov}
        return torch.optim.SGD(model.parameters(), rate, **options, fused=True)
    groups: tuple[list[Tensor], list[Tensor]] = [], []
    for parameter in model.parameters():
        groups[parameter.ndim > 1].append(parameter)
    decays = ({"params": group, "weight_decay": decay * index} for index, group in enumerate(groups))
    return torch.optim.AdamW(decays, rate, fused=True)


def freeze(network: nn.Module, stage: str) -> None:
    """Let the parameters of a network stay as they are, from its first one to the last of the module of that name, or
    to the one before its last layer (ALL_BUT_LAST). InputError: there is no such module, or it has none."""
    names = [name for name, _ in network.named_parameters()]
    if stage == ALL_BUT_LAST:
        frozen = [index for index, name in enumerate(names) if name.rpartition(".")[0] != names[-1].rpartition(".")[0]]
    else:
        frozen = [index for index, name in enumerate(names) if name.startswith(f"{stage}.")]
    if not frozen:
        parts = nearest(stage, sorted({name.rpartition(".")[0] for name in names}))
        raise InputError(f"train.freeze={stage} is no part of the network: choose one, such as {parts}")
    for parameter in list(network.parameters())[: frozen[-1] + 1]:
        parameter.requires_grad_(False)


def training_loss(
    model: nn.Module, settings: TrainSettings, studied: Sequence[int], teacher: nn.Module | None, labeled: bool = True
) -> Loss:
    """A function of uint8 images (B, 3, H, W), labels (B,) and which are renders, (B,) bool: the loss, and how many
    predictions are correct.

    The loss is the mean `label_loss` plus, by their weights, the mean `ranking_loss` of the classes `studied` and the
    `divergence` from the teacher's predictions: on renders, of all classes but these, or none without any. Unless the
    data are labeled, only renders have a `label_loss`, and the teacher's answers are the others' labels.
    """

    def loss_and_hits(images: Tensor, labels: Tensor, rendered: Tensor) -> tuple[Tensor, Tensor]:
        logits = model(to_unit(images))
        if teacher is not None:
            with torch.no_grad():
                targets = teacher(to_unit(images))
            if not labeled:
                labels = torch.where(rendered, labels, targets.argmax(1))
        losses = label_loss(logits, labels, settings.label_smoothing, studied[1:])
        loss = (losses if labeled else losses * rendered).mean()
        if teacher is not None:
            changed = divergence(logits, targets) * ~rendered
            if studied:
                classes = torch.arange(logits.shape[1], device=logits.device)
                kept = torch.stack([classes != label for label in studied]).all(0)
                changed = changed + divergence(logits[:, kept], targets[:, kept]) * rendered
            loss = loss + settings.distillation * changed.mean()
        if studied and settings.ranking:
            ranked = sum(ranking_loss(logits, labels, label) for label in studied)
            loss = loss + settings.ranking * ranked / len(studied)
        return loss, is_right(logits.detach().argmax(1), labels, studied[1:]).sum()

    return loss_and_hits


def augmentation(name: str, model: nn.Module, seed: int, absent: Sequence[int] = ()) -> Augment:
    """One of `AUGMENTATIONS`: PGD against the model's `label_loss`, which takes `absent`; or a transform of
    torchvision's, the jitter at half the strengths of Chen et al. 2020, as is usual for small images. The draws for an
    image depend on seed, step and its index."""
    if name == "none":
        return lambda images, labels, step: images
    if name == "pgd":
        return lambda images, labels, step: pgd(
            model, images, labels, generator(seed, step, "pgd", distributed.rank()), absent
        )
    from torchvision.transforms import v2  # takes a second, as wherever torchvision is imported where it is used

    jitter = v2.ColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.1)
    transform = {"color_jitter": jitter, "trivial_augment": v2.TrivialAugmentWide(), "augmix": v2.AugMix()}[name]

    def transform_each(images: Tensor, labels: Tensor, step: int) -> Tensor:
        """torchvision's transforms draw once for a whole batch, and from the global generator."""
        transformed = []
        with torch.random.fork_rng(devices=[images.device] if images.is_cuda else []):
            for index, image in enumerate(images, distributed.rank() * len(images)):
                torch.manual_seed(stream_seed(seed, step, index, "distortion"))
                transformed.append(transform(image))
        return torch.stack(transformed)

    return transform_each


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
    (`StepSettings.take_step`), without a criterion to stop at.

    Args:
        model: Classifier of images in [0, 1], which is in eval mode meanwhile.
        images: Images, shape (B, 3, H, W), uint8.
        labels: Labels, shape (B,); see `augment.losses.label_loss`.
        draws: CPU generator of the random start.
        absent: Further classes that no image of a complementary label shows.

    Returns:
        Images within the norm-balls of `PGD`, rounded to 8 bits,
        shape (B, 3, H, W), uint8.
    """
    clean = to_unit(images)
    possible = partial(nearest_in_box, low=0, high=1)
    adversarial = PGD.project(PGD.sample(clean, draws), clean, possible)
    with as_found(model):
        for _ in range(PGD_STEPS):
            adversarial.requires_grad_(True)
            cost = -label_loss(model(adversarial), labels, absent=absent).sum()
            (gradient,) = torch.autograd.grad(cost, adversarial)
            adversarial = PGD.take_step(adversarial.detach(), gradient, clean, possible)
    return to_bytes(adversarial)
