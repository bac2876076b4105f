"""One image of an attack: what the classifier saw before and after, their difference, and the light of either."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from renderer.io.tiles import Tile, draw_grid

SIDE = 192  # px: smaller images are enlarged by a whole factor to at least this width


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
    """Write the image, a row per view, as a .png.

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
    titles, tiles = zip(*columns, strict=True)
    rows = [[*map(_enlarged, row)] for row in zip(*tiles, strict=True)]
    draw_grid(rows, titles).save(path)


def _tiles(images: Tensor, captions: Sequence[tuple[str, ...]]) -> list[Tile]:
    """Tiles of images (V, 3, H, W) in [0, 1]."""
    return [Tile.of(image, caption) for image, caption in zip(images, captions, strict=True)]


def _difference_tiles(differences: Tensor) -> list[Tile]:
    largest = differences.abs().amax((1, 2, 3)).tolist()
    gain = 1 / max(1 / 255, *largest)  # smaller ones than a step of eight bits stay as small as they are
    captions = [(f"largest {value:.3f}", f"shown {gain:.3g} times") for value in largest]
    return _tiles((1 + gain * differences) / 2, captions)


def _enlarged(tile: Tile) -> Tile:
    scale = -(-SIDE // tile.image.shape[1])
    return Tile(tile.image.repeat(scale, 0).repeat(scale, 1), tile.caption)
