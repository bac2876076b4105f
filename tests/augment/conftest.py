"""What tests attack: a small scene of the mesh that has few faces and no symmetry, and linear classifiers."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from augment.objects import SceneObject
from augment.scene import Example, Scene
from renderer.camera import OrthographicCamera
from renderer.image import ImageSettings
from renderer.light.presets import ambient
from renderer.mesh import Mesh
from renderer.rasterizer import choose

SIZE = 6
FRONT, SIDE, BACK = (OrthographicCamera(polar, azimuth, 2.2) for polar, azimuth in ((0.9, 0.3), (1.3, 1.9), (1.1, 3.5)))


@pytest.fixture(scope="session")
def stone() -> Mesh:
    """A turned icosahedron whose faces have a color each."""
    solid, rng = trimesh.creation.icosahedron(), np.random.default_rng(0)
    vertices = solid.vertices @ Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix() * [1.0, 0.9, 0.8]
    corners = Mesh.plain(vertices, solid.faces)
    corners.corner_colors[:] = rng.uniform(0.3, 0.8, (len(solid.faces), 1, 3))
    return corners


@pytest.fixture
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


@pytest.fixture
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
