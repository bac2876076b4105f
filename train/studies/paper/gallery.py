"""One attack of each kind as an image (the paper's Section 4: skylight, several views, the illusion, and more)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from augment.attacks.attack import AttackResult
from augment.attacks.figure import save_figure
from augment.attacks.files import panels
from augment.objects import ObjectSettings
from renderer.errors import InputError
from train.attacks.experiment import attack_mesh
from train.report.tables import markdown
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.subjects import VERTICES

TITLE = "A gallery of attacks"


@dataclass
class Settings(SectionSettings):
    """steps: at most. targets: of the illusion, a class per view."""

    steps: int
    targets: list[str]


LIKE_THE_PAPER = [  # any light, an end where the classifier is fooled, no shadows
    "attack.allow_negative=true",
    "attack.margin=0",
    "attack.rounded=false",
    "renderer.transport=direct",
    "renderer.cache=null",
]
LIMIT = 150_000  # bytes of a committed image; above it the colours are reduced


@dataclass(frozen=True)
class Case:
    """An attack to show. overrides: of scripts/attack.py. target: a class per view, or None for any error."""

    name: str
    title: str
    item: ObjectSettings
    overrides: Sequence[str]
    target: Sequence[str] | None = None


def cases(lamp: ObjectSettings, orange: ObjectSettings, targets: Sequence[str]) -> list[Case]:
    """targets: a class per view of the illusion; the attack on the pixels takes the first."""
    skylight = ["attack=[skylight]", "attack.skylight.step_size=0.2"]
    evening = ["attack.skylight.zenith=75", "attack.skylight.turbidity=8", "scene.backgrounds=[0.0]"]
    shape = ["attack=[geometry]", f"scene.vertices={VERTICES}"]
    wider = ["attack.geometry.radius=0.01", "attack.geometry.step_size=0.001"]
    free = ["attack.geometry.radius=null", "attack.geometry.step_size=0.001"]
    three_views = ["scene.views=3", "attack.shared=true"]
    view_per_target = [f"scene.views={len(targets)}", "attack.shared=true"]
    illusion = "optical illusion: one shape, a target for each view"
    return [
        Case("lighting", "light", lamp, ["attack=[lighting]"]),
        Case("skylight", "skylight, orange", orange, [*skylight, *evening]),
        Case("skylight_lamp", "skylight, lamp", lamp, skylight),
        Case("lighting_views", "one light for three views", lamp, ["attack=[lighting]", *three_views]),
        Case("geometry", "shape", lamp, shape),
        Case("geometry_views", "one shape for three views", lamp, [*shape, *wider, *three_views]),
        Case("illusion", illusion, lamp, [*shape, *free, *view_per_target], targets),
        Case("albedo", "albedo of each face", lamp, ["attack=[albedo]"]),
        Case("pixels", f"pixels, target {targets[0]}", lamp, ["attack=[pixels]"], targets[:1]),
        Case("lighting_geometry", "light and shape at once", lamp, ["attack=[lighting,geometry]", shape[1]]),
    ]


def measure(study: Study, settings: Settings) -> Section:
    """Every case on the first of the meshes, but for the skylight's on the orange, which comes second."""
    if len(study.items) != 2:
        raise InputError("scene.meshes of section=gallery has two: the solid to attack, and the orange under the sky")
    lamp, orange = study.items
    records, images, figures = [], [], {}
    asked = [*LIKE_THE_PAPER, f"attack.max_steps={settings.steps}", f"seed={study.seed}"]
    for case in cases(lamp, orange, settings.targets):
        told = replace(study.command(case.item, [*case.overrides, *asked]), target=case.target)
        attacked = attack_mesh(case.item, told, study.classifier, torch.device("cpu"))
        records.append(record(case, attacked))
        figures[f"gallery_{case.name}.png"] = partial(save_small, attacked)
        images.append(f"{case.title.capitalize()}:\n\n![{case.title}](paper/gallery_{case.name}.png)")
    values = {
        "mesh": Path(lamp.mesh).name,
        "lamp": lamp.label,
        "vertices": VERTICES,
        "table": markdown(["attack", "parameters", "views", "steps", "before", "after"], map(row, records)),
        "images": "\n\n".join(images),
    }
    return Section(values, records, figures)


def record(case: Case, attacked: AttackResult) -> dict[str, Any]:
    return {
        "case": case.name,
        "title": case.title,
        "parameters": attacked.problem.start.shape[1],
        "views": attacked.images.shape[1],
        "target": case.target,
        "success": bool(attacked.success[0]),
        "steps": int(attacked.steps[0]),
        "before": answers(attacked.logits_before, attacked),
        "after": answers(attacked.logits, attacked),
    }


def answers(logits: Tensor, attacked: AttackResult) -> list[str]:
    """The answer of each view of the first example."""
    best = logits[0].softmax(1).max(1)
    pairs = zip(best.indices.tolist(), best.values.tolist(), strict=True)
    return [f"{attacked.classifier.classes[index]} {confidence:.2f}" for index, confidence in pairs]


def row(found: dict[str, Any]) -> list[str]:
    steps = str(found["steps"]) if found["success"] else f"{found['steps']}, not fooled"
    said = (", ".join(found[key]) for key in ("before", "after"))
    return [found["title"], f"{found['parameters']:,}", str(found["views"]), steps, *said]


def save_small(attacked: AttackResult, path: Path) -> None:
    """The image of an attack, in 256 colours where it would be large."""
    save_figure(*panels(attacked, 0), path)
    if path.stat().st_size > LIMIT:
        with Image.open(path) as image:
            reduced = image.quantize(256)
        reduced.save(path, optimize=True)
