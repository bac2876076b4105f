"""Shadows and bounces beside Mitsuba's path tracer, on meshes that are hard in one way each."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from augment.objects import ObjectSettings, PropSettings, SceneObject, load_object, on_ground
from renderer.camera import OrthographicCamera
from renderer.environment import write_map
from renderer.files.mitsuba_scene import DIFFERENTIABLE, SCENE, VARIANT, mitsuba, mitsuba_map, write_mitsuba_scene
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.mesh import Mesh, concatenate, normalise
from renderer.shapes import solid
from renderer.transfer import Operator, build_operators
from renderer.visibility import choose
from train.report.tables import markdown
from train.studies.quadrature import quadrature

CAMERA = OrthographicCamera(0.9, 0.6, 2.2)
SIZE, SEEDS = 32, 8  # Mitsuba's images, whose spread tells its noise
MAP_ROWS = 512
SAMPLES, CONVERGED = 16, (2**14, 2**15, 2**8)  # of a pixel's side; a pixel's directions, patches, their directions
TRANSPORTS = ("shadows", "bounces:3")


def meshes() -> dict[str, Mesh]:
    shell = trimesh.creation.icosphere(subdivisions=3)
    ball, lower = Mesh.plain(shell.vertices, shell.faces), shell.vertices[shell.faces].mean(axis=1)[:, 2] < 0
    dents = np.random.default_rng(0).uniform(0.6, 1, (len(shell.vertices), 1))
    plate = Mesh.plain([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], [[0, 1, 2], [0, 2, 3]], (0.2, 0.6, 0.9))
    box = trimesh.creation.box((0.8, 0.8, 0.02))
    ring, cup = trimesh.creation.torus(0.45, 0.45), normalise(solid("cup", 0))
    apples = [PropSettings("solid:apple", place, 0.5) for place in ([0.2, 0.7], [0.4, -0.8])]
    return {
        "convex: a ball": ball,
        "concave: solid:cup": cup,
        "concave: solid:table": normalise(solid("table", 0)),
        "rugged: a dented ball": replace(ball, vertices=shell.vertices * dents),
        "open: half a ball": Mesh.plain(shell.vertices, shell.faces[lower], (0.8, 0.7, 0.5)),
        "self-touching: a ring without a hole": Mesh.plain(ring.vertices, ring.faces, (0.3, 0.8, 0.5)),
        "touching parts: a ball on a plate": concatenate([ball, plate]),
        "thin: boards 0.03 apart": concatenate(
            [Mesh.plain(box.vertices + np.array([0, 0, 0.05 * each]), box.faces, (0.9, 0.6, 0.4)) for each in range(5)]
        ),
        "scene.ground: solid:cup on a table": on_ground(SceneObject("", cup), (0.9, 0.3, 0.2)).mesh,
        "scene.meshes: solid:pear beside two apples, on a table": on_ground(
            load_object(ObjectSettings("solid:pear", "pear", props=apples)), (0.3, 0.3, 0.9)
        ).mesh,
    }


def table() -> str:
    rows = [[name, transport, *row(mesh, transport)] for name, mesh in meshes().items() for transport in TRANSPORTS]
    whose = ("error", "converged", "noise", "direct")
    head = [f"{what}: {each}" for what in ("image", "gradient") for each in whose]
    return markdown(["mesh", "transport", *head], rows)


def row(mesh: Mesh, transport: str) -> list[str]:
    return [f"{each:.2%}" for each in errors(mesh, transport)]


def errors(mesh: Mesh, transport: str) -> list[float]:
    """Of the image, and of the gradient by the light of its sum with random weights: the error, that with many
    more samples, rays and patches, Mitsuba's own noise, and the error of direct light."""
    settings = ImageSettings(SIZE, transport=transport)
    with quadrature(*CONVERGED):
        finest = operator(mesh, replace(settings, samples=SAMPLES))
    seen = operator(mesh, settings), finest, operator(mesh, replace(settings, transport="direct"))
    theirs, noise = mitsuba_image(mesh, settings)
    inside, brightest = theirs[3] > 0.999, theirs[:3].max()
    default, finest_off, direct = (image(each) - theirs for each in seen)
    found = [
        float(each[:3, inside].square().mean().sqrt() / brightest) for each in (default, finest_off, noise, direct)
    ]
    upstream = inside * torch.rand(3, SIZE**2, generator=torch.Generator().manual_seed(0))
    slope, noise = mitsuba_gradient(mesh, settings, upstream)
    default, finest_off, direct = (each.light_gradient(upstream[:, each.pixels]) - slope for each in seen)
    return found + [float(each.norm() / slope.norm()) for each in (default, finest_off, noise, direct)]


def operator(mesh: Mesh, settings: ImageSettings) -> Operator:
    [built] = build_operators(mesh, [CAMERA], settings, choose("software"))
    return built


def image(seen: Operator) -> Tensor:
    """(4, size²): radiance and coverage."""
    canvas = torch.zeros(4, seen.settings.size**2, dtype=torch.float64)
    canvas[:3, seen.pixels] = seen.radiance(light()).double()
    canvas[3, seen.pixels] = seen.coverage.double()
    return canvas


def light() -> Tensor:
    """The probe St. Peter's, which is positive all round."""
    return load_light("st_peters")


@cache
def light_and_map() -> tuple[Tensor, Tensor]:
    """Its coefficients, and the map's texels with their graph."""
    coefficients = light().double().requires_grad_()
    return coefficients, mitsuba_map(coefficients, MAP_ROWS)


def mitsuba_image(mesh: Mesh, settings: ImageSettings) -> tuple[Tensor, Tensor]:
    """The mean (4, size²) of SEEDS images and its standard error."""
    with mitsuba_scene(mesh, settings, VARIANT) as (mi, scene):
        images = np.stack([np.array(mi.render(scene, seed=seed)) for seed in range(SEEDS)])
    return mean_and_noise(torch.from_numpy(images).double().permute(0, 3, 1, 2).flatten(2))


def mitsuba_gradient(mesh: Mesh, settings: ImageSettings, upstream: Tensor) -> tuple[Tensor, Tensor]:
    """The mean (49, 3) of the gradients by the light of SEEDS images (3, size²) × upstream, and its standard error.

    Mitsuba differentiates its integrator in reverse mode by the map's pixels, and these are linear in the light.
    """
    import drjit

    coefficients, texels = light_and_map()
    found: list[Tensor] = []
    weights = torch.zeros(settings.size**2, 4)
    weights[:, :3] = upstream.T
    with mitsuba_scene(mesh, settings, DIFFERENTIABLE) as (mi, scene):
        parameters = mi.traverse(scene)
        [name] = [name for name, _ in parameters if name.endswith(".data")]
        for seed in range(SEEDS):
            data = drjit.detach(mi.TensorXf(parameters[name]))
            drjit.enable_grad(data)
            parameters[name] = data
            parameters.update()
            above = mi.TensorXf(weights.view(settings.size, -1, 4).numpy())
            drjit.backward(drjit.sum(mi.render(scene, parameters, seed=seed) * above, axis=None))
            by_texel = torch.from_numpy(np.array(drjit.grad(data)))[:, 1:-1]  # its map has a column more on either side
            found += torch.autograd.grad(texels, coefficients, by_texel.to(texels), retain_graph=True)
    return mean_and_noise(torch.stack(found))


@contextmanager
def mitsuba_scene(mesh: Mesh, settings: ImageSettings, variant: str) -> Iterator[tuple[Any, Any]]:
    """(the module, the scene)"""
    with TemporaryDirectory() as folder, mitsuba(variant) as mi:
        write_mitsuba_scene(Path(folder), mesh, 1.0, [CAMERA], settings, "light.exr")
        write_map(Path(folder, "light.exr"), light_and_map()[1].detach())
        yield mi, mi.load_file(str(Path(folder, SCENE)))


def mean_and_noise(draws: Tensor) -> tuple[Tensor, Tensor]:
    """The mean of (SEEDS, ...) draws and its standard error."""
    return draws.mean(0), draws.std(0) / SEEDS**0.5
