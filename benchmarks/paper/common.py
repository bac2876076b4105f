"""Code that the paper's benchmarks share.

These are options, networks, meshes, views that a network classifies correctly
before an attack ("clean-correct"), and files of JSON lines.

docs/results.md has the commands, which run in the root of the clone. A mesh is a
file, solid:NAME:SEED, or a YAML mapping such as
'{mesh: banana.glb, label: banana, albedo_scale: 2}'.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from augment import AttackSettings, Classifier, Scene, StepSettings
from augment.network import compute_outputs
from augment.random_streams import generator
from augment.scene.objects import Example, SceneObject, load_object
from augment.settings import ObjectSettings
from benchmarks.common import Row, machine
from renderer import ImageSettings, InputError, OrthographicCamera, load_light
from renderer.visibility import choose
from train.checkpoints import load_network

# Meshes whose shape is attacked are subdivided until they have more vertices
# (the paper's Section 4).
VERTICES = 10_000
# Polar angle of all cameras in degrees (the paper's appendix C).
POLAR = 60.0
# Widths of the image in world units (the paper's appendix "Evaluate Rendering
# Quality").
WIDTHS = (2.0, 3.0)
# Gray values of the backgrounds.
GRAYS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Number of examples that are rendered or attacked at once. The gradient of a
# shape keeps all samples of its images, which limits this number.
BATCH_SIZE = 10
# The search for clean-correct views stops with an error when a smaller fraction
# of the drawn views is correct.
MIN_CORRECT_FRACTION = 0.02
# Steps of the paper's attacks (its appendix C).
STEPS = {
    "lighting": StepSettings("linf", None, "unit", 0.05),
    "geometry": StepSettings("linf", 0.002, "sign", 0.0005),
}


@dataclass(frozen=True)
class View:
    """A camera and the background of its image.

    Attributes:
        camera: The camera.
        gray: Gray value of the background in [0, 1].
    """

    camera: OrthographicCamera
    gray: float


@dataclass(frozen=True)
class Setup:
    """Options, classifier and scene of a benchmark.

    Attributes:
        options: Parsed command line.
        classifier: Network that is attacked.
        subjects: Objects that are rendered.
    """

    options: argparse.Namespace
    classifier: Classifier
    subjects: list[SceneObject]


# ---------------------------------------------------------------------------- command line


def make_parser(study: str | None, description: str | None) -> argparse.ArgumentParser:
    """Make a parser with the options that every benchmark of the paper has.

    Args:
        study: Name of the benchmark's table in `benchmarks.paper.table`. None
            if the command line has an argument for it.
        description: Text of --help.

    Returns:
        The parser.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if study is not None:
        parser.set_defaults(study=study)
    add = parser.add_argument
    add("--out", type=Path, required=True, help="JSON lines are appended to this file")
    add(
        "--meshes",
        nargs="+",
        required=True,
        help="files, solid:NAME:SEED or {mesh, label, albedo_scale}",
    )
    add(
        "--classifier",
        default="efficientnet_lite0",
        help="network that is attacked: NAME[=WEIGHTS] or run:FOLDER",
    )
    add("--seed", type=int, default=0)
    add("--threads", type=int, default=1, help="number of threads on the CPU")
    return parser


def add_examples(parser: argparse.ArgumentParser) -> None:
    """Add the option --examples, which `subjects_with_views` reads, to a parser."""
    parser.add_argument("--examples", type=int, default=20, help="number of views of each mesh")


def prepare(
    parser: argparse.ArgumentParser, argv: Sequence[str] | None, vertices: int = 0
) -> Setup:
    """Parse the command line, load the network and the meshes, and begin a run in the file.

    Args:
        parser: Parser of the benchmark.
        argv: Words of the command line. None takes those of the process.
        vertices: Meshes are subdivided until they have more vertices.

    Returns:
        Options, network and objects.

    Raises:
        InputError: If the network or a mesh cannot be loaded.
    """
    options = parser.parse_args(argv)
    torch.set_num_threads(options.threads)
    classifier = load_named_network(options.classifier)
    subjects = []
    for mesh in options.meshes:
        settings = read_mesh(mesh)
        subject = load_object(settings, vertices)
        subjects.append(replace(subject, name=Path(settings.mesh).stem))
    begin_run(options)
    return Setup(options, classifier, subjects)


def load_named_network(name: str) -> Classifier:
    """Load a network whose name may end in =WEIGHTS, a file of its weights.

    Args:
        name: NAME, NAME=WEIGHTS or run:FOLDER.

    Returns:
        The network.
    """
    name, _, weights = name.partition("=")
    return load_network(name, weights or None)


def read_mesh(mesh: str) -> ObjectSettings:
    """Read a value of --meshes, whose label is "orange" by default.

    Args:
        mesh: Name of a mesh, or a YAML mapping.

    Returns:
        Settings of the object.
    """
    given = yaml.safe_load(mesh)
    if not isinstance(given, dict):
        given = {"mesh": mesh}
    return ObjectSettings(**({"label": "orange"} | given))


# ---------------------------------------------------------------------------- JSON lines


def begin_run(options: argparse.Namespace) -> None:
    """Append the line that begins a run to the file: its settings, and the machine.

    Args:
        options: Parsed command line.
    """
    settings = {name: value for name, value in vars(options).items() if name != "out"}
    append(options.out, {"run": settings | {"machine": machine()}})


def append(path: Path, row: Mapping[str, Any]) -> None:
    """Append a line of JSON to a file.

    Args:
        path: File, which is created if it is missing.
        row: Content of the line.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def last_run(path: Path) -> tuple[Row, list[Row]]:
    """Read the last run in a file of JSON lines.

    Args:
        path: File that `begin_run` and `append` wrote.

    Returns:
        Settings of the run, and its records.
    """
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    begin = max(index for index, row in enumerate(rows) if "run" in row)
    return rows[begin]["run"], rows[begin + 1 :]


# ---------------------------------------------------------------------------- attacks and views


def attack_settings(
    kind: str, max_steps: int = 30, step: StepSettings | None = None, **overrides: Any
) -> AttackSettings:
    """Return the settings of the paper's attack (its appendix C).

    Any light is allowed, and an attack ends when the network misclassifies.

    Args:
        kind: Attacked parameter, such as "lighting".
        max_steps: Largest number of steps.
        step: Settings of the steps. None takes those of the paper.
        **overrides: Further fields of `AttackSettings`.

    Returns:
        The settings.
    """
    # The gradient of a shape holds visibility fixed, so that a whole step may
    # raise the cost.
    is_backtracking = kind == "geometry"
    settings: dict[str, Any] = {
        kind: step or STEPS[kind],
        "max_steps": max_steps,
        "allow_negative": True,
        "margin": 0.0,
        "quantized": False,
        "sensor_noise": 0.0,
        "backtracking": is_backtracking,
    }
    return AttackSettings(**(settings | overrides))


def make_scene(subject: SceneObject, size: int, views: Sequence[View]) -> Scene:
    """Make a scene of one object under the light at which attacks start.

    Args:
        subject: Object to render.
        size: Pixels per side of the images.
        views: View of each example.

    Returns:
        Scene with an example for each view.
    """
    examples = [Example(0, (view.camera,), index) for index, view in enumerate(views)]
    grays = torch.tensor([view.gray for view in views])
    backgrounds = grays.view(-1, 1, 1, 1).expand(-1, 3, size, size)
    return Scene(
        [subject],
        examples,
        backgrounds,
        load_light("grace"),
        ImageSettings(size, samples=2, normals="smooth"),
        choose(),
    )


def random_views(count: int, draws: torch.Generator) -> list[View]:
    """Draw views with random azimuths, widths and grays, at the paper's polar angle.

    Args:
        count: Number of views.
        draws: Generator of the random numbers.

    Returns:
        The views.
    """
    azimuths = (360 * torch.rand(count, generator=draws)).tolist()
    widths = torch.randint(len(WIDTHS), (count,), generator=draws).tolist()
    grays = torch.randint(len(GRAYS), (count,), generator=draws).tolist()
    views = []
    for azimuth, width, gray in zip(azimuths, widths, grays, strict=True):
        camera = OrthographicCamera(POLAR, azimuth, WIDTHS[width])
        views.append(View(camera, GRAYS[gray]))
    return views


def subjects_with_views(setup: Setup) -> Iterator[tuple[SceneObject, list[View]]]:
    """Draw --examples views of each subject that the classifier recognizes.

    Args:
        setup: What the benchmark works on.

    Yields:
        Each subject with its views.
    """
    options = setup.options
    for subject in setup.subjects:
        draws = generator(options.seed, subject.name)
        views = clean_correct_views(subject, setup.classifier, options.examples, draws)
        yield subject, views


def clean_correct_views(
    subject: SceneObject, classifier: Classifier, count: int, draws: torch.Generator
) -> list[View]:
    """Draw random views until the classifier is correct in enough of them.

    Args:
        subject: Object to render.
        classifier: Classifier of the images.
        count: Number of views to return.
        draws: Generator of the random numbers.

    Returns:
        Views that are classified correctly.

    Raises:
        InputError: If hardly any view is classified correctly.
    """
    correct: list[View] = []
    drawn_count = 0
    while len(correct) < count:
        views = random_views(BATCH_SIZE, draws)
        images = render_all(make_scene(subject, classifier.size, views))
        predicted = predict(classifier, images)
        for view, name in zip(views, predicted, strict=True):
            if name == subject.label:
                correct.append(view)
        drawn_count += len(views)
        # The subtraction allows for a batch that has no correct view by chance.
        if len(correct) < MIN_CORRECT_FRACTION * drawn_count - BATCH_SIZE:
            images_text = f"{len(correct)} of {drawn_count} images of {subject.name}"
            raise InputError(
                f"{classifier.name} classifies only {images_text} correctly. "
                "Choose another mesh, label or classifier."
            )
    return correct[:count]


def batches(views: Sequence[View]) -> Iterator[Sequence[View]]:
    """Divide views into batches of at most BATCH_SIZE.

    Args:
        views: Views to divide.

    Yields:
        The views of a batch.
    """
    for first in range(0, len(views), BATCH_SIZE):
        yield views[first : first + BATCH_SIZE]


@torch.no_grad()
def render_all(scene: Scene) -> Tensor:
    """Render all E examples under the scene's own light, shape (E, 1, 3, size, size).

    Args:
        scene: Scene with one view per example.
    """
    examples = torch.arange(len(scene))
    return scene.render(scene.conditions(examples), examples)


def predict(classifier: Classifier, images: Tensor) -> list[str]:
    """Predict the class of each of E examples.

    Args:
        classifier: Classifier of the images.
        images: Image of the only view of each example, shape
            (E, 1, 3, size, size).

    Returns:
        Names of the predicted classes.
    """
    logits = compute_outputs(classifier, images, BATCH_SIZE)
    best = logits[:, 0].argmax(1).tolist()
    return [classifier.classes[index] for index in best]
