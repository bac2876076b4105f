"""Views that are shaded together are those that are shaded alone."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import norm_balls as nb
from renderer.camera import project_views
from renderer.operators import build
from renderer.visibility import fragments

GLOSS = nb.Gloss(*torch.tensor([[0.4], [0.2], [0.5]]))
PARTS = [nb.orbit_cameras(5, 2.2), nb.orbit_cameras(6, 2.2, fov=40.0)]
CAMERAS = [*PARTS[0], *PARTS[1]]  # perspective cameras among others
LIGHT = nb.load_light("grace").double()
MATTE: list[dict] = [{"normals": "smooth"}, {"normals": "flat"}, {"samples": 1}]
OPTIONS = [*MATTE, {"gloss": GLOSS}]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("name", ["cup", "pear"])
def test_images_and_gradients_of_many_views_are_those_of_each(name, options):
    mesh = nb.solid(name)
    vertices = torch.from_numpy(mesh.vertices).requires_grad_()
    behind = torch.rand(len(CAMERAS), 3, 24, 16, generator=torch.Generator().manual_seed(0))
    weights = torch.rand(behind.shape, generator=torch.Generator().manual_seed(1))
    together = nb.render(mesh, CAMERAS, LIGHT, (24, 16), behind, vertices=vertices, **options)
    alone = torch.stack(
        [
            nb.render(mesh, camera, LIGHT, (24, 16), image, vertices=vertices, **options)
            for camera, image in zip(CAMERAS, behind, strict=True)
        ]
    )
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-14)
    gradients = [
        torch.autograd.grad((each * weights).sum(), vertices) for each in (together, alone)
    ]
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-12)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("devices", [("cpu",), ()], ids=["SciPy", "torch"])
def test_operators_of_many_views_are_those_of_each(options, devices, monkeypatch):
    """A device that SciPy does not know adds up samples in torch."""
    mesh = nb.solid("cup")
    alone = [nb.precompute_transfer(mesh, camera, 24, **options) for camera in CAMERAS]
    monkeypatch.setattr(build, "SCIPY_DEVICES", devices)
    together = nb.precompute_transfer(mesh, CAMERAS, 24, **options)
    for found, expected in zip(together, alone, strict=True):
        assert torch.equal(found.pixels, expected.pixels)
        parts = [(each.by_channel, each.coverage) for each in (found, expected)]
        torch.testing.assert_close(*parts, rtol=0, atol=1e-6)


class Operations(TorchDispatchMode):
    """Counts operations of torch, each of which a GPU starts."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        self.count += 1
        return function(*arguments, **(options or {}))


@pytest.mark.parametrize("options", MATTE, ids=str)
@pytest.mark.parametrize("part", PARTS, ids=["orthographic", "perspective"])
def test_a_gpu_starts_as_many_operations_for_twelve_views_as_for_three(part, options, monkeypatch):
    """On a GPU, a block has the samples of many views, as here, and points are a tensor.

    Gloss takes some more for each camera.
    """
    for name in ("SAMPLES_ON_CPU", "BLOCK_ON_CPU"):
        monkeypatch.setattr(fragments, name, 2**22)
    mesh = nb.solid("pear")
    points = torch.from_numpy(mesh.vertices)
    counts = []
    for count in (3, 12):
        cameras = (3 * part)[:count]
        with Operations() as operations:
            project_views(cameras, points)
            nb.render(mesh, cameras, LIGHT, 64, rasterizer="torch", **options)
        counts.append(operations.count)
    assert counts[1] < 1.1 * counts[0]


@pytest.mark.parametrize("options", MATTE, ids=str)
def test_checks_of_many_views_wait_for_a_gpu_as_often_as_those_of_two(options):
    mesh = nb.solid("pear")
    vertices = torch.from_numpy(mesh.vertices)
    counts = []
    for count in (2, 5):
        with torch.autograd.profiler.profile() as profile:
            nb.render(mesh, PARTS[0][:count], LIGHT, 128, vertices=vertices, **options)
        names = [event.name for event in profile.function_events]
        counts.append(names.count("aten::_local_scalar_dense"))
    assert counts[0] == counts[1] > 0
