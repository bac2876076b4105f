"""What an attack leaves behind: images, lights, shapes, and all numbers as JSON lines."""

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from augment.attacks.checks import Checks
from augment.attacks.figure import Exhibit, answer_caption, save_figure
from augment.attacks.run import Attacked
from augment.scene import Conditions
from renderer.environment import to_map, write_map
from renderer.light_sphere import light_sphere
from renderer.lights import save_light
from renderer.mesh_damage import mesh_damage
from renderer.mesh_export import export_mesh

LINES = "attack.jsonl"  # a line per example, and a last one with the checks
MAP_HEIGHT = 256
SPHERE = 192


def write_files(attacked: Attacked, checks: Checks | None, folder: Path) -> None:
    """Write a folder: attack.jsonl, and for each example an image and the light and shape that it ended with."""
    folder.mkdir(parents=True, exist_ok=True)
    everything = attacked.problem.everything
    before = attacked.problem.conditions(attacked.problem.start, everything)
    after = attacked.problem.conditions(attacked.result.values, everything)
    with open(folder / LINES, "w", encoding="utf-8") as file:
        for example in range(len(everything)):
            stem = folder / f"example_{example:03d}"
            _write_image(attacked, before, after, example, stem.with_suffix(".png"))
            numbers = _numbers(attacked, example) | dict(_write_conditions(attacked, after, example, stem))
            file.write(json.dumps({"example": example, **numbers}) + "\n")
        if checks is not None:
            file.write(json.dumps({"checks": asdict(checks), "warnings": checks.warnings}) + "\n")


def _write_image(attacked: Attacked, before: Conditions, after: Conditions, example: int, path: Path) -> None:
    sides = [
        (attacked.images_before, attacked.logits_before, before),
        (attacked.result.images, attacked.logits, after),
    ]
    save_figure(*(_exhibit(attacked, *side, example) for side in sides), path)


def _exhibit(attacked: Attacked, images: Tensor, logits: Tensor, conditions: Conditions, example: int) -> Exhibit:
    scene, classes = attacked.problem.scene, attacked.classifier.classes
    labels = attacked.goal.decrease[example].tolist()
    captions = [
        answer_caption(view.softmax(0), classes, classes[label])
        for view, label in zip(logits[example], labels, strict=True)
    ]
    spheres = [light_sphere(conditions.light[example], SPHERE, camera) for camera in scene.cameras[example]]
    return Exhibit(images[example], captions, torch.stack(spheres))


def _numbers(attacked: Attacked, example: int) -> dict:
    result, classes = attacked.result, attacked.classifier.classes
    before, after = (logits[example].softmax(1) for logits in (attacked.logits_before, attacked.logits))
    return {
        "recognised": bool(attacked.recognised[example]),
        "fooled_before": bool(result.fooled_before[example]),
        "fooled": bool(result.fooled[example]),
        "fooled_in_views": attacked.success_in_views[example].tolist(),
        "steps": int(result.steps[example]),
        "cost_before": float(result.cost_before[example]),
        "cost": float(result.cost[example]),
        "label": [classes[index] for index in attacked.goal.decrease[example].tolist()],
        "answer_before": [classes[index] for index in before.argmax(1).tolist()],
        "confidence_before": before.amax(1).tolist(),
        "answer": [classes[index] for index in after.argmax(1).tolist()],
        "confidence": after.amax(1).tolist(),
        "largest_change": {
            kind.name: float((part - start).abs().max())
            for kind, part, start in zip(
                attacked.problem.kinds,
                attacked.problem.split(result.values[example : example + 1]),
                attacked.problem.split(attacked.problem.start[example : example + 1]),
                strict=True,
            )
        },
    }


def _write_conditions(attacked: Attacked, after: Conditions, example: int, stem: Path) -> Iterator[tuple[str, object]]:
    """What can be used elsewhere: the light, if it was attacked, and the shape."""
    scene, light = attacked.problem.scene, after.light[example].detach().cpu()
    mesh = scene.mesh(example)
    if not torch.equal(light, scene.lights[example].cpu()):
        save_light(stem.with_name(stem.name + "_light.json"), light)
        write_map(stem.with_name(stem.name + "_light.hdr"), to_map(light, MAP_HEIGHT))
    if after.vertices is not None:
        vertices = after.vertices[example, : len(mesh.vertices)].detach().cpu().double().numpy()
        for suffix in (".glb", ".ply"):
            path, shape = stem.with_name(stem.name + "_shape" + suffix), replace(mesh, vertices=vertices)
            export_mesh(shape, path, scene.settings.normals, scene.cameras[example])
        yield "shape", asdict(mesh_damage(mesh.vertices, vertices, mesh.faces))
