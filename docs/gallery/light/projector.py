"""
Patterns from a projector
=========================

A projector is a local light with one coefficient for each of its pixels. Here it projects four
patterns onto an orange in dim environment lighting.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

projector = nb.Projector(pixels=32, polar=55.0, azimuth=15.0)
row, column = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")
stripes = (column // 2 % 2).float()
checkers = ((row // 3 + column // 3) % 2).float()
rings = ((row - 15.5).hypot(column - 15.5) // 2 % 2).float()
window = ((row % 12 > 2) & (column % 12 > 2)).float()
orange = nb.solid("orange")
[camera] = nb.orbit_cameras(1, width=2.2)
light = 0.15 * nb.load_light("grace")
images = []
for pattern in (stripes, checkers, rings, window):
    lights = [(projector, pattern.reshape(-1, 1).expand(-1, 3))]
    options = {"lights": lights, "encoding": "srgb"}
    images.append(nb.render(orange, camera, light, 160, 0.1, **options))

plt.imshow(torch.cat(images, 2).permute(1, 2, 0))
plt.xticks(80 + 160 * torch.arange(4), ["stripes", "checkers", "rings", "window"])
plt.yticks([])
plt.show()
