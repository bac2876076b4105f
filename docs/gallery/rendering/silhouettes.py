"""
Gradients at silhouettes
========================

Gradient descent moves and scales a pear until its image resembles a goal. In uniform light, a pear
of one color is a flat shape. Only its silhouette shows where it is. Without ``silhouettes``, the
gradient is zero, and the pear stays where it starts.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

pear, light = nb.solid("pear"), nb.load_light("uniform")
points = torch.tensor(pear.vertices, dtype=torch.float32)
gray = torch.full((len(pear.faces), 3), 0.3)
[camera] = nb.orbit_cameras(1, width=3.0)
options = {"size": 64, "background": 1.0, "albedo": gray, "samples": 8}
goal = nb.render(pear, camera, light, **options)
start = 0.5 * points + torch.tensor([0.0, 0.6, 0.3])
images = [goal, nb.render(pear, camera, light, vertices=start, **options)]
for silhouettes in (False, True):
    pose = torch.tensor([0.5, 0.0, 0.6, 0.3], requires_grad=True)
    optimizer = torch.optim.Adam([pose], lr=0.03)
    for _ in range(60):
        vertices = pose[0] * points + pose[1:]
        options["silhouettes"] = silhouettes
        image = nb.render(pear, camera, light, vertices=vertices, **options)
        optimizer.zero_grad()
        (image - goal).square().sum().backward()
        optimizer.step()
    images.append(image.detach())

plt.imshow(torch.cat(images, 2).permute(1, 2, 0))
plt.xticks(32 + 64 * torch.arange(4), ["goal", "start", "silhouettes=False", "silhouettes=True"])
plt.yticks([])
plt.show()
