"""
Adversarial lighting
====================

Which lighting makes a network misclassify an orange? The attack changes the 49 spherical-harmonics
coefficients of each color. The change has an L2 norm of at most 1, and the lighting stays
physically possible. The white ball shows the adversarial lighting.
"""

import norm_balls as nb

network = nb.load("none")
scene = nb.build_scene([("solid:orange:3", "orange")], network.size)
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=1.0))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
