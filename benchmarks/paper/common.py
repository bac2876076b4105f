"""What the paper's benchmarks share: options, networks, meshes, clean-correct views, and JSON lines.

docs/results.md has the commands, which run in the root of the clone. A mesh is a file, solid:NAME:SEED, or a
YAML mapping such as '{mesh: banana.glb, label: banana, albedo_scale: 2}'.
"""

import argparse
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from augment import AttackSettings, Classifier, Scene, StepSettings
from augment.attacks.attack import logits_of
from augment.scene.conditions import Example
from augment.scene.objects import SceneObject, load_object
from augment.settings import ObjectSettings
from benchmarks.common import Row, machine
from renderer import ImageSettings, InputError, OrthographicCamera, load_light
from renderer.visibility.rasterizers import choose
from train.runs.saved_networks import load_network

VERTICES = 10_000  # shapes that are attacked have more (the paper's Section 4)
WIDTHS = (2.0, 3.0)  # of the image in world units (the paper's appendix on rendering quality)
GRAYS = (0.0, 0.25, 0.5, 0.75, 1.0)
BATCH = 10  # examples that are rendered or attacked at once: a shape's gradient keeps all samples of its images
LEAST_CORRECT = 0.02  # a fraction; below it the search for clean-correct views is given up
STEPS = {  # the paper's appendix C
    "lighting": StepSettings("linf", None, "unit", 0.05),
    "geometry": StepSettings("linf", 0.002, "sign", 0.0005),
}

View = tuple[OrthographicCamera, float]  # and the gray of the background


def parser(study: str | None, description: str | None) -> argparse.ArgumentParser:
    """The options of every benchmark. study: the name of its table, None where it is an option."""
    options = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if study is not None:
        options.set_defaults(study=study)
    mesh = "files, solid:NAME:SEED or {mesh, label, albedo_scale}"
    options.add_argument("--out", type=Path, required=True, help="JSON lines are appended to this file")
    options.add_argument("--meshes", nargs="+", required=True, help=mesh)
    options.add_argument("--classifier", default="efficientnet_lite0", help="attacked: NAME[=WEIGHTS] or run:FOLDER")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--threads", type=int, default=1, help="of the CPU")
    return options


def prepare(
    options: argparse.ArgumentParser, argv: Sequence[str] | None, vertices: int = 0
) -> tuple[argparse.Namespace, Classifier, list[SceneObject]]:
    """Parse the arguments, load network and meshes, and begin a run in the file of JSON lines.

    vertices: subdivide meshes until they have more.
    """
    arguments = options.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    classifier = load_network(*arguments.classifier.split("=", 1))
    items = [read_item(mesh) for mesh in arguments.meshes]
    subjects = [replace(load_object(item, vertices), name=Path(item.mesh).stem) for item in items]
    begin(arguments)
    return arguments, classifier, subjects


def read_item(mesh: str) -> ObjectSettings:
    """A value of --meshes; an orange where it has no label."""
    given = yaml.safe_load(mesh)
    return ObjectSettings(**({"label": "orange"} | (given if isinstance(given, dict) else {"mesh": mesh})))


def begin(arguments: argparse.Namespace) -> None:
    """Append the line that begins a run: its settings, and the machine."""
    settings = {name: value for name, value in vars(arguments).items() if name != "out"}
    append(arguments.out, {"run": settings | {"machine": machine()}})


def append(path: Path, row: Mapping[str, Any]) -> None:
    """One line of JSON at the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def last_run(path: Path) -> tuple[Row, list[Row]]:
    """(settings, records) of the last run in a file of JSON lines."""
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    last = max(index for index, row in enumerate(rows) if "run" in row)
    return rows[last]["run"], rows[last + 1 :]


def attack_settings(kind: str, max_steps: int = 30, step: StepSettings | None = None, **more: Any) -> AttackSettings:
    """The paper's attack (its appendix C): any light, an end where the network errs. step: another than the paper's."""
    settings = {kind: step or STEPS[kind], "max_steps": max_steps, "allow_negative": True, "margin": 0.0}
    shorten = kind == "geometry"  # its gradient holds visibility fixed, so that whole steps may raise the cost
    as_they_are = {"rounded": False, "sensor_noise": 0.0}
    return AttackSettings(**{**settings, **as_they_are, "shorten": shorten, **more})


def scene_of(subject: SceneObject, size: int, views: Sequence[View]) -> Scene:
    """An example per view, under the light where attacks begin."""
    return Scene(
        [subject],
        [Example(0, (camera,), index) for index, (camera, _) in enumerate(views)],
        torch.tensor([gray for _, gray in views]).view(-1, 1, 1, 1).expand(-1, 3, size, size),
        load_light("grace"),
        ImageSettings(size, samples=2, normals="smooth"),
        choose(),
    )


def random_views(count: int, draws: torch.Generator) -> list[View]:
    """Views from π/3 off the zenith (the paper's) and any azimuth, of width 2 or 3, on a gray."""
    azimuths = (2 * math.pi * torch.rand(count, generator=draws)).tolist()
    widths = torch.randint(len(WIDTHS), (count,), generator=draws).tolist()
    grays = torch.randint(len(GRAYS), (count,), generator=draws).tolist()
    return [
        (OrthographicCamera(math.pi / 3, azimuth, WIDTHS[width]), GRAYS[gray])
        for azimuth, width, gray in zip(azimuths, widths, grays, strict=True)
    ]


def clean_correct_views(subject: SceneObject, classifier: Classifier, count: int, draws: torch.Generator) -> list[View]:
    """As many random views that the classifier gets right. InputError: hardly any is."""
    correct: list[View] = []
    drawn = 0
    while len(correct) < count:
        views = random_views(BATCH, draws)
        predicted = predictions(classifier, images_of(scene_of(subject, classifier.size, views)))
        correct += [view for view, name in zip(views, predicted, strict=True) if name == subject.label]
        drawn += len(views)
        if len(correct) < LEAST_CORRECT * drawn - BATCH:
            raise InputError(f"{classifier.name} gets only {len(correct)} of {drawn} images of {subject.name} right")
    return correct[:count]


def batches(views: Sequence[View]) -> Iterator[Sequence[View]]:
    for first in range(0, len(views), BATCH):
        yield views[first : first + BATCH]


@torch.no_grad()
def images_of(scene: Scene) -> Tensor:
    """(E, 1, 3, size, size) of all examples under the scene's own light."""
    examples = torch.arange(len(scene))
    return scene.render(scene.conditions(examples), examples)


def predictions(classifier: Classifier, images: Tensor) -> list[str]:
    """The predicted class of the one view of each of E examples (E, 1, 3, size, size)."""
    return [classifier.classes[index] for index in logits_of(classifier, images, BATCH)[:, 0].argmax(1).tolist()]
