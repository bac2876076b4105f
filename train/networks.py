"""Build the networks that are trained.

A network is a WideResNet, an architecture of torchvision, or the result of a
Python function.
"""

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
from renderer.errors import InputError, single_line
from train.settings import WIDERESNET

# Start of the name of an architecture of torchvision.
TORCHVISION = "torchvision:"
# Start of the name of a Python function.
PYTHON = "python:"
# Version of the description that is stored with the weights of a network.
# Version 1 had no size, normalization and encoding.
VERSION = 2
# Largest depth and largest number of parameters of a WideResNet. A file from
# elsewhere can ask for any depth and width, and 1e9 parameters take 4 GB.
MAX_DEPTH = 1000
MAX_PARAMETER_COUNT = 1e9
# Dropout on a CPU draws integers of 16 bits.
DROPOUT_LEVELS = 2**16
# RGB, shape (3,).
Color = Sequence[float]
# Mean and standard deviation of the data, if they are not given.
MEAN = (0.5, 0.5, 0.5)
STD = (0.25, 0.25, 0.25)
# Key in the description of a network that `augment.build_classifier` built.
CLASSIFIER = "classifier"
# Arguments of architectures of torchvision. Auxiliary classifiers would return
# several outputs.
_OPTIONS = {
    "googlenet": {"aux_logits": False, "init_weights": True},
    "inception_v3": {"aux_logits": False, "init_weights": True},
}


class WideResNet(nn.Module):
    """Wide residual network for small images (Zagoruyko and Komodakis 2016).

    The network WRN-depth-width has three groups of n blocks, where the depth is
    6n + 4. A block has two convolutions. WRN-16-4 has 2.77 million parameters
    for 100 classes. The network normalizes its input itself.

    Example:
        >>> WideResNet(classes=100)(torch.zeros(2, 3, 32, 32)).shape
        torch.Size([2, 100])
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        classes: int,
        depth: int = 16,
        width: int = 4,
        dropout: float = 0.3,
        mean: Color = MEAN,
        std: Color = STD,
    ):
        """Build a network with random weights.

        Args:
            classes: Number of classes.
            depth: Number of layers: 10, 16, 22 and so on.
            width: Factor of the number of channels, at least 1.
            dropout: Probability of dropout in each block, in [0, 1).
            mean: Mean of the data, RGB, for images in [0, 1].
            std: Standard deviation of the data, RGB.

        Raises:
            InputError: If an argument is outside its range, or if the network
                would have too many parameters.
        """
        super().__init__()
        _require_shape(depth, width, dropout)
        channels = [16, 16 * width, 32 * width, 64 * width]
        block_count = (depth - 4) // 6
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        self.stem = nn.Conv2d(3, channels[0], 3, padding=1, bias=False)
        self.groups = nn.Sequential()
        for index in range(3):
            inputs = channels[index]
            outputs = channels[index + 1]
            stride = 2 if index else 1
            blocks = [_Block(inputs, outputs, stride, dropout)]
            blocks += [_Block(outputs, outputs, 1, dropout) for _ in range(block_count - 1)]
            self.groups.append(nn.Sequential(*blocks))
        self.norm = nn.BatchNorm2d(channels[3])
        self.head = nn.Linear(channels[3], classes)
        self.apply(_initialize)

    def forward(self, images: Tensor) -> Tensor:
        """Classify images.

        Args:
            images: RGB in [0, 1], shape (N, 3, H, W).

        Returns:
            Logits, shape (N, classes).
        """
        features = self.groups(self.stem((images - self.mean) / self.std))
        return self.head(F.relu(self.norm(features)).mean((2, 3)))


def _require_shape(depth: int, width: int, dropout: float) -> None:
    """Raise InputError if a WideResNet cannot have the depth, the width or the dropout."""
    given = f"depth={depth}, width={width}"
    # The weights of the 3 × 3 convolutions, which are most of the parameters.
    # Each group has two convolutions in each of (depth - 4) / 6 blocks. The channels
    # of the groups are 16, 32 and 64 times the width, with the squares 16² · (1, 4, 16).
    parameter_count = 9 * (depth - 4) // 3 * width**2 * 16**2 * (1 + 4 + 16)
    if depth < 10 or (depth - 4) % 6 or width < 1:
        raise InputError(f"{given}: depth is 10, 16, 22, ... and width at least 1", "depth")
    if depth > MAX_DEPTH or parameter_count > MAX_PARAMETER_COUNT:
        raise InputError(f"{given}: {parameter_count:.1g} parameters are too many", "depth")
    if not 0 <= dropout < 1:
        raise InputError(f"dropout={dropout} must be at least 0 and below 1", "dropout")


class _Block(nn.Module):
    """Residual block with two convolutions, each after a batch norm and a ReLU.

    The dropout stands between the convolutions. If the shape changes, the
    shortcut has a convolution after the first ReLU.
    """

    def __init__(self, inputs: int, outputs: int, stride: int, dropout: float):
        super().__init__()
        self.norm1 = nn.BatchNorm2d(inputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(outputs)
        self.dropout = Dropout(dropout)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.shortcut: nn.Module | None = None
        if inputs != outputs or stride > 1:
            self.shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Transform features (N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        activated = F.relu(self.norm1(x))
        shortcut = x if self.shortcut is None else self.shortcut(activated)
        hidden = self.conv1(activated)
        return self.conv2(self.dropout(F.relu(self.norm2(hidden)))) + shortcut


def _initialize(module: nn.Module) -> None:
    """Initialize the weights of a layer at random (He et al. 2015)."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    elif isinstance(module, nn.Linear):
        nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
        nn.init.zeros_(module.bias)


class Dropout(nn.Dropout):
    """Dropout that is fast on a CPU and independent of the number of processes.

    On a CPU, the draws of `nn.Dropout` take a third of a training step. Here
    they come from numpy, and the probability is rounded to a multiple of 2⁻¹⁶.
    Each of several processes has an equal shard of the batch. It draws for the
    whole batch and uses the draws of its shard.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Set random values to 0, and scale the others by 1 / (1 - p).

        Args:
            x: Features of the shard of this process, of any shape.

        Returns:
            Features of the same shape. In evaluation mode, they are unchanged.
        """
        if not self.training or self.p == 0:
            return x
        if x.device.type == "cpu":
            return x * self._draw_factors(x)
        if distributed.world_size() == 1:
            return super().forward(x)
        draws = torch.rand(distributed.world_size(), *x.shape, device=x.device)
        return x * (draws[distributed.rank()] >= self.p) / (1 - self.p)

    def _draw_factors(self, x: Tensor) -> Tensor:
        """Draw a factor for each value of x: 0 with probability p, otherwise 1 / (1 - p).

        A draw has 16 random bits. The factors have the shape and the memory
        layout of x.
        """
        # All processes draw for the whole batch, and each takes its own part.
        # The draws then do not depend on the number of processes.
        value_count = x.numel()
        batch_value_count = value_count * distributed.world_size()
        # The seed comes from torch, so that `torch.manual_seed` decides the draws.
        seed = int(torch.randint(2**63 - 1, (1,)))
        generator = np.random.Generator(np.random.SFC64(seed))
        # A word of 64 bits has four draws. The division rounds up.
        word_count = -(-batch_value_count // 4)
        words = generator.integers(0, 2**64 - 1, word_count, dtype=np.uint64, endpoint=True)
        draws = torch.from_numpy(words.view(np.int16))
        shard_draws = draws[distributed.rank() * value_count :][:value_count]
        dropped_levels = round(self.p * DROPOUT_LEVELS)
        # The comparison writes 0 or 1 to the draws themselves, because numbers
        # of type int16 convert to float five times faster than bool.
        is_kept = shard_draws.ge_(dropped_levels - DROPOUT_LEVELS // 2)
        # The tensor is dense, so that its storage can be filled in order.
        factors = torch.empty_like(x)
        scale = DROPOUT_LEVELS / (DROPOUT_LEVELS - dropped_levels)
        factors.as_strided((value_count,), (1,)).copy_(is_kept).mul_(scale)
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
    """Build a network that maps images (N, 3, size, size), RGB in [0, 1], to logits.

    Args:
        classes: Names of the classes.
        size: Pixels per side of the images.
        name: "wideresnet", "torchvision:NAME" or "python:MODULE:FUNCTION". The
            Python function returns a module, the size of its images and its
            classes. This module normalizes images itself.
        mean: Mean of the data, RGB.
        std: Standard deviation of the data, RGB.
        classifier: Whether `name` is a name for `augment.build_classifier`
            instead. Such a network has pretrained weights.
        **shape: `depth`, `width` and `dropout` of "wideresnet".

    Returns:
        Network. All but Python functions and classifiers give random weights.

    Raises:
        InputError: If the name is unknown, or if the network does not take the
            images or has other classes.
    """
    if classifier:
        module = cast(nn.Module, build_classifier(name, size, classes).function)
        return module.requires_grad_(True)
    if name == WIDERESNET:
        return WideResNet(len(classes), **shape, mean=mean, std=std)
    network: nn.Module | None = None
    if name.startswith(PYTHON):
        network = _call_function(name, classes, size)
    elif name.startswith(TORCHVISION):
        require_architecture(name.removeprefix(TORCHVISION))
    else:
        raise InputError(
            f"name={name}: choose {WIDERESNET}, {TORCHVISION}NAME or {PYTHON}MODULE:FUNCTION",
            "name",
        )
    # An architecture can refuse a size in many ways.
    try:
        if network is None:
            architecture = _build_architecture(name.removeprefix(TORCHVISION), len(classes), size)
            network = Normalized(architecture, mean, std)
        _require_logits(network, len(classes), size)
    except (RuntimeError, ValueError, AssertionError, TypeError, AttributeError) as error:
        task = f"{len(classes)} logits for images of {size} pixels per side"
        raise InputError(
            f"name={name} does not give {task} ({single_line(error)}): choose another",
            "name",
        ) from error
    return network


def _call_function(name: str, classes: Sequence[str], size: int) -> nn.Module:
    """Call the Python function that builds a network.

    Args:
        name: "python:MODULE:FUNCTION". The function returns a module, the size
            of its images and its classes.
        classes: Classes that the function must return.
        size: Pixels per side that the function must return.

    Raises:
        InputError: If the function returns no module, or another size or other
            classes.
    """
    network, own_size, own_classes = call_python(name.removeprefix(PYTHON))
    if not isinstance(network, nn.Module):
        raise InputError(f"name={name} returns no torch.nn.Module, which training needs", "name")
    if own_size != size:
        raise InputError(
            f"name={name} is for images of {own_size} pixels per side, and the data has {size}",
            "name",
        )
    if list(own_classes) != list(classes):
        raise InputError(
            f"name={name} has other classes than the data, or in another order: "
            f"{classes[0]!r} first",
            "name",
        )
    return network


def _build_architecture(architecture: str, class_count: int, size: int) -> nn.Module:
    """Build an architecture of torchvision with random weights."""
    from torchvision import models

    options: dict[str, Any] = dict(_OPTIONS.get(architecture, {}))
    if architecture.startswith("vit_"):
        options = {"image_size": size}
    return models.get_model(architecture, weights=None, num_classes=class_count, **options)


def _require_logits(network: nn.Module, class_count: int, size: int) -> None:
    """Raise ValueError if a network does not return logits (2, class_count) for two images."""
    with eval_mode(network), torch.no_grad():
        logits = network(torch.zeros(2, 3, size, size))
    if logits.shape != (2, class_count):
        raise ValueError(f"it returned {tuple(logits.shape)} for 2 images")


def describe(
    network: nn.Module,
    classes: Sequence[str],
    size: int,
    encoding: str,
    **shape: Any,
) -> dict[str, Any]:
    """Describe a network, so that it can be used without the configuration of its run.

    The description is stored with the weights.

    Args:
        network: The network.
        classes: Names of the classes.
        size: Pixels per side of the images.
        encoding: Encoding of the renders that the network was trained with.
        **shape: Settings of the network, such as its name and its depth.

    Returns:
        Values that JSON can hold, with the normalization of the network if its
        attributes `mean` and `std` have it.
    """
    description = {
        "version": VERSION,
        "classes": list(classes),
        "size": size,
        "encoding": encoding,
        **shape,
    }
    for name in ("mean", "std"):
        if hasattr(network, name):
            description[name] = getattr(network, name).flatten().tolist()
    return description
