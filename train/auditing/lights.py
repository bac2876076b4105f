"""Measure how a classifier recognizes renders in many kinds of lighting, and attack the lighting.

All classifiers of an audit get the same objects from the same cameras. The
images of each classifier have the size that it takes. No lighting has a
negative radiance in any direction.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from augment.attack_settings import NOISE_MARGIN, RANDOM_SEARCH, AttackSettings
from augment.attacks.attack import AttackResult, attack, fooled_in_views, logits_of, predictions
from augment.attacks.checks import success_by_radius
from augment.attacks.descent import Criterion
from augment.attacks.eot import preprocessed_model
from augment.attacks.problem import AttackProblem, build_problem
from augment.classifiers import Classifier
from augment.parameter_settings import SkylightSettings, StepSettings
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.build import build_local_light
from augment.scene.conditions import Conditions
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from augment.scene.variation import vary
from augment.settings import LampsSettings, ProjectorSettings, VariationSettings
from renderer.camera import orbit_cameras
from renderer.errors import MAX_SCALE
from renderer.image import to_bytes
from renderer.io.files import atomic_write
from renderer.io.images import write_image
from renderer.light.basis import HARMONICS, with_local_lights
from renderer.light.presets import load_light, perturb
from renderer.settings import ImageSettings
from renderer.visibility.rasterizers import choose
from train.auditing.frames import SIDE, frames_of

# Images in one pass of the classifier.
BATCH = 16
# Environment lighting of the views, before an attack changes it.
LIGHT = "grace"
# Standard deviation of the noise in each spherical-harmonic coefficient of a
# random light. The paper's training with random lighting has the same value.
AMPLITUDE = 0.5
# Start of the name of every random light.
RANDOM = "random "
# Distance of the camera from the origin, in world units, and its polar angle,
# azimuth and field of view, in degrees.
CAMERA_DISTANCE = 2.6
CAMERA_ANGLES = (60, 45, 40)
CAMERA = orbit_cameras(1, CAMERA_DISTANCE, *CAMERA_ANGLES)
# Range of the random cameras, poses and sizes, around CAMERA and the objects.
VARIATION = VariationSettings(azimuth=25, rotation=60, scale=[0.85, 1.15])
# Number of steps of the attack at each radius, and of random draws at each radius.
STEPS = 10
# Number of forward passes of a search without gradients at each radius, and of
# random draws beside it.
QUERIES = 100
# Number of steps of an attack that continues after its success.
ADDITIONAL_STEPS = 20
# A step of an attack has the length radius / STEPS_PER_RADIUS.
STEPS_PER_RADIUS = 4
# Gray value of the background, in sRGB.
BACKGROUND = 0.5


class LightKind(NamedTuple):
    """Kind of lighting that an attack changes, within L∞ balls of several radii.

    Attributes:
        title: Name of the lighting in the report.
        unit: Unit of the radii in the report.
        radii: Radii of the L∞ balls, in ascending order.
        local: Light sources in the scene in addition to the environment lighting.
    """

    title: str
    unit: str
    radii: tuple[float, ...]
    local: tuple[ProjectorSettings | LampsSettings, ...] = ()


# Kinds of lighting that an audit attacks, by the name of their files.
KINDS = {
    "lighting": LightKind(
        title="light from all around",
        unit="change of each coefficient",
        radii=(0.02, 0.05, 0.1, 0.3),
    ),
    "skylight": LightKind(
        title="a daylight sky",
        unit="1 is 57.3° of the sun, or 4 of turbidity",
        radii=(0.1, 0.3, 1.0, 3.0),
    ),
    "projector": LightKind(
        title="a projector",
        unit="fraction of its power, in each pixel",
        radii=(0.03, 0.1, 0.3, 1.0),
        local=(ProjectorSettings(),),
    ),
    "lamps": LightKind(
        title="four lamps",
        unit="change of the power in each channel",
        radii=(0.3, 1.0, 3.0, 10.0),
        local=(LampsSettings(),),
    ),
}


@dataclass(frozen=True)
class Views:
    """Views of objects, in random poses and from random cameras.

    The pose and the camera of a view depend only on the seed and on the number
    of views.

    Attributes:
        objects: Objects, which the views show in turn.
        count: Number of views.
        seed: Seed of the poses and the cameras.
        device: Device of the renders.
        light: Name of the environment lighting, before an attack changes it.
        exposure: Factor of this lighting.
        size: Factor of the size of the objects.
    """

    objects: Sequence[SceneObject]
    count: int
    seed: int
    device: torch.device
    light: str = LIGHT
    exposure: float = 1.0
    size: float = 1.0

    def scene(self, size: int, kind: str = "lighting") -> Scene:
        """Build a scene with one example for each view.

        Args:
            size: Pixels per side of the renders.
            kind: Key of KINDS. It decides which light sources the scene has.

        Returns:
            Scene of `count` examples.
        """
        objects = [self.objects[index % len(self.objects)] for index in range(self.count)]
        local_lights = [build_local_light(light) for light in KINDS[kind].local]
        natural_light = load_light(self.light) * self.exposure
        basis, lights = with_local_lights(natural_light, local_lights)
        scene = Scene.grid(
            objects,
            CAMERA,
            torch.full((1, 1, size, size), BACKGROUND),
            lights.to(self.device),
            ImageSettings(size, samples=2, encoding="srgb", normals="smooth"),
            choose("auto"),
            shared=False,
            basis=basis,
        )
        scales = [self.size * scale for scale in VARIATION.scale]
        variation = replace(VARIATION, scale=scales)
        return vary(scene, variation, generator(self.seed, "views"))


def recognized(
    classifier: Classifier,
    views: Views,
    environments: Sequence[str],
    count: int,
) -> dict[str, list[bool]]:
    """Test in which environment lighting the classifier recognizes each view.

    Args:
        classifier: Classifier to test.
        views: Views of objects of one class.
        environments: Names or files of environments, as `load_light` takes them.
        count: Number of random lights in addition.

    Returns:
        Whether each view is classified correctly, by the name of the lighting.
    """
    noise = generator(views.seed, "lights")
    random_lights = perturb(load_light(LIGHT), count, AMPLITUDE, None, noise)
    lights = {Path(name).stem: load_light(name) for name in environments}
    for number, light in enumerate(HARMONICS.project_nonnegative(random_lights), 1):
        lights[f"{RANDOM}{number}"] = light
    scene = views.scene(classifier.size)
    examples = torch.arange(views.count, device=views.device)
    recognized_by_light = {}
    for name, light in progress(lights.items(), "renders in other light"):
        exposed = views.exposure * light.to(scene.lights)
        conditions = Conditions(exposed.expand(len(scene), -1, -1))
        with torch.no_grad():
            images = scene.render(conditions, examples)
        recognized_by_light[name] = is_correct(classifier, scene, images).tolist()
    return recognized_by_light


def is_correct(classifier: Classifier, scene: Scene, images: Tensor) -> Tensor:
    """Test whether a classifier recognizes the images of a scene with one class.

    Args:
        classifier: Classifier to test.
        scene: Scene with one view per example.
        images: Images of its examples, shape (E, 1, 3, H, W).

    Returns:
        Whether each image gets the class of the scene, shape (E,), bool.
    """
    logits = logits_of(classifier, images, BATCH)[:, 0]
    return logits.argmax(1) == classifier.label(scene.labels[0])


def adversaries(
    classifier: Classifier,
    views: Views,
    kind: str,
    additional: bool = False,
) -> AttackResult:
    """Attack the lighting within the largest radius of its kind.

    A step changes each value by a quarter of the radius, in the direction of
    the sign of the gradient. A classifier without gradients is attacked by
    random search with QUERIES forward passes.

    Args:
        classifier: Attacked classifier.
        views: Views to attack.
        kind: Key of KINDS.
        additional: Whether to take all ADDITIONAL_STEPS steps. By default an attack ends
            when noise of a camera's sensor no longer corrects the prediction,
            or after STEPS steps.

    Returns:
        Result of the attack.
    """
    radius = KINDS[kind].radii[-1]
    settings_class = SkylightSettings if kind == "skylight" else StepSettings
    step_size = radius / STEPS_PER_RADIUS
    # Arguments of `AttackSettings`. A field with the name of the kind has the ball.
    limits: dict[str, Any] = {kind: settings_class("linf", radius, "sign", step_size)}
    if additional:
        limits |= {"max_steps": ADDITIONAL_STEPS, "margin": MAX_SCALE}
    else:
        limits |= {"max_steps": STEPS, "margin": 0.0, "noise_margin": NOISE_MARGIN}
    if not classifier.has_gradients:
        limits |= {"optimizer": RANDOM_SEARCH, "max_queries": QUERIES}
    return attack(
        classifier,
        views.scene(classifier.size, kind),
        settings=AttackSettings(**limits, batch_size=BATCH),
        seed=views.seed,
        force=True,
    )


def success_by_light(
    classifier: Classifier,
    views: Views,
    kind: str,
    out: Path,
) -> dict[str, Any]:
    """Count the views that are misclassified after attacks within each radius.

    The function writes the adversaries of the largest radius to out/KIND.npz,
    which `transfers` reads. If there are any, it also writes a picture of the
    first one, before and after the attack, to out/KIND.png.

    Args:
        classifier: Attacked classifier.
        views: Views to attack.
        kind: Key of KINDS.
        out: Existing folder.

    Returns:
        Dictionary with the keys

        - n: number of views,
        - correct: number of views that are classified correctly before,
        - adversarial: for each radius, how many of the correct views an attack
          or random draws make misclassified, also with noise of a sensor,
        - random: for each radius, the same of the random draws alone,
        - adversarial_without_noise and random_without_noise: the same two
          counts for images without noise,
        - predicted, confidence: classes of the picture before and after, with
          their probabilities, if there is a picture,
        - slider: lights between both, as `frames_of` returns them, if there is
          a picture.
    """
    result = adversaries(classifier, views, kind)
    radii = KINDS[kind].radii
    clean = result.clean_correct
    by_radius = success_by_radius(result, [radius / radii[-1] for radius in radii])
    counts: dict[str, Any] = {"n": views.count, "correct": int(clean.sum())}
    # The counts are made twice: with noise of a sensor, and without.
    for end, success in (
        ("", result.success),
        ("_without_noise", result.success_without_noise),
    ):
        adversarial = f"adversarial{end}"
        random = f"random{end}"
        # Within the largest radius, `result` is an attack from the start. The
        # attack of `by_radius` continues from the end of the smaller radii.
        by_radius[-1][adversarial] |= success[clean].cpu()
        counts[adversarial] = [int((row[adversarial] | row[random]).sum()) for row in by_radius]
        counts[random] = [int(row[random].sum()) for row in by_radius]
    is_wrong = clean & result.success
    content = io.BytesIO()
    np.savez(content, wrong=is_wrong.cpu(), values=result.descent.values.cpu())
    atomic_write(out / f"{kind}.npz", content.getbuffer())
    if is_wrong.any():
        example = int(is_wrong.nonzero()[0])
        logits = torch.stack([result.logits_before[example], result.logits[example]])
        counts |= predictions(logits, classifier.classes)
        counts["slider"] = frames_of(result, example)
        write_image(out / f"{kind}.png", _draw_pair(result, example))
    return counts


def _draw_pair(result: AttackResult, example: int) -> Image.Image:
    """Draw the first view of an example before and after the attack, side by side.

    Args:
        result: Result of the attack.
        example: Index of the example.

    Returns:
        Image of 2 · SIDE by SIDE pixels. Renders that are smaller are enlarged
        without smoothing, so that single pixels are visible.
    """
    before = result.images_before[example]
    after = result.images[example]
    pair = to_bytes(torch.cat([before, after], dim=2).cpu()).permute(1, 2, 0)
    is_enlarged = before.shape[-1] < SIDE
    method = Image.Resampling.NEAREST if is_enlarged else Image.Resampling.LANCZOS
    return Image.fromarray(pair.numpy()).resize((2 * SIDE, SIDE), method)


def transfer_success(
    attacked: Classifier,
    other: Classifier,
    views: Views,
    out: Path,
) -> dict[str, dict[str, list[int]]]:
    """Test whether the adversaries of one classifier also fool another classifier.

    "first" are the adversaries that `success_by_light` wrote. "further" are
    adversaries of attacks that continue after their success. All are rendered
    at the size of the other classifier.

    Args:
        attacked: Classifier that was attacked.
        other: Classifier to test.
        views: Attacked views.
        out: Folder that `success_by_light` wrote for the attacked classifier.

    Returns:
        For each kind of lighting and for "further" and "first", three counts:
        of adversaries that also fool the other classifier, of adversaries
        whose view it classifies correctly before, and of adversaries that fool
        it in images without noise of a sensor.
    """
    counts: dict[str, dict[str, list[int]]] = {}
    for kind in progress(KINDS, "transfer"):
        result = adversaries(attacked, views, kind, additional=True)
        is_wrong = result.clean_correct & result.success
        found = {"further": (is_wrong, result.descent.values)}
        with np.load(out / f"{kind}.npz") as saved:
            found["first"] = (torch.from_numpy(saved["wrong"]), torch.from_numpy(saved["values"]))
        problem = build_problem(result.settings, views.scene(other.size, kind))
        test = _TransferTest(result, other, problem)
        counts[kind] = {name: test.count(*found_here) for name, found_here in found.items()}
    return counts


class _TransferTest:
    """Test whether the adversaries of one attack fool another classifier.

    Args:
        result: Result of the attack on the first classifier.
        other: Classifier to test.
        problem: The attacked parameters, with a scene at the size of the other
            classifier.
    """

    def __init__(self, result: AttackResult, other: Classifier, problem: AttackProblem):
        label = other.label(problem.scene.labels[0])
        self.result = result
        self.problem = problem
        self.is_correct = is_correct(other, problem.scene, problem.images(problem.start))
        self.criterion = Criterion(torch.full_like(result.criterion.source, label))
        self.model = preprocessed_model(result.settings, other)

    def count(self, is_wrong: Tensor, values: Tensor) -> list[int]:
        """Count the adversaries that fool the other classifier, too.

        Only adversaries count whose view the other classifier recognizes before
        the attack.

        Args:
            is_wrong: Whether each example fools the attacked classifier, shape (E,).
            values: Attacked values of all examples, shape (E, D).

        Returns:
            Three counts: adversaries that fool the other classifier also with
            noise of a sensor, all counted adversaries, and adversaries that
            fool it in images without noise.
        """
        is_tested = is_wrong.to(self.is_correct) & self.is_correct
        images = self.problem.images(values.to(self.problem.start))
        predicted = logits_of(self.model, images, BATCH).argmax(2)
        is_fooled = fooled_in_views(
            self.model,
            images,
            predicted,
            self.problem.all_examples,
            self.criterion,
            self.result.settings,
            self.result.seed,
        ).all(1)
        is_fooled_without_noise = self.criterion.reached(predicted)
        parts = (is_tested & is_fooled, is_tested, is_tested & is_fooled_without_noise)
        return [int(part.sum()) for part in parts]
