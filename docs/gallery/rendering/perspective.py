"""
Field of view
=============

An orthographic camera has no perspective. A perspective camera comes nearer to the object as its
field of view grows, so that the object keeps its size in the image. From nearby, the rim of the
cup looks larger than its base.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

cup, light = nb.solid("cup"), nb.load_light("grace")
angles = [None, 20.0, 40.0, 60.0]
images = []
for fov in angles:
    [camera] = nb.orbit_cameras(1, width=2.6, polar=45.0, fov=fov)
    images.append(nb.render(cup, camera, light, 128, 1.0, encoding="srgb"))

plt.imshow(torch.cat(images, 2).permute(1, 2, 0))
plt.xticks(64 + 128 * torch.arange(4), ["orthographic", "20°", "40°", "60°"])
plt.yticks([])
plt.show()
