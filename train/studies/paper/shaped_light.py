"""Do lights that fool a network here fool it in a path tracer, where meshes shade and light themselves?"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from augment.attacks.attack import AttackSettings, attack
from augment.attacks.parameters import StepSettings
from augment.objects import SceneObject
from augment.scene import Scene
from renderer.camera import Camera
from renderer.environment import write_map
from renderer.files.mitsuba_scene import SCENE, mitsuba_map, render_mitsuba_scene, write_mitsuba_scene
from renderer.image import ImageSettings, behind, develop_composite
from renderer.lights import ambient
from renderer.transfer import build_operators
from renderer.visibility import choose
from train.report.tables import markdown
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent
from train.studies.paper.subjects import answers, recognised_scene

TITLE = "Light that a mesh shapes itself"


@dataclass
class Settings(SectionSettings):
    """examples: of each mesh, which the network recognises in direct light. steps: of a descent at most. margin: in the
    logit, that it goes on to, as `AttackSettings` has it."""

    examples: int
    steps: int
    margin: float


TRANSPORTS = ("direct", "shadows", "bounces:3")
TRACED = "bounces:16"  # paths that go on for longer change no image
SELF_SHADED = 0.05  # of a white sky's light that a mesh keeps from itself: from here on it counts as concave
LIGHT = StepSettings("linf", None, "unit", 0.1)
MAP_ROWS = 128


def measure(study: Study, settings: Settings) -> Section:
    """Adversaries of every mesh under every transport."""
    records = [record for subject in study.subjects for record in adversaries(subject, study, settings)]
    kept = {record["mesh"]: record["kept"] for record in records}
    values = {
        "size_of_step": LIGHT.step_size,
        "table": results(records),
        "share": SELF_SHADED,
        "kept": ", ".join(f"{name} {share:.0%}" for name, share in kept.items()),
    }
    return Section(values, records)


def adversaries(subject: SceneObject, study: Study, settings: Settings) -> Iterator[dict[str, Any]]:
    """A record per transport and random view: what the network says before and after, here and of Mitsuba's images."""
    network = study.classifier
    drawn = recognised_scene(subject, network, study.light, settings.examples, study.seed)
    image, before = ImageSettings(network.size, samples=4), None
    kept = kept_from_itself(subject, drawn.cameras[0], image)
    stepping = AttackSettings(lighting=LIGHT, max_steps=settings.steps, margin=settings.margin)
    for transport in TRANSPORTS:
        scene = replace(drawn, settings=replace(image, transport=transport))
        attacked = attack(network, scene, settings=stepping, force=True)
        if before is None:  # the light is the same under every transport
            start = attacked.problem.conditions(attacked.problem.start, attacked.problem.everything).light
            before = answers(network, path_traced(scene, start))
        after = answers(network, path_traced(scene, attacked.conditions.light))
        here = zip(*(answers(network, each) for each in (attacked.images_before, attacked.images)), strict=True)
        for said, traced in zip(here, zip(before, after, strict=True), strict=True):
            yield {
                "mesh": subject.name,
                "label": subject.label,
                "transport": transport,
                "kept": round(kept, 3),
                "here": said,
                "traced": traced,
            }


def kept_from_itself(subject: SceneObject, cameras: Sequence[Camera], settings: ImageSettings) -> float:
    """The share of a white sky's light on the surface in sight that shadows take."""
    sky, seen = ambient(torch.ones(3)), {}
    for transport in ("direct", "shadows"):
        shown = replace(settings, transport=transport)
        views = build_operators(subject.mesh, cameras, shown, choose(), subject.gain)
        seen[transport] = sum(float(view.radiance(sky).sum()) for view in views)
    return 1 - seen["shadows"] / seen["direct"]


def path_traced(scene: Scene, lights: Tensor) -> Tensor:
    """Images (E, V, 3, size, size) of a scene's examples by Mitsuba, each in its light (E, 49, 3)."""
    images, settings = [], replace(scene.settings, transport=TRACED)
    for row, light in zip(scene.examples, lights, strict=True):
        shown = scene.objects[row.object]
        with TemporaryDirectory() as folder:
            write_mitsuba_scene(Path(folder), shown.mesh, shown.gain, row.cameras, settings, "light.exr")
            write_map(Path(folder, "light.exr"), mitsuba_map(light, MAP_ROWS).clamp(min=0))
            seen = render_mitsuba_scene(Path(folder, SCENE), len(row.cameras))
        added = behind(seen[:, 3:], scene.backgrounds[row.background], settings.encoding)
        images.append(develop_composite(seen[:, :3] + added, settings.encoding))
    return torch.stack(images)


def results(records: Sequence[Mapping[str, Any]]) -> str:
    """A row per kind of mesh and transport."""
    rows = []
    for concave in (False, True):
        for transport in TRANSPORTS:
            here = [each for each in records if each["transport"] == transport]
            here = [each for each in here if (each["kept"] > SELF_SHADED) == concave]
            both = [each for each in here if each["here"][0] == each["traced"][0] == each["label"]]
            success = [each for each in both if each["here"][1] != each["label"]]
            found = percent([each["here"][1] != each["label"] for each in both])
            traced = percent([each["traced"][1] != each["label"] for each in success])
            rows.append(["concave" if concave else "convex", transport, found, traced])
    return markdown(["meshes", "found with", "fools here", "and, of these, path-traced"], rows)
