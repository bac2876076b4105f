"""
Degrees of environment lighting
===============================

The degree of the lighting sets how many details of the surroundings it contains. A metal ball
reflects these details: a window, which a low degree blurs and surrounds with rings. A matte ball
looks the same from degree 3 on.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb


def window(directions: torch.Tensor) -> torch.Tensor:
    """Return the radiance of a bright window in a dim room."""
    is_window = (directions - torch.tensor([0.7, -0.5, 0.5])).abs().amax(1) < 0.3
    return 0.08 + 2.5 * is_window[:, None] * torch.tensor([1.0, 0.9, 0.7])


ball = nb.solid("ball")
[camera] = nb.orbit_cameras(1, width=2.2)
gray = torch.full((len(ball.faces), 3), 0.7)
degrees = [0, 1, 3, 6, 20]
rows = []
for gloss in (None, nb.Gloss(0.2, metallic=1.0)):
    images = []
    for degree in degrees:
        light = nb.harmonics.project(window, degree).float()
        options = {"albedo": gray, "gloss": gloss, "encoding": "srgb"}
        images.append(nb.render(ball, camera, light, 128, 1.0, **options))
    rows.append(torch.cat(images, 2))

plt.figure(figsize=(8, 3.6))
plt.imshow(torch.cat(rows, 1).permute(1, 2, 0))
plt.xticks(64 + 128 * torch.arange(5), [f"degree {degree}" for degree in degrees])
plt.yticks([64, 192], ["matte", "metal"])
plt.show()
