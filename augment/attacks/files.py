"""Files of an attack: a figure and a folder for each example, and all numbers as JSON lines."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from augment.attack_settings import LINES
from augment.attacks.adversary import MITSUBA, Adversary, reload, save_lights, write_adversary
from augment.attacks.objective import Images, as_jpeg
from augment.attacks.parameters.lights import Skylight
from augment.attacks.result import AttackResult, require_result, warnings
from augment.progress import progress
from augment.scene.objects import Conditions
from renderer.errors import as_folder, as_list, require_choice
from renderer.image import background_term, clamp, encode, to_bytes, to_unit
from renderer.io.files import atomic_write, remove
from renderer.io.images import draw_grid, tiles_of, write_image
from renderer.mitsuba_scene import SCENE, mitsuba, render_mitsuba_scene
from renderer.rendering import light_sphere
from renderer.visibility import Rasterizer

# `save` also classifies the attacked images after JPEG compression with this quality.
JPEG_QUALITY = 90

# Entries of attack.jsonl that are attributes of `AttackResult`.
NUMBERS = (
    "clean_correct",
    "success_before",
    "success",
    "success_without_noise",
    "success_with_margin",
    "success_in_views",
    "steps",
    "queries",
    "backward_passes",
)
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
    verify = [verify] if isinstance(verify, str) else verify
    verify = as_list("verify", verify, str, "a list of renderers")
    require_renderers(verify)
    if (folder / LINES).exists():
        # Files of an earlier attack would be taken for those of this one.
        remove(*folder.glob("example_*"))
    folder.mkdir(parents=True, exist_ok=True)
    images = result.images_in_views.cpu()
    paths = [folder / f"example_{example:03d}" for example in range(len(images))]
    after = result.conditions
    shown_paths = enumerate(progress(paths, "saving"))
    lines = [_write_example(result, after, example, path) for example, path in shown_paths]
    versions = {
        "float": images,
        "8 bits": to_unit(to_bytes(images)),
        f"JPEG {JPEG_QUALITY}": as_jpeg(images, JPEG_QUALITY),
    }
    if verify:
        # Images of all examples by the name of the renderer, shape (E, V, 3, height, width) each.
        folders = progress(paths, "rendering the saved files")
        rendered = [render_again(path, verify, result.problem.scene.rasterizer) for path in folders]
        versions |= {name: torch.stack([views[name] for views in rendered]) for name in verify}
    for name, version in versions.items():
        numbers = _numbers_of_version(result, version.to(result.images_in_views))
        for line, of_example in zip(lines, numbers, strict=True):
            line["versions"][name] = of_example

    last = [] if checks is None else [{"checks": checks, "warnings": warnings(checks)}]
    atomic_write(folder / LINES, "".join(json.dumps(line) + "\n" for line in [*lines, *last]))
    return lines


def require_renderers(names: Sequence[str]) -> None:
    """Check that the renderers of the argument `verify` are known and installed."""
    for name in names:
        require_choice("verify", name, ("reload", MITSUBA))
    if MITSUBA in names:
        # The context imports Mitsuba, or raises InputError if it is not installed.
        with mitsuba():
            pass


def _write_example(
    result: AttackResult, after: Conditions, example: int, path: Path
) -> dict[str, Any]:
    """Write the figure and the folder of an example. `after` are the conditions of all examples.

    Return its numbers for attack.jsonl, where the dictionary "versions" is empty.
    """
    problem, scene = result.problem, result.problem.scene
    images = result.images_in_views_before[example], result.images_in_views[example]
    write_image(path.with_suffix(".png"), figure(result, example))
    adversary = Adversary.of(scene, example, after, *images)
    # An index would be another class of another network.
    names = result.classifier.classes
    label = names[result.classifier.label(adversary.shown.label)]
    # An index may also be a text. A label that is no class stays as it is.
    name_of: dict[str | int, str] = {str(index): name for index, name in enumerate(names)}
    name_of |= {name: name for name in names} | dict(enumerate(names))
    others = [(name_of.get(of, of), mesh) for of, mesh in adversary.shown.others]
    adversary = replace(adversary, shown=replace(adversary.shown, label=label, others=others))
    light_numbers = write_adversary(adversary, path)
    # The files of an adversary have the light after the attack. Add that before it.
    light_before, basis_before = result.light(problem.start, example)
    save_lights(path, scene.exposed(light_before.cpu(), example), basis_before, "_before")

    classes = result.classifier.classes
    minimum = result.minimum
    values = problem.split_by_parameter(minimum.values[[example]])
    skies = [kind.described(part[0]) for kind, part in values if isinstance(kind, Skylight)]
    # Change of each of the D attack values of this example, shape (1, D).
    parts = problem.split_by_parameter(minimum.values[[example]] - problem.start[[example]])
    return {
        "example": example,
        **{name: getattr(result, name)[example].tolist() for name in NUMBERS},
        "cost_before": float(minimum.cost_before[example]),
        "cost": float(minimum.cost[example]),
        "label": [classes[index] for index in result.criterion.source[example].tolist()],
        **result.predictions(result.evidence_in_views_before[example], example, "_before"),
        **result.predictions(result.evidence_in_views[example], example),
        "largest_change": {parameter.name: float(part.abs().max()) for parameter, part in parts},
        **({"sky": skies[0]} if skies else {}),
        **light_numbers,
        "versions": {},
    }


def _numbers_of_version(result: AttackResult, images: Images) -> list[dict[str, Any]]:
    """Return successes, predictions and differences of another version for each example."""
    judged = result.objective().judge(images, result.problem.all_examples)
    evidence, fooled_in_views, without_noise = judged
    # Examples that reach the criterion before the attack are no successes.
    is_counted = ~result.success_before
    return [
        {
            "success": bool((fooled_in_views.all(1) & is_counted)[example]),
            "success_without_noise": bool((without_noise & is_counted)[example]),
            **result.predictions(evidence[example], example),
            "largest_difference": float(difference.max()),
            "mean_difference": float(difference.mean()),
        }
        for example, difference in enumerate((images - result.images_in_views).abs().flatten(1))
    ]


def render_again(folder: Path, names: Sequence[str], rasterizer: Rasterizer) -> dict[str, Tensor]:
    """Render the V views of an example from its saved files alone.

    Return images of shape (V, 3, height, width) by the names of the renderers.
    """
    adversary = reload(folder)
    images = {}
    if "reload" in names:
        images["reload"] = adversary.render_views(rasterizer)
    if MITSUBA in names:
        settings, cameras = adversary.settings, adversary.cameras
        rgba = render_mitsuba_scene(folder / MITSUBA / SCENE, len(cameras), settings.shape)
        # The fourth channel is the coverage of each pixel by the object.
        background = background_term(rgba[:, 3:], adversary.background, settings.encoding)
        rendered = encode(clamp(rgba[:, :3] + background), settings.encoding)
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
    before, after = result.images_in_views_before[example], result.images_in_views[example]
    differences = after - before
    largest = differences.abs().amax((1, 2, 3)).tolist()
    # Differences are enlarged by this factor, at most 255, to fill the range of an image.
    scale = 1 / max(1 / 255, *largest)
    captions = [(f"largest {value:.3f}", f"shown {scale:.3g} times") for value in largest]
    captions_before = _captions(result, result.evidence_in_views_before[example], example)
    captions_after = _captions(result, result.evidence_in_views[example], example)
    columns = {
        "initial": tiles_of(map(result.drawn, before), captions_before, SIDE),
        "adversarial": tiles_of(map(result.drawn, after), captions_after, SIDE),
        # A difference of 0 becomes the gray value 1/2.
        "difference": tiles_of((1 + scale * differences) / 2, captions, SIDE),
    }
    first = result.light(result.problem.start, example)
    last = result.light(result.minimum.values, example)
    if not torch.equal(first[0], last[0]) or first[1] != last[1]:
        cameras = result.problem.scene.cameras[example]
        for title, (light, basis) in {"initial light": first, "adversarial light": last}.items():
            balls = [light_sphere(light, SIDE, camera, basis) for camera in cameras]
            columns[title] = tiles_of(balls)
    return draw_grid(list(zip(*columns.values(), strict=True)), list(columns))


def _captions(result: AttackResult, evidence: Tensor, example: int) -> list[tuple[str, ...]]:
    """Return the captions of the V views of an example in the figure of an attack.

    The first line has the confidence and the name of the predicted class. If it is wrong, a second
    line has those of the true class.
    """
    source = result.criterion.source[example]
    of_label = result.classifier.task.confidences(evidence).gather(1, source[:, None])[:, 0]
    found = result.predictions(evidence, example)
    captions = []
    columns = (found["predicted"], found["confidence"], source.tolist(), of_label.tolist())
    for name, confidence, label, label_confidence in zip(*columns, strict=True):
        # A dictionary has each class once, so a correct prediction takes one line.
        shown = {name: confidence, result.classifier.classes[label]: label_confidence}
        captions.append(tuple(f"{value:.1%} {text}" for text, value in shown.items()))
    return captions
