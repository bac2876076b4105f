"""
From the first lighting to the adversarial one
==============================================

The lighting changes step by step from left to right. The prediction of the network flips on the
way. ``AttackResult.save_animation`` writes the same as an animation.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

network = nb.load("none")
scene = nb.build_scene([("solid:orange:3", "orange")], network.size)
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=2.0))
result = nb.attack(network, scene, settings=settings)
start, end = scene.lights[0], result.conditions.light[0]
operator = nb.precompute_transfer(nb.solid("orange", 3), scene.cameras[0][0], size=128)

figure, axes = plt.subplots(1, 6, figsize=(8, 1.9))
for axis, fraction in zip(axes, torch.linspace(0, 1, 6), strict=True):
    image = operator.image(start + fraction * (end - start), 0.5)
    small = torch.nn.functional.avg_pool2d(image, 4)
    probability, index = network(small[None]).softmax(1)[0].max(0)
    axis.imshow(image.permute(1, 2, 0))
    axis.set(title=f"{network.classes[index]} {probability:.0%}", xticks=[], yticks=[])
plt.show()
