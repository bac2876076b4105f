"""
Adversarial lamps
=================

Four lamps of equal power light the orange before the attack. The attack changes the red, green and
blue power of each lamp.
"""

import norm_balls as nb

network = nb.load("none")
scene = nb.build_scene([("solid:orange:3", "orange")], network.size, lamps={"start": 1.0})
settings = nb.AttackSettings(lamps=nb.StepSettings(step_size=3.0))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
