"""
An adversarial time of day
==========================

The attack moves the sun and changes the turbidity of the air. Every light that it tries occurs
under a clear sky.
"""

import norm_balls as nb

network = nb.load("none")
options = {"azimuth": 120.0, "width": 2.4, "encoding": "srgb"}
scene = nb.build_scene([("solid:sweet_pepper", "sweet_pepper")], network.size, **options)
settings = nb.AttackSettings(skylight=nb.SkylightSettings(step_size=0.1))
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
