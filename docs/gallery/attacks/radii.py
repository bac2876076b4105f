"""
Larger norm-balls
=================

The radius of the norm-ball limits how far the lighting may change. Below each light sphere is the
image, with the prediction of the network. Here, the attack continues after its success
(``margin=20``).
"""

import matplotlib.pyplot as plt

import norm_balls as nb

network = nb.load("none")
scene = nb.build_scene([("solid:orange:0", "orange")], network.size, width=2.4, encoding="srgb")
radii = [0.1, 0.2, 0.5, 1.0, 2.0]
figure, axes = plt.subplots(2, 5, figsize=(8, 3.8))
for column, radius in enumerate(radii):
    ball = nb.StepSettings("l2", radius, step_size=0.2)
    settings = nb.AttackSettings(lighting=ball, max_steps=15, margin=20.0)
    result = nb.attack(network, scene, settings=settings)
    predicted = network.classes[result.logits[0].argmax()]
    light = nb.light_sphere(result.conditions.light[0], 64)
    axes[0, column].imshow(light.permute(1, 2, 0))
    axes[1, column].imshow(result.images[0].permute(1, 2, 0))
    axes[0, column].set(title=f"radius {radius}", xticks=[], yticks=[])
    axes[1, column].set(title=predicted, xticks=[], yticks=[])
plt.show()
