"""Do lights and shapes that fool one network fool others (Table 3)?"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.utils import generator
from train.report.tables import markdown
from train.run_folder.classifier import load_classifier
from train.studies.figures import panels_beside, save
from train.studies.paper.adversaries import ATTACKS, FURTHER, STEPS, with_random_signs
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import draw_shares, percent, share_of
from train.studies.paper.subjects import answers, finer, greys_of, recognised_parts, scene_of

TITLE = "Transfer to unseen networks"


@dataclass
class Settings(SectionSettings):
    """examples: of each mesh. targets: networks that are not attacked. squeezenet: weights of one more."""

    examples: int
    targets: list[str]
    squeezenet: str | None


STATES = ("before", "first", "first_random", "further", "further_random")
COLUMNS = {
    "first": "adversary as found",
    "first_random": "random change as large",
    "further": f"adversary {FURTHER} steps on",
    "further_random": "random change as large",
}
STYLES: dict[str, dict[str, Any]] = {
    "first": {"color": "#4269d0", "fmt": "o"},
    "first_random": {"color": "#4269d0", "fmt": "o", "markerfacecolor": "white"},
    "further": {"color": "#c2410c", "fmt": "s"},
    "further_random": {"color": "#c2410c", "fmt": "s", "markerfacecolor": "white"},
}


def measure(study: Study, settings: Settings) -> Section:
    """Adversaries of every mesh and kind, before all networks."""
    seen_by = networks(study.classifier, settings)
    records: list[dict[str, Any]] = []
    for subject in study.subjects:
        draws = generator(study.seed, subject.name, "transfer")
        records += transfer(finer(subject), seen_by, settings.examples, study.light, draws)
    names = [network.name for network in seen_by]
    values = {
        "table": results(records, names, study.label),
        "further": FURTHER,
        "steps": STEPS,
        "examples": settings.examples * len(study.subjects),
    }
    return Section(values, records, {"transfer.png": partial(draw, records, names, study.label)})


def networks(source: Classifier, settings: Settings) -> list[Classifier]:
    """The source, and then the targets."""
    targets = [load_classifier(name) for name in settings.targets]
    if settings.squeezenet is not None:
        targets.append(load_classifier("squeezenet_caffe", settings.squeezenet))
    return [source, *targets]


def transfer(
    subject: SceneObject, seen_by: Sequence[Classifier], count: int, light: str, draws: torch.Generator
) -> Iterator[dict[str, Any]]:
    """For some examples and each kind of attack on the first network: what all networks call them in every state."""
    for scene in recognised_parts(subject, seen_by[0], light, count, draws):
        greys = greys_of(scene)
        scenes = [scene, *(scene_of(subject, target, light, scene.cameras, greys) for target in seen_by[1:])]
        for kind, attack in ATTACKS.items():
            problems = [attack.problem(each) for each in scenes]
            start = problems[0].start
            first, further = attack.adversaries(problems[0], seen_by[0], subject.label, views=1)
            random = [with_random_signs(values, start, draws) for values in (first, further)]
            states = dict(zip(STATES, (start, first, random[0], further, random[1]), strict=True))
            said = {
                network.name: {state: answers(network, problem.images(values)) for state, values in states.items()}
                for network, problem in zip(seen_by, problems, strict=True)
            }
            yield {"kind": kind, "mesh": subject.name, "answers": said}


def outcomes(records: Iterable[Mapping[str, Any]], network: str, state: str, source: str, label: str) -> list[bool]:
    """Whether a network is fooled where it recognised the original: the source itself, or another by what fools the
    source at that strength."""
    strength = state.removesuffix("_random")
    return [
        answer != label
        for said in (record["answers"] for record in records)
        for before, answer, of_source in zip(
            said[network]["before"], said[network][state], said[source][strength], strict=True
        )
        if before == label and (network == source or of_source != label)
    ]


def results(records: Sequence[Mapping[str, Any]], names: Sequence[str], label: str) -> str:
    """A row per kind of attack and network, the source first."""
    rows = []
    for kind in ATTACKS:
        here = [record for record in records if record["kind"] == kind]
        for name in names:
            cells = [percent(outcomes(here, name, state, names[0], label)) for state in COLUMNS]
            rows.append([kind, f"{name}, attacked" if name == names[0] else name, *cells])
    return markdown(["attack", "network", *COLUMNS.values()], rows)


def draw(records: Sequence[Mapping[str, Any]], names: Sequence[str], label: str, path: Path) -> None:
    """A panel per kind of attack, the networks side by side, adversaries filled and random changes hollow."""
    figure, panels = panels_beside(len(ATTACKS), (4.2, 3.6), layout="constrained")
    for panel, kind in zip(panels, ATTACKS, strict=True):
        here = [record for record in records if record["kind"] == kind]
        for index, (state, title) in enumerate(COLUMNS.items()):
            shares = [share_of(outcomes(here, name, state, names[0], label)) for name in names]
            places = [place + 0.12 * (index - 1.5) for place in range(len(names))]
            draw_shares(panel, places, shares, 100, label=title, capsize=2, **STYLES[state])
        ticks = [name.removeprefix("run:").replace("_", "\n").replace("/", "/\n") for name in names]
        panel.set_xticks(range(len(names)), ticks, fontsize=7)
        panel.set(title=kind, ylim=(-2, 102))
    panels[0].set_ylabel("fooled, % of recognised")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    save(figure, path)
