"""Fixtures that several tests of augment use: a small scene, classifiers, and an attack.

The scene shows an icosahedron, which has few faces. It is turned and scaled, so that it has no
symmetry. The classifiers are linear, so that their gradients are known.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

import augment
from augment.scene.objects import Example, SceneObject
from augment.scene.scene import Scene
from renderer.camera import OrthographicCamera
from renderer.light.files import ambient
from renderer.mesh import Mesh
from renderer.settings import ImageSettings
from renderer.visibility import choose

SIZE = 6
ANGLES = (51.6, 17.2), (74.5, 108.9), (63.0, 200.5)  # polar angles and azimuths in degrees
FRONT, SIDE, BACK = (OrthographicCamera(polar, azimuth, 2.2) for polar, azimuth in ANGLES)
PAIRS = ((FRONT, SIDE), (SIDE, BACK), (FRONT, BACK))


@pytest.fixture(scope="session")
def stone() -> Mesh:
    solid = trimesh.creation.icosahedron()
    turn = Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix()
    vertices = solid.vertices @ turn * [1.0, 0.9, 0.8]
    mesh = Mesh.plain(vertices, solid.faces)
    mesh.corner_colors[:] = np.random.default_rng(0).uniform(0.3, 0.8, (len(solid.faces), 1, 3))
    return mesh


@pytest.fixture(scope="session")
def make_scene(stone) -> Callable[..., Scene]:
    """Return a function that builds three examples of two views without a clamped pixel."""

    def build(
        mesh=stone,
        cameras=PAIRS,
        backgrounds=None,
        dtype=torch.float64,
        encoding="linear",
        albedo_scale=1.0,
        size=SIZE,
    ) -> Scene:
        draws = torch.Generator().manual_seed(0)
        soft_front_light = ambient(torch.full((3,), 0.22))
        light = soft_front_light + 0.03 * torch.randn(49, 3, generator=draws)
        if backgrounds is None:
            backgrounds = 0.2 + 0.6 * torch.rand(len(cameras), 3, size, size, generator=draws)
        settings = ImageSettings(size, samples=2, encoding=encoding)
        examples = [Example(0, tuple(views), index) for index, views in enumerate(cameras)]
        objects = [SceneObject("", mesh, albedo_scale)]
        return Scene(objects, examples, backgrounds, light.to(dtype), settings, choose("numpy"))

    return build


@pytest.fixture(scope="session")
def make_linear() -> Callable[..., nn.Module]:
    """Return a function that builds a linear classifier, of which only class 0 has a bias."""

    def build(classes, bias=0.0, size=SIZE, dtype=torch.float64, seed=1) -> nn.Module:
        linear = nn.Linear(3 * size**2, classes)
        draws = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            linear.weight.copy_(torch.randn(linear.weight.shape, generator=draws) / size)
            linear.bias.zero_()
            linear.bias[0] = bias
        return nn.Sequential(nn.Flatten(), linear).to(dtype)

    return build


def logits_of_mean_color(images: Tensor) -> Tensor:
    means = 30 * images.mean((2, 3))
    darkness = 12 - means.sum(1, keepdim=True)
    return torch.cat([means, darkness], dim=1)


@pytest.fixture(scope="session")
def by_color() -> augment.Classifier:
    classes = ("orange", "lime", "sky", "night")
    return augment.Classifier(logits_of_mean_color, 8, classes, "by_color")


STEPS = {
    "skylight": augment.SkylightSettings(step_size=0.1),
    "geometry": augment.StepSettings("linf", 0.05, "sign", 0.01),
    "pose": augment.PoseSettings("linf", 1.0, "sign", 0.2),
    "material": augment.MaterialSettings("linf", 1.0, "sign", 0.2, hue=30.0),
    "albedo": augment.StepSettings("linf", 0.5, "sign", 0.1),
    "pixels": augment.StepSettings("linf", 0.3, "sign", 0.05),
}
OTHER_STEPS = augment.StepSettings(step_size=0.1)
LAMPS = augment.LampsSettings([[2, 2, 2], [-2, 2, 2]], start=0.5)
PROJECTOR = augment.ProjectorSettings(pixels=4, pattern=0.2)
# The local light that the attack on each of these parameters requires in the scene.
REQUIRED_LIGHTS = {name: {"lamps": LAMPS} for name in ("lamps", "positions")}
REQUIRED_LIGHTS["projector"] = {"projector": PROJECTOR}


@pytest.fixture(scope="session")
def attacked(by_color) -> Callable[..., augment.AttackResult]:
    """Return a function that attacks an orange of 80 faces until the classifier errs."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    orange = Mesh.plain(ball.vertices, ball.faces, (0.9, 0.5, 0.1))

    def run(
        parameters, scene=None, classifier=by_color, target=None, seed=0, force=False, **settings
    ):
        steps = parameters
        if isinstance(parameters, str):
            steps = {name: STEPS.get(name, OTHER_STEPS) for name in parameters.split("+")}
        options = {"rasterizer": "numpy", "degree": 6, "width": 2.4, "normals": "flat"}
        options["silhouettes"] = "pose" in steps
        for name in steps:
            options |= REQUIRED_LIGHTS.get(name, {})
        options |= scene or {}
        label = classifier.classes[0]
        shown = augment.build_scene([(orange, label)], classifier.size, **options)
        choices = {"allow_negative": True, "quantized": False, "margin": 0.0, "sensor_noise": 0.0}
        chosen = augment.AttackSettings(**steps, **choices | {"max_steps": 8} | settings)
        return augment.attack(classifier, shown, target, chosen, seed=seed, force=force)

    return run
