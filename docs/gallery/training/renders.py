"""
Renders for training
====================

``AugmentationService`` renders images for a training loop. Every regeneration draws other
instances, views, exposures and backgrounds.
"""

import matplotlib.pyplot as plt
from torch import nn
from torchvision.utils import make_grid

import norm_balls as nb

vary = nb.VariationSettings(
    shift=0.1,
    scale=[0.6, 1.0],
    exposure=[0.5, 1.5],
    instances=True,
    azimuth=60.0,
    directional_fraction=0.5,
    lit_background=True,
)
settings = nb.AugmentationSettings(mode="random", vary=vary)
meshes = [("solid:orange", 53), ("solid:pear", 57), ("solid:sweet_pepper", 83)]
options = {"views": 4, "samples": 3, "encoding": "srgb"}
service = nb.AugmentationService.from_meshes(meshes, 64, settings, **options)
# Any network that takes the images. Random renders do not depend on it.
network = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 100))
renders = service.regenerate(network, number=0)

plt.figure(figsize=(8, 4.2))
plt.imshow(make_grid(renders.images[::2][:24], nrow=8).permute(1, 2, 0))
plt.xticks([])
plt.yticks([])
plt.show()
