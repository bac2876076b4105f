"""The files of an attack: an image and a folder for each example, and all numbers as JSON lines."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.attacks.adversary import Adversary, write_adversary
from augment.attacks.attack import AttackResult, predictions
from augment.attacks.evaluate import Checks, RerenderCheck, require_renderers, rerender
from augment.attacks.figure import Panel, prediction_caption, save_figure
from augment.scene import Conditions
from renderer.light.basis import Basis
from renderer.mesh import doubled_area_vectors
from renderer.rendering import light_sphere

LINES = "attack.jsonl"  # a line per example, and a last one with the checks
SPHERE = 192


def save(
    result: AttackResult, folder: str | Path, checks: Checks | None = None, verify: Sequence[str] = ("reload",)
) -> list[RerenderCheck]:
    """Write attack.jsonl and, for each example, an image of before and after and a folder with its whole adversary.

    verify: "reload", "mitsuba" or both render the adversaries again from these folders; returned are the checks of
    these images and of the attack's own ones, which are in attack.jsonl, too. See `augment.reload`.

    >>> rerender_checks = augment.save(result, "adversaries")
    >>> sorted(path.name for path in Path("adversaries").iterdir())
    ['attack.jsonl', 'example_000', 'example_000.png']
    >>> [check.version for check in rerender_checks]
    ['float', '8 bits', 'JPEG 90', 'reload']
    """
    require_renderers(verify)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    after = result.conditions
    stems = [folder / f"example_{example:03d}" for example in range(len(result.images))]
    lines = []
    for example, stem in enumerate(stems):
        save_figure(*panels(result, example), stem.with_suffix(".png"))
        images = result.images_before[example], result.images[example]
        light = write_adversary(Adversary.of(result.problem.scene, example, after, *images), stem)
        lines.append({"example": example, **_numbers(result, example), **light, **_damage(result, after, example)})
    rerender_checks = rerender(result, stems, verify)
    with open(folder / LINES, "w", encoding="utf-8") as file:
        for example, line in enumerate(lines):
            versions = {check.version: check.of(example, result.classifier.classes) for check in rerender_checks}
            file.write(json.dumps({**line, "versions": versions}) + "\n")
        if checks is not None:
            file.write(json.dumps({"checks": asdict(checks), "warnings": checks.warnings}) + "\n")
    return rerender_checks


def panels(result: AttackResult, example: int) -> tuple[Panel, Panel]:
    """An example's sides before and after, with their light only where the attack has changed it."""
    problem, classes = result.problem, result.classifier.classes
    one = problem.everything[example : example + 1]
    sides = [problem.conditions(values[one], one) for values in (problem.start, result.descent.values)]
    lights = [(side.light[0], problem.scene.basis_under(side, 0)) for side in sides]
    changed = not torch.equal(lights[0][0], lights[1][0]) or lights[0][1] != lights[1][1]
    labels = [classes[label] for label in result.goal.source[example].tolist()]

    def panel(images: Tensor, logits: Tensor, light: Tensor, basis: Basis) -> Panel:
        views = zip(logits[example].softmax(1), labels, strict=True)
        captions = [prediction_caption(probabilities, classes, label) for probabilities, label in views]
        cameras = problem.scene.cameras[example]
        spheres = torch.stack([light_sphere(light, SPHERE, each, basis) for each in cameras]) if changed else None
        return Panel(images[example], captions, spheres)

    return (
        panel(result.images_before, result.logits_before, *lights[0]),
        panel(result.images, result.logits, *lights[1]),
    )


def _numbers(result: AttackResult, example: int) -> dict[str, object]:
    descent, classes = result.descent, result.classifier.classes
    before = predictions(result.logits_before[example], classes)
    one = slice(example, example + 1)
    ends = (result.problem.split(values[one]) for values in (descent.values, result.problem.start))
    return {
        "clean_correct": bool(result.clean_correct[example]),
        "success_before": bool(result.success_before[example]),
        "success": bool(result.success[example]),
        "success_in_views": result.success_in_views[example].tolist(),
        "steps": int(result.steps[example]),
        "cost_before": float(descent.cost_before[example]),
        "cost": float(descent.cost[example]),
        "label": [classes[index] for index in result.goal.source[example].tolist()],
        **{f"{key}_before": value for key, value in before.items()},
        **predictions(result.logits[example], classes),
        "largest_change": {
            parameter.name: float((part - start).abs().max())
            for parameter, part, start in zip(result.problem.parameters, *ends, strict=True)
        },
    }


def _damage(result: AttackResult, after: Conditions, example: int) -> dict[str, dict[str, Any]]:
    """Of an attacked shape: faces turned by more than 90°, and the largest displacements along x, y and z."""
    mesh = result.problem.scene.mesh(example)
    if after.vertices is None:
        return {}
    vertices = after.vertices[example, : len(mesh.vertices)].detach().cpu().double().numpy()
    before, now = (doubled_area_vectors(corners, mesh.faces) for corners in (mesh.vertices, vertices))
    displacement = np.abs(vertices - mesh.vertices).max(axis=0).tolist()
    return {"shape": {"flipped": int(((before * now).sum(axis=1) < 0).sum()), "displacement": displacement}}
