"""
Lamps and their shadows
=======================

A lamp is a point or a disk. The larger the disk, the softer is the shadow of the pear on the
table.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

radii = [0.0, 0.5, 1.5]
images = []
for radius in radii:
    lamp = {"positions": [[0.5, 3.0, 2.5]], "radius": radius, "start": 10.0}
    table = {"ground": [0.8, 0.75, 0.7], "width": 3.4, "backgrounds": [0.0], "exposure": 0.1}
    scene = nb.build_scene([("solid:pear", "pear")], 160, lamps=lamp, encoding="srgb", **table)
    first = torch.tensor([0])
    images.append(scene.render(scene.conditions(first), first)[0, 0])

plt.imshow(torch.cat(images, 2).permute(1, 2, 0))
plt.xticks(80 + 160 * torch.arange(3), ["a point", "a disc of radius 0.5", "radius 1.5"])
plt.yticks([])
plt.show()
