"""
Pixels, for comparison
======================

Most attacks in the literature change the pixels of an image. Here, each pixel changes by at most
8/255. No camera would take this image.
"""

import norm_balls as nb

network = nb.load("none")
options = {"width": 2.4, "encoding": "srgb"}
scene = nb.build_scene([("solid:orange", "orange")], network.size, **options)
ball = nb.StepSettings("linf", radius=8 / 255, step="sign", step_size=2 / 255)
settings = nb.AttackSettings(pixels=ball)
result = nb.attack(network, scene, settings=settings)
figure = result.plot()
