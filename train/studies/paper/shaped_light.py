"""Do lights that fool a network here fool it in a path tracer, where meshes shade and light themselves?"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from augment.attacks.run import attack, logits_of
from augment.attacks.settings import AttackSettings
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.parameters import StepSettings
from augment.scene import Scene
from renderer.camera import Camera
from renderer.environment import write_map
from renderer.files.mitsuba_scene import SCENE, mitsuba_map, render_mitsuba_scene, write_mitsuba_scene
from renderer.image import ImageSettings, behind, develop_composite
from renderer.lights import ambient
from renderer.transfer import build_operators
from renderer.visibility import choose
from train.report.tables import markdown
from train.studies.page import filled
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent
from train.studies.paper.subjects import Subject, recognised_scene

TRANSPORTS = ("direct", "shadows", "bounces:3")
TRACED = "bounces:16"  # paths that go on for longer change no image
SELF_SHADED = 0.05  # of a white sky's light that a mesh keeps from itself: from here on it counts as concave
LIGHT = StepSettings("linf", None, "unit", 0.1)
MAP_ROWS = 128


@dataclass
class ShapedLightSettings(SectionSettings):
    """examples: of each mesh, which the network recognises in direct light. steps: of a descent at most. margin: in the
    logit, that it goes on to, as `AttackSettings` has it."""

    examples: int
    steps: int
    margin: float


def measure(study: Study, settings: ShapedLightSettings) -> Section:
    """Adversaries of every mesh under every transport."""
    records = [record for subject in study.subjects for record in adversaries(subject, study, settings)]
    kept = {record["mesh"]: record["kept"] for record in records}
    text = filled(
        __file__,
        classifier=study.classifier.name,
        steps=settings.steps,
        margin=settings.margin,
        size_of_step=LIGHT.step_size,
        examples=settings.examples,
        table=results(records),
        share=SELF_SHADED,
        meshes=", ".join(f"{name} {share:.0%}" for name, share in kept.items()),
        light=study.light,
        size=study.classifier.size,
    )
    return Section(text, records, {})


def adversaries(subject: Subject, study: Study, settings: ShapedLightSettings) -> Iterator[dict[str, Any]]:
    """A record per transport and random view: what the network says before and after, here and of Mitsuba's images."""
    network = study.classifier
    drawn = recognised_scene(subject, network, study.light, settings.examples, study.seed)
    image, shown = ImageSettings(network.size, samples=4), [SceneObject(subject.label, subject.mesh, subject.gain)]
    kept, before = kept_from_itself(subject, drawn.cameras[0], image), None
    for transport in TRANSPORTS:
        scene = replace(drawn, objects=shown, settings=replace(image, transport=transport))
        stepping = AttackSettings(lighting=LIGHT, max_steps=settings.steps, margin=settings.margin)
        attacked = attack(network, scene, settings=stepping, force=True)
        if before is None:  # the light is the same under every transport
            start = attacked.problem.conditions(attacked.problem.start, attacked.problem.everything).light
            before = said(network, path_traced(scene, start)[0])
        images, coverage = path_traced(scene, attacked.conditions.light)
        covered = (coverage > 0).expand_as(images)
        off = torch.where(covered, (attacked.images - images).abs(), 0).flatten(1).sum(1) / covered.flatten(1).sum(1)
        here = zip(*(said(network, each) for each in (attacked.images_before, attacked.images)), strict=True)
        there = zip(before, said(network, images), strict=True)
        for answers, traced, difference in zip(here, there, off.tolist(), strict=True):
            yield {
                "mesh": subject.name,
                "label": subject.label,
                "transport": transport,
                "kept": round(kept, 3),
                "here": answers,
                "traced": traced,
                "difference": round(difference, 4),
            }


def kept_from_itself(subject: Subject, cameras: Sequence[Camera], settings: ImageSettings) -> float:
    """The share of a white sky's light on the surface in sight that shadows take."""
    sky, seen = ambient(torch.ones(3)), {}
    for transport in ("direct", "shadows"):
        shown = replace(settings, transport=transport)
        views = build_operators(subject.mesh, cameras, shown, choose(), subject.gain)
        seen[transport] = sum(float(view.radiance(sky).sum()) for view in views)
    return 1 - seen["shadows"] / seen["direct"]


def path_traced(scene: Scene, lights: Tensor) -> tuple[Tensor, Tensor]:
    """Images (E, V, 3, size, size) of a scene's examples by Mitsuba, each in its light (E, 49, 3), and their coverage
    (E, V, 1, size, size)."""
    images, coverages = [], []
    for row, light in zip(scene.examples, lights, strict=True):
        shown, settings = scene.objects[row.object], replace(scene.settings, transport=TRACED)
        with TemporaryDirectory() as folder:
            write_mitsuba_scene(Path(folder), shown.mesh, shown.gain, row.cameras, settings, "light.exr")
            write_map(Path(folder, "light.exr"), mitsuba_map(light, MAP_ROWS).clamp(min=0))
            seen = render_mitsuba_scene(Path(folder, SCENE), len(row.cameras))
        radiance, coverage = seen[:, :3], seen[:, 3:]
        added = behind(coverage, scene.backgrounds[row.background], settings.encoding)
        images.append(develop_composite(radiance + added, settings.encoding))
        coverages.append(coverage)
    return torch.stack(images), torch.stack(coverages)


def said(classifier: Classifier, images: Tensor) -> list[str]:
    """What a classifier calls the one view of each of E examples (E, 1, 3, size, size)."""
    return [classifier.classes[index] for index in logits_of(classifier, images, 32)[:, 0].argmax(1).tolist()]


def results(records: Sequence[Mapping[str, Any]]) -> str:
    """A row per kind of mesh and transport."""
    rows = []
    for concave in (False, True):
        for transport in TRANSPORTS:
            here = [each for each in records if each["transport"] == transport]
            here = [each for each in here if (each["kept"] > SELF_SHADED) == concave]
            both = [each for each in here if each["here"][0] == each["traced"][0] == each["label"]]
            fooled = [each for each in both if each["here"][1] != each["label"]]
            off = sum(each["difference"] for each in here) / max(1, len(here))
            rows.append(
                [
                    "concave" if concave else "convex",
                    transport,
                    percent([each["here"][1] != each["label"] for each in both]),
                    percent([each["traced"][1] != each["label"] for each in fooled]),
                    f"{off:.3f}",
                ]
            )
    head = ["meshes", "found with", "fools here", "and, of these, path-traced", "difference"]
    return markdown(head, rows)
