"""What an iteration of an attack costs, and how many it takes (the paper's Section 4.2, "Runtime").

PYTHONPATH=. python scripts/paper/run_time.py --meshes FILE FILE:GAIN
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
from common import (
    GREYS,
    Subject,
    arguments,
    command,
    recognised_scene,
    scene_of,
    subjects,
    table,
    versions,
    write_section,
)
from torch import Tensor, nn

from augment.backgrounds import load_backgrounds
from augment.cost import adversarial_cost
from augment.descent import DescentSettings, Goal, descend
from augment.objects import ObjectSettings, SceneObject, load_object
from augment.parameters import Geometry, Lighting, StepSettings
from augment.perturbation import Perturbation
from augment.scene import Scene
from augment.service import AugmentationService, AugmentationSettings, TrainingAttackSettings
from renderer.camera import ring
from renderer.image import PictureSettings
from renderer.lights import load_light
from renderer.subdivision import subdivide
from renderer.visibility import choose
from train.photographs.shares import share
from train.run_classifier import load_classifier

VERTICES = 10_000
FIELDS = (2.0, 2.8, 4.0, 5.7, 8.0)  # each halves the pixels of the one before
KINDS = {
    "lighting": (Lighting, StepSettings("linf", None, "unit", 0.05)),
    "geometry": (Geometry, StepSettings("linf", 0.002, "sign", 0.0005)),
}
TARGETS = {"lighting": 1.05, "geometry": 1.3}
TRAINING, TRAINING_TARGET = "the training's, 100 examples, 32², WideResNet-16-4", 1.03
PRETRAINED = Path(__file__).parents[2] / "pretrained" / "none"
SOLID = ObjectSettings("solid:orange", "orange")
EXAMPLES, MANY_PASSES = 100, 2  # at once, as in training; so many take their time
BATCH = 32  # pictures per pass through the classifier, as in conf/attack.yaml
FEWER = 10  # iterations, the paper's
SHARES = {"quartile": 0.25, "median": 0.5, "third quartile": 0.75, "90 %": 0.9, "most": 1.0}
ITERATION_COLUMNS = ["attack", "pixels", "classifier, ms", "renderer, ms", "iteration, ms"]
RATIO_COLUMNS = [
    *("attack", "on", "classifier's pass, ms", "renderer, ms", "iteration, ms"),
    *("iteration / pass", "1 + renderer / pass", "target"),
]
ATTACK_COLUMNS = ["mesh", "attacks", "fooled", *(f"{unit}, {name}" for unit in ("steps", "s") for name in SHARES)]
COLOURS = ("#a9b8d8", "#e8743b")  # classifier, renderer

TEXT = """
One CPU thread, process time, medians; what is compared is measured in turns within one run, and the intervals are the
quartiles of the turns. An iteration is all that an attack does for one step: render, ask the classifier, differentiate
both, step, project.

### An iteration against the pixels that need derivatives

One picture of {size}², {classifier}, the mesh {mesh} with {vertices:,} vertices, its texture, smooth normals and 2×2
samples a pixel; the field of view sets how many pixels it covers. Lighting keeps what it rasterised; geometry
rasterises anew at every step.

![Milliseconds per iteration](paper/run_time.png)

{iterations}

The paper's inset plots the time per iteration, which grows with the pixels that need derivatives, and prints no figure.
Ours grows with them too. The classifier, whose cost does not depend on them, takes {classifier_share} of the time with
light and {geometry_share} with shape at {most:,} pixels. The paper differentiates in Python on a Xeon of 3.5 GHz and
rasterises by OpenGL on a GTX 1080, for ResNet-101, which is about twenty times as much work as {classifier}.

### Against the classifier's own forward and input-gradient pass

{ratios}

On a machine that others share, the same pass through the classifier takes a tenth more or less from one second to the
next, at times a quarter, and iteration / pass with it. 1 + renderer / pass leaves that out; the renderer is all of
an iteration but the pass; the targets are judged by it.

100 examples at 224² are 20 views on 5 backgrounds, {batch} per pass through {classifier}. At 32² a step is that of the
training's attack: two meshes, 10 views and 5 backgrounds, WideResNet-16-4 as in `pretrained/none`, with its bias for
the label raised so that no example leaves the batch. A single picture's iteration finds in the processor's cache what
the classifier left there: a good part of its cost by light is reading the operator twice, which pictures of one view
share.

### How many iterations, how many seconds

An attack on the light of {examples} pictures that {classifier} recognises, one after the other: steps of 0.05 along the
gradient at unit length, at most {max_steps}, no limit to the norm. Seconds include what is rendered once per picture.

{distribution}

{finding}

{command}

{versions}
"""


@dataclass(frozen=True)
class Setup:
    """What the pictures show, every view on each background, and how they are drawn."""

    name: str
    subject: Subject
    samples: int
    normals: str
    views: int = 1
    backgrounds: Sequence[float] = (0.5,)


@dataclass(frozen=True)
class Iteration:
    """Milliseconds per iteration at one number of pixels. (turns,) each."""

    setup: str
    kind: str
    pixels: int
    bare: tuple[float, ...]  # the classifier's forward and input-gradient pass alone
    whole: tuple[float, ...]  # an iteration of the attack
    inside: tuple[float, ...]  # its part in the classifier

    @property
    def renderer(self) -> np.ndarray:
        return np.subtract(self.whole, self.inside)


@dataclass(frozen=True)
class Attack:
    """One picture's attack. prepared: seconds spent on what is rendered once."""

    mesh: str
    fooled: bool
    steps: int
    seconds: float
    prepared: float


class Stopwatch:
    """Adds up the process time of a descent's passes through the classifier; see `augment.phases.Phases`."""

    def __init__(self):
        self.seconds = 0.0

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.process_time()
        yield
        self.seconds += (time.process_time() - start) * (name == "attack_classifier")


def seconds(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def classifier_pass(model: nn.Module, images: Tensor, labels: Tensor, batch_size: int) -> None:
    """Pictures' logits and the gradient of their cost."""
    for part, label in zip(images.split(batch_size), labels.split(batch_size), strict=True):
        pictures = part.detach().requires_grad_(True)
        torch.autograd.grad(adversarial_cost(model(pictures), label).sum(), pictures)


def iteration(
    setup: str,
    kind: str,
    pixels: int,
    model: nn.Module,
    images: Tensor,
    labels: Tensor,
    attack: Callable,
    batch_size: int,
    passes: int,
    turns: int,
) -> Iteration:
    """attack: a descent of so many passes, given a stopwatch. The first turn is a rehearsal."""
    rows = []
    for _ in range(turns + 1):
        watch = Stopwatch()
        whole = seconds(lambda watch=watch: attack(watch))
        bare = seconds(lambda: [classifier_pass(model, images, labels, batch_size) for _ in range(passes)])
        rows.append([1000 * value / passes for value in (bare, whole, watch.seconds)])
    return Iteration(setup, kind, pixels, *(tuple(column) for column in zip(*rows[1:], strict=True)))


def stubborn(
    setup: Setup, kind: str, classifier: nn.Module, field: float, passes: int, options: argparse.Namespace
) -> Iteration:
    """An attack that never succeeds, since its targets are the least likely classes."""
    size, subject = classifier.size, setup.subject
    views = ring(setup.views, field)
    cameras, behind = zip(*product(views, setup.backgrounds), strict=True)
    picture, count = PictureSettings(size, setup.samples, normals=setup.normals), len(cameras)
    scene = Scene.of_mesh(
        subject.mesh,
        [[camera] for camera in cameras],
        load_backgrounds(behind, size),
        load_light(options.light),
        picture,
        choose(),
        subject.gain,
    )
    make, settings = KINDS[kind]
    problem = Perturbation(scene, [make(scene, settings)])
    images = problem.render(problem.start, torch.arange(count)).detach()[:, 0]
    label = torch.full((count, 1), classifier.label(subject.label))
    least_likely = torch.cat([classifier(part).argmin(1, keepdim=True) for part in images.split(BATCH)])
    descent = DescentSettings(passes - 1, shorten=kind == "geometry", batch_size=BATCH)
    return iteration(
        setup.name,
        kind,
        covered(scene),
        classifier,
        images,
        label[:, 0],
        lambda watch: descend(classifier, problem, Goal(label, least_likely), descent, watch),
        BATCH,
        passes,
        options.turns,
    )


def training_step(chosen: Sequence[Subject], options: argparse.Namespace) -> Iteration:
    """The training's attack at 32² on 100 examples of two meshes."""
    classifier = load_classifier(f"run:{PRETRAINED}")
    label, views = classifier.label(options.label), EXAMPLES // len(chosen) // len(GREYS)
    objects = [SceneObject(item.label, item.mesh, item.gain) for item in chosen]
    behind, settings = load_backgrounds(GREYS, classifier.size), PictureSettings(classifier.size)
    scene = Scene.grid(objects, ring(views, 2.0), behind, load_light(options.light), settings, choose())
    with torch.no_grad():
        classifier.function.head.bias[label] += 100
    labels = torch.full((len(scene),), label)
    attack = AugmentationSettings(
        examples=len(scene), attack=TrainingAttackSettings(max_steps=options.passes - 1, batch_size=len(scene))
    )

    def regenerate(watch: Stopwatch) -> None:
        AugmentationService(attack, scene, labels, options.seed, watch).regenerate(classifier, 0)

    everything = torch.arange(len(scene))
    images = scene.render(scene.conditions(everything), everything)[:, 0]
    return iteration(
        TRAINING,
        "lighting",
        len(scene.stacks[0].pixels),
        classifier,
        images,
        labels,
        regenerate,
        len(scene),
        options.passes,
        options.turns // 2,
    )


def covered(scene: Scene) -> int:
    """Pixels of a view that the mesh covers, on average."""
    return int(np.mean([int((each > 0).sum()) for stack in scene.stacks for each in stack.coverage]))


def many(setup: Setup) -> Setup:
    """The same for 100 pictures."""
    return replace(setup, name=f"{setup.name}, {EXAMPLES} examples", views=EXAMPLES // len(GREYS), backgrounds=GREYS)


def fine(subject: Subject) -> Subject:
    return replace(subject, mesh=subdivide(subject.mesh, VERTICES))


def attacks(subject: Subject, classifier: nn.Module, options: argparse.Namespace) -> Iterator[Attack]:
    """Attack the light of recognised pictures, each on its own."""
    scene = recognised_scene(subject, classifier, options.light, options.examples, options.seed)
    goal = Goal(torch.tensor([[classifier.label(subject.label)]]))
    for example in range(len(scene)):
        one = scene_of(subject, classifier, options.light, [scene.cameras[example]], scene.backgrounds[example, :1, 0])
        prepared = seconds(lambda one=one: one.stacks)
        problem = Perturbation(one, [Lighting(one, KINDS["lighting"][1])])
        start = time.process_time()
        result = descend(classifier, problem, goal, DescentSettings(options.max_steps), Stopwatch())
        spent = time.process_time() - start
        yield Attack(subject.name, bool(result.fooled), int(result.steps), prepared + spent, prepared)


def quartiles(values: Sequence[float], digits: int) -> str:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def one_digit(values: Sequence[float]) -> str:
    return quartiles(values, 1)


def iteration_rows(measured: Sequence[Iteration]) -> list[list[str]]:
    return [
        [each.kind, f"{each.pixels:,}", *map(one_digit, (each.inside, each.renderer, each.whole))] for each in measured
    ]


def ratio_row(each: Iteration) -> list[str]:
    ratio = 1 + each.renderer / each.bare
    target = TRAINING_TARGET if each.setup == TRAINING else TARGETS[each.kind]
    met = "met" if np.median(ratio) <= target else "not met"
    return [
        each.kind,
        each.setup,
        *map(one_digit, (each.bare, each.renderer, each.whole)),
        *(quartiles(values, 3) for values in (np.divide(each.whole, each.bare), ratio)),
        f"{target}: {met}",
    ]


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
            f"{rate['value']:.2f} [{rate['low']:.2f}, {rate['high']:.2f}]",
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


def draw(measured: Sequence[Iteration], path: Path) -> None:
    """A panel per kind: the classifier's share below the renderer's, against pixels."""
    figure, panels = plt.subplots(1, len(KINDS), figsize=(8, 2.9), sharey=True)
    for panel, kind in zip(panels, KINDS, strict=True):
        rows = sorted((each for each in measured if each.kind == kind), key=lambda each: each.pixels)
        parts = [[np.median(each.inside) for each in rows], [np.median(each.renderer) for each in rows]]
        panel.stackplot([each.pixels for each in rows], parts, labels=["classifier", "renderer"], colors=COLOURS)
        panel.set(title=kind, xlabel="pixels that need derivatives", xticks=range(0, 40_000, 10_000))
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("ms per iteration")
    panels[0].set_ylim(0, 1.05 * max(np.median(each.whole) for each in measured))
    panels[0].legend(loc="upper left", frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    options = arguments(__doc__, examples=50, max_steps=30, passes=5, turns=20).parse_args()
    matplotlib.use("Agg")
    torch.set_num_threads(1)
    chosen, classifier = subjects(options), load_classifier(options.classifier, options.weights)
    solid = Subject("solid", load_object(SOLID).mesh, options.label)
    setups = (
        Setup(f"{chosen[0].name}, textured, smooth, 2×2 samples", fine(chosen[0]), 2, "smooth"),
        Setup("solid:orange, flat, 1 sample", fine(solid), 1, "flat"),
    )
    measured = [
        stubborn(setups[0], kind, classifier, field, options.passes, options) for kind in KINDS for field in FIELDS
    ]
    largest = {kind: next(each for each in measured if each.kind == kind) for kind in KINDS}
    plain = [stubborn(setups[1], kind, classifier, FIELDS[0], options.passes, options) for kind in KINDS]
    at_once = [
        stubborn(many(setup), kind, classifier, FIELDS[0], MANY_PASSES, options)
        for setup in reversed(setups)
        for kind in KINDS
    ]
    training = training_step(chosen, options)
    done = [each for subject in chosen for each in attacks(subject, classifier, options)]
    share_of = {kind: np.median(np.divide(each.inside, each.whole)) for kind, each in largest.items()}
    text = TEXT.format(
        size=classifier.size,
        classifier=classifier.name,
        mesh=chosen[0].name,
        vertices=len(setups[0].subject.mesh.vertices),
        iterations=table(ITERATION_COLUMNS, iteration_rows(measured)),
        most=largest["lighting"].pixels,
        classifier_share=f"{share_of['lighting']:.0%}",
        geometry_share=f"{share_of['geometry']:.0%}",
        ratios=table(RATIO_COLUMNS, map(ratio_row, (training, *at_once, *plain, *largest.values()))),
        examples=len(done),
        batch=BATCH,
        max_steps=options.max_steps,
        distribution=table(ATTACK_COLUMNS, distribution_rows(done, [subject.name for subject in chosen])),
        finding=finding(done),
        command=command(),
        versions=versions(),
    )
    records = [asdict(each) for each in (*measured, *plain, *at_once, training, *done)]
    write_section(options.out, "run_time", "Run time", text, records)
    draw(measured, options.out / "paper" / "run_time.png")


if __name__ == "__main__":
    main()
