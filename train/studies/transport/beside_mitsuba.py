"""Shadows and bounces beside Mitsuba's path tracer, on meshes that are hard in one way each."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import trimesh
from torch import Tensor

from renderer.camera import OrthographicCamera
from renderer.environment import to_map, write_map
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.mesh import Mesh, concatenate, normalise
from renderer.mitsuba_scene import SCENE, mitsuba, write_mitsuba_scene
from renderer.shapes import solid
from renderer.transfer import build_operators
from renderer.visibility import choose
from train.tables import markdown

CAMERA = OrthographicCamera(0.9, 0.6, 2.2)
SIZE, SEEDS = 32, 3  # Mitsuba's images, whose spread tells its noise
TRANSPORTS = ("shadows", "bounces:3")


def meshes() -> dict[str, Mesh]:
    shell = trimesh.creation.icosphere(subdivisions=3)
    ball, lower = Mesh.plain(shell.vertices, shell.faces), shell.vertices[shell.faces].mean(axis=1)[:, 2] < 0
    dents = np.random.default_rng(0).uniform(0.6, 1, (len(shell.vertices), 1))
    plate = Mesh.plain([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], [[0, 1, 2], [0, 2, 3]], (0.2, 0.6, 0.9))
    box = trimesh.creation.box((0.8, 0.8, 0.02))
    return {
        "convex: a ball": ball,
        "concave: solid:cup": normalise(solid("cup", 0)),
        "concave: solid:table": normalise(solid("table", 0)),
        "rugged: a dented ball": replace(ball, vertices=shell.vertices * dents),
        "open: half a ball": Mesh.plain(shell.vertices, shell.faces[lower], (0.8, 0.7, 0.5)),
        "touching parts: a ball on a plate": concatenate([ball, plate]),
        "thin: boards 0.03 apart": concatenate(
            [Mesh.plain(box.vertices + np.array([0, 0, 0.05 * each]), box.faces, (0.9, 0.6, 0.4)) for each in range(5)]
        ),
    }


def table() -> str:
    rows = []
    for name, mesh in meshes().items():
        for transport in TRANSPORTS:
            settings = ImageSettings(SIZE, transport=transport)
            theirs, noise = mitsuba_image(mesh, settings)
            inside, brightest = theirs[3] > 0.999, theirs[:3].max()
            off = {each: ours(mesh, replace(settings, transport=each)) - theirs for each in (transport, "direct")}
            error, without = (
                f"{each[:3, inside].square().mean().sqrt() / brightest:.2%}" for each in (off[transport], off["direct"])
            )
            rows.append(
                [name, transport, error, f"{noise[:3, inside].square().mean().sqrt() / brightest:.2%}", without]
            )
    return markdown(["mesh", "transport", "error", "Mitsuba's own noise", "error of direct light"], rows)


def ours(mesh: Mesh, settings: ImageSettings) -> Tensor:
    """(4, size²): radiance and coverage."""
    [operator] = build_operators(mesh, [CAMERA], settings, choose("software"))
    image = torch.zeros(4, settings.size**2, dtype=torch.float64)
    image[:3, operator.pixels] = operator.radiance(light()).double()
    image[3, operator.pixels] = operator.coverage.double()
    return image


def light() -> Tensor:
    """The probe St. Peter's, which is positive all round."""
    return load_light("st_peters")


def mitsuba_image(mesh: Mesh, settings: ImageSettings) -> tuple[Tensor, Tensor]:
    """The mean (4, size²) of SEEDS images and its standard error."""
    with TemporaryDirectory() as folder, mitsuba() as mi:
        write_mitsuba_scene(Path(folder), mesh, 1.0, [CAMERA], settings, "light.exr")
        write_map(Path(folder, "light.exr"), to_map(light(), 256))
        scene = mi.load_file(str(Path(folder, SCENE)))
        images = np.stack([np.array(mi.render(scene, sensor=0, seed=seed)) for seed in range(SEEDS)])
    drawn = torch.from_numpy(images).double().permute(0, 3, 1, 2).flatten(2)
    return drawn.mean(0), drawn.std(0) / SEEDS**0.5
