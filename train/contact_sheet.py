"""A sheet of small pictures with captions, in titled sections one below the other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

COLUMNS = 10
PICTURE = 96  # px, the side of an enlarged picture
FRAME = 4
GAP = 12
MARGIN = 24
TITLE_SIZE, CAPTION_SIZE = 20, 12
TITLE_HEIGHT, LINE_HEIGHT = 36, 16
PAPER, INK, FAINT = "white", "#1a1a1a", "#6b6b6b"

CELL = PICTURE + 2 * FRAME
CAPTION_WIDTH = CELL + GAP - 4
SHEET_WIDTH = 2 * MARGIN + COLUMNS * CELL + (COLUMNS - 1) * GAP


@dataclass(frozen=True)
class Tile:
    """A picture, (H, W, 3) uint8 RGB, with lines of text below it: the first in ink, the others faint."""

    picture: np.ndarray
    caption: tuple[str, ...]


@dataclass(frozen=True)
class Section:
    """Tiles under one title, all framed in one colour (any name or #rrggbb that Pillow knows)."""

    title: str
    colour: str
    tiles: Sequence[Tile]

    @property
    def cell_height(self) -> int:
        lines = max((len(tile.caption) for tile in self.tiles), default=0)
        return CELL + lines * LINE_HEIGHT + GAP

    @property
    def height(self) -> int:
        rows = -(-len(self.tiles) // COLUMNS)
        return TITLE_HEIGHT + rows * self.cell_height + GAP


def draw_contact_sheet(sections: Sequence[Section]) -> Image.Image:
    """Draw the sections from top to bottom, each row by row.

    Pictures are enlarged without smoothing, so that one sees the pixels that the classifier saw.
    A section without tiles keeps its title.
    """
    height = 2 * MARGIN + sum(section.height for section in sections)
    sheet = Image.new("RGB", (SHEET_WIDTH, height), PAPER)
    top = MARGIN
    for section in sections:
        _draw_section(sheet, section, top)
        top += section.height
    return sheet


def _draw_section(sheet: Image.Image, section: Section, top: int) -> None:
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, top), section.title, INK, ImageFont.load_default(TITLE_SIZE))
    for index, tile in enumerate(section.tiles):
        row, column = divmod(index, COLUMNS)
        left = MARGIN + column * (CELL + GAP)
        _draw_tile(sheet, tile, section.colour, left, top + TITLE_HEIGHT + row * section.cell_height)


def _draw_tile(sheet: Image.Image, tile: Tile, colour: str, left: int, top: int) -> None:
    draw = ImageDraw.Draw(sheet)
    draw.rectangle((left, top, left + CELL - 1, top + CELL - 1), fill=colour)
    picture = Image.fromarray(tile.picture).resize((PICTURE, PICTURE), Image.Resampling.NEAREST)
    sheet.paste(picture, (left + FRAME, top + FRAME))
    font = ImageFont.load_default(CAPTION_SIZE)
    for line, text in enumerate(tile.caption):
        position = (left, top + CELL + 2 + line * LINE_HEIGHT)
        draw.text(position, _shortened(text, font), FAINT if line else INK, font)


def _shortened(text: str, font: ImageFont.FreeTypeFont) -> str:
    """The longest start of the text that fits under a tile, with an ellipsis where some was cut."""
    if font.getlength(text) <= CAPTION_WIDTH:
        return text
    while text and font.getlength(text + "…") > CAPTION_WIDTH:
        text = text[:-1]
    return text + "…"
