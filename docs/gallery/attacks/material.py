"""
An adversarial material
=======================

The attack changes the strength of the highlights, and turns the hue of the colors by at most 30°.
"""

import norm_balls as nb

network = nb.load("none")
options = {"width": 2.4, "encoding": "srgb"}
scene = nb.build_scene([("solid:orange", "orange")], network.size, **options)
material = nb.MaterialSettings("linf", 1.0, "sign", 0.25, roughness=0.0, hue=30.0)
settings = nb.AttackSettings(material=material)
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
