"""
Environment lighting
====================

Four environment lights are installed. A white ball shows each of them. The same pear looks
different in each light.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

pear = nb.solid("pear")
[camera] = nb.orbit_cameras(1, width=2.2)
names = ["uniform", "grace", "eucalyptus", "st_peters"]
lights = [nb.load_light(name) for name in names]
balls = torch.cat([nb.light_sphere(light, 128) for light in lights], 2)
images = [nb.render(pear, camera, light, 128, 1.0, encoding="srgb") for light in lights]
pears = torch.cat(images, 2)

plt.figure(figsize=(8, 4.2))
plt.imshow(torch.cat([balls, pears], 1).permute(1, 2, 0))
plt.xticks(64 + 128 * torch.arange(4), names)
plt.yticks([])
plt.show()
