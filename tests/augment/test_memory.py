import logging

import pytest
import torch
from torch import nn

from augment import memory
from augment.descent import DescentSettings, Goal, descend
from augment.memory import BatchSize
from augment.phases import Phases

ERRORS = [torch.OutOfMemoryError("CUDA out of memory"), MemoryError(), RuntimeError("can't allocate memory: you tried")]


class Small(nn.Module):
    """Two classes; no memory for more than so many images."""

    def __init__(self, most: int, error: Exception):
        super().__init__()
        self.most, self.error, self.sizes = most, error, []

    def forward(self, images):
        self.sizes.append(len(images))
        if len(images) > self.most:
            raise self.error
        return torch.stack([images.sum((1, 2, 3)), 1 - images.sum((1, 2, 3))], dim=1)


class Shades:
    """Images that have the one value of their example."""

    start = torch.linspace(0.2, 1, 10, dtype=torch.float64)[:, None]

    def render(self, values, examples):
        return values[:, None, :, None, None].expand(-1, 1, 3, 1, 1)

    def step(self, gradient):
        return 0.05 * gradient.sign()

    def project(self, values, examples):
        return values.clamp(0, 1)


def attack(model: nn.Module, batch_size: int):
    settings = DescentSettings(max_steps=4, batch_size=batch_size)
    return descend(model, Shades(), Goal(torch.zeros(10, 1, dtype=torch.int64)), settings, Phases())


@pytest.fixture(autouse=True)
def unsaid():
    memory._say.cache_clear()


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_attack_that_does_not_fit_goes_on_in_smaller_batches_with_the_same_result(caplog, error):
    roomy, small = Small(10, error), Small(3, error)
    expected, found = attack(roomy, batch_size=2), attack(small, batch_size=8)
    for name in ("values", "images", "steps", "cost", "predicted", "fooled"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert small.sizes[:3] == [8, 4, 2] and max(small.sizes[3:]) == 2  # not tried again in every step
    attack(small, batch_size=8)
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert said == [f"memory ran out: the attack goes on with {size} images per pass" for size in (4, 2)]


def test_no_memory_for_one_image_and_other_errors_are_raised():
    with pytest.raises(MemoryError):
        attack(Small(0, MemoryError()), batch_size=4)
    with pytest.raises(RuntimeError, match="shapes differ"):
        attack(Small(3, RuntimeError("shapes differ")), batch_size=4)


def test_parts_follow_each_other_to_the_end():
    assert list(BatchSize(4).map(lambda part: list(range(10))[part], 10)) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert list(BatchSize(4).map(lambda part: part, 0)) == []
