"""
Painted faces
=============

The attack adds at most 0.1 to the albedo of each face of the mesh, or subtracts it.
"""

import norm_balls as nb

network = nb.load("none")
options = {"width": 2.4, "encoding": "srgb"}
scene = nb.build_scene([("solid:orange", "orange")], network.size, **options)
ball = nb.StepSettings("linf", radius=0.1, step="sign", step_size=0.02)
settings = nb.AttackSettings(albedo=ball)
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
