"""Random images of a mesh that a classifier recognises, to be attacked."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from augment.attacks.attack import logits_of
from augment.classifiers import Classifier
from augment.objects import ObjectSettings, SceneObject, load_object
from augment.scene import Example, Scene
from augment.utils import generator
from renderer.camera import Camera, OrthographicCamera
from renderer.errors import InputError
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.subdivision import subdivide
from renderer.visibility import choose

VERTICES = 10_000  # shapes that are attacked have more (the paper's Section 4)
FIELDS_OF_VIEW = (2.0, 3.0)  # the paper's appendix on rendering quality
GREYS = (0.0, 0.25, 0.5, 0.75, 1.0)
PART = 10  # examples attacked or drawn at once
LEAST_SHARE = 0.02  # recognised; below it the search for examples is given up


def short_name(item: ObjectSettings) -> str:
    """A mesh's name on the page."""
    return Path(item.mesh).stem


def load_subject(item: ObjectSettings) -> SceneObject:
    """A mesh to attack. InputError: as `load_object`."""
    return replace(load_object(item), name=short_name(item))


def finer(subject: SceneObject) -> SceneObject:
    """The subject with enough vertices for an attack on its shape."""
    return replace(subject, mesh=subdivide(subject.mesh, VERTICES), own=None)


def random_scene(subject: SceneObject, classifier: Classifier, light: str, count: int, draws: torch.Generator) -> Scene:
    """Views at π/3 off the zenith (the paper's) and any azimuth, with a field of view of 2 or 3, on a grey."""
    azimuths = (2 * math.pi * torch.rand(count, generator=draws)).tolist()
    fields = torch.randint(len(FIELDS_OF_VIEW), (count,), generator=draws).tolist()
    greys = torch.tensor(GREYS)[torch.randint(len(GREYS), (count,), generator=draws)]
    cameras = [
        [OrthographicCamera(math.pi / 3, azimuth, FIELDS_OF_VIEW[field])]
        for azimuth, field in zip(azimuths, fields, strict=True)
    ]
    return scene_of(subject, classifier, light, cameras, greys)


def scene_of(
    subject: SceneObject,
    classifier: Classifier,
    light: str,
    cameras: Sequence[Sequence[Camera]],
    greys: Tensor,
    samples: int = 2,
    normals: str = "smooth",
) -> Scene:
    """A subject before cameras (E × V), each example on a grey (E,)."""
    size = classifier.size
    return Scene(
        [subject],
        [Example(0, tuple(views), index) for index, views in enumerate(cameras)],
        greys.view(-1, 1, 1, 1).expand(-1, 3, size, size),
        load_light(light),
        ImageSettings(size, samples, normals=normals),
        choose(),
    )


def part_of(scene: Scene, rows: Tensor) -> Scene:
    """Some examples (A,) of a scene."""
    return replace(scene, examples=[scene.examples[row] for row in rows], lights=scene.lights[rows])


def greys_of(scene: Scene) -> Tensor:
    """(E,) that its examples are on."""
    return scene.backgrounds[[example.background for example in scene.examples], 0, 0, 0]


def answers(classifier: Classifier, images: Tensor) -> list[str]:
    """What a classifier calls the one view of each of E examples (E, 1, 3, size, size)."""
    return [classifier.classes[index] for index in logits_of(classifier, images, PART)[:, 0].argmax(1).tolist()]


def recognised_parts(
    subject: SceneObject, classifier: Classifier, light: str, count: int, draws: torch.Generator, at_once: int = PART
) -> Iterator[Scene]:
    """Random scenes of so many examples at most, which the classifier recognises: `count` in all."""
    found = drawn = 0
    while found < count:
        scene = random_scene(subject, classifier, light, at_once, draws)
        examples = torch.arange(len(scene))
        with torch.no_grad():
            images = torch.cat([scene.render(scene.conditions(part), part) for part in examples.split(16)])
        right = [answer == subject.label for answer in answers(classifier, images)]
        kept = examples[torch.tensor(right)][: count - found]
        if len(kept):
            yield part_of(scene, kept)
        found, drawn = found + len(kept), drawn + len(scene)
        if found < LEAST_SHARE * drawn - PART:
            raise InputError(f"{classifier.name} recognises only {found} of {drawn} images of {subject.name}")


def recognised_scene(subject: SceneObject, classifier: Classifier, light: str, count: int, seed: int) -> Scene:
    """`count` random examples of a subject that the classifier recognises."""
    draws = generator(seed, subject.name)
    parts = list(recognised_parts(subject, classifier, light, count, draws, at_once=count))
    cameras = [views for scene in parts for views in scene.cameras]
    return scene_of(subject, classifier, light, cameras, torch.cat([greys_of(scene) for scene in parts]))
