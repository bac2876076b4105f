"""
Adversarial lighting and other networks
=======================================

Does the lighting that fools one network fool the others? Each row has the adversaries of one
published network. The numbers are fractions of them that fool the network of the column.
"""

import matplotlib.pyplot as plt
import torch

import norm_balls as nb

names = ["none", "random", "adversarial", "best"]
networks = [nb.load(name) for name in names]
scene = nb.build_scene([("solid:orange:0", "orange")], 32, views=6, width=2.4, encoding="srgb")
light = nb.StepSettings(step_size=0.4)
settings = nb.AttackSettings(lighting=light, max_steps=40, allow_negative=True)
rates = torch.zeros(4, 4)
for row, network in enumerate(networks):
    result = nb.attack(network, scene, settings=settings, force=True)
    for column, record in enumerate(nb.transfer(result, networks)):
        rates[row, column] = torch.tensor(record["success"]).float().mean()

plt.figure(figsize=(5, 4))
plt.imshow(rates, cmap="Reds", vmin=0, vmax=2)
for row in range(4):
    for column in range(4):
        plt.text(column, row, f"{rates[row, column]:.2f}", ha="center", va="center")
plt.xticks(range(4), names)
plt.xlabel("other network")
plt.yticks(range(4), names)
plt.ylabel("attacked network")
plt.show()
