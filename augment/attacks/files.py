"""Files of an attack: a figure and a folder for each example, and all numbers as JSON lines."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from augment.attack_settings import LINES
from augment.attacks.adversary import MITSUBA, Adversary, reload, save_lights, write_adversary
from augment.attacks.objective import as_jpeg
from augment.attacks.result import CHECKED, AttackResult, predictions, require_result, warnings
from augment.progress import progress
from renderer.errors import InputError, as_folder, as_list, require_choice, require_kind
from renderer.image import background_term, clamp, encode, to_bytes, to_unit
from renderer.io.files import atomic_write
from renderer.io.images import Tile, draw_grid, tiles_of, write_image
from renderer.mitsuba_scene import SCENE, mitsuba, render_mitsuba_scene
from renderer.rendering import light_sphere
from renderer.visibility import Rasterizer

# `save` also classifies the attacked images after JPEG compression with this quality.
JPEG_QUALITY = 90
# Renderers that `save` may use to render the saved files again.
RENDERERS = ("reload", MITSUBA)

# Smallest width in pixels of an image in the figure of an example. Smaller images are enlarged by
# a whole factor.
SIDE = 192


def save(
    result: AttackResult,
    folder: str | Path,
    checks: dict[str, Any] | None = None,
    verify: Sequence[str] = ("reload",),
) -> list[dict[str, Any]]:
    """Write the files of an attack to a folder.

    The files are a figure and a folder for each example, and attack.jsonl with
    a line of numbers for each example. `nb.reload` reads the folder of an
    example.

    Args:
        result: The result of `nb.attack`.
        folder: The folder to write.
        checks: The result of `nb.check`, which becomes the last line of
            attack.jsonl. None for no such line.
        verify: Renderers that render the examples again from their files:
            "reload" (this library), "mitsuba" or both. Mitsuba renders direct
            light with the shadows that a mesh casts on itself.

    Returns:
        A dictionary for each example, as in attack.jsonl. "versions" has the
        predictions for the images as floats, with 8 bits, as JPEG and as each
        renderer renders them, and their differences from the floats. "success"
        is measured with sensor noise, and "success_without_noise" without.

    Raises:
        InputError: If an argument is of another type, or a renderer is unknown
            or not installed.

    Example:
        >>> from pathlib import Path
        >>> import norm_balls as nb
        >>> [line] = nb.save(result, "adversaries")
        >>> sorted(path.name for path in Path("adversaries").iterdir())
        ['attack.jsonl', 'example_000', 'example_000.png']
        >>> [*line["versions"]]
        ['float', '8 bits', 'JPEG 90', 'reload']
    """
    require_result(result)
    folder = as_folder("folder", folder)
    if checks is not None:
        require_kind("checks", checks, Mapping, "the dictionary that norm_balls.check returns")
        if missing := CHECKED - checks.keys():
            names = ", ".join(sorted(missing))
            raise InputError(f"checks lacks the keys {names}: give what norm_balls.check returns")
    verify = [verify] if isinstance(verify, str) else verify
    verify = as_list("verify", verify, str, "a list of renderers")
    require_renderers(verify)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"example_{example:03d}" for example in range(len(result.images_in_views))]

    lines = _write_examples(result, paths)
    versions = _versions(result, paths, verify)
    for example, line in enumerate(lines):
        line["versions"] = {name: numbers[example] for name, numbers in versions.items()}

    all_lines = list(lines)
    if checks is not None:
        all_lines.append({"checks": checks, "warnings": warnings(checks)})
    atomic_write(folder / LINES, "".join(json.dumps(line) + "\n" for line in all_lines))
    return lines


def require_renderers(names: Sequence[str]) -> None:
    """Check that the renderers of the argument `verify` are known and installed."""
    for name in names:
        require_choice("verify", name, RENDERERS)
    if MITSUBA in names:
        # The context imports Mitsuba, or raises InputError if it is not installed.
        with mitsuba():
            pass


def _write_examples(result: AttackResult, paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Write the figure and the folder of each example.

    Return the numbers of each example for attack.jsonl, without the key "versions".
    """
    problem = result.problem
    scene = problem.scene
    conditions_before = problem.conditions(problem.start, problem.all_examples)
    conditions_after = result.conditions
    lines = []
    for example, path in enumerate(progress(paths, "saving")):
        write_image(path.with_suffix(".png"), figure(result, example))
        adversary = Adversary.of(
            scene,
            example,
            conditions_after,
            before=result.images_in_views_before[example],
            images=result.images_in_views[example],
        )
        light_numbers = write_adversary(adversary, path)
        exposure = scene.examples[example].exposure
        light_before = conditions_before.light[example].cpu() * exposure
        save_lights(path, light_before, scene.basis_under(conditions_before, example), "_before")
        lines.append({"example": example, **_numbers(result, example), **light_numbers})
    return lines


def _numbers(result: AttackResult, example: int) -> dict[str, object]:
    """Return the successes, costs and predictions of one example for attack.jsonl."""
    minimum = result.minimum
    classes = result.classifier.classes
    before = predictions(result.logits_in_views_before[example], classes)
    # Change of each of the D attack values of this example, shape (1, D).
    change = minimum.values[[example]] - result.problem.start[[example]]
    # Largest change of a value of each attacked parameter, such as "pose".
    largest_change = {}
    for parameter, part in result.problem.split_by_parameter(change):
        largest_change[parameter.name] = float(part.abs().max())
    return {
        "clean_correct": bool(result.clean_correct[example]),
        "success_before": bool(result.success_before[example]),
        "success": bool(result.success[example]),
        "success_without_noise": bool(result.success_without_noise[example]),
        "success_with_margin": bool(result.success_with_margin[example]),
        "success_in_views": result.success_in_views[example].tolist(),
        "steps": int(result.steps[example]),
        "queries": int(result.queries[example]),
        "backward_passes": int(result.backward_passes[example]),
        "cost_before": float(minimum.cost_before[example]),
        "cost": float(minimum.cost[example]),
        "label": [classes[index] for index in result.criterion.source[example].tolist()],
        "predicted_before": before["predicted"],
        "confidence_before": before["confidence"],
        **predictions(result.logits_in_views[example], classes),
        "largest_change": largest_change,
    }


def _versions(
    result: AttackResult,
    paths: Sequence[Path],
    renderers: Sequence[str],
) -> dict[str, list[dict[str, Any]]]:
    """Classify several versions of the images after an attack.

    The versions are the images as floats, with 8 bits, as JPEG, and as each renderer renders them
    from the saved files. Return, for the name of each version, a dictionary for each example: its
    successes, predictions, and differences from the floats.
    """
    # Images of V views of each of the E examples, shape (E, V, 3, size, size).
    images = result.images_in_views.cpu()
    versions = {
        "float": images,
        "8 bits": to_unit(to_bytes(images)),
        f"JPEG {JPEG_QUALITY}": as_jpeg(images, JPEG_QUALITY),
    }
    if renderers:
        rasterizer = result.problem.scene.rasterizer
        rendered = []
        for path in progress(paths, "rendering the saved files"):
            rendered.append(render_again(path, renderers, rasterizer))
        for name in renderers:
            versions[name] = torch.stack([by_renderer[name] for by_renderer in rendered])
    numbers = {}
    for name, version in versions.items():
        numbers[name] = _numbers_of_version(result, version.to(result.images_in_views))
    return numbers


def _numbers_of_version(
    result: AttackResult, images: Float[Tensor, "E V 3 size size"]
) -> list[dict[str, Any]]:
    """Classify another version of the attacked images, such as renders of Mitsuba.

    Return a dictionary for each example: its successes, predictions, and differences from the
    images of the result.
    """
    objective = result.objective()
    logits = objective.logits(images)
    predicted = logits.argmax(2)
    success_in_views = objective.fooled_in_views(images, predicted, result.problem.all_examples)
    success = success_in_views.all(1) & ~result.success_before
    without_noise = result.criterion.reached(predicted) & ~result.success_before
    differences = (images - result.images_in_views).abs().flatten(1)
    numbers = []
    for example, difference in enumerate(differences):
        numbers.append(
            {
                "success": bool(success[example]),
                "success_without_noise": bool(without_noise[example]),
                **predictions(logits[example], result.classifier.classes),
                "largest_difference": float(difference.max()),
                "mean_difference": float(difference.mean()),
            }
        )
    return numbers


def render_again(
    folder: Path,
    renderers: Sequence[str],
    rasterizer: Rasterizer,
) -> dict[str, Tensor]:
    """Render the V views of an example from its saved files alone.

    Return images of shape (V, 3, size, size) by the name of the renderer.
    """
    adversary = reload(folder)
    images = {}
    if "reload" in renderers:
        images["reload"] = adversary.render_views(rasterizer)
    if MITSUBA in renderers:
        encoding = adversary.settings.encoding
        rgba = render_mitsuba_scene(folder / MITSUBA / SCENE, len(adversary.cameras))
        # The fourth channel is the coverage of each pixel by the object.
        background = background_term(rgba[:, 3:], adversary.background, encoding)
        rendered = encode(clamp(rgba[:, :3] + background), encoding)
        if adversary.pixels is not None:
            rendered = clamp(rendered + adversary.pixels)
        images[MITSUBA] = rendered
    return images


def figure(result: AttackResult, example: int) -> Image.Image:
    """Draw an example before and after the attack, with a row for each view.

    The columns show the two images with their predictions, their difference
    and, if the attack changed the light, a white ball in the light before and
    after. In the difference, unchanged values are gray, and the largest change
    of all views is black or white.
    """
    before = result.images_in_views_before[example]
    after = result.images_in_views[example]
    differences = after - before
    largest = differences.abs().amax((1, 2, 3)).tolist()
    # Differences are enlarged by this factor, at most 255, to fill the range of an image.
    scale = 1 / max(1 / 255, *largest)
    captions = [(f"largest {value:.3f}", f"shown {scale:.3g} times") for value in largest]
    predicted_before = _captions(result, result.logits_in_views_before, example)
    predicted_after = _captions(result, result.logits_in_views, example)
    columns = {
        "initial": tiles_of(before, predicted_before, SIDE),
        "adversarial": tiles_of(after, predicted_after, SIDE),
        "difference": tiles_of((1 + scale * differences) / 2, captions, SIDE),
        **_columns_of_light(result, example),
    }
    return draw_grid(list(zip(*columns.values(), strict=True)), list(columns))


def _columns_of_light(result: AttackResult, example: int) -> dict[str, list[Tile]]:
    """Draw a white ball in the light before and after an attack, as each camera sees it.

    Return the two columns by their titles, or an empty dictionary if the attack did not change the
    light.
    """
    problem = result.problem
    scene = problem.scene
    examples = problem.all_examples[[example]]
    conditions_before = problem.conditions(problem.start[examples], examples)
    conditions_after = problem.conditions(result.minimum.values[examples], examples)
    # Both conditions contain one example only, at index 0.
    basis_before = scene.basis_under(conditions_before, 0)
    basis_after = scene.basis_under(conditions_after, 0)
    is_same_light = torch.equal(conditions_before.light, conditions_after.light)
    if is_same_light and basis_before == basis_after:
        return {}
    light_before = conditions_before.light[0]
    light_after = conditions_after.light[0]
    spheres_before = []
    spheres_after = []
    for camera in scene.cameras[example]:
        spheres_before.append(light_sphere(light_before, SIDE, camera, basis_before))
        spheres_after.append(light_sphere(light_after, SIDE, camera, basis_after))
    return {
        "initial light": tiles_of(spheres_before),
        "adversarial light": tiles_of(spheres_after),
    }


def _captions(
    result: AttackResult, logits: Float[Tensor, "E V C"], example: int
) -> list[tuple[str, ...]]:
    """Return the captions of the V views of an example in the figure of an attack.

    The first line has the probability and the name of the predicted class. If it is wrong, a second
    line has those of the true class.
    """
    classes = result.classifier.classes
    labels = result.criterion.source[example].tolist()
    captions = []
    for probabilities, label in zip(logits[example].softmax(1), labels, strict=True):
        shown_classes = [int(probabilities.argmax())]
        if label not in shown_classes:
            shown_classes.append(label)
        lines = [f"{probabilities[index]:.1%} {classes[index]}" for index in shown_classes]
        captions.append(tuple(lines))
    return captions
