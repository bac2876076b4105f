"""Attacks on networks by the light of a projector on photographs, without meshes or labels.

The projector shows a slide, which is a random picture. A network loses a photograph
if the light of the slide changes the predicted class. The photographs need no labels,
because the prediction for the unchanged photograph counts as right. A detector or a segmenter loses
each of its detections or segments in unchanged light by itself. If an audit has no meshes, this is
its only test.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from augment import photographs as relighting
from augment.attack_settings import RelightingSettings
from augment.classifier import TaskNetwork
from augment.network import device_of
from augment.photographs import ADVERSARIAL, RANDOM, SLIDE, UNCHANGED, PhotographAttackResult
from augment.tasks.task import NOTHING
from renderer.errors import ShortRepr
from renderer.image import to_unit
from renderer.io.images import write_image
from train.data.photographs import find_unlabeled, load_photographs, require_outside
from train.results.first_screen import FirstScreen, ShownMetric
from train.results.intervals import Units, leave_out_of_mean
from train.results.pictures import Picture, evenly_spaced, read_pictures
from train.results.predictions import RELIT
from train.results.tables import Proportion, Table, format_fraction, join_words
from train.run_folder import read_json, write_json

# Pictures are written for this many photographs.
PICTURE_COUNT = 8
# Sentences of reports about what the simulation of the light leaves out.
MODELED = (
    "A slide is the picture that a projector shows. "
    "This models a flat print of each photograph in the light of a projector, with the shading of "
    "a random smooth surface. There are no cast shadows, highlights or changes of the shape."
)


# Name of the subfolder for these results in the folder of results of a network.
RELIT_FOLDER = "relit"
# Number of photographs that are attacked, if the setting `budget` is 1.
PHOTOGRAPH_COUNT = 100
# Number of passes through the network in each attack on a photograph.
PASSES = 11
# Largest width of a picture in the report, in pixels.
MAX_PICTURE_WIDTH = 900
# The report says that predictions depend on the light if less than this fraction of
# the photographs keeps its class under random slides.
PASS_THRESHOLD = 0.9


# Each kind of light in a table, and in a sentence.
TITLES = {SLIDE: "random slide", RANDOM: "random search", ADVERSARIAL: "gradient"}
CLAUSES = {
    SLIDE: "under a random slide",
    RANDOM: "after random search",
    ADVERSARIAL: "after the gradient attack",
}


@dataclass(frozen=True)
class RelitPhotograph:
    """Predictions of a network for one photograph, or one of its objects, in several lights.

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
        photographs: Predictions for each photograph, or for each object that a
            detector or a segmenter finds in one.
        pictures: For the indices of some photographs, the file name of a
            picture that shows the photograph in each kind of light.
        found: Number of photographs in the folder.
        unreadable: Paths of the photographs that could not be read.
        finds: What is counted, and how the network keeps it, in sentences.
    """

    folder: str
    slides: int
    gain: float
    passes: int
    photographs: Sequence[RelitPhotograph]
    pictures: Mapping[int, str]
    found: int
    unreadable: Sequence[str]
    finds: tuple[str, str]

    @property
    def lights(self) -> list[str]:
        """Kinds of light that were tested: "slide", "random" and perhaps "adversarial".

        A network without gradients is not tested in adversarial light.
        """
        return list(self.photographs[0].kept)

    @property
    def shown(self) -> int:
        """Number of photographs."""
        return len({item.path for item in self.photographs})

    def kept(self, light: str) -> Proportion:
        """Compute the fraction of photographs whose predicted class no slide changes.

        The interval of what is found in photographs is over the photographs.
        """
        # A photograph counts if all slides leave its class.
        is_kept = np.array([item.kept[light] == self.slides for item in self.photographs])
        _, unit = np.unique([item.path for item in self.photographs], return_inverse=True)
        return leave_out_of_mean(is_kept, Units([unit], "photographs")).proportion(is_kept)

    def tables(self) -> list[Table]:
        """Make a table of the photographs that keep their class, and one with a row for each class.

        A row has the number of photographs with the predicted class and, for each kind of light,
        the number that keep it. The classes that lose most photographs come first.
        """
        kept = [[TITLES[light], format_fraction(self.kept(light))] for light in self.lights]
        groups: dict[str, list[RelitPhotograph]] = {}
        for item in sorted(self.photographs, key=lambda item: item.predicted):
            groups.setdefault(item.predicted, []).append(item)
        rows: list[Any] = []
        for name, group in groups.items():
            counts = [sum(one.kept[light] == self.slides for one in group) for light in self.lights]
            rows.append([name, len(group), *counts])
        # The class that loses the largest part comes first.
        rows.sort(key=lambda row: sum(row[2:]) / row[1])
        titles = [f"kept: {TITLES[light]}" for light in self.lights]
        subject, _ = self.finds
        return [
            Table(f"{subject} that keep their class", ["light", "kept"], kept),
            Table("by predicted class", ["class", subject, *titles], rows),
        ]

    def sentence(self, name: str) -> str:
        """Write how many photographs keep their class in each kind of light for a network."""
        counts = [f"{self.kept(light).hits} {CLAUSES[light]}" for light in self.lights]
        subject, keeps = self.finds
        place = f" in {self.shown} photographs" if subject != "photographs" else ""
        kept = join_words(counts, "and")
        return f"Of {len(self.photographs)} {subject}{place}, {name} {keeps} {kept}."


def attack_folder(
    classifier: TaskNetwork, folder: Path, settings: RelightingSettings, out: Path, **options: Any
) -> RelitScores:
    """Attack a network by the light of a projector on photographs, and write the results.

    `options` are those of `attack_photographs`. With a `limit`, as many photographs at equal
    distances in the list are attacked, and as many objects in them.
    """
    require_outside(out, folder)
    found = find_unlabeled(folder)
    chosen = evenly_spaced(found, options.get("limit", len(found)))
    readable, images, unreadable = load_photographs(
        folder, chosen, classifier.size, skip_unreadable=True
    )
    result = relighting.attack_photographs(classifier, images, settings, **options)
    out.mkdir(parents=True, exist_ok=True)
    classes = [*result.classifier.classes, NOTHING]
    photographs = []
    # `row` is the photograph of each attacked object.
    for index, row in enumerate(result.index.tolist()):
        becomes = {
            light: [classes[label] for label in result.predicted[light][index].tolist()]
            for light in result.changed
        }
        # Number of slides that do not change the prediction.
        kept = {light: int((~item[index]).sum()) for light, item in result.changed.items()}
        predicted = classes[int(result.source[index])]
        photographs.append(RelitPhotograph(str(readable[row].path), predicted, kept, becomes))
    searched = settings.slides, settings.gain, settings.passes
    facts = len(found), unreadable, classifier.task.finds
    scores = RelitScores(str(folder), *searched, photographs, _write_pictures(result, out), *facts)
    write_json(out / RELIT, scores, durable=True, indent=1)
    return scores


def read_relit(folder: Path) -> RelitScores:
    """Read the predictions that `attack_folder` wrote to relit.json."""
    content = read_json(folder / RELIT)
    photographs = [RelitPhotograph(**item) for item in content["photographs"]]
    pictures = {int(index): name for index, name in content["pictures"].items()}
    return RelitScores(**content | {"photographs": photographs, "pictures": pictures})


def _write_pictures(result: PhotographAttackResult, out: Path) -> dict[int, str]:
    """Write pictures that show photographs in each kind of light, side by side.

    Up to PICTURE_COUNT photographs are chosen, those whose class changes in the strongest light
    first. Return the file name of each picture by the index of its photograph.
    """
    # The kinds of light are in the order of their strength.
    *_, changed_in_strongest = result.changed.values()
    order = changed_in_strongest.any(dim=1).int().argsort(descending=True, stable=True)
    names = {}
    for photograph in order[:PICTURE_COUNT].tolist():
        # The first slide that changes the class in the strongest light, or 0.
        slide = int(changed_in_strongest[photograph].int().argmax())
        shown = [(UNCHANGED, 0), *((light, slide) for light in result.changed)]
        images = [_drawn(result, result.image(photograph, *item)) for item in shown]
        names[photograph] = f"relit_{photograph:04d}.png"
        write_image(out / names[photograph], torch.cat(images, dim=2))
    return names


@torch.no_grad()
def _drawn(result: PhotographAttackResult, image: UInt8[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """Return an image with a drawing of what the attacked network finds in it."""
    network = result.classifier
    shown = to_unit(image).to(device_of(network))
    return network.task.draw(shown, network(shown[None])[0], network.classes).cpu()


def screen_of_photographs(results: Mapping[str, Path]) -> FirstScreen:
    """Make the top of the report of an audit without meshes."""
    scores = [read_relit(path / RELIT_FOLDER) for path in results.values()]
    # With a hardened network, the first scores are before hardening, and the last ones after it.
    first, last = scores[0], scores[-1]
    numbers = []
    for light in first.lights:
        if light in last.lights:
            before = first.kept(light) if len(scores) > 1 else None
            title = f"Kept {CLAUSES[light]}"
            numbers.append(ShownMetric(title, "higher is better", before, last.kept(light)))
    answer = "Random slides seldom change its predictions."
    kept = last.kept(SLIDE).value
    if kept is not None and kept < PASS_THRESHOLD:
        answer = "Its predictions depend on the light."
    sentences = [item.sentence(name) for name, item in zip(results, scores, strict=True)]
    place = f"{first.shown} photographs of {first.folder}"
    return FirstScreen(answer, [*sentences, MODELED], numbers, [*results], place)


def relit_sections(results: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Make a section about photographs in the light of a projector for each network."""
    sections = []
    for name, folder in ((name, path / RELIT_FOLDER) for name, path in results.items()):
        if not folder.exists():
            continue
        scores = read_relit(folder)
        sentences = [
            scores.sentence(name),
            f"Each search multiplies each channel of the slide by smooth factors between "
            f"1/{scores.gain:g} and {scores.gain:g}, in {scores.passes} passes through the "
            "network. A change counts only if it remains in three draws of the noise of a sensor.",
        ]
        unreadable_count = len(scores.unreadable)
        # Only a part of the photographs is attacked.
        if scores.shown + unreadable_count < scores.found:
            sentences.append(f"The folder has {scores.found} photographs, of which these are some.")
        if unreadable_count:
            sentences.append(f"{unreadable_count} photographs cannot be read.")
        pictures: list[Picture] = []
        for index, file in scores.pictures.items():
            item = scores.photographs[index]
            # The predicted class in each light, from left to right.
            shown = [f"unchanged: {item.predicted}"]
            shown += [f"{TITLES[key]}: {names[0]}" for key, names in item.becomes.items()]
            caption = f"{item.path}. {'; '.join(shown)}"
            pictures += read_pictures(folder / file, caption, MAX_PICTURE_WIDTH, caption)
        content = {"sentences": sentences, "tables": scores.tables(), "pictures": pictures}
        sections.append({"name": name, **content})
    return sections
