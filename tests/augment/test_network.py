import copy
from dataclasses import fields
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from augment.attack_settings import AttackSettings
from augment.attacks.loop import Minimum, minimize
from augment.attacks.objective import Objective
from augment.network import compute_outputs, say_once
from augment.tasks.classification import ClassCriterion

OUT_OF_MEMORY = [
    torch.OutOfMemoryError("CUDA out of memory"),
    MemoryError(),
    RuntimeError("can't allocate memory: you tried"),
    RuntimeError("CUDA error: out of memory"),
    RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED"),
    RuntimeError("cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED"),
    RuntimeError("GET was unable to find an engine to execute"),
]


class Limited(nn.Module):
    def __init__(self, most: int = 99, error: Exception = OUT_OF_MEMORY[0]):
        super().__init__()
        self.most, self.error, self.batch_sizes = most, error, []

    def forward(self, images):
        self.batch_sizes.append(len(images))
        if len(images) > self.most:
            raise self.error
        brightness = images.sum((1, 2, 3))
        return torch.stack([brightness, 1 - brightness], dim=1)


START = torch.linspace(0.2, 1, 10, dtype=torch.float64)[:, None]


def shades(group_size: int) -> SimpleNamespace:
    """Return a scene of ten images of one pixel, each with the value of its example."""
    return SimpleNamespace(
        start=START,
        group_size=group_size,
        render=lambda values, examples: values[:, None, :, None, None].expand(-1, 1, 3, 1, 1),
        scale_gradient=lambda gradient: 0.05 * gradient.sign(),
        project=lambda values, examples: values.clamp(0, 1),
    )


def attack(model: nn.Module, batch_size: int = 4, group_size: int = 10) -> Minimum:
    criterion = ClassCriterion(torch.zeros(10, 1, dtype=torch.int64))
    settings = AttackSettings(max_steps=6, margin=0.0, quantized=False, batch_size=batch_size)
    objective = Objective(model, criterion, settings)
    return minimize(shades(group_size), objective, restarts=[START.flip(0)])


def require_same(actual: Minimum, expected: Minimum) -> None:
    for field in fields(Minimum):
        assert torch.equal(getattr(actual, field.name), getattr(expected, field.name)), field.name


@pytest.mark.parametrize("error", OUT_OF_MEMORY, ids=repr)
def test_an_attack_without_memory_continues_in_smaller_batches_with_the_same_result(caplog, error):
    say_once.cache_clear()
    limited = Limited(3, error)
    require_same(attack(limited, batch_size=8), attack(Limited(), batch_size=2))
    assert limited.batch_sizes[:3] == [8, 4, 2]
    assert limited.batch_sizes.count(8) <= 2  # The large batch is not tried in every step.
    first, second = [record.message for record in caplog.records]
    assert "4 images" in first
    assert "2 images" in second


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("shapes differ")])
def test_no_memory_for_one_image_and_other_errors_are_raised(error):
    with pytest.raises(type(error)):
        attack(Limited(0, error))


@pytest.mark.parametrize("group_size", [1, 3, 4])
def test_an_attack_in_parts_is_the_attack(group_size):
    expected = attack(Limited())
    assert expected.steps.unique().numel() > 1
    require_same(attack(Limited(), group_size=group_size), expected)


@pytest.fixture
def network():
    """A network in training mode that would change its outputs and itself there."""
    torch.manual_seed(0)
    layers = [nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Flatten(), nn.Dropout(), nn.Linear(144, 5)]
    network = nn.Sequential(*layers)
    network[1].eval()
    return network


@pytest.mark.parametrize(("shape", "batch_size"), [((7,), 3), ((7, 2), 99), ((0,), 1)])
def test_outputs_of_many_images_are_those_of_a_copy_in_eval_mode(network, shape, batch_size):
    images = torch.rand(*shape, 3, 8, 8)
    state = {name: value.clone() for name, value in network.state_dict().items()}
    outputs = compute_outputs(network, images, batch_size)
    assert [module.training for module in network] == [True, False, True, True, True]
    assert all(value.equal(state[name]) for name, value in network.state_dict().items())
    assert not outputs.requires_grad
    expected = copy.deepcopy(network).eval()(images.flatten(0, -4)).view(*shape, 5)
    torch.testing.assert_close(outputs, expected.detach())


class Merged(nn.Linear):
    """Layer that adds another matrix to its weights in eval mode, as those of LoRA do."""

    is_merged = False

    def train(self, mode: bool):
        super().train(mode)
        if mode == self.is_merged:
            self.is_merged = not mode
            self.weight.data += -1.0 if mode else 1.0
        return self


def test_modules_that_change_with_the_mode_are_changed_back():
    network = nn.Sequential(nn.Flatten(), Merged(3 * 64, 5), nn.Dropout(), Merged(5, 5))
    network.train()
    network[3].train(False)
    network[2].training = False
    before = [network[index].weight.detach().clone() for index in (1, 3)]
    compute_outputs(network, torch.rand(2, 3, 8, 8))
    assert [module.training for module in network] == [True, True, False, False]
    assert [network[index].is_merged for index in (1, 3)] == [False, True]
    for index, weights in zip((1, 3), before, strict=True):
        torch.testing.assert_close(network[index].weight.detach(), weights)


def test_images_of_8_bits_and_batches_from_files_have_the_same_outputs(network):
    stored = torch.randint(256, (7, 3, 8, 8), dtype=torch.uint8)
    expected = compute_outputs(network, stored / 255)
    torch.testing.assert_close(compute_outputs(network, stored, 2), expected)
    torch.testing.assert_close(compute_outputs(network, iter(stored.split(3)), 2), expected)
    outputs = compute_outputs(lambda images: images.mean((2, 3)).half(), stored)
    assert outputs.dtype == torch.float32


def test_outputs_without_memory_come_in_smaller_batches():
    limited = Limited(3)
    images = torch.rand(7, 3, 1, 1)
    assert compute_outputs(limited, images, 8).equal(Limited()(images))
    assert limited.batch_sizes == [7, 4, 2, 2, 2, 1]
