"""
From paint to metal
===================

Paint reflects white highlights above its own color. A metal has no color below its highlights,
and reflects them in its own color. ``metallic`` blends between the two.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb


def lamp(directions: torch.Tensor) -> torch.Tensor:
    """Return the radiance of a round lamp in front of a dim sky."""
    cosine = directions @ torch.tensor([0.65, -0.4, 0.65], dtype=torch.float64)
    return (0.08 + 4.0 * torch.exp(60.0 * (cosine - 1.0)))[:, None].expand(-1, 3)


light = nb.harmonics.project(lamp, degree=17).float()
ball = nb.solid("ball")
gold = torch.tensor([1.0, 0.7, 0.2]).expand(len(ball.faces), 3)
[camera] = nb.orbit_cameras(1, width=2.2)
values = [0.0, 0.25, 0.5, 0.75, 1.0]
images = []
for metallic in values:
    options = {"gloss": nb.Gloss(0.3, metallic=metallic), "encoding": "srgb"}
    images.append(nb.render(ball, camera, light, 128, 1.0, albedo=gold, **options))

plt.imshow(torch.cat(images, 2).permute(1, 2, 0))
plt.xticks(64 + 128 * torch.arange(5), [f"metallic {value}" for value in values])
plt.yticks([])
plt.show()
