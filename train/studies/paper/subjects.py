"""Random images of a mesh that a classifier recognises, to be attacked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from augment.attacks.run import logits_of
from augment.classifiers import Classifier
from augment.objects import ObjectSettings, SceneObject, load_object
from augment.scene import Example, Scene
from augment.seeding import generator
from renderer.camera import Camera, OrthographicCamera
from renderer.errors import InputError
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.mesh import Mesh
from renderer.subdivision import subdivide
from renderer.visibility import choose

VERTICES = 10_000  # shapes that are attacked have more (the paper's Section 4)
FIELDS_OF_VIEW = (2.0, 3.0)  # the paper's appendix on rendering quality
GREYS = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Subject:
    """A mesh to attack and the class that it shows."""

    name: str
    mesh: Mesh
    label: str
    gain: float = 1.0

    @classmethod
    def load(cls, item: ObjectSettings) -> "Subject":
        """InputError: as `load_object`."""
        return cls(Path(item.mesh).stem, load_object(item).mesh, item.label, item.gain)


def finer(subject: Subject) -> Subject:
    """The subject with enough vertices for an attack on its shape."""
    return replace(subject, mesh=subdivide(subject.mesh, VERTICES))


def random_scene(subject: Subject, classifier: Classifier, light: str, count: int, draws: torch.Generator) -> Scene:
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
    subject: Subject,
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
        [SceneObject("", subject.mesh, subject.gain)],
        [Example(0, tuple(views), index) for index, views in enumerate(cameras)],
        greys.view(-1, 1, 1, 1).expand(-1, 3, size, size),
        load_light(light),
        ImageSettings(size, samples, normals=normals),
        choose(),
    )


def recognised(scene: Scene, classifier: Classifier, label: str) -> Tensor:
    """(E,) whether the classifier gives all views of an example the label."""
    examples = torch.arange(len(scene))
    with torch.no_grad():
        images = torch.cat([scene.render(scene.conditions(part), part) for part in examples.split(16)])
    return (logits_of(classifier, images, 32).argmax(2) == classifier.label(label)).all(1)


def recognised_scene(subject: Subject, classifier: Classifier, light: str, count: int, seed: int) -> Scene:
    """`count` random examples of a subject that the classifier recognises, drawn until there are as many."""
    draws, cameras, greys = generator(seed, subject.name), [], []
    for _ in range(20):
        scene = random_scene(subject, classifier, light, count, draws)
        kept = recognised(scene, classifier, subject.label).nonzero().squeeze(1).tolist()
        cameras += [scene.cameras[index] for index in kept]
        greys += [float(scene.backgrounds[index, 0, 0, 0]) for index in kept]
        if len(cameras) >= count:
            return scene_of(subject, classifier, light, cameras[:count], torch.tensor(greys[:count]))
    raise InputError(f"{classifier.name} recognises too few images of {subject.name}: {len(cameras)} of {20 * count}")
