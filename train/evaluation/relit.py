"""Scores of a network on photographs in the light of a projector, and their files.

The photographs need no labels. The class of each is what the network predicts
for it unchanged.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from augment.attack_settings import RelightingSettings
from augment.classifiers import Classifier
from augment.photographs.photograph_attack import (
    ADVERSARIAL,
    RANDOM,
    SLIDE,
    UNCHANGED,
    PhotographAttackResult,
    attack_photographs,
)
from renderer.io.files import atomic_write
from renderer.io.images import write_image
from train.data.photographs import Photograph, find_unlabeled, load_photographs
from train.evaluation.scores.sheet import evenly_spaced
from train.evaluation.tables import Proportion, Table, format_fraction, fraction
from train.runs.run_config import read_json

# File with the predictions for all photographs.
RELIT = "relit.json"
# Number of photographs of which `attack_folder` writes pictures.
PICTURED = 8
# Lights by the titles of their columns.
TITLES = {
    SLIDE: "random slide",
    RANDOM: "random search",
    ADVERSARIAL: "gradient",
}
# Sentence of reports on the limits of the model.
MODELED = (
    "This models a flat print of each photograph in the light of a projector, with the shading of "
    "a random smooth surface. There are no cast shadows, highlights or changes of the shape."
)


@dataclass(frozen=True)
class RelitPhotograph:
    """Predictions of a network for one photograph.

    Attributes:
        path: Path in its folder.
        predicted: Predicted class of the unchanged photograph.
        kept: Number of slides under which the photograph keeps this class, by
            light.
        becomes: Predicted classes under the slides, by light.
    """

    path: str
    predicted: str
    kept: Mapping[str, int]
    becomes: Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class RelitScores:
    """Predictions of a network for relit photographs.

    Attributes:
        folder: Folder of the photographs.
        slides: Number of slides for each photograph.
        gain: Largest factor of a channel of a slide.
        passes: Passes through the network of each search.
        photographs: Predictions for each photograph.
        pictures: File name of a picture by the index of its photograph.
        found: Number of photographs in the folder.
        unreadable: Paths of photographs that could not be read.
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
        """Lights of the predictions: "slide", "random" and, with gradients, "adversarial"."""
        return list(self.photographs[0].kept)

    def kept(self, light: str) -> Proportion:
        """Count the photographs that keep their class under all of their slides.

        Args:
            light: One of `lights`.

        Returns:
            Their fraction, with its 95% interval.
        """
        hits = sum(photograph.kept[light] == self.slides for photograph in self.photographs)
        return fraction(hits, len(self.photographs))

    def summary_table(self) -> Table:
        """Make a table of the fraction of photographs that keep their class, by light."""
        rows = []
        for light in self.lights:
            rows.append([TITLES[light], format_fraction(self.kept(light))])
        return Table("photographs that keep their class", ["light", "kept"], rows)

    def class_table(self) -> Table:
        """Make a table of the photographs that keep their class, by predicted class.

        The classes that lose most photographs come first.
        """
        groups: dict[str, list[RelitPhotograph]] = {}
        for photograph in self.photographs:
            groups.setdefault(photograph.predicted, []).append(photograph)
        rows: list[list[object]] = []
        for name, members in sorted(groups.items()):
            counts: list[object] = []
            for light in self.lights:
                counts.append(sum(item.kept[light] == self.slides for item in members))
            rows.append([name, len(members), *counts])
        rows.sort(key=_kept_fraction)
        titles = [f"kept: {TITLES[light]}" for light in self.lights]
        return Table("by predicted class", ["class", "photographs", *titles], rows)


def _kept_fraction(row: Sequence[Any]) -> float:
    """Sum the fraction of the photographs that keep their class over all lights.

    Args:
        row: Row of `RelitScores.class_table`: the class, the number of
            photographs, and for each light the number that keep their class.

    Returns:
        Sum of one fraction for each light.
    """
    return sum(row[2:]) / row[1]


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
    """Attack a network through the light on the photographs of a folder, and write the results.

    Args:
        classifier: Network to attack.
        folder: Folder of photographs, with sub-folders or without.
        settings: Settings of the attack.
        out: Folder of the results. If it does not exist, it is made.
        sensor_noise: Standard deviation of the noise, in steps of 8 bits.
        batch_size: Photographs per pass.
        seed: Seed of all draws.
        limit: Largest number of photographs. From more, evenly spaced ones are
            attacked. None for all.

    Returns:
        The predictions, as they are written.

    Raises:
        InputError: If the folder holds no photograph that can be read.
    """
    found = find_unlabeled(folder)
    chosen = evenly_spaced(found, limit or len(found))
    shown, images, unreadable = load_photographs(
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
    content = {
        "folder": str(folder),
        "slides": settings.slides,
        "gain": settings.gain,
        "passes": settings.passes,
        "found": len(found),
        "unreadable": unreadable,
        "photographs": _describe(result, shown),
        "pictures": _write_pictures(result, out),
    }
    atomic_write(out / RELIT, json.dumps(content, indent=1) + "\n", durable=True)
    return read_relit(out)


def read_relit(folder: Path) -> RelitScores:
    """Read the predictions that `attack_folder` wrote.

    Args:
        folder: Folder of the results.

    Returns:
        The predictions.

    Raises:
        InputError: If the file is missing or damaged.
    """
    content = read_json(folder / RELIT)
    photographs = [RelitPhotograph(**item) for item in content["photographs"]]
    pictures = {int(index): name for index, name in content["pictures"].items()}
    return RelitScores(**content | {"photographs": photographs, "pictures": pictures})


def _describe(
    result: PhotographAttackResult, photographs: Sequence[Photograph]
) -> list[dict[str, Any]]:
    """Describe the predictions for each photograph by names of classes.

    Args:
        result: Result of the attack on N photographs, with several slides each.
        photographs: The N photographs.

    Returns:
        Fields of `RelitPhotograph` by name, for each photograph.
    """
    classes = result.classifier.classes
    described = []
    for index, photograph in enumerate(photographs):
        kept = {}
        becomes = {}
        for light, changed in result.changed.items():
            kept[light] = int((~changed[index]).sum())
            becomes[light] = [classes[label] for label in result.predicted[light][index].tolist()]
        described.append(
            {
                "path": str(photograph.path),
                "predicted": classes[int(result.source[index])],
                "kept": kept,
                "becomes": becomes,
            }
        )
    return described


def _write_pictures(result: PhotographAttackResult, out: Path) -> dict[int, str]:
    """Write pictures of at most PICTURED photographs in all lights, side by side.

    Photographs whose class changes in one light come first. Usually this light
    is the gradient attack. Photographs whose class changes in two lights follow,
    and so on. Photographs that no light changes come last.

    Args:
        result: Result of the attack.
        out: Folder of the pictures.

    Returns:
        File name of each picture by the index of its photograph.
    """
    # Number of lights in which a photograph changes its class under any slide,
    # shape (N,).
    number_of_losses = torch.stack([mask.any(1) for mask in result.changed.values()]).sum(0)
    is_lost = number_of_losses > 0
    # Adding 100 puts the photographs without a change at the end.
    order = torch.argsort(number_of_losses + 100 * ~is_lost, stable=True)
    names = {}
    for photograph in order[:PICTURED].tolist():
        slide = _slide_to_show(result, photograph)
        shown: list[Tensor] = [result.image(photograph, UNCHANGED)]
        for light in result.changed:
            shown.append(result.image(photograph, light, slide))
        name = f"relit_{photograph:04d}.png"
        strip = torch.cat(shown, dim=2).permute(1, 2, 0).cpu().numpy()
        write_image(out / name, Image.fromarray(strip))
        names[photograph] = name
    return names


def _slide_to_show(result: PhotographAttackResult, photograph: int) -> int:
    """Choose the slide under which a picture shows a photograph.

    Args:
        result: Result of the attack.
        photograph: Index of the photograph.

    Returns:
        Index of the first slide that changes the class in the last, strongest
        light. 0 if no slide does.
    """
    changed = [*result.changed.values()][-1][photograph]
    return int(changed.int().argmax())
