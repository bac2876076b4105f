"""Draw sheets of images with captions.

A sheet is a picture with a grid of tiles. A tile is an image with its caption
below.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, repeat, zip_longest

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from renderer.image import to_bytes

# Distance in pixels between neighboring tiles of a sheet.
GAP = 12
# Distance in pixels between the tiles and the border of a sheet.
MARGIN = 24
# Distance in pixels between an image and its caption.
CAPTION_GAP = 2
# Font sizes of titles and captions in pixels.
TITLE_SIZE = 20
CAPTION_SIZE = 12
# Heights of a title and of a line of a caption in pixels.
TITLE_HEIGHT = 36
LINE_HEIGHT = 16

# Background color of a sheet of images.
PAPER = "white"
# Color of titles and of the first line of a caption: nearly black.
INK = "#1a1a1a"
# Color of the lines of a caption after the first line: gray.
FAINT = "#6b6b6b"


@dataclass(frozen=True)
class Tile:
    """Image with a caption below it.

    Attributes:
        image: RGB values, uint8, shape (H, W, 3).
        caption: Lines of text. The first line is nearly black, and the other lines
            are gray.
    """

    image: UInt8[np.ndarray, "H W 3"]
    caption: tuple[str, ...]

    def captioned(self) -> Image.Image:
        """Draw the image with its caption below. It is as wide as the image or the longest line."""
        image = Image.fromarray(self.image)
        line_widths = [_text_width(line, CAPTION_SIZE) for line in self.caption]
        width = max([image.width, *line_widths])
        caption_top = image.height + CAPTION_GAP
        height = caption_top + LINE_HEIGHT * len(self.caption)
        captioned = Image.new("RGB", (width, height), PAPER)
        captioned.paste(image)
        draw = ImageDraw.Draw(captioned)
        font = ImageFont.load_default(CAPTION_SIZE)
        for number, line in enumerate(self.caption):
            color = INK if number == 0 else FAINT
            draw.text((0, caption_top + number * LINE_HEIGHT), line, color, font)
        return captioned


def tiles_of(
    images: Iterable[Tensor], captions: Iterable[tuple[str, ...]] = repeat(()), side: int = 1
) -> list[Tile]:
    """Create a tile for each image.

    Small images are enlarged without smoothing, so that a tile shows the pixels
    that a classifier saw. Images have values in [0, 1]. They are enlarged by the smallest whole
    factor that makes them `side` pixels wide.
    """
    tiles = []
    for image, caption in zip(images, captions, strict=False):
        pixels = to_bytes(image.detach().cpu()).permute(1, 2, 0).numpy()
        factor = math.ceil(side / image.shape[2])
        enlarged = pixels.repeat(factor, 0).repeat(factor, 1)
        tiles.append(Tile(enlarged, caption))
    return tiles


def draw_grid(
    rows: Sequence[Sequence[Tile]], titles: Sequence[str] = (), heading: str = ""
) -> Image.Image:
    """Draw rows of tiles on a sheet.

    Each column is as wide as its widest tile or title. Each row is as high as its
    highest tile. The last row may be shorter.
    """
    images = [[tile.captioned() for tile in row] for row in rows]
    row_heights = [max(image.height for image in row) for row in images]
    column_widths = _column_widths(images, titles)
    title_lines = bool(heading) + bool(titles)
    first_top = MARGIN + TITLE_HEIGHT * title_lines
    # Left edges of the columns and top edges of the rows. Each list has one
    # more entry: the position at which another column or row would begin.
    lefts = list(accumulate((width + GAP for width in column_widths), initial=MARGIN))
    tops = list(accumulate((height + GAP for height in row_heights), initial=first_top))

    # Another column would begin at lefts[-1],
    # one GAP after the end of the last column.
    right = max(lefts[-1] - GAP, MARGIN + _text_width(heading, TITLE_SIZE))
    bottom = max(tops[-1] - GAP, first_top)
    sheet = Image.new("RGB", (right + MARGIN, bottom + MARGIN), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(TITLE_SIZE)
    draw.text((MARGIN, MARGIN), heading, INK, font)
    for title, left in zip(titles, lefts, strict=False):
        draw.text((left, first_top - TITLE_HEIGHT), title, INK, font)
    for row, top in zip(images, tops, strict=False):
        for image, left in zip(row, lefts, strict=False):
            sheet.paste(image, (left, top))
    return sheet


def _column_widths(images: Sequence[Sequence[Image.Image]], titles: Sequence[str]) -> list[int]:
    """Compute the width of each column of a sheet of images in pixels."""
    columns = zip_longest(*images)
    widths = []
    # zip_longest fills up with None: an image,
    # a column or a title may be missing.
    for column, title in zip_longest(columns, titles):
        title_width = _text_width(title or "", TITLE_SIZE)
        image_widths = [image.width for image in column or () if image]
        widths.append(max([title_width, *image_widths]))
    return widths


def _text_width(text: str, size: int) -> int:
    """Compute the width of a line of text in pixels, rounded up."""
    if not text:
        return 0
    return round(ImageFont.load_default(size).getlength(text) + 0.5)
