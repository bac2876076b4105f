"""A classifier and images that tests of several packages use."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn
from torchvision.ops import masks_to_boxes

from augment.classifier import Classifier
from augment.scene.scene import Scene

FRUIT = ["apple", "orange", "pear"]
# From the last pixels of torchvision's boxes to their right and lower sides.
BORDER = torch.tensor([0, 0, 1, 1])


def bright_or_dark(images: Tensor) -> Tensor:
    """Return logits of two classes, of which the first one means bright."""
    mean = images.mean((1, 2, 3))
    return torch.stack([3 * mean, 0.4 + 0 * mean], dim=1)


CHANNELS = ("orange", "lime", "sky")


def by_channel(size: int, classes: tuple[str, ...] = CHANNELS, name: str = "") -> Classifier:
    """Make a classifier whose logits are the mean red, green and blue, in the order of classes."""
    channels = [CHANNELS.index(label) for label in classes]
    return Classifier(lambda images: 30 * images.mean((2, 3))[:, channels], size, classes, name)


class Brightness(nn.Module):
    """Network that takes images darker than a limit on average for its first class."""

    def __init__(self, limit: float, scale: float = 100):
        super().__init__()
        self.limit = nn.Parameter(torch.tensor(float(limit)))
        self.scale = scale

    def forward(self, images: Tensor) -> Tensor:
        excess = self.scale * (images.mean((1, 2, 3)) - self.limit)
        return torch.stack([-excess, excess], dim=1)


def darker_than(limit: float, size: int = 8, name: str = "", scale: float = 100) -> Classifier:
    """Make a classifier that takes images darker than a limit on average for an orange."""
    network = Brightness(limit, scale).eval()
    return Classifier(network, size, ("orange", "other"), name or f"darker than {limit}")


def images_of(scene: Scene) -> Tensor:
    """Render the first view of each example of a scene, (E, 3, H, W)."""
    rows = torch.arange(len(scene))
    return scene.render(scene.conditions(rows), rows)[:, 0]


def colored_noise(labels: np.ndarray, rng: np.random.Generator, contrast: int) -> np.ndarray:
    """Draw noise images (N, 3, 16, 16) in which the channel of the label's number is brighter.

    The contrast is in 8-bit levels up to 55.
    """
    images = rng.integers(0, 200, (len(labels), 3, 16, 16))
    images[np.arange(len(labels)), labels] += contrast
    return images.astype(np.uint8)


def save_noise(path: Path, rng: np.random.Generator, shape=(20, 24), low=0, high=256) -> None:
    """Save an image of noise of some 8-bit levels, and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rng.integers(low, high, (*shape, 3)).astype(np.uint8)).save(path)


def save_plain(path: Path, color: int | str | tuple[int, int, int], size=(8, 8)) -> None:
    """Save an image of one color or 8-bit gray level, and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (color,) * 3 if isinstance(color, int) else color).save(path)


def save_colored_noise(path: Path, rng: np.random.Generator, contrast: int) -> None:
    """Save a data set of 60 training and 30 test images of three classes."""
    arrays = {"classes": np.array(FRUIT)}
    for part, count in (("train", 20), ("test", 10)):
        labels = np.repeat(np.arange(3), count)
        images = colored_noise(labels, rng, contrast)
        arrays |= {f"{part}_labels": labels, f"{part}_images": images}
    np.savez(path, **arrays)


def find_red(images):
    """Detect what differs from the gray background. Its score is the fraction of red light."""
    outputs = []
    for image in images:
        is_object = ((image - 0.5).abs() > 0.05).any(0)
        if not is_object.any():
            empty = image.new_zeros(0)
            none = {"boxes": image.new_zeros(0, 4), "labels": empty.long(), "scores": empty}
            outputs.append(none)
            continue
        red, green, _ = image[:, is_object].mean(1)
        found = {"boxes": masks_to_boxes(is_object[None]) + BORDER, "labels": torch.tensor([0])}
        outputs.append(found | {"scores": (12 * (red - green) - 1).sigmoid()[None]})
    return outputs
