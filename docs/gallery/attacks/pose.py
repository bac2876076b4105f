"""
An adversarial pose
===================

The attack turns the bottle by at most 10° about each axis, and moves and scales it by at most a
tenth. The camera moves as well.
"""

import norm_balls as nb

network = nb.load("none")
options = {"width": 2.4, "encoding": "srgb", "silhouettes": True}
scene = nb.build_scene([("solid:bottle", "bottle")], network.size, **options)
settings = nb.AttackSettings(pose=nb.PoseSettings("linf", 1.0, "sign", 0.25))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
