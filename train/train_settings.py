"""Settings of the recipe of a training, and of the architecture. See `renderer.settings`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from renderer.errors import MAX_SCALE
from renderer.settings import Settings, setting

# Default of model.name.
WIDERESNET = "wideresnet"
# Training settings that need a network with whose weights the training begins.
NEEDS_INITIAL = ("distillation_weight", "soup", "eval_mode", "consistency_weight", "interpolate")
# Value of train.freeze with which only the last layer is trained, as by Kirichenko
# et al. (2023).
ALL_BUT_LAST = "all_but_last"
# Choices of train.augmentation that are transforms of torchvision.
TRANSFORMS = (
    *("color_jitter", "exposure_jitter", "trivial_augment", "augmix", "color_jitter+augmix"),
)
# Augmentation by the light of a projector; see `train.training.augmentations`.
RELIGHT = "relight"
# Augmentation by low light with the noise of a camera, alone or for every second image.
LOW_LIGHT, RELIGHT_AND_LOW_LIGHT = "low_light", "relight+low_light"
# Choices of train.augmentation.
AUGMENTATIONS = ("none", *TRANSFORMS, "pgd", RELIGHT, LOW_LIGHT, RELIGHT_AND_LOW_LIGHT)
# Choices of train.optimizer.
OPTIMIZERS = ("sgd", "adamw")
# Choices of train.flips.
FLIPS = ("random", "alternating")
# Choices of train.schedule.
SCHEDULES = ("step", "cosine", "one_cycle")


def weight(term: str) -> Any:
    """Create a field for the weight of a term of the loss, by default 0."""
    return setting(0.0, f"Weight of {term}", within=(0, MAX_SCALE))


@dataclass
class ModelSettings(Settings):
    """Settings of the architecture of the network to train."""

    name: str = setting(WIDERESNET, "wideresnet, torchvision:NAME or python:module:function.")
    depth: int = setting(16, "Depth of the WideResNet.")
    width: int = setting(4, "Width of the WideResNet.")
    dropout: float = setting(0.3, "Dropout of the WideResNet.", minimum=0, below=1)

    @property
    def shape(self) -> dict[str, Any]:
        """Arguments of `build_network` that build the network. They are stored with its weights."""
        if self.name == WIDERESNET:
            return {"depth": self.depth, "width": self.width, "dropout": self.dropout}
        return {"name": self.name}


@dataclass
class TrainSettings(Settings):
    """Settings of the training of the network. The defaults are those of the paper."""

    epochs: int = setting(150, "Number of passes over the training images.", within=(1, 10**6))
    images_per_epoch: int | None = setting(
        None, "Number of training images, drawn anew for each epoch. null: all.", within=(1, 10**9)
    )
    batch_size: int = setting(128, "Images per training step.", within=(1, 10**6))
    optimizer: str = setting("sgd", "adamw decays neither biases nor norms.", choices=OPTIMIZERS)
    learning_rate: float = setting(0.125, "Highest learning rate.", above=0, maximum=MAX_SCALE)
    feature_norm: float | None = setting(
        None, "Norm of features that this rate is for. null: any norm.", above=0, maximum=MAX_SCALE
    )
    momentum: float = setting(0.9, "Nesterov momentum.", minimum=0, below=1)
    weight_decay: float = setting(5e-4, "Weight decay.", within=(0, MAX_SCALE))
    clip_gradient: float | None = setting(
        None, "Largest norm of the gradient of a batch. null: any.", above=0, maximum=MAX_SCALE
    )
    freeze: str | None = setting(
        None, "Last module that stays as is. all_but_last: only the last layer learns. null: none."
    )
    schedule: str = setting("step", "step: times 0.2 at 30%, 60% and 80%.", choices=SCHEDULES)
    flips: str = setting("random", "Flips of random images, or in alternate epochs.", choices=FLIPS)
    augmentation: str = setting(
        "none",
        "relight: light of a projector. low_light: few photons. relight+low_light: both in turn.",
        choices=AUGMENTATIONS,
    )
    relight_gain: float = setting(
        3.0, "Largest factor of a channel for relight, and 1 / the smallest.", within=(1, 100)
    )
    relight_steps: int = setting(
        0, "Gradient steps that find the factors. 0: random factors.", within=(0, 1000)
    )
    label_smoothing: float = setting(0.0, "Label smoothing.", minimum=0, below=1)
    ranking_weight: float = weight("the loss that ranks `label` above other classes.")
    distillation_weight: float = weight("the divergence from the predictions of `network`.")
    consistency_weight: float = weight("the same divergence on augmented images.")
    interpolate: bool = setting(False, "Mix weights before and after by validation (WiSE-FT).")
    ema_decay: float = setting(0.0, "Decay of averaged weights. 0: none.", minimum=0, below=1)
    soup: bool = setting(False, "Keep the mean of all epochs, which all start with `network`.")
    eval_mode: bool | None = setting(
        None, "Train with statistics of `network`, no dropout. null: true for other libraries."
    )
    precision: str = setting("auto", "bfloat16, float16, float32, or auto: by the hardware.")
    device: str = setting("auto", "auto, cpu, cuda or cuda:N.")
    threads: int | None = setting(
        None, "CPU threads. null: all cores, or one for small batches.", within=(1, 1024)
    )
    compile: str = setting(
        "auto", "Compile the training step. auto: on one GPU.", choices=("auto", "always", "never")
    )
    deterministic: bool = setting(False, "Compute the same bits every time on a GPU, too.")
    checkpoint_every: int = setting(1, "Epochs between checkpoints.", within=(1, 10**6))
    resume: bool = setting(False, "Resume from the last checkpoint in `out`.")
    cache: str | None = setting("auto", "Folder of rendered data sets. null: none.")

    def __post_init__(self) -> None:
        """Check all values, and that attacked images have a loss."""
        super().__post_init__()
        if self.relight_steps and not self.consistency_weight:
            raise self.wrong("relight_steps", "needs a consistency loss: set its weight")
