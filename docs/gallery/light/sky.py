"""
A day in sunlight
=================

``skylight.coefficients`` computes the light of a clear sky from the position of the sun and the
turbidity of the air. The sun sets from left to right.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

orange = nb.solid("orange")
[camera] = nb.orbit_cameras(1, width=2.2)
zeniths = [10.0, 40.0, 60.0, 75.0, 85.0]
lights = [nb.skylight.coefficients(zenith, 60.0, 3.0).float() for zenith in zeniths]
lights = [light * 0.8 / light[0].mean() for light in lights]
images = [nb.render(orange, camera, light, 128, 1.0, encoding="srgb") for light in lights]
oranges = torch.cat(images, 2)
balls = torch.cat([nb.light_sphere(light, 128) for light in lights], 2)

plt.figure(figsize=(8, 3.6))
plt.imshow(torch.cat([balls, oranges], 1).permute(1, 2, 0))
plt.xticks(64 + 128 * torch.arange(5), [f"zenith angle {zenith:.0f}°" for zenith in zeniths])
plt.yticks([])
plt.show()
