"""
Hiding an object from a detector
================================

A detector finds the orange. Within an L2 radius of 2, the attack finds a lighting in which it no
longer does. The published detector is trained on generated objects alone, and knows no others.
"""

import norm_balls as nb

network = nb.load("detector")
scene = nb.build_scene([("solid:orange:3", "orange")], network.size, width=3.2, encoding="srgb")
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=2.0, step_size=0.2))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
