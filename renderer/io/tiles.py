"""Sheets of images: tiles with captions in a grid."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, repeat, zip_longest

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from renderer.image import to_bytes

# All lengths are in pixels.
# Distance between neighboring tiles.
GAP = 12
# Distance between the tiles and the border of the sheet.
MARGIN = 24
# Distance between an image and its caption.
CAPTION_GAP = 2
# Font sizes.
TITLE_SIZE = 20
CAPTION_SIZE = 12
# Heights of a title, and of a line of a caption.
TITLE_HEIGHT = 36
LINE_HEIGHT = 16

# Colors of the background, of text, and of less important text.
PAPER = "white"
INK = "#1a1a1a"
FAINT = "#6b6b6b"


@dataclass(frozen=True)
class Tile:
    """Image with lines of text below it.

    Attributes:
        image: RGB values, uint8, shape (H, W, 3).
        caption: Lines of text. The first line has the color INK, and the others
            have the color FAINT.
    """

    image: np.ndarray
    caption: tuple[str, ...]

    def captioned(self) -> Image.Image:
        """Draw the image above its caption.

        Returns:
            Image that is as wide as the wider of image and caption.
        """
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
    """Create tiles of images, enlarged without smoothing.

    A tile then shows the pixels that a classifier saw.

    Args:
        images: RGB images with values in [0, 1], shape (3, H, W) each.
        captions: Lines of text below each image. The default is none.
        side: Smallest width of the tiles in pixels. Images are enlarged by the
            smallest whole factor that reaches it.

    Returns:
        One tile for each image.
    """
    tiles = []
    for image, caption in zip(images, captions, strict=False):
        pixels = to_bytes(image.detach().cpu()).permute(1, 2, 0).numpy()
        # Negating before and after the division rounds up.
        factor = -(-side // image.shape[2])
        enlarged = pixels.repeat(factor, 0).repeat(factor, 1)
        tiles.append(Tile(enlarged, caption))
    return tiles


def draw_grid(
    rows: Sequence[Sequence[Tile]], titles: Sequence[str] = (), heading: str = ""
) -> Image.Image:
    """Draw rows of tiles on a sheet.

    Each column and each row is as large as its largest tile.

    Args:
        rows: Tiles of each row. The last row may be shorter.
        titles: Title of each column. The default is none.
        heading: Title of the sheet. The default is none.

    Returns:
        Sheet with a margin of MARGIN pixels.
    """
    images = [[tile.captioned() for tile in row] for row in rows]
    heights = [max(image.height for image in row) for row in images]
    widths = _column_widths(images, titles)
    lefts = list(accumulate((width + GAP for width in widths), initial=MARGIN))
    title_lines = bool(heading) + bool(titles)
    first_top = MARGIN + TITLE_HEIGHT * title_lines
    tops = list(accumulate((height + GAP for height in heights), initial=first_top))

    # The last entries of both lists lie one gap beyond the last tile.
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
    """Return the width of the widest image or title of each column."""
    widths = []
    for column, title in zip_longest(zip_longest(*images), titles):
        title_width = _text_width(title or "", TITLE_SIZE)
        image_widths = [image.width for image in column or () if image]
        widths.append(max([title_width, *image_widths]))
    return widths


def _text_width(text: str, size: int) -> int:
    """Return the width of a line of text in pixels, for a font size."""
    if not text:
        return 0
    return round(ImageFont.load_default(size).getlength(text) + 0.5)
