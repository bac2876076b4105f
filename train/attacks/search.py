"""The scene that an attack shows a mesh in, or another in which the classifier recognizes it."""

import math
import shlex
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from augment.attacks.attack import logits_of
from augment.build import build_scene
from augment.classifiers import Classifier
from augment.objects import ObjectSettings
from augment.scene import Scene
from augment.utils import generator
from renderer.light.presets import PROBES, UNIFORM, load_light
from train.attacks.settings import AttackExperimentSettings, AttackSceneSettings
from train.settings import keyed

POLAR, FIELD_OF_VIEW = (20.0, 100.0), (1.8, 3.5)  # degrees and world units, from which cameras are drawn
CLOSEST = 2.0  # world units from the middle of a mesh, which all of it is within
LENS = 45.0  # degrees, of every other camera that is drawn where the scene is orthographic
LIGHT_GRAY = 0.9  # as things are shown in catalogs
EXPOSURES = (1.0, 0.5, 0.7, 1.5, 2.5, 4.0)  # times the scene's own
SURE = 0.5  # confidence, in every image, at which the search ends


def scene_of(item: ObjectSettings, settings: AttackExperimentSettings, size: int, device: torch.device) -> Scene:
    """Views × backgrounds at `size` pixels per side, as an example each, or where views share what is attacked, an
    example per background."""
    with keyed("scene", vars(settings.scene)):
        return build_scene(
            [item],
            size,
            settings.scene.views,
            shared=settings.attack.shared,
            scene=settings.scene,
            renderer=settings.renderer,
            device=device,
        )


def search(
    item: ObjectSettings, settings: AttackExperimentSettings, classifier: Classifier, device: torch.device
) -> AttackSceneSettings:
    """The settings as they are, where every image is recognized, or else the ones most surely recognized among
    `_candidates`, each under the scene's light, the probes and uniform light at several exposures; the settings as they
    are, where none is recognized. What a classifier hardly knows from anywhere may not be found."""
    scene, draws = settings.scene, generator(settings.seed, item.mesh, "search")
    if _confidence(scene_of(item, settings, classifier.size, device), settings, classifier).item() > 0:
        return scene
    best, chosen = 0.0, scene
    for candidate in _candidates(scene, draws):
        found, lit = _brightest(item, replace(settings, scene=candidate), classifier, device)
        if found > best:
            best, chosen = found, lit
        if best >= SURE:
            break
    return chosen


def _candidates(scene: AttackSceneSettings, draws: torch.Generator) -> Iterator[AttackSceneSettings]:
    """The scene from `scene.search` cameras, the first of them its own, before its backgrounds and, in place of a gray
    one, before light gray."""
    for index in range(scene.search):
        lens = LENS if scene.fov is None and index % 2 else scene.fov
        camera = _drawn(replace(scene, fov=lens), draws) if index else scene
        yield camera
        if len(scene.backgrounds) == 1 and not isinstance(scene.backgrounds[0], str):
            yield replace(camera, backgrounds=[LIGHT_GRAY])


def _brightest(
    item: ObjectSettings, settings: AttackExperimentSettings, classifier: Classifier, device: torch.device
) -> tuple[float, AttackSceneSettings]:
    """Of lights and exposures, what is recognized most surely, with its confidence; 0 where none is."""
    scene = scene_of(item, settings, classifier.size, device)
    lights = list(product(dict.fromkeys([settings.scene.light, *PROBES, UNIFORM]), EXPOSURES))
    exposures = [settings.scene.exposure * factor for _, factor in lights]
    coefficients = [load_light(name) * exposure for (name, _), exposure in zip(lights, exposures, strict=True)]
    sky = torch.stack(coefficients).repeat_interleave(len(scene), dim=0).to(device)
    lit = torch.cat([sky, scene.lights.repeat(len(lights), 1, 1)[:, sky.shape[1] :]], dim=1)  # projector and lamps stay
    rows = replace(scene, examples=[*scene.examples] * len(lights), lights=lit)
    confidence, index = _confidence(rows, settings, classifier, len(lights)).max(0)
    return float(confidence), replace(settings.scene, light=lights[index][0], exposure=exposures[index])


@torch.no_grad()
def _confidence(scene: Scene, settings: AttackExperimentSettings, classifier: Classifier, groups: int = 1) -> Tensor:
    """(groups,) the least confidence in the label where an attack would begin, over each group of a scene's rows; 0
    where an image is taken for something else."""
    problem = settings.attack.problem(scene)
    images = problem.images(problem.start)
    shares = logits_of(settings.attack.preprocessed_model(classifier), images, settings.attack.batch_size).softmax(2)
    labels = torch.tensor([classifier.label(label) for label in scene.labels], device=shares.device)[:, None]
    right = shares.gather(2, labels[..., None].expand(-1, scene.views, 1))[..., 0] * (shares.argmax(2) == labels)
    return right.view(groups, -1).amin(1)


def _drawn(scene: AttackSceneSettings, draws: torch.Generator) -> AttackSceneSettings:
    """The scene from another side and another distance, through the same lens."""
    polar, azimuth, field = torch.rand(3, generator=draws).tolist()
    least, most = FIELD_OF_VIEW
    if scene.fov is not None:
        narrowest = 2 * CLOSEST * math.tan(math.radians(scene.fov) / 2)
        least, most = max(least, narrowest), max(most, 2 * narrowest)
    return replace(
        scene,
        polar=round(POLAR[0] + (POLAR[1] - POLAR[0]) * polar, 1),
        azimuth=round(360 * azimuth, 1),
        width=round(least + (most - least) * field, 2),
    )


def overrides(found: AttackSceneSettings, scene: AttackSceneSettings) -> str:
    """What the command line would say to find this in the place of a scene."""
    names = ("polar", "azimuth", "width", "fov", "backgrounds", "light", "exposure")
    changed = (name for name in names if getattr(found, name) != getattr(scene, name))
    return " ".join(shlex.quote(f"scene.{name}={getattr(found, name)}") for name in changed)
