"""A classifier and images that tests of several packages use."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

FRUIT = ["apple", "orange", "pear"]


def bright_or_dark(images: Tensor) -> Tensor:
    """Return logits of two classes, of which the first one means bright."""
    mean = images.mean((1, 2, 3))
    return torch.stack([3 * mean, 0.4 + 0 * mean], dim=1)


def colored_noise(labels: np.ndarray, rng: np.random.Generator, contrast: int) -> np.ndarray:
    """Draw noise images (N, 3, 16, 16) in which the channel of the label's number is brighter.

    The contrast is in 8-bit levels up to 55.
    """
    images = rng.integers(0, 200, (len(labels), 3, 16, 16))
    images[np.arange(len(labels)), labels] += contrast
    return images.astype(np.uint8)


def save_colored_noise(path: Path, rng: np.random.Generator, contrast: int) -> None:
    """Save a data set of 60 training and 30 test images of three classes."""
    train_labels = np.repeat(np.arange(3), 20)
    test_labels = np.repeat(np.arange(3), 10)
    np.savez(
        path,
        classes=np.array(FRUIT),
        train_images=colored_noise(train_labels, rng, contrast),
        train_labels=train_labels,
        test_images=colored_noise(test_labels, rng, contrast),
        test_labels=test_labels,
    )
