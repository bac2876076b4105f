"""
Random light on images
======================

``nb.RandomLighting`` shows images in random light, as a transform of torchvision. Each row has one
model of light, in three draws. The image here is a render. It may be any photograph.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

mesh = nb.solid("orange")
[camera] = nb.orbit_cameras(1, width=2.6)
light = nb.load_light("st_peters", 6)
image = nb.render(mesh, camera, light, 128, 0.7, encoding="srgb")
image = (255 * image).round().byte()

torch.manual_seed(0)
names = ["projected_slide", "cast_shadow", "point", "lamps", "color_temperature", "low_light"]
rows = [[nb.RandomLighting(name)(image) for _ in range(3)] for name in names]

# Two models beside each other.
half = len(names) // 2
left, right = (
    torch.cat([torch.cat(row, 2) for row in part], 1) for part in (rows[:half], rows[half:])
)
plt.figure(figsize=(8, 4.2))
plt.imshow(torch.cat([left, right], 2).permute(1, 2, 0))
plt.xticks([192, 576], ["\n".join(names[:half]), "\n".join(names[half:])])
plt.yticks([])
plt.tight_layout()
plt.show()

# %%
# Boxes, masks and keypoints of a sample stay. ``make_params`` draws a light, and ``apply`` shows
# each frame of a clip in it.

transform = nb.RandomLighting({"cast_shadow": 2.0, "low_light": 1.0}, p=0.8, strength=0.9)
drawn = transform.make_params()
frames = [transform.apply(frame, drawn) for frame in (image, image.flip(2))]
