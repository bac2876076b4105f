"""
Effects of a camera
===================

Hardening with ``experiment=patterns`` adds projected patterns, white balance, blur and noise to
the renders.
"""

import matplotlib.pyplot as plt
import torch
from torch import nn

import norm_balls as nb

effects = {
    "none": {},
    "patterns": {"pattern_fraction": 1.0, "pattern_fill": [0.0, 0.1]},
    "white balance": {"white_balance": 0.6},
    "blur": {"blur": 1.5},
    "noise": {"noise": 0.15},
}
# Any network that takes the images. Random renders do not depend on it.
network = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 100))
options = {"views": 5, "backgrounds": [0.3], "samples": 3, "encoding": "srgb", "width": 2.4}
rows = []
for effect in effects.values():
    vary = nb.VariationSettings(camera=nb.CameraEffectSettings(**effect))
    light = nb.RandomLightSettings(amplitude=1e-5)
    settings = nb.AugmentationSettings(mode="random", vary=vary, random_light=light)
    service = nb.AugmentationService.from_meshes([("solid:orange", 53)], 64, settings, **options)
    renders = service.regenerate(network, number=0)
    rows.append(torch.cat([*renders.images], 2))

plt.figure(figsize=(6, 5.6))
plt.imshow(torch.cat(rows, 1).permute(1, 2, 0))
plt.xticks([])
plt.yticks(32 + 64 * torch.arange(5), list(effects))
plt.show()
