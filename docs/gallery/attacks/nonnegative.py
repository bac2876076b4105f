"""
Physically possible lighting
============================

The maps show the radiance of an adversarial light from all directions: red is positive, blue is
negative. By default, the attack permits no negative radiance, because no lamp emits it. The paper
permits it.
"""

import matplotlib.pyplot as plt

import norm_balls as nb

network = nb.load("none")
scene = nb.build_scene([("solid:orange:0", "orange")], network.size, width=2.4, encoding="srgb")
directions, _ = nb.harmonics.equirectangular(32, 64)
figure, axes = plt.subplots(1, 3, figsize=(8, 2.1))
lights = {"before the attack": scene.lights[0]}
for name, allow_negative in (("default", False), ("allow_negative=True", True)):
    ball = nb.StepSettings("l2", radius=3.0, step_size=0.3)
    settings = nb.AttackSettings(lighting=ball, allow_negative=allow_negative, margin=10.0)
    lights[name] = nb.attack(network, scene, settings=settings).conditions.light[0]
for axis, (name, light) in zip(axes, lights.items(), strict=True):
    radiance = nb.harmonics.basis(directions, degree=6).float() @ light
    axis.imshow(radiance.mean(-1).reshape(32, 64), cmap="coolwarm", vmin=-0.8, vmax=0.8)
    axis.set(title=f"{name}\nminimum {radiance.min():.2f}", xticks=[], yticks=[])
plt.show()
