"""
An adversarial pattern
======================

Before the attack, a projector lights the orange evenly. The attack changes each of its 16 × 16
pixels.
"""

import norm_balls as nb

network = nb.load("none")
projector = {"pixels": 16, "polar": 50.0, "azimuth": 20.0, "pattern": 0.3}
scene = nb.build_scene([("solid:orange:3", "orange")], network.size, projector=projector)
settings = nb.AttackSettings(projector=nb.StepSettings(step_size=1.0))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
