"""Renders for a slider in the report, which moves the light from natural to attacked."""

import base64
import io
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from augment.attacks.result import AttackResult
from renderer.image import to_bytes
from renderer.rendering import light_sphere

# Number of positions of the slider, from the natural to the attacked light.
FRAME_COUNT = 21
# Number of classes whose probabilities are shown beside the slider.
CLASS_COUNT = 5
# Width and height of the image of the object, in pixels.
SIDE = 200
# Width and height of the image of a white ball, which shows the light, in pixels.
BALL_SIDE = 120


def frames_of(result: AttackResult, example: int) -> dict[str, Any]:
    """Render an example in lights between the start and the end of an attack.

    Frame i of n has the light start + i / (n - 1) · (end - start). If the attack may use two
    lights, it may use all lights between them, too. "classes" are the right class and the
    CLASS_COUNT - 1 most probable others. Each of "frames" has "image", "ball" (a white ball in the
    same light), both JPEG in base64, and "probabilities" of these classes.
    """
    start = result.problem.start[example]
    end = result.descent.values[example]
    weights = torch.linspace(0, 1, FRAME_COUNT).to(start)[:, None]
    values = start + weights * (end - start)
    examples = torch.full((FRAME_COUNT,), example, device=start.device)
    with torch.no_grad():
        images = result.problem.render(values, examples)
        conditions = result.problem.conditions(values, examples)
        logits = result.objective().logits(images)[:, 0]
    probabilities = logits.softmax(1).cpu()
    label = int(result.criterion.source[example, 0])
    highest_probability = probabilities.amax(dim=0)
    ranked = highest_probability.argsort(descending=True).tolist()
    other_classes = [index for index in ranked if index != label]
    shown_classes = [label, *other_classes][:CLASS_COUNT]
    frames = []
    for index in range(FRAME_COUNT):
        basis = result.problem.scene.basis_under(conditions, index)
        ball = light_sphere(conditions.light[index], BALL_SIDE, basis=basis)
        shown_probabilities = probabilities[index, shown_classes].tolist()
        frames.append(
            {
                "image": _jpeg(images[index, 0], SIDE),
                "ball": _jpeg(ball, BALL_SIDE),
                "probabilities": [round(value, 4) for value in shown_probabilities],
            }
        )
    names = [result.classifier.classes[index] for index in shown_classes]
    return {"classes": names, "label": names[0], "frames": frames}


def _jpeg(image: Float[Tensor, "3 H W"], side: int) -> str:
    """Resize an image in [0, 1] to a square, and encode it as a JPEG file in base64."""
    pixels = to_bytes(image.cpu().clamp(0, 1)).permute(1, 2, 0).numpy()
    file = io.BytesIO()
    Image.fromarray(pixels).resize((side, side)).save(file, "JPEG", quality=85)
    return base64.b64encode(file.getvalue()).decode()
