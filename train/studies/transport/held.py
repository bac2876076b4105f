"""What it costs in accuracy that shadows and bounces are held while vertices move."""

from dataclasses import replace

import numpy as np
import torch

from augment.scene import Conditions, Scene
from renderer.camera import ring
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.mesh import Mesh
from renderer.transfer import build_operators
from renderer.visibility import choose
from train.tables import markdown

RADII = (0.0005, 0.002, 0.01, 0.03)
SETTINGS = ImageSettings(32, transport="shadows")


def table(mesh: Mesh) -> str:
    """By how far each coordinate of each vertex moves, up or down at random."""
    light, backend, [camera] = load_light("grace"), choose("software"), ring(1, 2.2)
    scene = Scene.of_mesh(mesh, [[camera]], torch.zeros(1, 1, 32, 32), light, SETTINGS, backend)
    signs, rows = np.random.default_rng(0).choice([-1.0, 1.0], mesh.vertices.shape), []
    for radius in RADII:
        moved = mesh.vertices + radius * signs
        [exact] = build_operators(replace(mesh, vertices=moved), [camera], SETTINGS, backend)
        truth = exact.image(light, 0.0)
        conditions = Conditions(light[None], vertices=torch.from_numpy(moved).to(light)[None])
        held = scene.render(conditions, torch.arange(1))[0, 0]
        still = scene.render(scene.conditions(torch.arange(1)), torch.arange(1))[0, 0]
        off, change = ((each - truth).square().mean().sqrt() / truth.max() for each in (held, still))
        rows.append([f"{radius}", f"{off:.2%}", f"{change:.2%}"])
    return markdown(["radius", "error of held shadows", "change of the image"], rows)
