"""What all sheets of images share: tiles with captions, and the measures and colours of a page."""

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from renderer.image import to_bytes

GAP = 12  # px
MARGIN = 24
TITLE_SIZE, CAPTION_SIZE = 20, 12
TITLE_HEIGHT, LINE_HEIGHT = 36, 16
PAPER, INK, FAINT = "white", "#1a1a1a", "#6b6b6b"


@dataclass(frozen=True)
class Tile:
    """An image, (H, W, 3) uint8 RGB, with lines of text below it: the first in ink, the others faint."""

    image: np.ndarray
    caption: tuple[str, ...]

    @staticmethod
    def of(image: Tensor, caption: tuple[str, ...]) -> "Tile":
        """Of an image (3, H, W) of values in [0, 1]."""
        return Tile(to_bytes(image.detach().cpu()).permute(1, 2, 0).numpy(), caption)
