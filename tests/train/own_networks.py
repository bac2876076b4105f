"""A network of ten classes as a user of torchvision would train one."""

from functools import cache

import torch
from torch import Tensor, nn
from torchvision.models import mobilenet_v3_small

import augment

NAME = "mobilenet_v3_small"
SIZE = 32
CLASSES = (
    *("Apple", "ball", "bottle", "cup", "lemon", "mushroom", "Orange", "pear", "plate"),
    "Sweet pepper",
)
MEAN = torch.tensor((0.485, 0.456, 0.406)).view(3, 1, 1)
STD = torch.tensor((0.229, 0.224, 0.225)).view(3, 1, 1)


@cache
def renders() -> Tensor:
    """Return an image of each class in uniform light, shape (10, 3, 32, 32)."""
    images = []
    for name in CLASSES:
        item = (f"solid:{name.lower().replace(' ', '_')}:0", name)
        scene = augment.build_scene([item], SIZE, samples=1)
        example = torch.arange(1)
        images.append(scene.render(scene.conditions(example), example)[0])
    return torch.cat(images)


@cache
def trained_weights() -> dict[str, Tensor]:
    """Fit the last layer of a network of torchvision to the images; return its state dict.

    The other layers are random. The logits of an image are 10 for its class, and otherwise 0.
    """
    torch.manual_seed(0)
    network = mobilenet_v3_small(num_classes=len(CLASSES))
    images = (renders() - MEAN) / STD
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = None  # The statistics are those of the images.
    with torch.no_grad():
        network(images)
        features = network.eval().features(images).mean((2, 3))
        hidden = network.classifier[:3](features).double()
        ones = torch.ones(len(images), 1)
        weights = torch.linalg.pinv(torch.cat([hidden, ones], dim=1)).T * 10
        network.classifier[3].weight.copy_(weights[:, :-1])
        network.classifier[3].bias.copy_(weights[:, -1])
    return network.state_dict()


def trained_network() -> nn.Module:
    """Return the trained network in evaluation mode. It takes normalized images."""
    network = mobilenet_v3_small(num_classes=len(CLASSES))
    network.load_state_dict(trained_weights())
    return network.eval()
