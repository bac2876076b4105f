"""Small detectors for tests."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def small_detector(class_count: int, size: int) -> nn.Module:
    """Return a RetinaNet of torchvision with a backbone of two layers and two anchors."""
    from torchvision.models.detection import RetinaNet
    from torchvision.models.detection.anchor_utils import AnchorGenerator
    from torchvision.models.detection.retinanet import RetinaNetHead

    with torch.random.fork_rng():
        torch.manual_seed(0)
        first, second = (nn.Conv2d(*sizes, 3, stride=2, padding=1) for sizes in ((3, 8), (8, 16)))
        backbone = nn.Sequential(first, nn.ReLU(), second, nn.ReLU())
        backbone.out_channels = 16
        options = {
            "anchor_generator": AnchorGenerator(((size / 2, 0.8 * size),), ((1.0,),)),
            "head": RetinaNetHead(16, 2, class_count),
            **{"min_size": size, "max_size": size, "image_mean": [0.5] * 3, "image_std": [1.0] * 3},
        }
        network = RetinaNet(backbone, class_count, **options)
    return network.eval()


class BrightBox(nn.Module):
    """Detector of one class whose only box has the mean of the image as its score."""

    def __init__(self, box: tuple[float, float, float, float], label: int = 1):
        super().__init__()
        self.box = torch.tensor([box])
        self.label = torch.tensor([label])

    def forward(self, images: Tensor) -> list[dict[str, Tensor]]:
        scores = images.mean((1, 2, 3))
        return [{"boxes": self.box, "labels": self.label, "scores": one[None]} for one in scores]


class OneBox(nn.Module):
    """Detector of one object of class 1, whose box and score are linear in 8 × 8 pixels.

    As the detectors of torchvision, it takes targets and returns losses in training mode.
    """

    def __init__(self, size: int):
        super().__init__()
        self.size = size
        self.layer = nn.Linear(3 * 8 * 8, 5)
        nn.init.zeros_(self.layer.weight)
        nn.init.zeros_(self.layer.bias)

    def forward(self, images: Tensor, targets=None) -> Any:
        values = self.layer(F.adaptive_avg_pool2d(images, 8).flatten(1))
        score, ends = values[:, 0], values[:, 1:] + torch.tensor([0.3, 0.3, 0.7, 0.7])
        box = ends.unflatten(1, (2, 2)).sort(1).values.flatten(1)
        if self.training:
            is_shown = torch.tensor([float(len(item["labels"]) > 0) for item in targets])
            loss = {"objectness": F.binary_cross_entropy_with_logits(score, is_shown)}
            for index, item in enumerate(targets):
                for true in item["boxes"]:
                    distance = (box[index] - true / self.size).abs().mean()
                    loss["box"] = loss.get("box", 0) + distance / len(images)
            return loss
        boxes = self.size * box.clamp(0, 1)
        return [
            {"boxes": one[None], "scores": value[None].sigmoid(), "labels": torch.tensor([1])}
            for one, value in zip(boxes, score, strict=True)
        ]


class RawCells(nn.Module):
    """Raw network of 2 × 2 cells, each with the logit of class 1 for a box of half the size."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3 * 2 * 2, 4)
        nn.init.constant_(self.layer.weight, 0.5)
        nn.init.constant_(self.layer.bias, -2.0)

    def forward(self, images: Tensor) -> Tensor:
        return self.layer(F.adaptive_avg_pool2d(images, 2).flatten(1))

    @staticmethod
    def decode(raw: Tensor) -> list[dict[str, Tensor]]:
        """Return the boxes in images of 32 × 32 pixels, with scores of classes 0 and 1."""
        corners = 16.0 * torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
        boxes = torch.cat([corners, corners + 16], dim=1)
        scores = torch.stack([torch.zeros_like(raw), raw.sigmoid()], dim=-1)
        return [{"boxes": boxes, "scores": one} for one in scores]
