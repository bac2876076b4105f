"""One attack of each kind as an image (the paper's Section 4: skylight, several views, the illusion, and more)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from augment.attacks.figure import save_figure
from augment.attacks.files import exhibits
from augment.attacks.run import Attacked
from augment.attacks.settings import SIGNED, SkylightSettings
from augment.objects import ObjectSettings
from augment.parameters import StepSettings
from renderer.errors import InputError
from train.attacks.experiment import attack_mesh
from train.attacks.settings import AttackCommandSettings, AttackExperimentSettings, AttackSceneSettings
from train.report.tables import markdown
from train.settings import RendererSettings
from train.studies.page import filled
from train.studies.paper.adversaries import LIGHT, SHAPE
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.subjects import VERTICES

LIMIT = 150_000  # bytes of a committed image; above it the colours are reduced
WIDER_SHAPE = StepSettings("linf", 0.01, "sign", 0.001)
FREE_SHAPE = StepSettings("linf", None, "sign", 0.001)
ALBEDO = StepSettings("linf", 0.1, "sign", 0.02)
PIXELS = StepSettings("linf", 8 / 255, "sign", 2 / 255)
COLUMNS = ["attack", "parameters", "views", "steps", "before", "after", "largest change", "seconds"]


@dataclass
class GallerySettings(SectionSettings):
    """steps: at most. targets: of the illusion, a class per view."""

    steps: int
    targets: list[str]


@dataclass(frozen=True)
class Case:
    """An attack to show. background: grey. target: a class per view, or None for any error."""

    name: str
    title: str
    item: ObjectSettings
    attack: AttackCommandSettings
    views: int = 1
    background: float = 0.5
    target: Sequence[str] | None = None

    def settings(self, light: str, seed: int) -> AttackExperimentSettings:
        return AttackExperimentSettings(
            target=self.target,
            seed=seed,
            attack=replace(self.attack, light=SIGNED),
            scene=AttackSceneSettings(
                views=self.views,
                backgrounds=[self.background],
                vertices=VERTICES if self.attack.geometry else 0,
                light=light,
            ),
            renderer=RendererSettings(samples=2, normals="smooth", cache=None),
        )


def cases(lamp: ObjectSettings, orange: ObjectSettings, targets: Sequence[str], steps: int) -> list[Case]:
    """targets: a class per view of the illusion; the attack on the pixels takes the first."""
    noon = SkylightSettings("linf", None, "unit", 0.2)
    evening = SkylightSettings("linf", None, "unit", 0.2, zenith=75.0, turbidity=8.0)

    def case(name: str, title: str, views: int = 1, target: Sequence[str] | None = None, **kinds: Any) -> Case:
        attack = AttackCommandSettings(**kinds, shared=views > 1, shorten="geometry" in kinds, max_steps=steps)
        return Case(name, title, lamp, attack, views, target=target)

    return [
        case("lighting", "light", lighting=LIGHT),
        replace(case("skylight", "skylight, orange", skylight=evening), item=orange, background=0.0),
        case("skylight_lamp", "skylight, lamp", skylight=noon),
        case("lighting_views", "one light for three views", views=3, lighting=LIGHT),
        case("geometry", "shape", geometry=SHAPE),
        case("geometry_views", "one shape for three views", views=3, geometry=WIDER_SHAPE),
        case(
            "illusion",
            "optical illusion: one shape, a target for each view",
            views=len(targets),
            target=targets,
            geometry=FREE_SHAPE,
        ),
        case("albedo", "albedo of each face", albedo=ALBEDO),
        case("pixels", f"pixels, target {targets[0]}", target=targets[:1], pixels=PIXELS),
        case("lighting_geometry", "light and shape at once", lighting=LIGHT, geometry=SHAPE),
    ]


def save_small(attacked: Attacked, path: Path) -> None:
    """The image of an attack, in 256 colours where it would be large."""
    save_figure(*exhibits(attacked, 0), path)
    if path.stat().st_size > LIMIT:
        with Image.open(path) as image:
            reduced = image.quantize(256)
        reduced.save(path, optimize=True)


def answers(logits: Tensor, attacked: Attacked) -> list[str]:
    """The answer of each view of the first example."""
    best = logits[0].softmax(1).max(1)
    pairs = zip(best.indices.tolist(), best.values.tolist(), strict=True)
    return [f"{attacked.classifier.classes[index]} {confidence:.2f}" for index, confidence in pairs]


def changes(attacked: Attacked) -> dict[str, float]:
    """The largest change of any value, by kind."""
    problem, result = attacked.problem, attacked.result
    ends, starts = problem.split(result.values[:1]), problem.split(problem.start[:1])
    return {
        kind.name: float((end - start).abs().max())
        for kind, end, start in zip(problem.kinds, ends, starts, strict=True)
    }


def record(case: Case, attacked: Attacked) -> dict[str, Any]:
    target = attacked.goal.increase
    reached = None if target is None else attacked.logits[0].softmax(1).gather(1, target[0, :, None])[:, 0].tolist()
    return {
        "case": case.name,
        "parameters": attacked.problem.start.shape[1],
        "views": case.views,
        "target": case.target,
        "fooled_before": bool(attacked.result.fooled_before[0]),
        "fooled": bool(attacked.result.fooled[0]),
        "steps": int(attacked.result.steps[0]),
        "before": answers(attacked.logits_before, attacked),
        "after": answers(attacked.logits, attacked),
        "target_confidence": reached,
        "largest_change": changes(attacked),
        "seconds": round(attacked.seconds["attack"], 2),
    }


def row(case: Case, numbers: dict[str, Any]) -> list[str]:
    outcome = str(numbers["steps"]) if numbers["fooled"] else f"{numbers['steps']}, not fooled"
    return [
        case.title,
        f"{numbers['parameters']:,}",
        str(numbers["views"]),
        outcome,
        ", ".join(numbers["before"]),
        ", ".join(numbers["after"]),
        ", ".join(f"{value:.3g}" for value in numbers["largest_change"].values()),
        f"{numbers['seconds']:.1f}",
    ]


def findings(numbers: Sequence[dict[str, Any]]) -> dict[str, str]:
    """What came of each case, by its name, and what the illusion `reached`."""
    reached = next(each["target_confidence"] for each in numbers if each["case"] == "illusion")
    return {"reached": " and ".join(f"{value:.2f}" for value in reached)} | {
        each["case"]: f"{'fooled' if each['fooled'] else 'not fooled'} after {each['steps']} steps" for each in numbers
    }


def measure(study: Study, settings: GallerySettings) -> Section:
    """Every case on the first of the meshes, but for the skylight's on the orange, which comes second."""
    if len(study.items) != 2:
        raise InputError("scene.meshes of section=gallery has two: the solid to attack, and the orange under the sky")
    lamp, orange = study.items
    numbers, rows, images, figures = [], [], [], {}
    for case in cases(lamp, orange, settings.targets, settings.steps):
        attacked = attack_mesh(case.item, case.settings(study.light, study.seed), study.classifier, torch.device("cpu"))
        numbers.append(record(case, attacked))
        rows.append(row(case, numbers[-1]))
        figures[f"gallery_{case.name}.png"] = partial(save_small, attacked)
        images.append(f"### {case.title.capitalize()}\n\n![{case.title}](paper/gallery_{case.name}.png)")
    text = filled(
        __file__,
        classifier=study.classifier.name,
        mesh=Path(lamp.mesh).name,
        label=lamp.label,
        vertices=VERTICES,
        steps=settings.steps,
        table=markdown(COLUMNS, rows),
        **findings(numbers),
        images="\n\n".join(images),
    )
    return Section(text, numbers, figures)
