"""
Views from a circle of cameras
==============================

``orbit_cameras`` places cameras at equal distances on a circle around the object. Each camera
looks at the origin of the world.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

cup = nb.solid("cup")
cameras = nb.orbit_cameras(6, width=2.6, polar=65.0)
light = nb.load_light("eucalyptus")
images = nb.render(cup, cameras, light, size=96, background=1.0, encoding="srgb")

plt.imshow(torch.cat([*images], 2).permute(1, 2, 0))
plt.xticks(48 + 96 * torch.arange(6), [f"azimuth {camera.azimuth:.0f}°" for camera in cameras])
plt.yticks([])
plt.show()
