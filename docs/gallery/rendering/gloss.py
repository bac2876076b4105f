"""
Roughness of a specular surface
===============================

``Gloss`` adds specular reflection to a surface. The rougher the surface, the wider and the dimmer
is the highlight of a lamp. Narrow highlights need lighting of a high degree.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb


def lamp(directions: torch.Tensor) -> torch.Tensor:
    """Return the radiance of a round lamp in front of a dim sky."""
    cosine = directions @ torch.tensor([0.65, -0.4, 0.65], dtype=torch.float64)
    return (0.2 + 6.0 * torch.exp(60.0 * (cosine - 1.0)))[:, None].expand(-1, 3)


light = nb.harmonics.project(lamp, degree=20).float()
[camera] = nb.orbit_cameras(1, width=2.2)
roughnesses = [0.8, 0.5, 0.35, 0.25]
images = []
for gloss in [None, *(nb.Gloss(roughness) for roughness in roughnesses)]:
    options = {"gloss": gloss, "encoding": "srgb"}
    images.append(nb.render(nb.solid("apple"), camera, light, 128, 1.0, **options))

plt.imshow(torch.cat(images, 2).permute(1, 2, 0))
names = ["matte", *(f"roughness {roughness}" for roughness in roughnesses)]
plt.xticks(64 + 128 * torch.arange(5), names)
plt.yticks([])
plt.show()
