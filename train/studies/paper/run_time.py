"""What an iteration of an attack costs, and how many it takes (the paper's Section 4.2, "Runtime")."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
import torch

from augment.descent import DescentSettings, descend
from augment.goal import Goal
from augment.objects import ObjectSettings, load_object
from train.photographs.shares import share
from train.report.tables import markdown
from train.studies.page import filled
from train.studies.paper.adversaries import ATTACKS
from train.studies.paper.iterations import (
    BATCH,
    Iteration,
    Setup,
    Stopwatch,
    draw,
    iteration_table,
    many,
    ratio_table,
    stubborn,
    training_step,
)
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import interval
from train.studies.paper.subjects import Subject, finer, recognised_scene, scene_of
from train.studies.renderer_speed.measure import seconds

FIELDS = (2.0, 2.8, 4.0, 5.7, 8.0)  # each halves the pixels of the one before
SOLID = ObjectSettings("solid:orange", "orange")
MANY_PASSES = 2  # of a timed descent on many examples at once, which takes its time
FEWER = 10  # iterations, the paper's
SHARES = {"quartile": 0.25, "median": 0.5, "third quartile": 0.75, "90 %": 0.9, "most": 1.0}
ATTACK_COLUMNS = ["mesh", "attacks", "fooled", *(f"{unit}, {name}" for unit in ("steps", "s") for name in SHARES)]


@dataclass
class RunTimeSettings(SectionSettings):
    """examples: of each mesh that are attacked, in max_steps at most. passes: of a timed descent. turns: of them."""

    examples: int
    max_steps: int
    passes: int
    turns: int


@dataclass(frozen=True)
class Attack:
    """One image's attack. prepared: seconds spent on what is rendered once."""

    mesh: str
    fooled: bool
    steps: int
    seconds: float
    prepared: float


def attacks(subject: Subject, study: Study, settings: RunTimeSettings) -> Iterator[Attack]:
    """Attack the light of recognised images, each on its own."""
    classifier = study.classifier
    scene = recognised_scene(subject, classifier, study.light, settings.examples, study.seed)
    goal = Goal(torch.tensor([[classifier.label(subject.label)]]))
    for example in range(len(scene)):
        one = scene_of(subject, classifier, study.light, [scene.cameras[example]], scene.backgrounds[example, :1, 0, 0])
        prepared = seconds(partial(getattr, one, "stacks"))
        problem = ATTACKS["lighting"].problem(one)
        start = time.process_time()
        result = descend(classifier, problem, goal, DescentSettings(settings.max_steps), Stopwatch())
        spent = time.process_time() - start
        yield Attack(subject.name, bool(result.fooled), int(result.steps), prepared + spent, prepared)


def distribution_rows(done: Sequence[Attack], names: Sequence[str]) -> Iterator[list[str]]:
    """A row per mesh, and one for all of them where there are several."""
    groups = {name: [each for each in done if each.mesh == name] for name in names}
    for name, group in (groups | ({"all": done} if len(groups) > 1 else {})).items():
        fooled = [each for each in group if each.fooled]
        rate = share(len(fooled), len(group))
        steps, spent = [each.steps for each in fooled], [each.seconds for each in fooled]
        yield [
            name,
            str(len(group)),
            interval(rate),
            *(f"{np.quantile(steps, q):.0f}" if steps else "-" for q in SHARES.values()),
            *(f"{np.quantile(spent, q):.2f}" if spent else "-" for q in SHARES.values()),
        ]


def finding(done: Sequence[Attack]) -> str:
    """Whether "fewer than 10 iterations, a few seconds" holds, failures counted as attacks that never end."""
    steps = [each.steps if each.fooled else np.inf for each in done]
    few = share(sum(value < FEWER for value in steps), len(steps))
    median, spent = np.median(steps), np.median([each.seconds for each in done])
    return (
        f"The paper: an adversary normally takes fewer than {FEWER} iterations, thus a few seconds. Here "
        f"{few['value']:.0%} [{few['low']:.0%}, {few['high']:.0%}] take fewer; the median attack, failures counted as "
        f"endless, takes {median:.0f} iterations and {spent:.2f} s: {'met' if median < FEWER else 'not met'}."
    )


def measure(study: Study, settings: RunTimeSettings) -> Section:
    """Iterations by pixels and against the classifier's pass, and whole attacks."""
    first, solid = study.subjects[0], Subject("solid", load_object(SOLID).mesh, study.label)
    setups = (
        Setup(f"{first.name}, textured, smooth, 2×2 samples", finer(first), 2, "smooth"),
        Setup("solid:orange, flat, 1 sample", finer(solid), 1, "flat"),
    )

    def measured(setup: Setup, fields: Sequence[float], passes: int) -> list[Iteration]:
        return [
            stubborn(setup, kind, study.classifier, study.light, field, passes, settings.turns)
            for kind in ATTACKS
            for field in fields
        ]

    by_pixels = measured(setups[0], FIELDS, settings.passes)
    largest = {kind: next(each for each in by_pixels if each.kind == kind) for kind in ATTACKS}
    plain = measured(setups[1], FIELDS[:1], settings.passes)
    at_once = [each for setup in reversed(setups) for each in measured(many(setup), FIELDS[:1], MANY_PASSES)]
    training = training_step(study, settings.passes, settings.turns // 2)
    done = [each for subject in study.subjects for each in attacks(subject, study, settings)]
    share_of = {kind: np.median(np.divide(each.inside, each.whole)) for kind, each in largest.items()}
    text = filled(
        __file__,
        size=study.classifier.size,
        classifier=study.classifier.name,
        mesh=first.name,
        vertices=len(setups[0].subject.mesh.vertices),
        iterations=iteration_table(by_pixels),
        most=largest["lighting"].pixels,
        classifier_share=f"{share_of['lighting']:.0%}",
        geometry_share=f"{share_of['geometry']:.0%}",
        ratios=ratio_table([training, *at_once, *plain, *largest.values()]),
        examples=len(done),
        batch=BATCH,
        max_steps=settings.max_steps,
        distribution=markdown(ATTACK_COLUMNS, distribution_rows(done, [subject.name for subject in study.subjects])),
        finding=finding(done),
    )
    found: list[Iteration | Attack] = [*by_pixels, *plain, *at_once, training, *done]
    records = [asdict(each) for each in found]
    return Section(text, records, {"run_time.png": partial(draw, by_pixels)})
