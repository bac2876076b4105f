"""A network of ten classes as a user of torchvision would train one."""

from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchvision.models import mobilenet_v3_small

import augment

NAME = "mobilenet_v3_small"
SIZE = 32
CLASSES = (
    "Apple",
    "ball",
    "bottle",
    "cup",
    "lemon",
    "mushroom",
    "Orange",
    "pear",
    "plate",
    "Sweet pepper",
)
MEAN = torch.tensor((0.485, 0.456, 0.406)).view(3, 1, 1)
STD = torch.tensor((0.229, 0.224, 0.225)).view(3, 1, 1)
VIEWS = 12
STEPS = 40
BATCH = 40


def renders() -> tuple[Tensor, Tensor]:
    """Return images (120, 3, 32, 32) and labels: 12 views of each class in uniform light."""
    images = []
    for name in CLASSES:
        item = (f"solid:{name.lower().replace(' ', '_')}:0", name)
        scene = augment.build_scene([item], SIZE, views=VIEWS)
        examples = torch.arange(len(scene))
        images.append(scene.render(scene.conditions(examples), examples).flatten(0, 1))
    return torch.cat(images), torch.arange(len(CLASSES)).repeat_interleave(VIEWS)


@cache
def trained_weights() -> dict[str, Tensor]:
    """Train a network of torchvision with ten classes on renders; return its state dict."""
    torch.manual_seed(0)
    network = mobilenet_v3_small(num_classes=len(CLASSES))
    images, labels = renders()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            # The statistics then are those of the last steps.
            module.momentum = 0.3
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    for _ in range(STEPS):
        rows = torch.randperm(len(images))[:BATCH]
        exposure = torch.rand(BATCH, 1, 1, 1) + 0.5
        noisy = (images[rows] * exposure + 0.02 * torch.randn(BATCH, 3, SIZE, SIZE)).clamp(0, 1)
        loss = F.cross_entropy(network((noisy - MEAN) / STD), labels[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network.state_dict()


def trained_network() -> nn.Module:
    """Return the trained network in evaluation mode. It takes normalized images."""
    network = mobilenet_v3_small(num_classes=len(CLASSES))
    network.load_state_dict(trained_weights())
    return network.eval()
