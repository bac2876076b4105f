import logging
from dataclasses import fields

import pytest
import torch
from torch import nn

from augment import utils
from augment.attacks.criteria import Goal
from augment.attacks.descent import DescentResult, DescentSettings, descend, descend_in_parts
from augment.build import build_scene
from augment.utils import BatchSize, Phases, require_memory
from renderer.errors import InputError

CPU = torch.device("cpu")
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
    utils._say.cache_clear()


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_attack_that_does_not_fit_goes_on_in_smaller_batches_with_the_same_result(caplog, error):
    roomy, small = Small(10, error), Small(3, error)
    expected, found = attack(roomy, batch_size=2), attack(small, batch_size=8)
    for name in ("values", "images", "steps", "cost", "predicted", "success"):
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


@pytest.mark.parametrize("at_once", [1, 3, 4, 10])
def test_an_attack_in_parts_is_the_attack(at_once):
    def whole(most):
        settings, goal = DescentSettings(max_steps=12, batch_size=4), Goal(torch.zeros(10, 1, dtype=torch.int64))
        starts = [Shades.start.flip(0)]
        return descend_in_parts(Small(99, ERRORS[0]), Shades(), goal, settings, Phases(), starts, most)

    expected, found = whole(10), whole(at_once)
    assert 0 < expected.success.sum() < 10 or expected.steps.unique().numel() > 1
    for item in fields(DescentResult):
        assert torch.equal(getattr(found, item.name), getattr(expected, item.name)), item.name


def test_what_is_too_large_for_the_memory_is_refused_before_it_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(utils, "MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(utils, "GROUP", tmp_path)
    require_memory("renders", 2**60, CPU)  # a system that does not say
    (tmp_path / "meminfo").write_text("MemTotal: 8388608 kB\nMemAvailable: 4194304 kB\n")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("5\n")
    require_memory("renders", 2**32, CPU)
    with pytest.raises(InputError, match=r"^renders need 8\.0 GB of memory and 4\.0 GB are free: ask for fewer"):
        require_memory("renders", 2**33, CPU)
    (tmp_path / "memory.max").write_text(f"{2**30 + 5}\n")
    with pytest.raises(InputError, match=r"and 1\.0 GB are free"):
        require_memory("renders", 2**32, CPU)


def test_a_million_renders_need_their_memory_before_any_is_made(monkeypatch):
    monkeypatch.setattr(utils, "_free", lambda device: 2**30)
    with pytest.raises(InputError, match=r"^100000 renders of 64 pixels per side .* need 9\.2 GB"):
        build_scene(
            [("solid:orange", "orange")], 64, 20_000, backgrounds=(0, 0.25, 0.5, 0.75, 1), visibility="software"
        )
    scene = build_scene([("solid:orange", "orange")], 128, 500, visibility="software", samples=1)
    monkeypatch.setattr(utils, "_free", lambda device: 10**8)
    with pytest.raises(InputError, match=r"^500 views of 128 pixels per side .* need "):
        _ = scene.stacks
