"""
Shadows and bounces beside Mitsuba
==================================

Mitsuba is a path tracer, so its image has noise. Both images have the same number of bounces. The
right image shows ten times their difference: noise, and the sampling of edges.
"""

from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import torch

import norm_balls as nb
from renderer.light.basis import HARMONICS
from renderer.light.environment import write_map
from renderer.mitsuba_scene import mitsuba_map, render_mitsuba_scene, write_mitsuba_scene

cup = nb.solid("cup")
light = HARMONICS.project_nonnegative(nb.load_light("grace"))  # Mitsuba needs radiance above 0.
cameras = nb.orbit_cameras(1, width=2.2, polar=35.0)
settings = nb.ImageSettings(size=128, samples=8, bounces=4, normals="flat")
ours = nb.render(cup, cameras, light, 128, 0.0, normals="flat", samples=8, bounces=4)[0]

folder = Path(mkdtemp())
write_map(folder / "light.exr", mitsuba_map(light, 64).clamp(min=0))
write_mitsuba_scene(folder, cup, 1.0, cameras, settings, "light.exr")
theirs = render_mitsuba_scene(folder / "scene.xml", 1, (128, 128))[0, :3].clamp(0, 1)
difference = (10 * (ours - theirs)).abs()

plt.imshow(torch.cat([ours, theirs, difference], 2).clamp(0, 1).permute(1, 2, 0))
plt.xticks(64 + 128 * torch.arange(3), ["this library", "Mitsuba", "10 times the difference"])
plt.yticks([])
plt.show()
