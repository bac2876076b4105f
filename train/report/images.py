"""Small images from the files of runs; what cannot be read is left out."""

import io
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from PIL import Image

from renderer.errors import InputError
from renderer.io.images import read_square
from train.photographs.answers import Answer, outcomes
from train.photographs.contact_sheet import caption, evenly
from train.report.blocks import Gallery, Illustration
from train.run_folder.attack_examples import SUFFIX, Side, read_attack_examples

TILE = 96  # pixels
TILES = 8  # photographs of each kind
WIDEST = 720  # pixels of a grid of renders


def encoded(image: Image.Image, alt: str, width: int, text: str = "") -> Illustration:
    """As PNG where few pixels are to be seen as they are, else as JPEG."""
    file, small = io.BytesIO(), max(image.size) <= 2 * TILE
    image.convert("RGB").save(file, "PNG" if small else "JPEG", optimize=True, quality=82)
    return Illustration(file.getvalue(), "png" if small else "jpeg", alt, width, text)


def from_file(path: Path, alt: str, widest: int, text: str = "") -> list[Illustration]:
    """The image of a file, reduced to a width; [] where there is none that can be read."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return []
        with Image.open(path) as image:
            shown = image.convert("RGB")
    except Exception:  # Pillow's decoders raise almost anything at a broken file
        return []
    shown.thumbnail((widest, 4 * widest))
    return [encoded(shown, alt, shown.width, text)]


def first_middle_last(paths: Sequence[Path]) -> list[tuple[int, Path]]:
    """Of files named epoch_NUMBER, with the numbers."""
    numbered = sorted((int(path.stem.removeprefix("epoch_")), path) for path in paths if path.stem[6:].isdigit())
    return evenly(numbered, 3)


def renders(folder: Path, arm: str) -> Gallery:
    """The renders of a run's first, middle and last epoch."""
    return Gallery(
        arm,
        [
            image
            for epoch, path in first_middle_last([*(folder / "renders").glob("epoch_*.png")])
            for image in from_file(path, f"Renders of epoch {epoch}, {arm}", WIDEST, f"epoch {epoch}")
        ],
    )


def _specimens(folder: Path) -> Iterator[tuple[int, list[tuple[str, Side, Side]]]]:
    """Those of a run's first, middle and last epoch with attack_examples: the epoch, and label, before and after of
    each."""
    for epoch, path in first_middle_last([*(folder / "renders").glob(f"epoch_*{SUFFIX}")]):
        with suppress(InputError):
            yield epoch, read_attack_examples(path)


def attack_examples(folder: Path, arm: str) -> Iterator[Gallery]:
    """What fooled in a run: renders and lights, before and after."""
    for epoch, rows in _specimens(folder):
        yield Gallery(f"{arm}, epoch {epoch}", [image for label, *sides in rows for image in _sides(label, sides)])


def turned(folder: Path, count: int) -> list[tuple[Side, Side]]:
    """Before and after, of the newest of a run's attack examples that were called by their label before, and not
    after."""
    for _, rows in reversed([*_specimens(folder)]):
        if found := [(before, after) for label, before, after in rows if before.answer == label != after.answer]:
            return found[:count]
    return []


def _sides(label: str, sides: Sequence[Side]) -> Iterator[Illustration]:
    for when, side in zip(("before", "after"), sides, strict=True):
        image, sphere = (Image.fromarray(shown.permute(1, 2, 0).numpy()) for shown in (side.image, side.sphere))
        pair = Image.new("RGB", (TILE + sphere.width, TILE), "white")
        pair.paste(image.resize((TILE, TILE), Image.Resampling.NEAREST))
        pair.paste(sphere, (TILE, (TILE - sphere.height) // 2))
        said = f"{side.confidence:.0%} {side.answer}"
        yield encoded(pair, f"{label} {when}: called {said}; a ball in its light", pair.width, f"{when}: {said}")


def photographs(answers: Sequence[Answer], folder: Path, label: str, arm: str) -> Iterator[Gallery]:
    """Hits, misses and false alarms, with the network's answers."""
    kinds = "recognized", "called something else", f"others called {label}"
    for kind, group in zip(kinds, outcomes(answers, label), strict=True):
        tiles = [image for answer in evenly(group, TILES) for image in _photograph(answer, folder)]
        yield Gallery(f"{arm}: {kind}, {len(tiles)} of {len(group)}", tiles)


def _photograph(answer: Answer, folder: Path) -> list[Illustration]:
    path = answer.photograph.path
    if path.is_absolute() or ".." in path.parts or not (folder / path).is_file():
        return []
    try:
        square = read_square(folder / path, TILE)
    except Exception:  # as above
        return []
    said = " / ".join(caption(answer))
    return [encoded(Image.fromarray(square), f"{answer.photograph.label}, called {said}", TILE, said)]
