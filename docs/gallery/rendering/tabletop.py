"""
A table with props
==================

A scene can have a table and other objects beside the one that is attacked. They cast shadows and
reflect light onto it.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

pear = nb.ObjectSettings(
    "solid:pear:0",
    label="pear",
    props=[
        {"mesh": "solid:cup:0", "at": [-0.8, 1.2], "scale": 0.8},
        {"mesh": "solid:lemon:0", "at": [0.9, -0.9], "scale": 0.5},
    ],
)
table = {"ground": [0.75, 0.6, 0.45], "width": 5.0, "fov": 30.0, "backgrounds": [0.9]}
scene = nb.build_scene([pear], 160, views=3, bounces=2, encoding="srgb", **table)
examples = torch.arange(len(scene))
images = scene.render(scene.conditions(examples), examples)[:, 0]

plt.imshow(torch.cat([*images], 2).permute(1, 2, 0))
plt.xticks([])
plt.yticks([])
plt.show()
