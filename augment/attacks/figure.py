"""One image of an attack: what the classifier saw before and after, their difference, and the light of either."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from renderer.tiles import (
    CAPTION_SIZE,
    FAINT,
    GAP,
    INK,
    LINE_HEIGHT,
    MARGIN,
    PAPER,
    TITLE_HEIGHT,
    TITLE_SIZE,
    Tile,
)

SIDE = 192  # px: smaller images are enlarged by a whole factor to at least this width

Column = tuple[str, Sequence[Tile]]  # a title, and a tile per view


@dataclass(frozen=True)
class Exhibit:
    """What one side of an attack, initial or adversarial, shows in V views.

    images: (V, 3, H, W) RGB in [0, 1]. captions: V times lines of text, as `answer_caption` gives them, the first in
    ink and the others faint. spheres: (V, 3, S, S) in [0, 1], each view's light (`renderer.light_sphere`), or None.
    """

    images: Tensor
    captions: Sequence[tuple[str, ...]]
    spheres: Tensor | None = None


def answer_caption(probabilities: Tensor, classes: Sequence[str], label: str) -> tuple[str, ...]:
    """A classifier's answer (C,) with its confidence and, where it is wrong, the true class with its own below it."""
    shown = dict.fromkeys([int(probabilities.argmax()), classes.index(label)])
    return tuple(f"{probabilities[index]:.1%} {classes[index]}" for index in shown)


def save_figure(initial: Exhibit, adversarial: Exhibit, path: Path) -> None:
    """Write the image, a row per view, to a file whose suffix Pillow knows.

    The differences are grey where there is none, and scaled alike so that the largest reaches black or white.
    Images are enlarged without smoothing, so that one sees the pixels that the classifier saw.
    """
    columns = [
        ("initial", _tiles(initial.images, initial.captions)),
        ("adversarial", _tiles(adversarial.images, adversarial.captions)),
        ("difference", _difference_tiles(adversarial.images - initial.images)),
    ]
    for title, exhibit in (("initial light", initial), ("adversarial light", adversarial)):
        if exhibit.spheres is not None:
            columns.append((title, _tiles(exhibit.spheres, [()] * len(exhibit.spheres))))
    _draw(columns).save(path)


def _tiles(images: Tensor, captions: Sequence[tuple[str, ...]]) -> list[Tile]:
    """Tiles of images (V, 3, H, W) in [0, 1]."""
    return [Tile.of(image, caption) for image, caption in zip(images, captions, strict=True)]


def _difference_tiles(differences: Tensor) -> list[Tile]:
    largest = differences.abs().amax((1, 2, 3)).tolist()
    gain = 1 / max(1 / 255, *largest)  # smaller ones than a step of eight bits stay as small as they are
    captions = [(f"largest {value:.3f}", f"shown {gain:.3g} times") for value in largest]
    return _tiles((1 + gain * differences) / 2, captions)


def _draw(columns: Sequence[Column]) -> Image.Image:
    title_font = ImageFont.load_default(TITLE_SIZE)
    images = [[_enlarged(tile) for tile in tiles] for _, tiles in columns]
    widths = [
        max(round(title_font.getlength(title) + 0.5), *(image.width for image in column))
        for (title, _), column in zip(columns, images, strict=True)
    ]
    heights = [max(image.height for image in row) for row in zip(*images, strict=True)]
    size = (
        2 * MARGIN + sum(widths) + GAP * (len(widths) - 1),
        2 * MARGIN + TITLE_HEIGHT + sum(heights) + GAP * (len(heights) - 1),
    )
    sheet, left = Image.new("RGB", size, PAPER), MARGIN
    for (title, _), column, width in zip(columns, images, widths, strict=True):
        ImageDraw.Draw(sheet).text((left, MARGIN), title, INK, title_font)
        top = MARGIN + TITLE_HEIGHT
        for image, height in zip(column, heights, strict=True):
            sheet.paste(image, (left, top))
            top += height + GAP
        left += width + GAP
    return sheet


def _enlarged(tile: Tile) -> Image.Image:
    """The tile's image over its caption, as wide as the wider of them."""
    font, image = ImageFont.load_default(CAPTION_SIZE), Image.fromarray(tile.image)
    image = image.resize([side * -(-SIDE // image.width) for side in image.size], Image.Resampling.NEAREST)
    width = max([image.width, *(round(font.getlength(line) + 0.5) for line in tile.caption)])
    captioned = Image.new("RGB", (width, image.height + 2 + LINE_HEIGHT * len(tile.caption)), PAPER)
    captioned.paste(image)
    for line, text in enumerate(tile.caption):
        ImageDraw.Draw(captioned).text((0, image.height + 2 + line * LINE_HEIGHT), text, FAINT if line else INK, font)
    return captioned
