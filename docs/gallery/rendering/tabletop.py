"""
Several objects on a table
==========================

An entry of a scene can be a list of objects on a table. They cast shadows and reflect light onto
each other. Attacks on shape and colors change the first one.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

objects = [
    ("solid:pear:0", "pear"),
    nb.ObjectSettings("solid:cup:0", "cup", at=[-0.8, 1.2], scale=0.8),
    nb.ObjectSettings("solid:lemon:0", "lemon", at=[0.9, -0.9], scale=0.5),
]
table = {"ground": [0.75, 0.6, 0.45], "width": 5.0, "fov": 30.0, "backgrounds": [0.9]}
scene = nb.build_scene([objects], 160, views=3, bounces=2, encoding="srgb", **table)
examples = torch.arange(len(scene))
images = scene.render(scene.conditions(examples), examples)[:, 0]

plt.imshow(torch.cat([*images], 2).permute(1, 2, 0))
plt.xticks([])
plt.yticks([])
plt.show()
