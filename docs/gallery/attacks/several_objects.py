"""
One of several objects
======================

The scene shows three objects on a table. The attack on the lighting hides the first, an orange. The
others count only as what the detector may find at the place of the orange.
"""

import norm_balls as nb

network = nb.load("detector")
objects = [
    ("solid:orange:2001", "orange"),
    nb.ObjectSettings("solid:cup:0", "cup", at=[-1.5, 2.2]),
    nb.ObjectSettings("solid:mushroom:0", "mushroom", at=[-1.5, -2.4]),
]
table = {"ground": [0.3, 0.35, 0.3], "width": 6.5, "backgrounds": [0.6]}
scene = nb.build_scene([objects], network.size, encoding="srgb", **table)
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=3.0, step_size=0.2))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
