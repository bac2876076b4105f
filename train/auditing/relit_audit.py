"""The part of an audit that needs neither meshes nor labels: photographs in a projector's light.

`train.auditing.audit` measures this part for each network. If an audit has no
meshes, it is the only part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from augment.attack_settings import RelightingSettings
from augment.classifiers import Classifier
from augment.photographs.photograph_attack import ADVERSARIAL, RANDOM, SLIDE
from train.command_settings import AuditSettings
from train.evaluation.relit import (
    MODELED,
    TITLES,
    RelitPhotograph,
    RelitScores,
    attack_folder,
    read_relit,
)
from train.evaluation.tables import Table, join_words
from train.report import plots
from train.report.first_screen import FirstScreen, ShownMetric
from train.report.plots import Picture
from train.report.report_page import write_page
from train.runs.run_config import CONFIG, read_config
from train.settings import published

# Part of a network with the scores on relit photographs.
RELIT_PART = "relit"
# Number of photographs that an audit with a budget of 1 attacks.
PHOTOGRAPHS = 100
# Number of passes through the network in each search.
PASSES = 11
# Width of a picture in pixels.
WIDEST = 900
# `_answer` says that predictions depend on the light if fewer photographs than this
# fraction keep their class under random slides.
PASS_THRESHOLD = 0.9
# Titles of the numbers on the first screen.
NUMBERS = {
    SLIDE: "Keep their class under a random slide",
    RANDOM: "… after random search",
    ADVERSARIAL: "… after as many passes along the gradient",
}

# Lights in sentences.
IN_LIGHT = {
    SLIDE: "under a random slide",
    RANDOM: "after random search",
    ADVERSARIAL: "after the gradient attack",
}


@dataclass(frozen=True)
class RelitSection:
    """Section of a page on the relit photographs of one network.

    Attributes:
        name: Name of the network.
        tables: Tables by light and by class.
        pictures: Photographs in all lights.
        sentences: What was measured.
    """

    name: str
    tables: Sequence[Table]
    pictures: Sequence[Picture]
    sentences: Sequence[str]


def measure_photographs(classifier: Classifier, settings: AuditSettings, out: Path) -> None:
    """Attack a network through the light on the photographs of an audit.

    Args:
        classifier: Network.
        settings: Settings of the audit, with `photographs`.
        out: Folder of the results.

    Raises:
        InputError: If the folder holds no photograph that can be read.
    """
    attack_folder(
        classifier,
        published(Path(str(settings.photographs))),
        RelightingSettings(passes=PASSES),
        out,
        seed=settings.seed,
        limit=settings.scale(PHOTOGRAPHS),
    )


def relit_sections(paths: Mapping[str, Path]) -> list[RelitSection]:
    """Make the section of each network that has scores on relit photographs.

    Args:
        paths: Folder of the parts of each network by its name.

    Returns:
        The sections.
    """
    sections = []
    for name, path in paths.items():
        folder = path / RELIT_PART
        if folder.exists():
            sections.append(_section(name, folder))
    return sections


def photographs_screen(paths: Mapping[str, Path]) -> FirstScreen:
    """Make the first screen of an audit without meshes, of one network or of two.

    Args:
        paths: Folder of the parts of each network by its name.

    Returns:
        The first screen.
    """
    scores = [read_relit(path / RELIT_PART) for path in paths.values()]
    first = scores[0]
    last = scores[-1]
    numbers = []
    for light in first.lights:
        if light in last.lights:
            before = first.kept(light) if len(scores) > 1 else None
            numbers.append(
                ShownMetric(NUMBERS[light], "higher is better", before, last.kept(light))
            )
    sentences = [_sentence(name, item) for name, item in zip(paths, scores, strict=True)]
    counted = f"{len(first.photographs)} photographs of {first.folder}"
    return FirstScreen(_answer(last), [*sentences, MODELED], numbers, {}, [*paths], counted)


def write_photographs_page(
    screen: FirstScreen, paths: Mapping[str, Path], out: Path, caveats: Sequence[str]
) -> Path:
    """Write the page of an audit without meshes.

    Args:
        screen: First screen of the page.
        paths: Folder of the parts of each network by its name.
        out: Folder of the audit.
        caveats: Sentences at the beginning of the report.

    Returns:
        Path of the report.
    """
    return write_page(
        out,
        "relit.html.jinja",
        title="Audit: photographs in the light of a projector",
        about=" and ".join(paths),
        screen=screen,
        relit=relit_sections(paths),
        caveats=caveats,
        config=read_config(out / CONFIG),
    )


def _answer(scores: RelitScores) -> str:
    """Say whether the predictions of a network depend on the light of a projector.

    The fraction of photographs that keep their class under random slides
    decides.
    """
    kept = scores.kept(SLIDE)
    if kept.value is not None and kept.value < PASS_THRESHOLD:
        return "Its predictions depend on the light."
    return "Random slides seldom change its predictions."


def _sentence(name: str, scores: RelitScores) -> str:
    """Say how many photographs keep their class in each light.

    Args:
        name: Name of the network.
        scores: Predictions of the network for the photographs.
    """
    counts = [f"{scores.kept(light).hits} {IN_LIGHT[light]}" for light in scores.lights]
    kept = join_words(counts, "and")
    return f"Of {len(scores.photographs)} photographs, {name} keeps the class of {kept}."


def _section(name: str, folder: Path) -> RelitSection:
    """Read the tables, the pictures and the sentences of a network.

    Args:
        name: Name of the network.
        folder: Folder that `attack_folder` wrote.
    """
    scores = read_relit(folder)
    sentences = [
        _sentence(name, scores),
        f"Each search multiplies each channel of the slide by smooth factors between "
        f"1/{scores.gain:g} and {scores.gain:g}, in {scores.passes} passes through the network. "
        "A change counts only if it remains in three draws of the noise of a sensor.",
    ]
    attacked = len(scores.photographs)
    if attacked + len(scores.unreadable) < scores.found:
        sentences.append(f"The folder holds {scores.found} photographs, of which these are some.")
    if scores.unreadable:
        sentences.append(f"{len(scores.unreadable)} photographs cannot be read.")
    pictures: list[Picture] = []
    for index, file in scores.pictures.items():
        caption = _caption(scores.photographs[index])
        pictures += plots.from_file(folder / file, caption, WIDEST, caption)
    tables = [scores.summary_table(), scores.class_table()]
    return RelitSection(name, tables, pictures, sentences)


def _caption(photograph: RelitPhotograph) -> str:
    """Name the predictions for a photograph, from left to right in its picture."""
    shown = [f"unchanged: {photograph.predicted}"]
    for light, predicted in photograph.becomes.items():
        shown.append(f"{TITLES[light]}: {predicted[0]}")
    return f"{photograph.path}. {'; '.join(shown)}"
