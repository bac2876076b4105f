"""Views that are shaded together are those that are shaded alone."""

import pytest
import torch

import norm_balls as nb
from renderer.operators import build

GLOSS = nb.Gloss(*torch.tensor([[0.4], [0.2], [0.5]]))
PARTS = [nb.orbit_cameras(5, 2.2), nb.orbit_cameras(6, 2.2, fov=40.0)]
CAMERAS = [*PARTS[0], *PARTS[1]]  # perspective cameras among others
LIGHT = nb.load_light("grace").double()
OPTIONS = [{"normals": "smooth"}, {"normals": "flat"}, {"gloss": GLOSS}, {"samples": 1}]


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
