"""What an attack leaves behind: an image and a folder for each example, and all numbers as JSON lines."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attacks.adversary import Adversary, write_adversary
from augment.attacks.attack import AttackResult, predictions
from augment.attacks.evaluate import Checks, RerenderCheck, require_renderers, verify
from augment.attacks.figure import Panel, prediction_caption, save_figure
from augment.scene import Conditions
from renderer.io.mesh_damage import mesh_damage
from renderer.light.basis import Basis
from renderer.light.light_sphere import light_sphere

LINES = "attack.jsonl"  # a line per example, and a last one with the checks
SPHERE = 192


def write_files(
    attacked: AttackResult, checks: Checks | None, folder: Path, renderers: Sequence[str] = ("reload",)
) -> list[RerenderCheck]:
    """Write a folder: attack.jsonl and, for each example, an image and the adversary as a folder of its own.

    renderers: what is to render the adversaries anew from these; see `verify`.
    """
    require_renderers(renderers)
    folder.mkdir(parents=True, exist_ok=True)
    everything = attacked.problem.everything
    after = attacked.conditions
    stems = [folder / f"example_{example:03d}" for example in everything.tolist()]
    lines = []
    for example, stem in enumerate(stems):
        save_figure(*panels(attacked, example), stem.with_suffix(".png"))
        images = attacked.images_before[example], attacked.images[example]
        light = write_adversary(Adversary.of(attacked.problem.scene, example, after, *images), stem)
        lines.append({"example": example, **_numbers(attacked, example), **light, **_damage(attacked, after, example)})
    rerender_checks = verify(attacked, stems, renderers)
    with open(folder / LINES, "w", encoding="utf-8") as file:
        for example, line in enumerate(lines):
            survives = {each.version: each.of(example, attacked.classifier.classes) for each in rerender_checks}
            file.write(json.dumps({**line, "versions": survives}) + "\n")
        if checks is not None:
            file.write(json.dumps({"checks": asdict(checks), "warnings": checks.warnings}) + "\n")
    return rerender_checks


def panels(attacked: AttackResult, example: int) -> tuple[Panel, Panel]:
    """What an example shows before and after; its light only where the attack has changed it."""
    problem, classes = attacked.problem, attacked.classifier.classes
    one = problem.everything[example : example + 1]
    sides = [problem.conditions(values[one], one) for values in (problem.start, attacked.descent.values)]
    lights = [(side.light[0], problem.scene.basis_under(side, 0)) for side in sides]
    changed = not torch.equal(lights[0][0], lights[1][0]) or lights[0][1] != lights[1][1]
    labels = [classes[label] for label in attacked.goal.source[example].tolist()]

    def panel(images: Tensor, logits: Tensor, light: Tensor, basis: Basis) -> Panel:
        views = zip(logits[example].softmax(1), labels, strict=True)
        captions = [prediction_caption(probabilities, classes, label) for probabilities, label in views]
        cameras = problem.scene.cameras[example]
        spheres = torch.stack([light_sphere(light, SPHERE, each, basis) for each in cameras]) if changed else None
        return Panel(images[example], captions, spheres)

    return (
        panel(attacked.images_before, attacked.logits_before, *lights[0]),
        panel(attacked.images, attacked.logits, *lights[1]),
    )


def _numbers(attacked: AttackResult, example: int) -> dict[str, object]:
    result, classes = attacked.descent, attacked.classifier.classes
    before = predictions(attacked.logits_before[example], classes)
    one = slice(example, example + 1)
    ends = (attacked.problem.split(values[one]) for values in (result.values, attacked.problem.start))
    return {
        "clean_correct": bool(attacked.clean_correct[example]),
        "success_before": bool(result.success_before[example]),
        "success": bool(attacked.success[example]),
        "success_in_views": attacked.success_in_views[example].tolist(),
        "steps": int(result.steps[example]),
        "cost_before": float(result.cost_before[example]),
        "cost": float(result.cost[example]),
        "label": [classes[index] for index in attacked.goal.source[example].tolist()],
        **{f"{key}_before": value for key, value in before.items()},
        **predictions(attacked.logits[example], classes),
        "largest_change": {
            parameter.name: float((part - start).abs().max())
            for parameter, part, start in zip(attacked.problem.parameters, *ends, strict=True)
        },
    }


def _damage(attacked: AttackResult, after: Conditions, example: int) -> dict[str, dict[str, Any]]:
    """What became of the shape, where it was attacked."""
    mesh = attacked.problem.scene.mesh(example)
    if after.vertices is None:
        return {}
    vertices = after.vertices[example, : len(mesh.vertices)].detach().cpu().double().numpy()
    return {"shape": asdict(mesh_damage(mesh.vertices, vertices, mesh.faces))}
