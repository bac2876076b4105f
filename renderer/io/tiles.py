"""What all sheets of images share: tiles with captions, and the measures and colors of a page."""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont
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

    def captioned(self) -> Image.Image:
        """The image over its caption, as wide as the wider of them."""
        font, image = ImageFont.load_default(CAPTION_SIZE), Image.fromarray(self.image)
        width = max([image.width, *(round(font.getlength(line) + 0.5) for line in self.caption)])
        captioned = Image.new("RGB", (width, image.height + 2 + LINE_HEIGHT * len(self.caption)), PAPER)
        captioned.paste(image)
        for number, line in enumerate(self.caption):
            position = (0, image.height + 2 + number * LINE_HEIGHT)
            ImageDraw.Draw(captioned).text(position, line, FAINT if number else INK, font)
        return captioned
