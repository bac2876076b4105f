"""
Spherical harmonics
===================

Lighting is a sum of spherical harmonics. Each row shows the harmonics of one degree on a sphere:
red is positive, blue is negative. Degrees 0 to 6 have 49 harmonics.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

y, z = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(1, -1, 64), indexing="xy")
x = (1 - y**2 - z**2).clamp(min=0).sqrt()
values = nb.harmonics.basis(torch.stack([x, y, z], 2), degree=3)
values[x == 0] = torch.nan

figure, axes = plt.subplots(4, 7, figsize=(7, 4.2))
for axis in axes.flat:
    axis.axis("off")
for degree in range(4):
    for order in range(-degree, degree + 1):
        axis = axes[degree, 3 + order]
        axis.imshow(values[..., degree**2 + degree + order], cmap="coolwarm", vmin=-0.8, vmax=0.8)
plt.show()
