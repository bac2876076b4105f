"""
Generated solids
================

``solid`` generates a mesh from a name and a seed. No mesh file is needed. Another seed makes
another instance of the same kind, with another shape and other colors.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

light = nb.load_light("grace")
[camera] = nb.orbit_cameras(1, width=2.4)
names = ["orange", "apple", "pear", "sweet_pepper", "lemon", "mushroom", "bottle", "cup"]
rows = []
for seed in (0, 1):
    images = []
    for name in names:
        solid = nb.solid(name, seed)
        images.append(nb.render(solid, camera, light, 96, 1.0, encoding="srgb"))
    rows.append(torch.cat(images, 2))

plt.imshow(torch.cat(rows, 1).permute(1, 2, 0))
plt.xticks(48 + 96 * torch.arange(8), names)
plt.yticks([48, 144], ["seed 0", "seed 1"])
plt.show()
