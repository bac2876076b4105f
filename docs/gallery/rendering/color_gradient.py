"""
Descent on the colors of a mesh
===============================

Images are differentiable with respect to the color of each face. Gradient descent finds colors
with which an apple resembles an orange in every view.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

apple, light = nb.solid("apple"), nb.load_light("grace")
cameras = nb.orbit_cameras(6, width=2.4)
goal = nb.render(nb.solid("orange"), cameras, light, size=64)
albedo = torch.full((len(apple.faces), 3), 0.5, requires_grad=True)
optimizer = torch.optim.Adam([albedo], lr=0.05)
for _ in range(30):
    images = nb.render(apple, cameras, light, size=64, albedo=albedo.clamp(0, 1))
    optimizer.zero_grad()
    (images - goal).square().sum().backward()
    optimizer.step()

before = nb.render(apple, cameras, light, size=64)
rows = [torch.cat([*views], 2) for views in (before, images.detach(), goal)]
plt.imshow(torch.cat(rows, 1).permute(1, 2, 0))
plt.xticks([])
plt.yticks([32, 96, 160], ["apple", "found colors", "orange"])
plt.show()
