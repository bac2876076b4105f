"""One image of an attack: what the classifier saw before and after, their difference, and the light of either."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from renderer.io.tiles import GAP, INK, MARGIN, PAPER, TITLE_HEIGHT, TITLE_SIZE, Tile

SIDE = 192  # px: smaller images are enlarged by a whole factor to at least this width
COLUMNS = "columns"  # the text in a .png that says where its tiles are

Column = tuple[str, Sequence[Tile]]  # a title, and a tile per view


@dataclass(frozen=True)
class Panel:
    """What one side of an attack, initial or adversarial, shows in V views.

    images: (V, 3, H, W) RGB in [0, 1]. captions: V times lines of text, as `prediction_caption` gives them, the first
    in ink and the others faint. spheres: (V, 3, S, S) in [0, 1], each view's light (`light_sphere`), or None.
    """

    images: Tensor
    captions: Sequence[tuple[str, ...]]
    spheres: Tensor | None = None


def prediction_caption(probabilities: Tensor, classes: Sequence[str], label: str) -> tuple[str, ...]:
    """A classifier's answer (C,) with its confidence and, where it is wrong, the true class with its own below it."""
    shown = dict.fromkeys([int(probabilities.argmax()), classes.index(label)])
    return tuple(f"{probabilities[index]:.1%} {classes[index]}" for index in shown)


def save_figure(initial: Panel, adversarial: Panel, path: Path) -> None:
    """Write the image, a row per view, as a .png, whose tiles `read_figure` returns.

    The differences are gray where there is none, and scaled alike so that the largest reaches black or white.
    Images are enlarged without smoothing, so that one sees the pixels that the classifier saw.
    """
    columns = [
        ("initial", _tiles(initial.images, initial.captions)),
        ("adversarial", _tiles(adversarial.images, adversarial.captions)),
        ("difference", _difference_tiles(adversarial.images - initial.images)),
    ]
    for title, panel in (("initial light", initial), ("adversarial light", adversarial)):
        if panel.spheres is not None:
            columns.append((title, _tiles(panel.spheres, [()] * len(panel.spheres))))
    columns = [(title, [*map(_enlarged, tiles)]) for title, tiles in columns]
    sheet, told = _draw(columns)
    info = PngInfo()
    info.add_text(COLUMNS, json.dumps(told), zip=True)
    sheet.save(path, pnginfo=info)


def read_figure(path: Path) -> list[Column]:
    """The columns of an image of `save_figure`, with tiles as they were drawn; ValueError for another file."""
    try:
        with Image.open(path, formats=["PNG"]) as sheet:
            told = json.loads(sheet.info[COLUMNS])
            pixels = np.asarray(sheet.convert("RGB"))
        return [(str(column["title"]), [_cut(tile, pixels) for tile in column["tiles"]]) for column in told]
    except Exception as error:  # Pillow raises almost anything at a broken file
        raise ValueError(f"{path} is no image of an attack") from error


def _cut(tile: dict[str, Any], pixels: np.ndarray) -> Tile:
    left, top, width, height = (tile[key] for key in ("left", "top", "width", "height"))
    image = pixels[top : top + height, left : left + width]
    if image.shape != (height, width, 3) or not image.size:
        raise ValueError("a tile is not on the sheet")
    return Tile(image, tuple(map(str, tile["caption"])))


def _tiles(images: Tensor, captions: Sequence[tuple[str, ...]]) -> list[Tile]:
    """Tiles of images (V, 3, H, W) in [0, 1]."""
    return [Tile.of(image, caption) for image, caption in zip(images, captions, strict=True)]


def _difference_tiles(differences: Tensor) -> list[Tile]:
    largest = differences.abs().amax((1, 2, 3)).tolist()
    gain = 1 / max(1 / 255, *largest)  # smaller ones than a step of eight bits stay as small as they are
    captions = [(f"largest {value:.3f}", f"shown {gain:.3g} times") for value in largest]
    return _tiles((1 + gain * differences) / 2, captions)


def _draw(columns: Sequence[Column]) -> tuple[Image.Image, list[dict[str, Any]]]:
    """The sheet, and where on it each column's tiles are, for JSON."""
    title_font = ImageFont.load_default(TITLE_SIZE)
    images = [[tile.captioned() for tile in tiles] for _, tiles in columns]
    widths = [
        max(round(title_font.getlength(title) + 0.5), *(image.width for image in column))
        for (title, _), column in zip(columns, images, strict=True)
    ]
    heights = [max(image.height for image in row) for row in zip(*images, strict=True)]
    lefts, tops = _starts(MARGIN, widths), _starts(MARGIN + TITLE_HEIGHT, heights)
    sheet = Image.new("RGB", (lefts[-1] + widths[-1] + MARGIN, tops[-1] + heights[-1] + MARGIN), PAPER)
    told = []
    for (title, tiles), column, left in zip(columns, images, lefts, strict=True):
        ImageDraw.Draw(sheet).text((left, MARGIN), title, INK, title_font)
        places = []
        for tile, image, top in zip(tiles, column, tops, strict=True):
            sheet.paste(image, (left, top))
            height, width, _ = tile.image.shape
            places.append({"left": left, "top": top, "width": width, "height": height, "caption": tile.caption})
        told.append({"title": title, "tiles": places})
    return sheet, told


def _starts(first: int, sizes: Sequence[int]) -> list[int]:
    """Where things of these sizes begin, GAP apart."""
    return [*accumulate((size + GAP for size in sizes[:-1]), initial=first)]


def _enlarged(tile: Tile) -> Tile:
    scale = -(-SIDE // tile.image.shape[1])
    return Tile(tile.image.repeat(scale, 0).repeat(scale, 1), tile.caption)
