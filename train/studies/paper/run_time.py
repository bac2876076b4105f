"""What an iteration of an attack costs, and how many it takes (the paper's Section 4.2, "Runtime")."""

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from augment.backgrounds import load_backgrounds
from augment.classifiers import Classifier
from augment.descent import DescentSettings, Goal, adversarial_cost, descend
from augment.objects import ObjectSettings, SceneObject, load_object
from augment.phases import Phases
from augment.scene import Scene
from augment.service import AugmentationService, AugmentationSettings, TrainingAttackSettings
from renderer.camera import ring
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.visibility import choose
from train.photographs.shares import share
from train.run_classifier import load_classifier
from train.studies.figures import panels_beside, save
from train.studies.paper.adversaries import ATTACKS
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import interval
from train.studies.paper.subjects import GREYS, Subject, finer, recognised_scene, scene_of
from train.tables import markdown
from train.wideresnet import WideResNet

FIELDS = (2.0, 2.8, 4.0, 5.7, 8.0)  # each halves the pixels of the one before
TARGETS = {"lighting": 1.05, "geometry": 1.3}
TRAINING, TRAINING_TARGET = "the training's, 100 examples, 32², WideResNet-16-4", 1.03
PRETRAINED = "run:pretrained/none"
SOLID = ObjectSettings("solid:orange", "orange")
EXAMPLES, MANY_PASSES = 100, 2  # at once, as in training; so many take their time
BATCH = 32  # images per pass through the classifier, as in conf/attack.yaml
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

One image of {size}², {classifier}, the mesh {mesh} with {vertices:,} vertices, its texture, smooth normals and 2×2
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
the label raised so that no example leaves the batch. A single image's iteration finds in the processor's cache what
the classifier left there: a good part of its cost by light is reading the operator twice, which images of one view
share.

### How many iterations, how many seconds

An attack on the light of {examples} images that {classifier} recognises, one after the other: steps of 0.05 along the
gradient at unit length, at most {max_steps}, no limit to the norm. Seconds include what is rendered once per image.

{distribution}

{finding}
"""


@dataclass
class RunTimeSettings(SectionSettings):
    """examples: of each mesh that are attacked, in max_steps at most. passes: of a timed descent. turns: of them."""

    examples: int
    max_steps: int
    passes: int
    turns: int


@dataclass(frozen=True)
class Setup:
    """What the images show, every view on each background, and how they are drawn."""

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
    """One image's attack. prepared: seconds spent on what is rendered once."""

    mesh: str
    fooled: bool
    steps: int
    seconds: float
    prepared: float


class Stopwatch(Phases):
    """Adds up the process time of a descent's passes through the classifier."""

    def __init__(self) -> None:
        super().__init__()
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
    """Images' logits and the gradient of their cost."""
    for part, label in zip(images.split(batch_size), labels.split(batch_size), strict=True):
        variable = part.detach().requires_grad_(True)
        torch.autograd.grad(adversarial_cost(model(variable), label).sum(), variable)


def milliseconds(
    attack: Callable[[Stopwatch], None],
    model: nn.Module,
    images: Tensor,
    labels: Tensor,
    batch_size: int,
    passes: int,
    turns: int,
) -> list[tuple[float, ...]]:
    """Bare, whole and inside of an `Iteration`. attack: of so many passes, given a stopwatch; the first rehearses."""

    def passes_alone() -> None:
        for _ in range(passes):
            classifier_pass(model, images, labels, batch_size)

    rows = []
    for _ in range(turns + 1):
        watch = Stopwatch()
        whole = seconds(partial(attack, watch))
        bare = seconds(passes_alone)
        rows.append([1000 * value / passes for value in (bare, whole, watch.seconds)])
    return [tuple(column) for column in zip(*rows[1:], strict=True)]


def stubborn(
    setup: Setup, kind: str, classifier: Classifier, light: str, field: float, passes: int, turns: int
) -> Iteration:
    """An attack that never succeeds, since its targets are the least likely classes."""
    views = ring(setup.views, field)
    cameras, greys = zip(*product(views, setup.backgrounds), strict=True)
    before, count = [[camera] for camera in cameras], len(cameras)
    scene = scene_of(setup.subject, classifier, light, before, torch.tensor(greys), setup.samples, setup.normals)
    problem = ATTACKS[kind].problem(scene)
    images = problem.render(problem.start, torch.arange(count)).detach()[:, 0]
    label = torch.full((count, 1), classifier.label(setup.subject.label))
    least_likely = torch.cat([classifier(part).argmin(1, keepdim=True) for part in images.split(BATCH)])
    descent = DescentSettings(passes - 1, shorten=kind == "geometry", batch_size=BATCH)

    def attack(watch: Stopwatch) -> None:
        descend(classifier, problem, Goal(label, least_likely), descent, watch)

    found = milliseconds(attack, classifier, images, label[:, 0], BATCH, passes, turns)
    return Iteration(setup.name, kind, covered(scene), *found)


def training_step(study: Study, settings: RunTimeSettings) -> Iteration:
    """The training's attack at 32² on 100 examples of two meshes."""
    classifier = load_classifier(PRETRAINED)
    label, views = classifier.label(study.label), EXAMPLES // len(study.subjects) // len(GREYS)
    objects = [SceneObject(item.label, item.mesh, item.gain) for item in study.subjects]
    behind, drawn = load_backgrounds(GREYS, classifier.size), ImageSettings(classifier.size)
    scene = Scene.grid(objects, ring(views, 2.0), behind, load_light(study.light), drawn, choose())
    with torch.no_grad():
        cast(WideResNet, classifier.function).head.bias[label] += 100
    labels = torch.full((len(scene),), label)
    attack = AugmentationSettings(
        examples=len(scene), attack=TrainingAttackSettings(max_steps=settings.passes - 1, batch_size=len(scene))
    )

    def regenerate(watch: Stopwatch) -> None:
        AugmentationService(attack, scene, labels, study.seed, watch).regenerate(classifier, 0)

    everything = torch.arange(len(scene))
    images = scene.render(scene.conditions(everything), everything)[:, 0]
    found = milliseconds(regenerate, classifier, images, labels, len(scene), settings.passes, settings.turns // 2)
    return Iteration(TRAINING, "lighting", len(scene.stacks[0].pixels), *found)


def covered(scene: Scene) -> int:
    """Pixels of a view that the mesh covers, on average."""
    return int(np.mean([int((each > 0).sum()) for stack in scene.stacks for each in stack.coverage]))


def many(setup: Setup) -> Setup:
    """The same for 100 images."""
    return replace(setup, name=f"{setup.name}, {EXAMPLES} examples", views=EXAMPLES // len(GREYS), backgrounds=GREYS)


def attacks(subject: Subject, study: Study, settings: RunTimeSettings) -> Iterator[Attack]:
    """Attack the light of recognised images, each on its own."""
    classifier = study.classifier
    scene = recognised_scene(subject, classifier, study.light, settings.examples, study.seed)
    goal = Goal(torch.tensor([[classifier.label(subject.label)]]))
    for example in range(len(scene)):
        one = scene_of(subject, classifier, study.light, [scene.cameras[example]], scene.backgrounds[example, :1, 0])
        prepared = seconds(partial(getattr, one, "stacks"))
        problem = ATTACKS["lighting"].problem(one)
        start = time.process_time()
        result = descend(classifier, problem, goal, DescentSettings(settings.max_steps), Stopwatch())
        spent = time.process_time() - start
        yield Attack(subject.name, bool(result.fooled), int(result.steps), prepared + spent, prepared)


def quartiles(values: Collection[float], digits: int) -> str:
    low, middle, high = np.quantile([*values], [0.25, 0.5, 0.75])
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def one_digit(values: Collection[float]) -> str:
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


def draw(measured: Sequence[Iteration], path: Path) -> None:
    """A panel per kind: the classifier's share below the renderer's, against pixels."""
    figure, panels = panels_beside(len(ATTACKS), (4, 2.9))
    for panel, kind in zip(panels, ATTACKS, strict=True):
        rows = sorted((each for each in measured if each.kind == kind), key=lambda each: each.pixels)
        parts = [[np.median(each.inside) for each in rows], [np.median(each.renderer) for each in rows]]
        panel.stackplot([each.pixels for each in rows], parts, labels=["classifier", "renderer"], colors=COLOURS)
        panel.set(title=kind, xlabel="pixels that need derivatives", xticks=range(0, 40_000, 10_000))
    panels[0].set_ylabel("ms per iteration")
    panels[0].set_ylim(0, 1.05 * max(np.median(each.whole) for each in measured))
    panels[0].legend(loc="upper left", frameon=False)
    save(figure, path)


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
    training = training_step(study, settings)
    done = [each for subject in study.subjects for each in attacks(subject, study, settings)]
    share_of = {kind: np.median(np.divide(each.inside, each.whole)) for kind, each in largest.items()}
    text = TEXT.format(
        size=study.classifier.size,
        classifier=study.classifier.name,
        mesh=first.name,
        vertices=len(setups[0].subject.mesh.vertices),
        iterations=markdown(ITERATION_COLUMNS, iteration_rows(by_pixels)),
        most=largest["lighting"].pixels,
        classifier_share=f"{share_of['lighting']:.0%}",
        geometry_share=f"{share_of['geometry']:.0%}",
        ratios=markdown(RATIO_COLUMNS, map(ratio_row, (training, *at_once, *plain, *largest.values()))),
        examples=len(done),
        batch=BATCH,
        max_steps=settings.max_steps,
        distribution=markdown(ATTACK_COLUMNS, distribution_rows(done, [subject.name for subject in study.subjects])),
        finding=finding(done),
    )
    found: list[Iteration | Attack] = [*by_pixels, *plain, *at_once, training, *done]
    records = [asdict(each) for each in found]
    return Section(text, records, {"run_time.png": partial(draw, by_pixels)})
