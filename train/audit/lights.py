"""How surely a classifier recognizes renders, and how far each kind of light must change until it errs.

Every classifier gets the same objects from the same sides, at its own size. Light is nowhere negative.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from augment.attacks.attack import AttackResult, attack, fooled_in_views, logits_of, predictions
from augment.attacks.checks import success_by_radius
from augment.attacks.descent import Goal
from augment.attacks.eot import preprocessed_model
from augment.attacks.parameter_settings import SkylightSettings, StepSettings
from augment.attacks.problem import build_problem
from augment.attacks.settings import NOISE_MARGIN, AttackSettings
from augment.classifiers import Classifier
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.build import build_local_light
from augment.scene.conditions import Conditions
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from augment.scene.variation import vary
from augment.settings import LampsSettings, ProjectorSettings, VariationSettings
from renderer.camera import orbit_cameras
from renderer.errors import FACTOR
from renderer.image import to_bytes
from renderer.io.files import write_whole
from renderer.io.images import write_image
from renderer.light.basis import HARMONICS, with_local_lights
from renderer.light.presets import load_light, perturb
from renderer.settings import ImageSettings
from renderer.visibility.rasterizers import choose

BATCH = 16  # images per pass
LIGHT = "grace"  # in which all attacks but that of the sky begin
AMPLITUDE = 0.5  # of random light, in each coefficient: that of the paper's random arm
RANDOM = "random "  # begins the name of a random light
CAMERA = orbit_cameras(1, 2.6, *map(math.radians, (60, 45, 40)))
VARIATION = VariationSettings(azimuth=25, rotation=60, scale=[0.85, 1.15])
STEPS = 10  # of a descent at each radius, and random draws
FURTHER = 20  # steps of an attack that goes on after its success
SIDE = 200  # pixels of a picture


class LightKind(NamedTuple):
    """Light that an attack changes, within L∞ balls of radii. local: lights beside those from all around."""

    title: str
    unit: str  # of the radii
    radii: tuple[float, ...]
    local: tuple[ProjectorSettings | LampsSettings, ...] = ()


KINDS = {
    "lighting": LightKind("light from all around", "in each coefficient", (0.02, 0.05, 0.1, 0.3)),
    "skylight": LightKind("a daylight sky", "radians of the sun, a quarter of turbidity", (0.1, 0.3, 1.0, 3.0)),
    "projector": LightKind("a projector", "of its power, in each pixel", (0.03, 0.1, 0.3, 1.0), (ProjectorSettings(),)),
    "lamps": LightKind("four lamps", "of power, in each channel", (0.3, 1.0, 3.0, 10.0), (LampsSettings(),)),
}


@dataclass(frozen=True)
class Views:
    """The objects in turn, each turned and seen from the projector's side at random; the seed alone decides how."""

    objects: Sequence[SceneObject]
    count: int
    seed: int
    device: torch.device

    def scene(self, size: int, kind: str = "lighting") -> Scene:
        """An example of each view, in the lights of a kind of attack."""
        shown = [self.objects[index % len(self.objects)] for index in range(self.count)]
        basis, lights = with_local_lights(load_light(LIGHT), [build_local_light(light) for light in KINDS[kind].local])
        image = ImageSettings(size, samples=2, encoding="srgb", normals="smooth")
        given = CAMERA, torch.full((1, 1, size, size), 0.5), lights.to(self.device), image, choose("auto")
        scene = Scene.grid(shown, *given, shared=False, basis=basis)
        return vary(scene, VARIATION, generator(self.seed, "views"))


def recognized(classifier: Classifier, views: Views, environments: Sequence[str], count: int) -> dict[str, list[bool]]:
    """By name of a light, an environment as `load_light` takes it or one of `count` random lights, whether each view is
    classified as its label."""
    drawn = perturb(load_light(LIGHT), count, AMPLITUDE, None, generator(views.seed, "lights"))
    lights = {Path(name).stem: load_light(name) for name in environments}
    lights |= {f"{RANDOM}{number}": light for number, light in enumerate(HARMONICS.project_nonnegative(drawn), 1)}
    scene, rows, correct = views.scene(classifier.size), torch.arange(views.count, device=views.device), {}
    for name, light in progress(lights.items(), "renders in other light"):
        with torch.no_grad():
            images = scene.render(Conditions(light.to(scene.lights).expand(len(scene), -1, -1)), rows)
        correct[name] = _correct(classifier, scene, images).tolist()
    return correct


def _correct(classifier: Classifier, scene: Scene, images: Tensor) -> Tensor:
    """(E,) bool: whether images (E, 1, 3, H, W) of a scene, whose objects are of one class, are classified as it."""
    return logits_of(classifier, images, BATCH)[:, 0].argmax(1) == classifier.label(scene.labels[0])


def adversaries(classifier: Classifier, views: Views, kind: str, further: bool = False) -> AttackResult:
    """An attack within a kind's largest radius, by signed steps of a quarter of it, until the classifier errs by more
    than a sensor's noise changes; or all of FURTHER steps, however surely it errs."""
    radius = KINDS[kind].radii[-1]
    changed = {kind: (SkylightSettings if kind == "skylight" else StepSettings)("linf", radius, "sign", radius / 4)}
    options: dict[str, Any] = {"max_steps": STEPS, "margin": 0.0, "noise_margin": NOISE_MARGIN}
    if further:
        options = {"max_steps": FURTHER, "margin": FACTOR}
    settings = AttackSettings(**(options | changed), batch_size=BATCH)
    return attack(classifier, views.scene(classifier.size, kind), settings=settings, seed=views.seed, force=True)


def success_by_light(classifier: Classifier, views: Views, kind: str, out: Path) -> dict[str, Any]:
    """n: views; correct: of these, before. adversarial, random: at each radius, how many of the correct ones a descent
    or random draws turn wrong, and the draws alone, with the noise of a sensor; adversarial_without_noise and
    random_without_noise. The adversaries at the largest radius are kept in out/KIND.npz for `transfers`; one is written
    to out/KIND.png; predicted: its classes."""
    result, radii = adversaries(classifier, views, kind), KINDS[kind].radii
    clean, by_radius = result.clean_correct, success_by_radius(result, [radius / radii[-1] for radius in radii])
    largest, counts = by_radius[-1], dict[str, Any]()
    for end, success in (("", result.success), ("_without_noise", result.success_without_noise)):
        adversarial, random = f"adversarial{end}", f"random{end}"
        largest[adversarial] |= success[clean].cpu()  # from the start, not from where smaller radii ended
        counts[adversarial] = [int((row[adversarial] | row[random]).sum()) for row in by_radius]
        counts[random] = [int(row[random].sum()) for row in by_radius]
    wrong = clean & result.success
    kept = io.BytesIO()
    np.savez(kept, wrong=wrong.cpu(), values=result.descent.values.cpu())
    write_whole(out / f"{kind}.npz", kept.getbuffer())
    if wrong.any():
        row = int(wrong.nonzero()[0])
        logits = torch.stack([result.logits_before[row, 0], result.logits[row, 0]])
        counts["predicted"] = predictions(logits, classifier.classes)["predicted"]
        pair = to_bytes(torch.cat([result.images_before[row, 0], result.images[row, 0]], dim=2).cpu()).permute(1, 2, 0)
        method = Image.Resampling.NEAREST if classifier.size < SIDE else Image.Resampling.LANCZOS
        shown = Image.fromarray(pair.numpy()).resize((2 * SIDE, SIDE), method)
        write_image(out / f"{kind}.png", shown)
    return {"n": views.count, "correct": int(clean.sum()), **counts}


def transfers(attacked: Classifier, other: Classifier, views: Views, out: Path) -> dict[str, dict[str, list[int]]]:
    """[successes, n, successes without noise] by kind of adversaries, those that `success_by_light` kept in `out` and
    further ones, rendered at the size of another classifier, which is right before in `n`."""
    counts: dict[str, dict[str, list[int]]] = {}
    for kind in progress(KINDS, "transfer"):
        result = adversaries(attacked, views, kind, further=True)
        found = {"further": (result.clean_correct & result.success, result.descent.values)}
        with np.load(out / f"{kind}.npz") as kept:
            found["first"] = torch.from_numpy(kept["wrong"]), torch.from_numpy(kept["values"])
        problem = build_problem(result.settings, views.scene(other.size, kind))
        right, counts[kind] = _correct(other, problem.scene, problem.images(problem.start)), {}
        goal = Goal(torch.full_like(result.goal.source, other.label(problem.scene.labels[0])))
        model = preprocessed_model(result.settings, other)
        for name, (wrong, values) in found.items():
            both = wrong.to(right) & right
            images = problem.images(values.to(problem.start))
            predicted = logits_of(model, images, BATCH).argmax(2)
            of_all = problem.everything, goal, result.settings, result.seed
            lost = both & fooled_in_views(model, images, predicted, *of_all).all(1)
            lost_without_noise = both & goal.reached(predicted)
            counts[kind][name] = [int(part.sum()) for part in (lost, both, lost_without_noise)]
    return counts
