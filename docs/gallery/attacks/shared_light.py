"""
One lighting for several views
==============================

With ``shared=True``, the attack finds one lighting under which the network misclassifies the
object from every camera.
"""

import matplotlib.pyplot as plt

import norm_balls as nb

network = nb.load("none")
options = {"views": 4, "shared": True, "width": 2.4}
scene = nb.build_scene([("solid:orange:3", "orange")], network.size, **options)
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=2.0, step_size=0.2))
result = nb.attack(network, scene, settings=settings, force=True)

figure, axes = plt.subplots(2, 4, figsize=(8, 4.4))
for view in range(4):
    for row, images, logits in (
        (0, result.images_before, result.logits_before),
        (1, result.images, result.logits),
    ):
        axes[row, view].imshow(images[0, view].permute(1, 2, 0))
        predicted = network.classes[logits[0, view].argmax()]
        axes[row, view].set(title=predicted, xticks=[], yticks=[])
plt.show()
