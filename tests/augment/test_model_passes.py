"""Attacks in batches and parts, also where memory runs out."""

import logging
from dataclasses import fields

import pytest
import torch
from torch import nn

from augment.attack_settings import AttackSettings
from augment.attacks.descent import Criterion, DescentResult, descend
from augment.model_passes import warn_once

SAID = (
    "can't allocate memory: you tried",
    "CUDA error: out of memory",
    "CUDA error: CUBLAS_STATUS_ALLOC_FAILED",
)
SAID += (
    "cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED",
    "GET was unable to find an engine to execute",
)
ERRORS = [torch.OutOfMemoryError("CUDA out of memory"), MemoryError(), *map(RuntimeError, SAID)]


class Small(nn.Module):
    """Two classes; raises an error for batches of more than `most` images."""

    def __init__(self, most: int = 99, error: Exception = ERRORS[0]):
        super().__init__()
        self.most, self.error, self.sizes = most, error, []

    def forward(self, images):
        self.sizes.append(len(images))
        if len(images) > self.most:
            raise self.error
        return torch.stack([images.sum((1, 2, 3)), 1 - images.sum((1, 2, 3))], dim=1)


class Shades:
    """Images of one pixel that has the value of its example."""

    start = torch.linspace(0.2, 1, 10, dtype=torch.float64)[:, None]

    def __init__(self, group_size: int):
        self.group_size = group_size

    def render(self, values, examples):
        return values[:, None, :, None, None].expand(-1, 1, 3, 1, 1)

    def take_step(self, values, gradient, examples, length):
        return (values - length * 0.05 * gradient.sign()).clamp(0, 1)


def attack(model: nn.Module, batch_size: int = 4, group_size: int = 10) -> DescentResult:
    criterion = Criterion(torch.zeros(10, 1, dtype=torch.int64))
    settings = AttackSettings(max_steps=6, margin=0.0, batch_size=batch_size)
    return descend(model, Shades(group_size), criterion, settings, restarts=[Shades.start.flip(0)])


def assert_same(actual: DescentResult, expected: DescentResult) -> None:
    for item in fields(DescentResult):
        assert torch.equal(getattr(actual, item.name), getattr(expected, item.name)), item.name


@pytest.mark.parametrize("error", ERRORS, ids=repr)
def test_an_attack_without_memory_goes_on_in_smaller_batches_with_the_same_result(caplog, error):
    warn_once.cache_clear()
    small = Small(3, error)
    assert_same(attack(small, batch_size=8), attack(Small(), batch_size=2))
    assert (
        small.sizes[:3] == [8, 4, 2] and small.sizes.count(8) <= 2
    )  # not tried again in every step
    warnings = [
        record.getMessage() for record in caplog.records if record.levelno == logging.WARNING
    ]
    assert warnings == [
        f"memory ran out: the attack goes on with {size} images per pass" for size in (4, 2)
    ]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("shapes differ")])
def test_no_memory_for_one_image_and_other_errors_are_raised(error):
    with pytest.raises(type(error)):
        attack(Small(0, error))


@pytest.mark.parametrize("group_size", [1, 3, 4])
def test_an_attack_in_parts_is_the_attack(group_size):
    expected = attack(Small())
    assert 0 < expected.success.sum() < 10 or expected.steps.unique().numel() > 1
    assert_same(attack(Small(), group_size=group_size), expected)
