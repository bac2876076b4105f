"""Do lights and shapes that fool one network fool others (Table 3)?"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.classifiers import Classifier
from augment.descent import Part, Problem
from augment.seeding import generator
from train.report.tables import markdown
from train.run_folder.classifier import load_classifier
from train.studies.figures import pyplot, save
from train.studies.page import filled
from train.studies.paper.adversaries import ATTACKS, FURTHER, STEPS, answers, recognised_parts, with_random_signs
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent
from train.studies.paper.subjects import Subject, finer, scene_of


@dataclass
class TransferSettings(SectionSettings):
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
PAPER = {
    "lighting": {"AlexNet": 81.2, "VGG": 65.0, "SqueezeNet": 78.6, "DenseNet": 43.5},
    "geometry": {"AlexNet": 70.3, "VGG": 58.9, "SqueezeNet": 71.1, "DenseNet": 40.1},
}


@dataclass(frozen=True)
class Seen:
    """An image (3, H, W) of an adversary as a network sees it, and its answers before and to it."""

    kind: str
    mesh: str
    network: str
    image: Tensor
    before: str
    answer: str


def networks(study: Study, settings: TransferSettings) -> list[Classifier]:
    """The source, and then the targets."""
    targets = [load_classifier(name) for name in settings.targets]
    if settings.squeezenet is not None:
        targets.append(load_classifier("squeezenet_caffe", settings.squeezenet))
    return [study.classifier, *targets]


def transfer(
    subject: Subject, seen_by: Sequence[Classifier], count: int, light: str, draws: torch.Generator
) -> Iterator[tuple[list[dict[str, Any]], list[Seen]]]:
    """For some examples at a time and each kind of attack: a record per example, and images of the first."""
    for scene, kept in recognised_parts(subject, seen_by[0], light, count, draws):
        greys = scene.backgrounds[:, 0, 0, 0]
        scenes = [scene, *(scene_of(subject, target, light, scene.cameras, greys) for target in seen_by[1:])]
        for kind, attack in ATTACKS.items():
            problems = [attack.problem(each) for each in scenes]
            yield _attacked(kind, problems, kept, subject, seen_by, draws)


def _attacked(
    kind: str,
    problems: Sequence[Problem],
    kept: Tensor,
    subject: Subject,
    seen_by: Sequence[Classifier],
    draws: torch.Generator,
) -> tuple[list[dict[str, Any]], list[Seen]]:
    """Attack the first network in the examples (A,) of its problem, and show what comes of it to all."""
    start = problems[0].start[kept]
    first, further = ATTACKS[kind].adversaries(Part(problems[0], kept, start), seen_by[0], subject.label, views=1)
    states = (start, first, with_random_signs(first, start, draws), further, with_random_signs(further, start, draws))
    records: list[dict[str, Any]] = [
        {
            "kind": kind,
            "mesh": subject.name,
            "distance": [round(float((values[row] - start[row]).norm()), 4) for values in (first, further)],
            "answers": {},
        }
        for row in range(len(kept))
    ]
    seen = []
    for network, problem in zip(seen_by, problems, strict=True):
        by_state = zip(*(answers(problem, values, kept, network) for values in states), strict=True)
        for record, said in zip(records, by_state, strict=True):
            record["answers"][network.name] = dict(zip(STATES, said, strict=True))
        said = records[0]["answers"][network.name]
        with torch.no_grad():
            image = problem.render(further[:1], kept[:1])[0, 0]
        seen.append(Seen(kind, subject.name, network.name, image, said["before"], said["further"]))
    return records, seen


def outcomes(records: Iterable[Mapping[str, Any]], network: str, state: str, source: str, label: str) -> list[bool]:
    """Whether a network is fooled by what fools the source at that strength, where it recognised the original."""
    strength = state.removesuffix("_random")
    return [
        record["answers"][network][state] != label
        for record in records
        if record["answers"][source][strength] != label and record["answers"][network]["before"] == label
    ]


def results(records: Sequence[Mapping[str, Any]], names: Sequence[str], label: str) -> str:
    """A table per kind of attack, a row per target."""
    parts = []
    for kind in ATTACKS:
        of_kind = [record for record in records if record["kind"] == kind]
        rows = [
            [name, *(percent(outcomes(of_kind, name, state, names[0], label)) for state in COLUMNS)]
            for name in names[1:]
        ]
        parts += [f"**{kind.capitalize()}**", markdown(["network", *COLUMNS.values()], rows)]
    return "\n\n".join(parts)


def source_success(records: Sequence[Mapping[str, Any]], source: str, label: str) -> str:
    """How many examples fool the network that was attacked, by kind."""
    parts = []
    for kind in ATTACKS:
        said = [record["answers"][source] for record in records if record["kind"] == kind]
        counts = {state: sum(answer[state] != label for answer in said) for state in COLUMNS}
        parts.append(
            f"{kind} {counts['first']} of {len(said)}, and {counts['further']} after the further steps "
            f"(random changes as large: {counts['first_random']} and {counts['further_random']})"
        )
    return "; ".join(parts)


def distances(records: Sequence[Mapping[str, Any]]) -> str:
    """Medians, as a sentence."""
    parts = []
    for kind in ATTACKS:
        first, further = torch.tensor([each["distance"] for each in records if each["kind"] == kind]).median(0).values
        parts.append(f"{first:.2g} as found and {further:.2g} after the further steps ({kind})")
    return f"Median L2 distances from the start: {'; '.join(parts)}."


def draw(seen: Sequence[Seen], label: str, path: Path) -> None:
    """A row per kind and mesh, a column per network."""
    columns = list(dict.fromkeys(each.network for each in seen))
    rows = list(dict.fromkeys((each.kind, each.mesh) for each in seen))
    figure, panels = pyplot().subplots(
        len(rows), len(columns), figsize=(1.7 * len(columns), 1.95 * len(rows)), squeeze=False, layout="tight"
    )
    for each in seen:
        row, column = rows.index((each.kind, each.mesh)), columns.index(each.network)
        panel = panels[row, column]
        panel.imshow(each.image.permute(1, 2, 0).clamp(0, 1).numpy(), interpolation="nearest")
        panel.set(xticks=[], yticks=[])
        panel.set_xlabel(each.answer, fontsize=9, color=_colour(each, label))
        if row == 0:
            panel.set_title(each.network.replace(":", ":\n").replace("_", "\n", 1), fontsize=8)
        if column == 0:
            panel.set_ylabel(f"{each.kind}\n{each.mesh}", fontsize=8)
    save(figure, path)


def _colour(seen: Seen, label: str) -> str:
    if seen.before != label:
        return "#8a8a8a"
    return "#2e7d4f" if seen.answer == label else "#d03b3b"


def measure(study: Study, settings: TransferSettings) -> Section:
    """Adversaries of every mesh and kind, before all networks."""
    seen_by, records = networks(study, settings), []
    seen: dict[tuple[str, str], list[Seen]] = {}
    for subject in study.subjects:
        draws = generator(study.seed, subject.name, "transfer")
        for some, views in transfer(finer(subject), seen_by, settings.examples, study.light, draws):
            records += some
            seen.setdefault((views[0].kind, subject.name), views)
    names, source = [network.name for network in seen_by], study.classifier.name
    of_paper = list(PAPER["lighting"])
    text = filled(
        __file__,
        source=source,
        label=study.label,
        tables=results(records, names, study.label),
        further=FURTHER,
        paper=markdown(
            ["", *of_paper], [[kind, *(f"{row[name]} %" for name in of_paper)] for kind, row in PAPER.items()]
        ),
        examples=len(records) // len(ATTACKS),
        meshes=study.meshes,
        source_success=source_success(records, source, study.label),
        distances=distances(records),
        steps=STEPS,
        light=study.light,
    )
    images = [each for views in seen.values() for each in views]
    figures = {"transfer.png": partial(draw, images, study.label)}
    return Section(text, records, figures)
