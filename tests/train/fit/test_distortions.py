import pytest
import torch
import torch.nn.functional as F
from torch import nn
from torchvision.transforms import v2

from augment import utils
from renderer.image import to_unit
from train.fit.distortions import DISTORTIONS, RADIUS, TRANSFORMS, distortion, torchvision_transform
from train.wideresnet import WideResNet


@pytest.fixture
def images() -> torch.Tensor:
    return torch.randint(0, 256, (6, 3, 16, 16), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def model() -> nn.Module:
    torch.manual_seed(0)
    return WideResNet(4, 10, 1, 0.3)


LABELS = torch.tensor([0, 1, 2, 3, 0, 1])


@pytest.mark.parametrize("name", DISTORTIONS)
def test_a_distortion_is_a_function_of_seed_and_step_and_leaves_model_and_random_state_alone(name, images, model):
    before = torch.get_rng_state()
    first, again = (distortion(name, model, 3)(images, LABELS, 7) for _ in range(2))
    assert first.dtype == torch.uint8 and first.shape == images.shape
    assert torch.equal(first, again)
    assert torch.equal(torch.get_rng_state(), before)
    assert model.training and all(parameter.grad is None for parameter in model.parameters())
    if name == "none":
        assert torch.equal(first, images)
    else:
        assert not torch.equal(first, distortion(name, model, 3)(images, LABELS, 8))
        assert not torch.equal(first, distortion(name, model, 4)(images, LABELS, 7))


@pytest.mark.parametrize("name", TRANSFORMS)
def test_every_image_is_distorted_by_draws_of_its_own_whatever_the_number_of_processes(
    name, images, model, monkeypatch
):
    same = images[:1].expand(6, -1, -1, -1)
    whole = distortion(name, model, 0)(same, LABELS, 1)
    assert len(whole.unique(dim=0)) > 1
    monkeypatch.setattr(utils, "rank", lambda: 1)
    assert torch.equal(distortion(name, model, 0)(same[3:], LABELS[3:], 1), whole[3:])


def test_color_jitter_is_torchvisions(images, model):
    """Brightness changes by at most 0.4 of itself: no value of a gray image leaves that range, but for contrast."""
    gray = torch.full_like(images, 100)
    found = distortion("color_jitter", model, 0)(gray, LABELS, 0)
    assert found.min() >= 60 - 1 and found.max() <= 140 + 1
    assert isinstance(torchvision_transform("color_jitter"), v2.ColorJitter)


def test_pgd_stays_within_its_radius_and_raises_the_loss(images, model):
    found = distortion("pgd", model, 0)(images, LABELS, 0)
    assert (to_unit(found) - to_unit(images)).abs().max() <= RADIUS + 1e-6
    model.eval()
    before, after = (F.cross_entropy(model(to_unit(each)), LABELS) for each in (images, found))
    noise = torch.randint(-8, 9, images.shape, generator=torch.Generator().manual_seed(1))
    drawn = F.cross_entropy(model(to_unit((images.int() + noise).clamp(0, 255))), LABELS)
    assert after > before + 10 * abs(drawn - before)
