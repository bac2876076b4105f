"""What tests attack: a small scene of the mesh that has few faces and no symmetry, and linear classifiers."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

import augment
from augment.scene.conditions import Example
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from renderer.camera import OrthographicCamera
from renderer.geometry.mesh import Mesh
from renderer.light.presets import ambient
from renderer.settings import ImageSettings
from renderer.visibility.rasterizers import choose

SIZE = 6
ANGLES = (51.6, 17.2), (74.5, 108.9), (63.0, 200.5)  # polar angles and azimuths in degrees
FRONT, SIDE, BACK = (OrthographicCamera(polar, azimuth, 2.2) for polar, azimuth in ANGLES)


@pytest.fixture(scope="session")
def stone() -> Mesh:
    """A turned icosahedron whose faces have a color each."""
    solid, rng = trimesh.creation.icosahedron(), np.random.default_rng(0)
    vertices = solid.vertices @ Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix() * [1.0, 0.9, 0.8]
    corners = Mesh.plain(vertices, solid.faces)
    corners.corner_colors[:] = rng.uniform(0.3, 0.8, (len(solid.faces), 1, 3))
    return corners


@pytest.fixture(scope="session")
def make_scene(stone) -> Callable[..., Scene]:
    """Three examples of two views each, in light and before backgrounds that nothing clamps. Keywords change that."""

    def build(
        mesh: Mesh = stone,
        cameras: Sequence[Sequence[OrthographicCamera]] = ((FRONT, SIDE), (SIDE, BACK), (FRONT, BACK)),
        backgrounds: Tensor | None = None,
        dtype: torch.dtype = torch.float64,
        encoding: str = "linear",
        albedo_scale: float = 1.0,
        size: int = SIZE,
    ) -> Scene:
        draws = torch.Generator().manual_seed(0)
        light = ambient(torch.full((3,), 0.22)) + 0.03 * torch.randn(49, 3, generator=draws)
        if backgrounds is None:
            backgrounds = 0.2 + 0.6 * torch.rand(len(cameras), 3, size, size, generator=draws)
        settings = ImageSettings(size, samples=2, encoding=encoding)
        rows = [Example(0, tuple(views), index) for index, views in enumerate(cameras)]
        objects = [SceneObject("", mesh, albedo_scale)]
        return Scene(objects, rows, backgrounds, light.to(dtype), settings, choose("numpy"))

    return build


@pytest.fixture(scope="session")
def make_linear() -> Callable[..., nn.Module]:
    """A classifier whose logits are linear in the image: random weights (classes, 3·size²), a bias for class 0."""

    def build(
        classes: int, bias: float = 0.0, size: int = SIZE, dtype: torch.dtype = torch.float64, seed: int = 1
    ) -> nn.Module:
        network = nn.Sequential(nn.Flatten(), nn.Linear(3 * size**2, classes)).to(dtype)
        draws = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            network[1].weight.copy_(torch.randn(network[1].weight.shape, generator=draws) / size)
            network[1].bias.zero_()[0] = bias
        return network

    return build


@pytest.fixture(scope="session")
def by_color() -> augment.Classifier:
    """Orange is red, lime is green, sky is blue, night is dark."""

    def mean_color(images: Tensor) -> Tensor:
        means = 30 * images.mean((2, 3))
        return torch.cat([means, 12 - means.sum(1, keepdim=True)], dim=1)

    return augment.Classifier(mean_color, 8, ("orange", "lime", "sky", "night"), "by_color")


STEPS = {
    "skylight": augment.SkylightSettings(step_size=0.1),
    "geometry": augment.StepSettings("linf", 0.05, "sign", 0.01),
    "pose": augment.PoseSettings("linf", 1.0, "sign", 0.2),
    "material": augment.MaterialSettings("linf", 1.0, "sign", 0.2, hue=30.0),
    "albedo": augment.StepSettings("linf", 0.5, "sign", 0.1),
    "pixels": augment.StepSettings("linf", 0.3, "sign", 0.05),
}
OTHER_STEPS = augment.StepSettings(step_size=0.1)
LOCAL = {
    "projector": augment.ProjectorSettings(pixels=4, pattern=0.2),
    "lamps": augment.LampsSettings([[2, 2, 2], [-2, 2, 2]], start=0.5),
}


@pytest.fixture(scope="session")
def attacked(by_color) -> Callable[..., augment.AttackResult]:
    """An attack on parameters by name, or with their steps, of an orange of 80 faces, until the classifier errs.

    scene: keywords of `build_scene`. Further keywords are those of `AttackSettings`.
    """
    ball = trimesh.creation.icosphere(subdivisions=1)
    orange = Mesh.plain(ball.vertices, ball.faces, (0.9, 0.5, 0.1))

    def run(parameters, scene=None, classifier=by_color, target=None, seed=0, force=False, **settings):
        steps = (
            parameters
            if isinstance(parameters, dict)
            else {name: STEPS.get(name, OTHER_STEPS) for name in parameters.split("+")}
        )
        local = {light: LOCAL[light] for name in steps if (light := name.replace("positions", "lamps")) in LOCAL}
        shown = augment.build_scene(
            [(orange, classifier.classes[0])],
            classifier.size,
            **{
                "rasterizer": "numpy",
                "degree": 6,
                "width": 2.4,
                "normals": "flat",
                "silhouettes": "pose" in steps,
                **local,
                **(scene or {}),
            },
        )
        defaults = {"allow_negative": True, "margin": 0.0, "rounded": False, "sensor_noise": 0.0}
        defaults["max_steps"] = 8
        settings = augment.AttackSettings(**steps, **defaults | settings)
        return augment.attack(classifier, shown, target, settings, seed=seed, force=force)

    return run
