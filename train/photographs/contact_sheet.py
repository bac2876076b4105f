"""A sheet of small images with captions, in titled sections: what to show of the answers, and its drawing."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from renderer.tiles import CAPTION_SIZE, FAINT, GAP, INK, LINE_HEIGHT, MARGIN, PAPER, TITLE_HEIGHT, TITLE_SIZE, Tile
from train.photographs.answers import Answer

TILES_PER_SECTION = 40
COLUMNS = 10
IMAGE = 96  # px, the side of an enlarged image
FRAME = 4

CELL = IMAGE + 2 * FRAME
CAPTION_WIDTH = CELL + GAP - 4
Item = TypeVar("Item")
SHEET_WIDTH = 2 * MARGIN + COLUMNS * CELL + (COLUMNS - 1) * GAP


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


def choose_sections(answers: Sequence[Answer], images: torch.Tensor, label: str) -> list[Section]:
    """Hits, misses and false alarms; `images` are the answers' images, (N, 3, H, W) uint8 sRGB."""
    asked = list(zip(answers, images.permute(0, 2, 3, 1).numpy(), strict=True))
    mine = [pair for pair in asked if pair[0].photograph.label == label]
    others = [pair for pair in asked if pair[0].photograph.label != label]
    hits = [pair for pair in mine if pair[0].prediction == label]
    misses = [pair for pair in mine if pair[0].prediction != label]
    alarms = [pair for pair in others if pair[0].prediction == label]
    return [
        _section(f"{label}, recognised: {len(hits)} of {len(mine)}", "#2e9e5b", hits),
        _section(f"{label}, called something else: {len(misses)} of {len(mine)}", "#d03b3b", misses),
        _section(f"other things called {label}: {len(alarms)} of {len(others)}", "#e8a317", alarms),
    ]


def _section(title: str, colour: str, asked: Sequence[tuple[Answer, np.ndarray]]) -> Section:
    """The surest answers first; where there are too many, evenly drawn down to the least sure."""
    ordered = sorted(asked, key=lambda pair: -pair[0].probability)
    if len(ordered) > TILES_PER_SECTION:
        title += f" ({TILES_PER_SECTION} drawn evenly from the surest to the least sure)"
        ordered = evenly(ordered, TILES_PER_SECTION)
    return Section(title, colour, [Tile(image, caption(answer)) for answer, image in ordered])


def evenly(ordered: Sequence[Item], count: int) -> list[Item]:
    """`count` of a sequence at equal distances, first and last among them; all where there are no more."""
    drawn = np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int)
    return [ordered[index] for index in drawn]


def caption(answer: Answer) -> tuple[str, ...]:
    """The prediction and, where it is wrong, the true class below it."""
    said = f"{answer.probability:.0%} {answer.prediction}"
    if answer.true_rank == 1:
        return (said,)
    if answer.true_rank is None:
        return said, answer.photograph.label
    return said, f"{answer.true_probability:.0%} {answer.photograph.label}"


def draw_contact_sheet(sections: Sequence[Section]) -> Image.Image:
    """Draw the sections from top to bottom, each row by row.

    Images are enlarged without smoothing, so that one sees the pixels that the classifier saw.
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
    image = Image.fromarray(tile.image).resize((IMAGE, IMAGE), Image.Resampling.NEAREST)
    sheet.paste(image, (left + FRAME, top + FRAME))
    font = ImageFont.load_default(CAPTION_SIZE)
    for line, text in enumerate(tile.caption):
        position = (left, top + CELL + 2 + line * LINE_HEIGHT)
        draw.text(position, _shortened(text, font), FAINT if line else INK, font)


def _shortened(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> str:
    """The longest start of the text that fits under a tile, with an ellipsis where some was cut."""
    if font.getlength(text) <= CAPTION_WIDTH:
        return text
    while text and font.getlength(text + "…") > CAPTION_WIDTH:
        text = text[:-1]
    return text + "…"
