"""
An attack on a zero-shot network
================================

A zero-shot network such as CLIP turns images and texts into vectors. An image has the class whose
text has the nearest vector. Here, formulas stand for both parts: the vector of an image is the mean
of its colors, of which gray ones hardly count, and the vector of a text is the color that it names.
The attack finds a lighting in which the orange is nearest to another text. A published network is
attacked alike: give ``nb.load_classifier("hf:openai/clip-vit-base-patch32", classes=CLASSES)``
instead of the function.
"""

import torch
from torch.nn.functional import normalize

import norm_balls as nb

CLASSES = ["orange", "lime", "plum"]
TEXTS = normalize(torch.tensor([[1.0, 0.4, 0.1], [0.5, 0.8, 0.2], [0.6, 0.2, 0.5]]), dim=1)


def compare(images: torch.Tensor) -> torch.Tensor:
    """Return logits: the scaled cosines between the vectors of images and those of texts."""
    colorfulness = images.amax(1, keepdim=True) - images.amin(1, keepdim=True)
    vectors = normalize((colorfulness * images).mean((2, 3)), dim=1)
    return 50 * vectors @ TEXTS.T


scene = nb.build_scene([("solid:orange:3", "orange")], 96, width=3.0, encoding="srgb")
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=3.0, step_size=0.3))
result = nb.attack(compare, scene, settings=settings, classes=CLASSES)
figure = result.plot()
