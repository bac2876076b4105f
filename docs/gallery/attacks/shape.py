"""
An adversarial shape
====================

The attack moves each vertex by at most 0.03 along each axis. The mesh is 2 units wide.
"""

import norm_balls as nb

network = nb.load("none")
options = {"width": 2.4, "encoding": "srgb"}
scene = nb.build_scene([("solid:orange", "orange")], network.size, **options)
ball = nb.StepSettings("linf", radius=0.03, step="sign", step_size=0.005)
settings = nb.AttackSettings(geometry=ball)
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
