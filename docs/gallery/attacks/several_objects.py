"""
One of several objects
======================

The scene shows three objects on a table. The attack on the lighting hides the first, an orange. The
others count only as what the detector may find at the place of the orange.
"""

import norm_balls as nb

network = nb.load("detector")
objects = [
    ("solid:orange:3", "orange"),
    nb.ObjectSettings("solid:cup:0", "cup", at=[-1.4, 1.4]),
    nb.ObjectSettings("solid:bottle:0", "bottle", at=[-0.6, -2.0]),
]
table = {"ground": [0.75, 0.6, 0.45], "width": 6.5, "backgrounds": [0.9]}
scene = nb.build_scene([objects], network.size, encoding="srgb", **table)
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=3.0, step_size=0.2))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
