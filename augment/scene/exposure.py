"""The exposure of a scene: a factor for the light of each object, chosen as a camera does."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from augment.network import say_once
from augment.scene.scene import Scene
from augment.scene.truth import unlabeled
from renderer.image import clamp, encode

# Mean value of an object's pixels at the exposure "auto", and the largest one of its values
# that are not 0, as most are in a black or in a red object.
MEAN, LIT_MEAN = 0.4, 0.8
# Means beyond these limits are warned about.
DARK, BRIGHT = 0.05, 0.95
# Largest number of examples of an object from which its exposure is chosen.
PROBED = 8
# The exposure "auto" is sought between 2 to the power of minus and plus this number of stops.
STOPS = 20


def expose(scene: Scene) -> Scene:
    """Choose the exposure of each object at which its pixels have the mean MEAN, and say it."""
    factors = []
    for index, item in enumerate(scene.objects):
        rows = [row for row, example in enumerate(scene.examples) if example.object == index]
        values = _linear_values(scene, rows[:: -(-len(rows) // PROBED)]) if rows else torch.empty(0)
        lit = float((values > 0).float().mean()) if rows else 0.0
        aim = min(MEAN, LIT_MEAN * lit)
        low, high = -float(STOPS), float(STOPS)
        # The mean grows with the exposure. 40 halvings leave 2^-35 stops.
        for _ in range(40):
            middle = (low + high) / 2
            mean = encode(clamp(values * 2**middle), scene.settings.encoding).mean()
            low, high = (middle, high) if mean < aim else (low, middle)
        # Nothing brightens what is black.
        factors.append(2**low if lit else 1.0)
        if rows:
            say_once(f"{item.name}: exposure={factors[-1]:.3g}, at which its mean is {aim:.2g}")
    examples = [
        replace(example, exposure=example.exposure * factors[example.object])
        for example in scene.examples
    ]
    return scene.changed(examples=examples)


def _linear_values(scene: Scene, rows: list[int]) -> Float[Tensor, "N 3"]:
    """Return the linear values, before clamping, of the pixels of the first object in examples."""
    # Direct rendering: transfer operators would be built for light that never changes.
    probe = scene.changed(
        examples=[scene.examples[row] for row in rows],
        lights=scene.lights[rows],
        backgrounds=torch.zeros_like(scene.backgrounds),
        camera_effects=None,
        one_light=True,
    )
    every = torch.arange(len(rows))
    canvas = torch.zeros(len(rows) * scene.views, 3, scene.settings.pixel_count)
    for layer in probe.layers(probe.conditions(every), every.to(scene.lights.device)):
        shown = layer.composite.detach().float().cpu()
        canvas[layer.rows] = canvas[layer.rows].index_copy(2, layer.pixels.cpu(), shown)
    masks = probe.truth(unlabeled).masks[:, :, 0].flatten(0, 1).flatten(1).cpu()
    return canvas.transpose(1, 2)[masks]


@torch.no_grad()
def warn_of_exposure(scene: Scene) -> None:
    """Warn of objects that are almost black or white in their first example."""
    seen: dict[int, int] = {}
    for row, example in enumerate(scene.examples):
        seen.setdefault(example.object, row)
    rows = torch.tensor([*seen.values()][:PROBED], device=scene.lights.device)
    images = scene.render(scene.conditions(rows), rows)
    masks = scene.truth(unlabeled, rows).masks[:, :, 0]
    for index, image, mask in zip(seen, images, masks, strict=False):
        mean = float(image.movedim(1, 0)[:, mask].mean()) if mask.any() else MEAN
        if not DARK <= mean <= BRIGHT:
            kind = "dark" if mean < DARK else "bright"
            name = scene.objects[index].name
            say_once(
                f"{name} is too {kind}: its mean is {mean:.2f}; set exposure=auto or another light"
            )
