"""The files of an attack: a figure and a folder for each example, and all numbers as JSON lines."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from augment.attacks.adversary import MITSUBA, Adversary, reload, save_lights, write_adversary
from augment.attacks.attack import (
    AttackResult,
    fooled_in_views,
    logits_of,
    predictions,
    require_result,
)
from augment.attacks.eot import as_jpeg
from augment.attacks.evaluate import CHECKED, warnings
from augment.progress import progress
from renderer.errors import InputError, require_choice
from renderer.image import background_term, clamp, encode, to_bytes, to_unit
from renderer.io.files import write_whole
from renderer.io.images import write_image
from renderer.io.mitsuba import SCENE, mitsuba, render_mitsuba_scene
from renderer.io.tiles import draw_grid, tiles_of
from renderer.rasterizer import Rasterizer
from renderer.rendering import light_sphere
from renderer.validation import as_folder, as_list, require_kind

LINES = "attack.jsonl"  # a line per example, and a last one with the checks
JPEG_QUALITY = 90
RENDERERS = ("reload", MITSUBA)
SIDE = 192  # px: smaller images of a figure are enlarged by a whole factor to at least this width


def save(
    result: AttackResult,
    folder: str | Path,
    checks: dict[str, Any] | None = None,
    verify: Sequence[str] = ("reload",),
) -> list[dict[str, Any]]:
    """Write attack.jsonl and, for each example, a figure of before and after and a folder with its whole adversary.

    checks: as `augment.check` returns them, for the last line. verify: "reload", "mitsuba" or both render the
    adversaries again from these folders; Mitsuba's illumination is direct, and concave meshes shade themselves in it.
    Returns the examples' lines. Their `versions` are the predictions of the images as floats, with 8 bits, as JPEG and
    as rendered again, and the differences of pixel values. `success` is with the noise of a sensor, also of the
    versions, and `success_without_noise` by the images as they are. See `augment.reload`.

    >>> [line] = augment.save(result, "adversaries")
    >>> sorted(path.name for path in Path("adversaries").iterdir())
    ['attack.jsonl', 'example_000', 'example_000.png']
    >>> [*line["versions"]]
    ['float', '8 bits', 'JPEG 90', 'reload']
    """
    require_result(result)
    folder = as_folder("folder", folder)
    if checks is not None:
        require_kind("checks", checks, Mapping, "the result of augment.check")
        if missing := CHECKED - checks.keys():
            raise InputError(f"checks lacks {', '.join(sorted(missing))}: give the result of augment.check")
    verify = as_list("verify", [verify] if isinstance(verify, str) else verify, str, "a list of renderers")
    require_renderers(verify)
    problem, scene = result.problem, result.problem.scene
    folder.mkdir(parents=True, exist_ok=True)
    before, after, lines = problem.conditions(problem.start, problem.everything), result.conditions, []
    stems = [folder / f"example_{example:03d}" for example in range(len(result.images))]
    for example, stem in enumerate(progress(stems, "saving")):
        write_image(stem.with_suffix(".png"), figure(result, example))
        images = result.images_before[example], result.images[example]
        light = write_adversary(Adversary.of(scene, example, after, *images), stem)
        started = before.light[example].cpu() * scene.examples[example].exposure
        save_lights(stem, started, scene.basis_under(before, example), "_before")
        lines.append({"example": example, **_numbers(result, example), **light})
    versions = _versions(result, stems, verify)
    for example, line in enumerate(lines):
        line["versions"] = {name: numbers[example] for name, numbers in versions.items()}
    last = [] if checks is None else [{"checks": checks, "warnings": warnings(checks)}]
    write_whole(folder / LINES, "".join(json.dumps(line) + "\n" for line in [*lines, *last]))
    return lines


def require_renderers(names: Sequence[str]) -> None:
    """InputError unless each is known and installed."""
    for name in names:
        require_choice("verify", name, RENDERERS)
    if MITSUBA in names:
        with mitsuba():
            pass


def _numbers(result: AttackResult, example: int) -> dict[str, object]:
    descent, classes = result.descent, result.classifier.classes
    before = predictions(result.logits_before[example], classes)
    changes = result.problem.by_parameter(descent.values[[example]] - result.problem.start[[example]])
    return {
        "clean_correct": bool(result.clean_correct[example]),
        "success_before": bool(result.success_before[example]),
        "success": bool(result.success[example]),
        "success_without_noise": bool(result.success_without_noise[example]),
        "success_with_margin": bool(result.success_with_margin[example]),
        "success_in_views": result.success_in_views[example].tolist(),
        "steps": int(result.steps[example]),
        "cost_before": float(descent.cost_before[example]),
        "cost": float(descent.cost[example]),
        "label": [classes[index] for index in result.goal.source[example].tolist()],
        **{f"{key}_before": value for key, value in before.items()},
        **predictions(result.logits[example], classes),
        "largest_change": {parameter.name: float(change.abs().max()) for parameter, change in changes},
    }


def _versions(result: AttackResult, folders: Sequence[Path], verify: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """By version of the images after the attack, each example's numbers; folders: of the examples."""
    images = result.images.cpu()
    versions = {
        "float": images,
        "8 bits": to_unit(to_bytes(images)),
        f"JPEG {JPEG_QUALITY}": as_jpeg(images, JPEG_QUALITY),
    }
    to_verify = progress(folders if verify else [], "rendering the saved files")
    again = [render_again(folder, verify, result.problem.scene.rasterizer) for folder in to_verify]
    versions |= {name: torch.stack([views[name] for views in again]) for name in verify}
    numbers = {}
    for name, version in versions.items():
        images = version.to(result.images)
        logits = logits_of(result.preprocessed_model, images, result.settings.batch_size)
        predicted = logits.argmax(2)
        success = fooled_in_views(
            result.preprocessed_model,
            images,
            predicted,
            result.problem.everything,
            result.goal,
            result.settings,
            result.seed,
        ).all(1)
        without_noise = result.goal.reached(predicted)
        differences = (images - result.images).abs().flatten(1)
        numbers[name] = [
            {
                "success": bool(success[example]),
                "success_without_noise": bool(without_noise[example]),
                **predictions(logits[example], result.classifier.classes),
                "largest_difference": float(difference.max()),
                "mean_difference": float(difference.mean()),
            }
            for example, difference in enumerate(differences)
        ]
    return numbers


def render_again(folder: Path, renderers: Sequence[str], rasterizer: Rasterizer) -> dict[str, Tensor]:
    """The images (V, 3, size, size) by each renderer, from an example's files alone."""
    adversary, images = reload(folder), {}
    if "reload" in renderers:
        images["reload"] = adversary.render(rasterizer)
    if MITSUBA in renderers:
        encoding = adversary.settings.encoding
        rgba = render_mitsuba_scene(folder / MITSUBA / SCENE, len(adversary.cameras))
        composite = rgba[:, :3] + background_term(rgba[:, 3:], adversary.background, encoding)
        tonemapped = encode(clamp(composite), encoding)
        images[MITSUBA] = tonemapped if adversary.pixels is None else clamp(tonemapped + adversary.pixels)
    return images


def figure(result: AttackResult, example: int) -> Image.Image:
    """A row per view: an example's images before and after, predictions, difference, and the light where it changed.

    Differences are gray where there is none, and scaled alike so that the largest reaches black or white.
    """
    problem, one = result.problem, result.problem.everything[[example]]
    sides = [problem.conditions(values[one], one) for values in (problem.start, result.descent.values)]
    lights = [(side.light[0], problem.scene.basis_under(side, 0)) for side in sides]
    before, after = result.images_before[example], result.images[example]
    differences = after - before
    largest = differences.abs().amax((1, 2, 3)).tolist()
    scale = 1 / max(1 / 255, *largest)  # smaller ones than a step of eight bits stay as small as they are
    shown = [(f"largest {value:.3f}", f"shown {scale:.3g} times") for value in largest]
    columns = {
        "initial": tiles_of(before, _captions(result, result.logits_before, example), SIDE),
        "adversarial": tiles_of(after, _captions(result, result.logits, example), SIDE),
        "difference": tiles_of((1 + scale * differences) / 2, shown, SIDE),
    }
    if not torch.equal(lights[0][0], lights[1][0]) or lights[0][1] != lights[1][1]:
        for name, (light, basis) in zip(("initial", "adversarial"), lights, strict=True):
            cameras = problem.scene.cameras[example]
            columns[f"{name} light"] = tiles_of(light_sphere(light, SIDE, camera, basis) for camera in cameras)
    return draw_grid([*zip(*columns.values(), strict=True)], [*columns])


def _captions(result: AttackResult, logits: Tensor, example: int) -> list[tuple[str, ...]]:
    """The predicted class of each view with its confidence and, where it is wrong, the right class with its own."""
    classes, labels = result.classifier.classes, result.goal.source[example].tolist()
    return [
        tuple(f"{view[index]:.1%} {classes[index]}" for index in dict.fromkeys([int(view.argmax()), label]))
        for view, label in zip(logits[example].softmax(1), labels, strict=True)
    ]
