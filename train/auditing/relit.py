"""Audit of networks on photographs in the light of a projector, without meshes or labels.

The projector shows a slide, which is a random picture. A photograph keeps its class
if no slide changes the predicted class. `train.auditing.audit` runs this test on
each network. If an audit has no meshes, it is the only test.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from augment.attack_settings import RelightingSettings
from augment.classifier import Classifier
from augment.photographs import ADVERSARIAL, RANDOM, SLIDE
from train.command_settings import AuditSettings
from train.results.first_screen import FirstScreen, ShownMetric
from train.results.page import write_page
from train.results.pictures import Picture, read_pictures
from train.results.relit import (
    MODELED,
    TITLES,
    RelitPhotograph,
    RelitScores,
    attack_folder,
    read_relit,
)
from train.results.tables import Table, join_words
from train.run_config import CONFIG, read_config
from train.settings import published

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
# Titles of the numbers at the top of the report, by the kind of light.
NUMBER_TITLES = {
    SLIDE: "Keep their class under a random slide",
    RANDOM: "… after random search",
    ADVERSARIAL: "… after as many passes along the gradient",
}

# Descriptions of the kinds of light in a sentence.
IN_LIGHT = {
    SLIDE: "under a random slide",
    RANDOM: "after random search",
    ADVERSARIAL: "after the gradient attack",
}


@dataclass(frozen=True)
class RelitSection:
    """Section of a report about one network and photographs in the light of a projector.

    Attributes:
        name: Name of the network.
        tables: Table with a row for each kind of light, and table with a row
            for each class.
        pictures: Pictures that show a photograph in each kind of light.
        sentences: Sentences about the results and the test.
    """

    name: str
    tables: Sequence[Table]
    pictures: Sequence[Picture]
    sentences: Sequence[str]


def measure_photographs(classifier: Classifier, settings: AuditSettings, out: Path) -> None:
    """Attack a network by changing the light of a projector on photographs."""
    # A path below pretrained/ is found from any working folder.
    folder = published(Path(str(settings.unlabeled)))
    attack_folder(
        classifier,
        folder,
        RelightingSettings(passes=PASSES),
        out,
        seed=settings.seed,
        limit=settings.scale(PHOTOGRAPH_COUNT),
    )


def relit_sections(results: Mapping[str, Path]) -> list[RelitSection]:
    """Make a section about photographs in the light of a projector for each network."""
    sections = []
    for name, path in results.items():
        folder = path / RELIT_FOLDER
        if folder.exists():
            sections.append(_section(name, folder))
    return sections


def photographs_screen(results: Mapping[str, Path]) -> FirstScreen:
    """Make the top of the report of an audit without meshes."""
    scores = [read_relit(path / RELIT_FOLDER) for path in results.values()]
    first = scores[0]
    last = scores[-1]
    numbers = []
    for light in first.lights:
        if light in last.lights:
            title = NUMBER_TITLES[light]
            before = first.kept(light) if len(scores) > 1 else None
            numbers.append(ShownMetric(title, "higher is better", before, last.kept(light)))
    sentences = [_sentence(name, item) for name, item in zip(results, scores, strict=True)]
    place = f"{len(first.photographs)} photographs of {first.folder}"
    return FirstScreen(
        answer=_answer(last),
        sentences=[*sentences, MODELED],
        numbers=numbers,
        rows={},
        names=[*results],
        images=place,
    )


def write_photographs_page(
    screen: FirstScreen, results: Mapping[str, Path], out: Path, caveats: Sequence[str]
) -> Path:
    """Write the report of an audit without meshes."""
    return write_page(
        out,
        "relit.html.jinja",
        title="Audit: photographs in the light of a projector",
        about=" and ".join(results),
        screen=screen,
        relit=relit_sections(results),
        caveats=caveats,
        config=read_config(out / CONFIG),
    )


def _answer(scores: RelitScores) -> str:
    """Write whether fewer than PASS_THRESHOLD of the photographs keep their class."""
    kept = scores.kept(SLIDE)
    if kept.value is not None and kept.value < PASS_THRESHOLD:
        return "Its predictions depend on the light."
    return "Random slides seldom change its predictions."


def _sentence(name: str, scores: RelitScores) -> str:
    """Write how many photographs keep their class in each kind of light."""
    counts = [f"{scores.kept(light).hits} {IN_LIGHT[light]}" for light in scores.lights]
    kept = join_words(counts, "and")
    return f"Of {len(scores.photographs)} photographs, {name} keeps the class of {kept}."


def _section(name: str, folder: Path) -> RelitSection:
    """Make the section of a report about one network."""
    scores = read_relit(folder)
    sentences = [
        _sentence(name, scores),
        f"Each search multiplies each channel of the slide by smooth factors between "
        f"1/{scores.gain:g} and {scores.gain:g}, in {scores.passes} passes through the network. "
        "A change counts only if it remains in three draws of the noise of a sensor.",
    ]
    attacked_count = len(scores.photographs)
    unreadable_count = len(scores.unreadable)
    if attacked_count + unreadable_count < scores.found:
        sentences.append(f"The folder holds {scores.found} photographs, of which these are some.")
    if scores.unreadable:
        sentences.append(f"{unreadable_count} photographs cannot be read.")
    pictures: list[Picture] = []
    for index, file in scores.pictures.items():
        caption = _caption(scores.photographs[index])
        pictures += read_pictures(folder / file, caption, MAX_PICTURE_WIDTH, caption)
    tables = [scores.summary_table(), scores.class_table()]
    return RelitSection(name, tables, pictures, sentences)


def _caption(photograph: RelitPhotograph) -> str:
    """Write the caption of a picture: the predicted class in each light, from left to right."""
    predictions = [f"unchanged: {photograph.predicted}"]
    for light, predicted in photograph.becomes.items():
        predictions.append(f"{TITLES[light]}: {predicted[0]}")
    return f"{photograph.path}. {'; '.join(predictions)}"
