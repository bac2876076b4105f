"""
Shadows and bounces
===================

Without shadows, all of the inside of the cup receives the light of the whole sky. With shadows,
the rim blocks a part of it. Light that bounces between the walls brightens the inside again.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

cup, light = nb.solid("cup"), nb.load_light("grace")
[camera] = nb.orbit_cameras(1, width=2.2, polar=35.0)
effects = [{}, {"shadows": True}, {"bounces": 1}, {"bounces": 4}]
images = []
for effect in effects:
    images.append(nb.render(cup, camera, light, 128, 1.0, encoding="srgb", **effect))

plt.imshow(torch.cat(images, 2).permute(1, 2, 0))
plt.xticks(64 + 128 * torch.arange(4), ["no shadows", "shadows", "one bounce", "four bounces"])
plt.yticks([])
plt.show()
