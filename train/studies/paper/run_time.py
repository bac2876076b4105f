"""What an iteration of an attack costs, and how many it takes (the paper's Section 4.2, "Runtime")."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
import torch

from augment.attacks.criteria import Goal
from augment.attacks.descent import DescentSettings, descend
from augment.objects import ObjectSettings, SceneObject
from train.photographs.shares import share
from train.report.tables import markdown
from train.studies.paper.adversaries import ATTACKS
from train.studies.paper.iterations import (
    BATCH,
    TRAINING,
    Iteration,
    Setup,
    Stopwatch,
    draw,
    many,
    stubborn,
    training_step,
)
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.subjects import finer, greys_of, load_subject, recognised_scene, scene_of
from train.studies.renderer_speed.measure import seconds

TITLE = "Run time"


@dataclass
class Settings(SectionSettings):
    """examples: of each mesh that are attacked, in max_steps at most. passes: of a timed descent. turns: of them."""

    examples: int
    max_steps: int
    passes: int
    turns: int


FIELDS = (2.0, 2.8, 4.0, 5.7, 8.0)  # each halves the pixels of the one before
SOLID = "solid:orange"
MANY_PASSES = 2  # of a timed descent on many examples at once, which takes its time
FEWER = 10  # iterations, the paper's
QUANTILES = {"quartile": 0.25, "median": 0.5, "third quartile": 0.75, "90 %": 0.9, "most": 1.0}
TARGETS, TRAINING_TARGET = {"lighting": 1.05, "geometry": 1.3}, 1.03
RATIO_COLUMNS = ["attack", "on", "classifier's pass, ms", "renderer, ms", "1 + renderer / pass", "target"]


def measure(study: Study, settings: Settings) -> Section:
    """Iterations by pixels and against the classifier's pass, and whole attacks."""
    first = finer(study.subjects[0])
    textured = Setup(f"{first.name}, textured, smooth, 2×2 samples", first, 2, "smooth")
    plain = Setup("solid:orange, flat, 1 sample", finer(load_subject(ObjectSettings(SOLID, study.label))), 1, "flat")

    def measured(setup: Setup, fields: Sequence[float], passes: int) -> list[Iteration]:
        return [
            stubborn(setup, kind, study.classifier, study.light, field, passes, settings.turns)
            for kind in ATTACKS
            for field in fields
        ]

    by_pixels = measured(textured, FIELDS, settings.passes)
    largest = by_pixels[:: len(FIELDS)]
    single = measured(plain, FIELDS[:1], settings.passes)
    at_once = [each for setup in (plain, textured) for each in measured(many(setup), FIELDS[:1], MANY_PASSES)]
    training = training_step(study, settings.passes, max(1, settings.turns // 2))
    done = [each for subject in study.subjects for each in attacks(subject, study, settings)]
    values = {
        "mesh": first.name,
        "vertices": len(first.mesh.vertices),
        "most": largest[0].pixels,
        "inside": {each.kind: f"{np.median(np.divide(each.inside, each.whole)):.0%}" for each in largest},
        "ratios": markdown(RATIO_COLUMNS, map(ratio_row, [training, *at_once, *single, *largest])),
        "examples": len(done),
        "batch": BATCH,
        "distribution": markdown(["", *QUANTILES], distribution(done)),
        "finding": finding(done),
    }
    found: list[Iteration | Attack] = [*by_pixels, *single, *at_once, training, *done]
    return Section(values, [asdict(each) for each in found], {"run_time.png": partial(draw, by_pixels)})


def ratio_row(each: Iteration) -> list[str]:
    ratio = 1 + each.renderer / each.bare
    target = TRAINING_TARGET if each.setup == TRAINING else TARGETS[each.kind]
    met = "met" if np.median(ratio) <= target else "not met"
    times = quartiles(each.bare), quartiles(each.renderer), quartiles(ratio, 3)
    return [each.kind, each.setup, *times, f"{target}: {met}"]


def quartiles(values: Sequence[float] | np.ndarray, digits: int = 1) -> str:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


@dataclass(frozen=True)
class Attack:
    """One image's attack. seconds: also of what is rendered once."""

    mesh: str
    success: bool
    steps: int
    seconds: float


def attacks(subject: SceneObject, study: Study, settings: Settings) -> Iterator[Attack]:
    """Attack the light of recognised images, each on its own."""
    classifier = study.classifier
    scene = recognised_scene(subject, classifier, study.light, settings.examples, study.seed)
    goal = Goal(torch.tensor([[classifier.label(subject.label)]]))
    for example in range(len(scene)):
        one = scene_of(
            subject, classifier, study.light, [scene.cameras[example]], greys_of(scene)[example : example + 1]
        )
        prepared = seconds(partial(getattr, one, "stacks"))
        problem = ATTACKS["lighting"].problem(one)
        start = time.process_time()
        result = descend(classifier, problem, goal, DescentSettings(settings.max_steps), Stopwatch())
        spent = time.process_time() - start
        yield Attack(subject.name, bool(result.success), int(result.steps), prepared + spent)


def distribution(done: Sequence[Attack]) -> Iterator[list[str]]:
    """Steps and seconds of the attacks that succeed."""
    for name, digits in (("steps", 0), ("seconds", 2)):
        values = [getattr(each, name) for each in done if each.success]
        yield [name, *(f"{np.quantile(values, q):.{digits}f}" if values else "-" for q in QUANTILES.values())]


def finding(done: Sequence[Attack]) -> str:
    """Whether "fewer than 10 iterations, a few seconds" holds, failures counted as attacks that never end."""
    steps = [each.steps if each.success else np.inf for each in done]
    few = share(sum(value < FEWER for value in steps), len(steps))
    median, spent = np.median(steps), np.median([each.seconds for each in done])
    return (
        f"{few['value']:.0%} [{few['low']:.0%}, {few['high']:.0%}] take fewer; the median attack, failures counted as "
        f"endless, takes {median:.0f} iterations and {spent:.2f} s: {'met' if median < FEWER else 'not met'}."
    )
