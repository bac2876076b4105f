"""Frames of a slider that moves one light from natural to adversarial."""

import base64
import io
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from augment.attacks.attack import AttackResult, logits_of
from renderer.image import to_bytes
from renderer.rendering import light_sphere

# Number of frames, from the natural to the adversarial light.
FRAMES = 21
# Number of classes of which each frame has the probability.
CLASSES = 5
# Pixels per side of the image and of the ball that shows the light.
SIDE = 200
BALL_SIDE = 120
# Images in one pass of the classifier.
BATCH = 16


def frames_of(result: AttackResult, example: int) -> dict[str, Any]:
    """Render the lights between the start and the end of an attack.

    Frame i of n has the light start + i / (n - 1) · (end - start). The feasible
    lights are convex, so each frame is feasible.

    Args:
        result: Result of the attack, with one view per example.
        example: Index of the example.

    Returns:
        Dictionary with the keys

        - classes: names of the CLASSES classes with the highest probability in
          any frame, the right class first,
        - label: the right class,
        - frames: for each frame its "image" and its "ball", JPEG files in
          base64, and "probabilities" of these classes.
    """
    start = result.problem.start[example]
    end = result.descent.values[example]
    weights = torch.linspace(0, 1, FRAMES).to(start)[:, None]
    values = start + weights * (end - start)
    examples = torch.full((FRAMES,), example, device=start.device)
    with torch.no_grad():
        images = result.problem.render(values, examples)
        conditions = result.problem.conditions(values, examples)
        logits = logits_of(result.preprocessed_model, images, BATCH)[:, 0]
    probabilities = logits.softmax(1).cpu()
    label = int(result.criterion.source[example, 0])
    ranked = probabilities.amax(0).argsort(descending=True).tolist()
    # The right class, and then the other classes by falling probability.
    shown = [label, *(index for index in ranked if index != label)][:CLASSES]
    frames = []
    for index in range(FRAMES):
        basis = result.problem.scene.basis_under(conditions, index)
        ball = light_sphere(conditions.light[index], BALL_SIDE, basis=basis)
        frames.append(
            {
                "image": _jpeg(images[index, 0], SIDE),
                "ball": _jpeg(ball, BALL_SIDE),
                "probabilities": [round(float(probabilities[index, k]), 4) for k in shown],
            }
        )
    names = [result.classifier.classes[index] for index in shown]
    return {"classes": names, "label": names[0], "frames": frames}


def _jpeg(image: Tensor, side: int) -> str:
    """Encode an image (3, H, W) in [0, 1] as a JPEG file in base64."""
    pixels = to_bytes(image.cpu().clamp(0, 1)).permute(1, 2, 0).numpy()
    file = io.BytesIO()
    Image.fromarray(pixels).resize((side, side)).save(file, "JPEG", quality=85)
    return base64.b64encode(file.getvalue()).decode()
