"""The networks that are trained: a WideResNet, torchvision's, or a Python function's."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment import distributed
from augment.classifiers import build_classifier
from augment.classifiers.adapter import Normalized, call_python
from augment.classifiers.sources import require_architecture
from augment.model_passes import eval_mode
from renderer.errors import InputError, in_one_line
from train.settings import WIDERESNET

TORCHVISION, PYTHON = "torchvision:", "python:"
# The version of the description of a network. Version 1 had no size, normalization and encoding.
VERSION = 2
DEEPEST, MOST_PARAMETERS = 1000, 1e9  # 4 GB; a checkpoint from elsewhere may ask for anything
DROPOUT_LEVELS = 2**16
Color = Sequence[float]  # (3,) RGB
MEAN, STD = (0.5, 0.5, 0.5), (0.25, 0.25, 0.25)  # where those of the data are not given
CLASSIFIER = "classifier"  # of a description: of a network that began as one of `augment.classifiers`
_OPTIONS = {name: {"aux_logits": False, "init_weights": True} for name in ("googlenet", "inception_v3")}


class WideResNet(nn.Module):
    """WRN-depth-width (Zagoruyko and Komodakis 2016) for small images; WRN-16-4 has 2.77 M parameters for 100 classes.

    Takes (N, 3, H, W) RGB in [0, 1], normalizes with the data's own mean and std inside, gives logits (N, classes).
    depth is 6n + 4: n blocks of two convolutions in each of three groups.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, classes: int, depth: int = 16, width: int = 4, dropout: float = 0.3, mean: Color = MEAN, std: Color = STD
    ):
        super().__init__()
        parameters = 9 * (depth - 4) // 3 * width**2 * 16**2 * (1 + 4 + 16)
        if depth < 10 or (depth - 4) % 6 or width < 1:
            raise InputError(f"model.depth={depth}, model.width={width}: depth is 10, 16, 22, ... and width at least 1")
        if depth > DEEPEST or parameters > MOST_PARAMETERS:
            raise InputError(f"model.depth={depth}, model.width={width}: {parameters:.1g} parameters are too many")
        if not 0 <= dropout < 1:
            raise InputError(f"model.dropout={dropout} must be at least 0 and below 1")
        channels, blocks = [16, 16 * width, 32 * width, 64 * width], (depth - 4) // 6
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        self.stem = nn.Conv2d(3, channels[0], 3, padding=1, bias=False)
        self.groups = nn.Sequential()
        for index in range(3):
            group = [_Block(channels[index], channels[index + 1], 2 if index else 1, dropout)]
            group += [_Block(channels[index + 1], channels[index + 1], 1, dropout) for _ in range(blocks - 1)]
            self.groups.append(nn.Sequential(*group))
        self.norm = nn.BatchNorm2d(channels[3])
        self.head = nn.Linear(channels[3], classes)
        self.apply(_initialize)

    def forward(self, images: Tensor) -> Tensor:
        features = self.groups(self.stem((images - self.mean) / self.std))
        return self.head(F.relu(self.norm(features)).mean((2, 3)))


class _Block(nn.Module):
    """Pre-activation: norm, ReLU, convolution, twice, with dropout between; the shortcut starts after the ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int, dropout: float):
        super().__init__()
        self.norm1 = nn.BatchNorm2d(inputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(outputs)
        self.dropout = Dropout(dropout)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        changed = inputs != outputs or stride > 1
        self.shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False) if changed else None

    def forward(self, x: Tensor) -> Tensor:
        activated = F.relu(self.norm1(x))
        shortcut = x if self.shortcut is None else self.shortcut(activated)
        hidden = self.conv1(activated)
        return self.conv2(self.dropout(F.relu(self.norm2(hidden)))) + shortcut


def _initialize(module: nn.Module) -> None:
    """He initialization (He et al. 2015)."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    elif isinstance(module, nn.Linear):
        nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
        nn.init.zeros_(module.bias)


class Dropout(nn.Dropout):
    """`nn.Dropout`; on a CPU p is rounded to 2⁻¹⁶, since torch's own draws there take a third of a training step.

    Several processes draw for the whole batch, of which each has an equal shard, and take their own part.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.p == 0:
            return x
        if x.device.type == "cpu":
            return x * self._drawn_by_numpy(x)
        if distributed.world_size() == 1:
            return super().forward(x)
        whole_batch = torch.rand(distributed.world_size(), *x.shape, device=x.device)
        return x * (whole_batch[distributed.rank()] >= self.p) / (1 - self.p)

    def _drawn_by_numpy(self, x: Tensor) -> Tensor:
        """0 or 1 / (1 - p) for each value, in x's memory layout: 16 bits each, from a generator that torch seeds."""
        shard, whole_batch = x.numel(), x.numel() * distributed.world_size()
        generator = np.random.Generator(np.random.SFC64(int(torch.randint(2**63 - 1, (1,)))))
        words = generator.integers(0, 2**64 - 1, -(-whole_batch // 4), dtype=np.uint64, endpoint=True)
        bits = torch.from_numpy(words.view(np.int16))[distributed.rank() * shard :][:shard]
        dropped = round(self.p * DROPOUT_LEVELS)
        passed = bits.ge_(dropped - DROPOUT_LEVELS // 2)  # in place: int16 converts five times faster than bool
        factors = torch.empty_like(x)  # dense, so that its storage can be filled in order
        factors.as_strided((shard,), (1,)).copy_(passed).mul_(DROPOUT_LEVELS / (DROPOUT_LEVELS - dropped))
        return factors


def build_network(
    classes: Sequence[str],
    size: int,
    name: str = WIDERESNET,
    mean: Color = MEAN,
    std: Color = STD,
    classifier: bool = False,
    **shape: Any,
) -> nn.Module:
    """A network with fresh weights from images (N, 3, size, size), RGB in [0, 1], to logits of the classes.

    name: wideresnet, which alone has a shape (depth, width, dropout), torchvision:NAME, or
    python:package.module:function, a function that returns (module, size, classes) and whose module normalizes by
    itself. mean, std: the data's. classifier: the name is one that `augment.build_classifier` takes. InputError where
    there is no such network, or it does not take the data.
    """
    if classifier:
        return cast(nn.Module, build_classifier(name, size).function).requires_grad_(True)
    if name == WIDERESNET:
        return WideResNet(len(classes), **shape, mean=mean, std=std)
    if name.startswith(PYTHON):
        network, its_size, its_classes = call_python(name.removeprefix(PYTHON), f"model={name}")
        if its_size != size:
            raise InputError(f"model={name} is for images of {its_size} pixels per side, and the data has {size}")
        if list(its_classes) != list(classes):
            raise InputError(f"model={name} has other classes than the data, or in another order: {classes[0]!r} first")
    elif name.startswith(TORCHVISION):
        architecture = name.removeprefix(TORCHVISION)
        require_architecture(architecture, f"model={name}")
    else:
        raise InputError(f"model={name}: choose {WIDERESNET}, {TORCHVISION}NAME or {PYTHON}MODULE:FUNCTION")
    try:
        if name.startswith(TORCHVISION):
            from torchvision import models

            options = {"image_size": size} if architecture.startswith("vit_") else _OPTIONS.get(architecture, {})
            network = models.get_model(architecture, weights=None, num_classes=len(classes), **options)
            network = Normalized(network, mean, std)
        with eval_mode(network), torch.no_grad():
            logits = network(torch.zeros(2, 3, size, size))
        if logits.shape != (2, len(classes)):
            raise ValueError(f"it returned {tuple(logits.shape)} for 2 images")
    except (RuntimeError, ValueError, AssertionError, TypeError, AttributeError) as error:
        task = f"{len(classes)} logits for images of {size} pixels per side"
        raise InputError(f"model={name} does not give {task} ({in_one_line(error)}): choose another") from error
    return network


def describe(network: nn.Module, classes: Sequence[str], size: int, encoding: str, **shape: Any) -> dict[str, Any]:
    """The description that is stored with the weights, so that a network can be used without its run's configuration:
    with `shape`, the network's own settings, and its normalization, unless the network's own code has it."""
    statistics = {name: getattr(network, name).flatten().tolist() for name in ("mean", "std") if hasattr(network, name)}
    return {"version": VERSION, "classes": list(classes), "size": size, "encoding": encoding, **shape, **statistics}
