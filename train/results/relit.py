"""Attacks on a network through the light of a projector on photographs, and their results.

The projector shows a slide, which is a random picture. A network loses a photograph
if the light of the slide changes the predicted class. The photographs need no labels,
because the prediction for the unchanged photograph counts as right.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from augment.attack_settings import RelightingSettings
from augment.classifier import Classifier
from augment.photographs import (
    ADVERSARIAL,
    RANDOM,
    SLIDE,
    UNCHANGED,
    PhotographAttackResult,
    attack_photographs,
)
from renderer.io.files import atomic_write
from renderer.io.images import write_image
from renderer.short_repr import ShortRepr
from train.data.photo import Photograph
from train.data.photographs import find_unlabeled, load_photographs
from train.results.pictures import evenly_spaced
from train.results.tables import Proportion, Table, format_fraction, fraction
from train.run_folder import read_json

# Name of the file with the predictions for all photographs.
RELIT = "relit.json"
# Pictures are written for this many photographs.
PICTURE_COUNT = 8
# Titles of the columns of tables, by the kind of light.
TITLES = {
    SLIDE: "random slide",
    RANDOM: "random search",
    ADVERSARIAL: "gradient",
}
# Sentences of reports about what the simulation of the light leaves out.
MODELED = (
    "A slide is the picture that a projector shows. "
    "This models a flat print of each photograph in the light of a projector, with the shading of "
    "a random smooth surface. There are no cast shadows, highlights or changes of the shape."
)


@dataclass(frozen=True)
class RelitPhotograph:
    """Predictions of a network for one photograph in the light of several slides.

    A slide is a random picture that a projector shows on the photograph. There
    are up to three kinds of light: "slide" is the slide itself, "random" is the
    slide after a random search, and "adversarial" is the slide after a gradient
    attack.

    Attributes:
        path: Path of the photograph, relative to its folder.
        predicted: Predicted class of the unchanged photograph.
        kept: For each kind of light, the number of slides under which the
            predicted class stays the same.
        becomes: For each kind of light, the predicted class under each slide.
    """

    path: str
    predicted: str
    kept: Mapping[str, int]
    becomes: Mapping[str, Sequence[str]]


@dataclass(frozen=True, repr=False)
class RelitScores(ShortRepr):
    """Predictions of a network for photographs in the light of a projector.

    Attributes:
        folder: Folder of the photographs.
        slides: Number of slides for each photograph.
        gain: Largest factor by which an attack multiplies a color channel of a
            slide.
        passes: Number of passes through the network in each attack.
        photographs: Predictions for each photograph.
        pictures: For the indices of some photographs, the file name of a
            picture that shows the photograph in each kind of light.
        found: Number of photographs in the folder.
        unreadable: Paths of the photographs that could not be read.
    """

    folder: str
    slides: int
    gain: float
    passes: int
    photographs: Sequence[RelitPhotograph]
    pictures: Mapping[int, str]
    found: int
    unreadable: Sequence[str]

    @property
    def lights(self) -> list[str]:
        """Kinds of light that were tested: "slide", "random" and perhaps "adversarial".

        A network without gradients is not tested in adversarial light.
        """
        return list(self.photographs[0].kept)

    def kept(self, light: str) -> Proportion:
        """Compute the fraction of photographs whose predicted class no slide changes."""
        is_kept = [photograph.kept[light] == self.slides for photograph in self.photographs]
        return fraction(sum(is_kept), len(is_kept))

    def summary_table(self) -> Table:
        """Make a table of the photographs that keep their class, with a row for each light."""
        rows = []
        for light in self.lights:
            rows.append([TITLES[light], format_fraction(self.kept(light))])
        return Table("photographs that keep their class", ["light", "kept"], rows)

    def class_table(self) -> Table:
        """Make a table with a row for each predicted class of the unchanged photographs.

        A row has the number of photographs and, for each kind of light, the
        number that keep their class. The classes that lose most photographs
        come first.
        """
        photographs_of_class: dict[str, list[RelitPhotograph]] = {}
        for photograph in self.photographs:
            photographs_of_class.setdefault(photograph.predicted, []).append(photograph)
        rows: list[list[object]] = []
        for name, photographs in sorted(photographs_of_class.items()):
            kept_counts: list[object] = []
            for light in self.lights:
                kept_counts.append(sum(item.kept[light] == self.slides for item in photographs))
            rows.append([name, len(photographs), *kept_counts])
        rows.sort(key=_sum_of_kept_fractions)
        titles = [f"kept: {TITLES[light]}" for light in self.lights]
        return Table("by predicted class", ["class", "photographs", *titles], rows)


def _sum_of_kept_fractions(row: Sequence[Any]) -> float:
    """Add up the fractions of photographs that keep their class in each kind of light.

    `row` has the class, its number of photographs, and for each light how many keep their class.
    """
    _, photograph_count, *kept_counts = row
    return sum(kept_counts) / photograph_count


def attack_folder(
    classifier: Classifier,
    folder: Path,
    settings: RelightingSettings,
    out: Path,
    *,
    sensor_noise: float = 1.0,
    batch_size: int = 32,
    seed: int = 0,
    limit: int | None = None,
) -> RelitScores:
    """Attack a network by the light of a projector on photographs, and write the results.

    `sensor_noise` is a standard deviation in units of 1/255. `limit` photographs at equal distances
    in the list are attacked, or all if it is None.
    """
    found = find_unlabeled(folder)
    chosen = evenly_spaced(found, limit or len(found))
    readable, images, unreadable = load_photographs(
        folder, chosen, classifier.size, skip_unreadable=True
    )
    result = attack_photographs(
        classifier,
        images,
        settings,
        sensor_noise=sensor_noise,
        batch_size=batch_size,
        seed=seed,
    )
    out.mkdir(parents=True, exist_ok=True)
    scores = RelitScores(
        folder=str(folder),
        slides=settings.slides,
        gain=settings.gain,
        passes=settings.passes,
        photographs=[_describe(result, *item) for item in enumerate(readable)],
        pictures=_write_pictures(result, out),
        found=len(found),
        unreadable=unreadable,
    )
    atomic_write(out / RELIT, json.dumps(asdict(scores), indent=1) + "\n", durable=True)
    return scores


def read_relit(folder: Path) -> RelitScores:
    """Read the predictions that `attack_folder` wrote to relit.json."""
    content = read_json(folder / RELIT)
    photographs = [RelitPhotograph(**item) for item in content["photographs"]]
    pictures = {int(index): name for index, name in content["pictures"].items()}
    return RelitScores(**content | {"photographs": photographs, "pictures": pictures})


def _describe(
    result: PhotographAttackResult, index: int, photograph: Photograph
) -> RelitPhotograph:
    """Collect the predictions for the photograph with an index in an attack."""
    classes = result.classifier.classes
    predicted = {light: labels[index].tolist() for light, labels in result.predicted.items()}
    return RelitPhotograph(
        path=str(photograph.path),
        predicted=classes[int(result.source[index])],
        kept={light: int((~changed[index]).sum()) for light, changed in result.changed.items()},
        becomes={light: [classes[label] for label in predicted[light]] for light in result.changed},
    )


def _write_pictures(result: PhotographAttackResult, out: Path) -> dict[int, str]:
    """Write pictures that show photographs in each kind of light, side by side.

    Up to PICTURE_COUNT photographs are chosen. Photographs whose class changes in only one kind of
    light come first, which is usually the gradient attack. Photographs whose class changes in more
    kinds of light follow. Photographs whose class never changes come last. Return the file name of
    each picture by the index of its photograph.
    """
    # Each entry is about one kind of light: whether any slide changes the class of each
    # photograph, shape (N,).
    is_changed = [changed.any(dim=1) for changed in result.changed.values()]
    change_count = torch.stack(is_changed).sum(dim=0)
    # A rank above all counts puts photographs that never change at the end.
    rank = torch.where(change_count > 0, change_count, len(is_changed) + 1)
    order = torch.argsort(rank, stable=True)
    names = {}
    for photograph in order[:PICTURE_COUNT].tolist():
        slide = _slide_to_show(result, photograph)
        images: list[Tensor] = [result.image(photograph, UNCHANGED)]
        for light in result.changed:
            images.append(result.image(photograph, light, slide))
        side_by_side = torch.cat(images, dim=2)
        name = f"relit_{photograph:04d}.png"
        pixels = side_by_side.permute(1, 2, 0).cpu().numpy()
        write_image(out / name, Image.fromarray(pixels))
        names[photograph] = name
    return names


def _slide_to_show(result: PhotographAttackResult, photograph: int) -> int:
    """Choose the slide with which a picture shows a photograph.

    It is the first one that changes the class in the strongest light, or 0.
    """
    # The kinds of light are in the order of their strength.
    *_, changed_in_strongest = result.changed.values()
    return int(changed_in_strongest[photograph].int().argmax())
