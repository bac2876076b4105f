"""A sheet of small images with captions, in titled sections: what to show of the answers, and its drawing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import TypeVar

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont, ImageOps

from renderer.io.tiles import CAPTION_SIZE, GAP, INK, MARGIN, PAPER, TITLE_HEIGHT, TITLE_SIZE, Tile
from train.photographs.answers import Answer, outcomes

TILES_PER_SECTION = 40
COLUMNS = 10
IMAGE = 96  # px, the side of an enlarged image
FRAME = 4

CELL = IMAGE + 2 * FRAME
CAPTION_WIDTH = CELL + GAP - 4
Item = TypeVar("Item")
SECTION_WIDTH = COLUMNS * (CELL + GAP)


@dataclass(frozen=True)
class Section:
    """Tiles under one title, all framed in one color (any name or #rrggbb that Pillow knows)."""

    title: str
    color: str
    tiles: Sequence[Tile]


def choose_sections(answers: Sequence[Answer], images: torch.Tensor, label: str) -> list[Section]:
    """Hits, misses and false alarms; `images` are the answers' images, (N, 3, H, W) uint8 sRGB."""
    paths = [answer.photograph.path for answer in answers]
    shown = dict(zip(paths, images.permute(0, 2, 3, 1).numpy(), strict=True))
    hits, misses, alarms = outcomes(answers, label)
    mine = len(hits) + len(misses)
    others = len(answers) - mine
    return [
        _section(f"{label}, recognized: {len(hits)} of {mine}", "#2e9e5b", hits, shown),
        _section(f"{label}, called something else: {len(misses)} of {mine}", "#d03b3b", misses, shown),
        _section(f"other things called {label}: {len(alarms)} of {others}", "#e8a317", alarms, shown),
    ]


def _section(title: str, color: str, answers: Sequence[Answer], shown: Mapping[PurePosixPath, np.ndarray]) -> Section:
    if len(answers) > TILES_PER_SECTION:
        title += f" ({TILES_PER_SECTION} drawn evenly from the surest to the least sure)"
    drawn = evenly(answers, TILES_PER_SECTION)
    return Section(title, color, [Tile(shown[answer.photograph.path], caption(answer)) for answer in drawn])


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
    drawn = [_draw_section(section) for section in sections]
    size = 2 * MARGIN + SECTION_WIDTH - GAP, 2 * MARGIN + sum(image.height for image in drawn)
    sheet, top = Image.new("RGB", size, PAPER), MARGIN
    for image in drawn:
        sheet.paste(image, (MARGIN, top))
        top += image.height
    return sheet


def _draw_section(section: Section) -> Image.Image:
    tiles = [_framed(tile, section.color).captioned() for tile in section.tiles]
    row_height = max((tile.height for tile in tiles), default=0) + GAP
    rows = -(-len(tiles) // COLUMNS)
    image = Image.new("RGB", (SECTION_WIDTH, TITLE_HEIGHT + rows * row_height + GAP), PAPER)
    ImageDraw.Draw(image).text((0, 0), section.title, INK, ImageFont.load_default(TITLE_SIZE))
    for index, tile in enumerate(tiles):
        row, column = divmod(index, COLUMNS)
        image.paste(tile, (column * (CELL + GAP), TITLE_HEIGHT + row * row_height))
    return image


def _framed(tile: Tile, color: str) -> Tile:
    image = Image.fromarray(tile.image).resize((IMAGE, IMAGE), Image.Resampling.NEAREST)
    return Tile(np.asarray(ImageOps.expand(image, FRAME, color)), tuple(map(_shortened, tile.caption)))


def _shortened(text: str) -> str:
    """The longest start of the text that fits under a tile, with an ellipsis where some was cut."""
    font = ImageFont.load_default(CAPTION_SIZE)
    if font.getlength(text) <= CAPTION_WIDTH:
        return text
    while text and font.getlength(text + "…") > CAPTION_WIDTH:
        text = text[:-1]
    return text + "…"
