"""
The columns of a transfer operator
==================================

For a fixed view, the image is linear in the lighting. The matrix of this map is the transfer
operator. Each of its columns is the image in a single spherical harmonic. Red is positive, blue
is negative.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

[camera] = nb.orbit_cameras(1, width=2.2)
operator = nb.precompute_transfer(nb.solid("pear"), camera, size=64)
figure, axes = plt.subplots(3, 5, figsize=(7, 4.3))
for axis in axes.flat:
    axis.axis("off")
for degree in range(3):
    for order in range(-degree, degree + 1):
        light = torch.zeros(49, 3)
        light[degree**2 + degree + order] = 1.0
        image = torch.zeros(64 * 64)
        image[operator.pixels] = operator.radiance(light).mean(0)
        axis = axes[degree, 2 + order]
        axis.imshow(image.view(64, 64), cmap="coolwarm", vmin=-0.6, vmax=0.6)
plt.show()
