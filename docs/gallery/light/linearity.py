"""
Images add up
=============

Before values are clamped, the image in the sum of two lights is the sum of the two images. So an
operator is computed once, and each new light costs one matrix product.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

[camera] = nb.orbit_cameras(1, width=2.4)
operator = nb.precompute_transfer(nb.solid("mushroom", 1), camera, size=128)
left = nb.harmonics.basis(torch.tensor([0.4, -1.0, 0.3]), degree=6).float()
right = nb.harmonics.basis(torch.tensor([0.4, 1.0, 0.3]), degree=6).float()
lights = [left[:, None] * torch.tensor([1.5, 1.0, 0.6]), right[:, None] * torch.tensor([0.5, 1, 2])]
images = [operator.image(light, 0.0) for light in [*lights, sum(lights)]]
images.append(images[0] + images[1])

plt.imshow(torch.cat(images, 2).permute(1, 2, 0).clamp(0, 1))
plt.xticks(64 + 128 * torch.arange(4), ["light A", "light B", "light A + B", "image A + image B"])
plt.yticks([])
plt.show()
