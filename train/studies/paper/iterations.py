"""What an iteration of an attack costs, beside the classifier's own pass, by pixels and by examples at once."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from augment.attacks.criteria import Goal, adversarial_cost
from augment.attacks.descent import DescentSettings, descend
from augment.backgrounds import load_backgrounds
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.scene import Scene
from augment.service import AugmentationService, AugmentationSettings, TrainingAttackSettings
from augment.utils import Phases
from renderer.camera import ring
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.visibility import choose
from train.run_folder.classifier import load_classifier
from train.studies.figures import panels_beside, save
from train.studies.paper.adversaries import ATTACKS
from train.studies.paper.section import Study
from train.studies.paper.subjects import GREYS, scene_of
from train.studies.renderer_speed.measure import seconds
from train.wideresnet import WideResNet

TRAINING = "the training's, 100 examples, 32², WideResNet-16-4"
PRETRAINED = "run:pretrained/none"
EXAMPLES = 100  # at once, as in training
BATCH = 32  # images per pass through the classifier, as in conf/attack.yaml
COLOURS = ("#a9b8d8", "#e8743b")  # classifier, renderer


@dataclass(frozen=True)
class Setup:
    """What the images show, every view on each background, and how they are drawn."""

    name: str
    subject: SceneObject
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


def classifier_pass(model: nn.Module, images: Tensor, labels: Tensor, batch_size: int) -> None:
    """Images' logits and the gradient of their cost."""
    for part, label in zip(images.split(batch_size), labels.split(batch_size), strict=True):
        variable = part.detach().requires_grad_(True)
        torch.autograd.grad(adversarial_cost(model(variable), label).sum(), variable)


def milliseconds(
    attack: Callable[[Stopwatch], None], alone: Callable[[], None], passes: int, turns: int
) -> list[tuple[float, ...]]:
    """Bare, whole and inside of an `Iteration`. attack: of so many passes, given a stopwatch. alone: one of them. The
    first turn rehearses."""
    rows = []
    for _ in range(turns + 1):
        watch = Stopwatch()
        whole = seconds(partial(attack, watch))
        bare = sum(seconds(alone) for _ in range(passes))
        rows.append([1000 * value / passes for value in (bare, whole, watch.seconds)])
    return [tuple(column) for column in zip(*rows[1:], strict=True)]


def stubborn(
    setup: Setup, kind: str, classifier: Classifier, light: str, field: float, passes: int, turns: int
) -> Iteration:
    """An attack that never succeeds, since its targets are the least likely classes."""
    views = ring(setup.views, field)
    cameras, greys = zip(*product(([view] for view in views), setup.backgrounds), strict=True)
    scene = scene_of(setup.subject, classifier, light, cameras, torch.tensor(greys), setup.samples, setup.normals)
    problem = ATTACKS[kind].problem(scene)
    images = problem.images(problem.start)[:, 0]
    label = torch.full((len(scene), 1), classifier.label(setup.subject.label))
    least_likely = torch.cat([classifier(part).argmin(1, keepdim=True) for part in images.split(BATCH)])
    descent = DescentSettings(passes - 1, shorten=kind == "geometry", batch_size=BATCH)
    alone = partial(classifier_pass, classifier, images, label[:, 0], BATCH)

    def attack(watch: Stopwatch) -> None:
        descend(classifier, problem, Goal(label, least_likely), descent, watch)

    found = milliseconds(attack, alone, passes, turns)
    return Iteration(setup.name, kind, covered(scene), *found)


def training_step(study: Study, passes: int, turns: int) -> Iteration:
    """The training's attack at 32² on 100 examples of two meshes."""
    classifier = load_classifier(PRETRAINED)
    label, views = classifier.label(study.label), EXAMPLES // len(study.subjects) // len(GREYS)
    behind, drawn = load_backgrounds(GREYS, classifier.size), ImageSettings(classifier.size)
    scene = Scene.grid(study.subjects, ring(views, 2.0), behind, load_light(study.light), drawn, choose())
    with torch.no_grad():
        cast(WideResNet, classifier.function).head.bias[label] += 100
    labels = torch.full((len(scene),), label)
    attack = AugmentationSettings(
        examples=len(scene), attack=TrainingAttackSettings(max_steps=passes - 1, batch_size=len(scene))
    )

    def regenerate(watch: Stopwatch) -> None:
        AugmentationService(attack, scene, labels, study.seed, watch).regenerate(classifier, 0)

    everything = torch.arange(len(scene))
    images = scene.render(scene.conditions(everything), everything)[:, 0]
    alone = partial(classifier_pass, classifier, images, labels, len(scene))
    found = milliseconds(regenerate, alone, passes, turns)
    return Iteration(TRAINING, "lighting", len(scene.stacks[0].pixels), *found)


def covered(scene: Scene) -> int:
    """Pixels of a view that the mesh covers, on average."""
    return int(np.mean([int((each > 0).sum()) for stack in scene.stacks for each in stack.coverage]))


def many(setup: Setup) -> Setup:
    """The same for 100 images."""
    return replace(setup, name=f"{setup.name}, {EXAMPLES} examples", views=EXAMPLES // len(GREYS), backgrounds=GREYS)


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
