"""Build the networks that are trained.

A network is a WideResNet, an architecture of torchvision, or the result of a
Python function.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from augment import distributed
from augment.files import NetworkFacts
from augment.network import ChannelNormalization, Network, eval_mode, plain_outputs
from augment.settings import PYTHON
from augment.sources import build_torchvision, call_python, load_source
from renderer.errors import InputError, explained
from renderer.settings import Size
from train.settings import WIDERESNET

# The name of a network begins with this text if it is an architecture of torchvision.
TORCHVISION = "torchvision:"
# Name of the detector that is published with the library.
DETECTOR = "small_detector"
# Version of the description that is stored with the weights of a network. Version 1
# lacked the size and the normalization of images, and the encoding of renders.
VERSION = 2
# Largest number of parameters of a WideResNet. A file from elsewhere can ask for any depth and
# width, and 1e9 parameters take 4 GB.
MAX_PARAMETER_COUNT = 1e9
# Three numbers: red, green and blue.
Color = Sequence[float]
# Default mean and standard deviation of the pixels of the data, in red, green and blue.
MEAN = (0.5, 0.5, 0.5)
STD = (0.25, 0.25, 0.25)
# Key in the description of a network. It is True if `augment.sources.load_source` built
# the network.
CLASSIFIER = "classifier"


class WideResNet(nn.Module):
    """Wide residual network for small images (Zagoruyko and Komodakis 2016).

    The network WRN-depth-width has three groups of n blocks, where the depth is
    6n + 4. A block has two convolutions. WRN-16-4 has 2.77 million parameters
    for 100 classes. The network normalizes its input itself.
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

        The depth is 10, 16, 22 and so on. `mean` and `std` are of RGB images in [0, 1].
        """
        super().__init__()
        # Each group has (depth - 4) / 6 blocks. A block has two 3 × 3 convolutions, whose weights
        # are most of the parameters. The groups have 16, 32 and 64 times `width` channels.
        parameter_count = (depth - 4) // 6 * 2 * 3 * 3 * (16**2 + 32**2 + 64**2) * width**2
        if depth < 10 or (depth - 4) % 6 or width < 1 or parameter_count > MAX_PARAMETER_COUNT:
            advice = f"set depth to 10, 16 ..., and at most {MAX_PARAMETER_COUNT:.0g} parameters"
            raise InputError(f"depth={depth}, width={width}: {advice}", "depth")
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        self.stem = nn.Conv2d(3, 16, 3, padding=1, bias=False)
        self.groups = nn.Sequential()
        inputs = 16
        # The first group keeps the resolution, and each other group halves it.
        for outputs, stride in ((16 * width, 1), (32 * width, 2), (64 * width, 2)):
            blocks = [_Block(inputs, outputs, stride, dropout)]
            # A network of depth 6n + 4 has n blocks in each group.
            blocks += [_Block(outputs, outputs, 1, dropout) for _ in range((depth - 4) // 6 - 1)]
            self.groups.append(nn.Sequential(*blocks))
            inputs = outputs
        self.norm = nn.BatchNorm2d(inputs)
        self.head = nn.Linear(inputs, classes)
        self.apply(_initialize)

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N classes"]:
        """Classify RGB images in [0, 1]."""
        features = self.groups(self.stem((images - self.mean) / self.std))
        return self.head(F.relu(self.norm(features)).mean((2, 3)))


class _Block(nn.Module):
    """Residual block of a WideResNet.

    It has two convolutions with dropout between them. A batch norm and a ReLU
    precede each convolution. If the number of channels or the resolution
    changes, the shortcut is a 1 × 1 convolution after the first ReLU.
    """

    def __init__(self, inputs: int, outputs: int, stride: int, dropout: float):
        """Build a block with random weights."""
        super().__init__()
        self.norm1 = nn.BatchNorm2d(inputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(outputs)
        self.dropout = Dropout(dropout)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        is_changed = inputs != outputs or stride > 1
        self.shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False) if is_changed else None

    def forward(self, x: Float[Tensor, "N inputs H W"]) -> Float[Tensor, "N outputs _ _"]:
        """Compute the output features of the block."""
        activated = F.relu(self.norm1(x))
        shortcut = x if self.shortcut is None else self.shortcut(activated)
        hidden = self.conv1(activated)
        return self.conv2(self.dropout(F.relu(self.norm2(hidden)))) + shortcut


def _initialize(module: nn.Module) -> None:
    """Initialize the weights of a convolution or a linear layer at random (He et al. 2015)."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    elif isinstance(module, nn.Linear):
        nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
        nn.init.zeros_(module.bias)


class Dropout(nn.Dropout):
    """Dropout whose result is the same for any number of processes.

    Each process draws the random numbers of the whole batch, and uses those of its own part.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Set random values to 0, and scale the others by 1 / (1 - p)."""
        if not self.training or self.p == 0:
            return x
        draws = torch.rand(distributed.world_size(), *x.shape, device=x.device)
        return x * (draws[distributed.rank()] >= self.p) / (1 - self.p)


def build_network(
    classes: Sequence[str],
    size: int,
    name: str = WIDERESNET,
    mean: Color | None = None,
    std: Color | None = None,
    classifier: bool = False,
    trust_code: bool = False,
    **shape: Any,
) -> nn.Module:
    """Build a network that maps images (N, 3, size, size), RGB in [0, 1], to logits.

    The name is "wideresnet", "torchvision:NAME", "python:MODULE:FUNCTION" or, with `classifier`, a
    pretrained network of `augment.sources.load_source`. "small_detector" finds boxes, see
    `train.detectors`. If mean and std are None, they are 0.5 and 0.25. A network of Python
    normalizes images itself. `shape` is for "wideresnet".
    """
    if classifier:
        facts = NetworkFacts(classes, size, None if mean is None or std is None else (mean, std))
        built = load_source(name, None, facts, trust_code, is_random=True)
        return built.network.requires_grad_(True)
    if name == DETECTOR:
        # torchvision's detectors are imported when they are needed, because that takes a second.
        from train.detectors import small_detector

        return small_detector(len(classes), size)
    mean, std = mean or MEAN, std or STD
    if name == WIDERESNET:
        return WideResNet(len(classes), **shape, mean=mean, std=std)
    if not name.startswith((PYTHON, TORCHVISION)):
        choices = f"{WIDERESNET}, {TORCHVISION}NAME or {PYTHON}MODULE:FUNCTION"
        raise InputError(f"name={name}: choose {choices}", "name")
    fault = f"name={name} does not give {len(classes)} logits for images of {size} pixels per side"
    # Architectures raise errors of many types if images are too small for them.
    with explained(fault, "choose others", "name"):
        if name.startswith(PYTHON):
            network = _call_function(name, classes, size)
        else:
            # Networks of torchvision take normalized images, so a layer before them normalizes.
            model = name.removeprefix(TORCHVISION)
            built = build_torchvision(model, len(classes), size, init_weights=True)
            network = Network(built, [ChannelNormalization(mean, std)])
        with eval_mode(network), torch.no_grad():
            # Two images are tried, since a wrong number of classes is found only here.
            shape_of_two = tuple(plain_outputs(network(torch.zeros(2, 3, size, size))).shape)
        if shape_of_two != (2, len(classes)):
            raise ValueError(f"it returned {shape_of_two} for 2 images")
    return network


def _call_function(name: str, classes: Sequence[str], size: int) -> nn.Module:
    """Call a Python function of the user that builds a network."""
    network, own_size, own_classes = call_python(name.removeprefix(PYTHON))
    if not isinstance(network, nn.Module):
        raise InputError(f"name={name} returns no torch.nn.Module: return one", "name")
    if own_size != size or list(own_classes) != list(classes):
        fault = f"is for {own_size} pixels per side and classes such as {own_classes[0]!r}"
        raise InputError(f"name={name} {fault}: return the size and classes of the data", "name")
    return network


def describe(
    network: nn.Module, classes: Sequence[str], size: Size, encoding: str, **shape: Any
) -> dict[str, Any]:
    """Describe a network by the arguments with which `build_network` builds it again.

    The description is stored with the weights of the network.
    """
    facts = {"version": VERSION, "classes": list(classes), "size": size, "encoding": encoding}
    # A network normalizes images itself, or by its last transform.
    owner = network
    if isinstance(network, Network) and network.transforms:
        owner = network.transforms[-1]
    names = [name for name in ("mean", "std") if hasattr(owner, name)]
    return facts | shape | {name: getattr(owner, name).flatten().tolist() for name in names}
