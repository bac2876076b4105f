"""
The camera and the lighting of a photograph
===========================================

``fit_scene`` finds the camera and the lighting of a photograph of a known mesh. Attacks can start
from there. Here, a render with bounced light replaces the photograph.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

cup, light = nb.solid("cup"), 0.7 * nb.load_light("grace")
camera = nb.OrthographicCamera(polar=52.0, azimuth=115.0, width=3.0)
options = {"size": 64, "samples": 4, "bounces": 2}
photograph = nb.render(cup, camera, light, background=0.6, **options)
mask = 1 - nb.render(cup, camera, 0 * light, size=64, background=1.0, samples=4)[0]
nearby = nb.OrthographicCamera(polar=60.0, azimuth=100.0, width=3.0)
found = nb.fit_scene(photograph, mask, cup, bounces=2, start=nearby)
image = nb.render(cup, found.camera, found.light, background=0.6, **options)
difference = 0.5 + (image - photograph)

plt.imshow(torch.cat([photograph, image, difference], 2).permute(1, 2, 0).clamp(0, 1))
plt.xticks(32 + 64 * torch.arange(3), ["photograph", "fitted", "difference"])
plt.yticks([])
plt.show()
print(f"polar {found.camera.polar:.1f}° (52°), azimuth {found.camera.azimuth:.1f}° (115°)")
