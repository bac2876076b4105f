"""Sheets of images: tiles with captions in a grid."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, repeat, zip_longest

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

    def captioned(self) -> Image.Image:
        """The image over its caption, as wide as the wider of them."""
        font, image = ImageFont.load_default(CAPTION_SIZE), Image.fromarray(self.image)
        width = max([image.width, *(_text_width(line, CAPTION_SIZE) for line in self.caption)])
        captioned = Image.new("RGB", (width, image.height + 2 + LINE_HEIGHT * len(self.caption)), PAPER)
        captioned.paste(image)
        for number, line in enumerate(self.caption):
            position = (0, image.height + 2 + number * LINE_HEIGHT)
            ImageDraw.Draw(captioned).text(position, line, FAINT if number else INK, font)
        return captioned


def tiles_of(images: Iterable[Tensor], captions: Iterable[tuple[str, ...]] = repeat(()), side: int = 1) -> list[Tile]:
    """Of images (3, H, W) of values in [0, 1], enlarged by a whole factor to at least `side` pixels, without smoothing,
    so that one sees the pixels that the classifier saw."""
    tiles = []
    for image, caption in zip(images, captions, strict=False):
        pixels, factor = to_bytes(image.detach().cpu()).permute(1, 2, 0).numpy(), -(-side // image.shape[2])
        tiles.append(Tile(pixels.repeat(factor, 0).repeat(factor, 1), caption))
    return tiles


def draw_grid(rows: Sequence[Sequence[Tile]], titles: Sequence[str] = (), heading: str = "") -> Image.Image:
    """Rows of tiles, GAP apart, under a title per column, if any, and a heading over all columns, if any.
    Columns and rows are as large as their largest tile; the last row may be shorter."""
    font = ImageFont.load_default(TITLE_SIZE)
    images = [[tile.captioned() for tile in row] for row in rows]
    columns = [[image.width for image in column if image] for column in zip_longest(*images)]
    titled_columns = zip_longest(titles, columns, fillvalue="")
    widths = [max([_text_width(title, TITLE_SIZE), *column]) for title, column in titled_columns]
    heights = [max(image.height for image in row) for row in images]
    lefts = [*accumulate((width + GAP for width in widths), initial=MARGIN)]
    first = MARGIN + TITLE_HEIGHT * (bool(heading) + bool(titles))
    tops = [*accumulate((height + GAP for height in heights), initial=first)]
    width = max(lefts[-1] - GAP, MARGIN + _text_width(heading, TITLE_SIZE)) + MARGIN
    sheet = Image.new("RGB", (width, max(tops[-1] - GAP, first) + MARGIN), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN), heading, INK, font)
    for title, left in zip(titles, lefts, strict=False):
        draw.text((left, first - TITLE_HEIGHT), title, INK, font)
    for row, top in zip(images, tops, strict=False):
        for image, left in zip(row, lefts, strict=False):
            sheet.paste(image, (left, top))
    return sheet


def _text_width(text: str, size: int) -> int:
    return round(ImageFont.load_default(size).getlength(text) + 0.5) if text else 0
