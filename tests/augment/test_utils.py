import io
import itertools
import logging
import re
import sys
import time
from dataclasses import fields

import pytest
import torch
from torch import nn

from augment import AugmentationService, AugmentationSettings, scene, utils
from augment.attacks.attack import AttackSettings
from augment.attacks.descent import DescentResult, Goal, descend
from augment.build import build_scene
from augment.camera_effects import CameraEffectSettings
from augment.service import TrainingAttackSettings
from augment.utils import generator, progress, require_memory, stream_seed
from renderer.errors import InputError
from renderer.image import to_bytes

SAID = "can't allocate memory: you tried", "CUDA error: out of memory", "CUDA error: CUBLAS_STATUS_ALLOC_FAILED"
SAID += (
    "cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED",
    "GET was unable to find an engine to execute",
)
ERRORS = [torch.OutOfMemoryError("CUDA out of memory"), MemoryError(), *map(RuntimeError, SAID)]


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
@pytest.mark.parametrize("seconds, ends", [(0.3, True), (0.3, False), (0.0, True)])
def test_progress_is_shown_after_a_while_even_before_the_first_item_is_done(monkeypatch, stream, seconds, ends):
    """And leaves nothing on a terminal, also where the loop ends early."""
    monkeypatch.setattr(utils, "PATIENCE", 0.1)
    monkeypatch.setattr(sys, "stderr", stream())
    done = []
    for item in progress([1, 2], "attack"):
        time.sleep(seconds)
        done.append((item, "attack" in sys.stderr.getvalue()))
        if not ends:
            break
    assert done == [(item, seconds > 0) for item in ([1, 2] if ends else [1])]
    if stream is io.StringIO:
        lines = sys.stderr.getvalue().splitlines()
        assert lines[:1] == (["attack ..."] if seconds else []) and len(lines) < 5  # at 0.1, 0.3, 0.7 seconds ...
    else:
        assert sys.stderr.getvalue().rpartition("\r")[2].strip() == ""


def test_lines_of_progress_say_how_much_time_is_left(monkeypatch):
    monkeypatch.setattr(utils, "PATIENCE", 0.4)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    for _ in progress([1, 2, 3], "attack", 1000, 10):
        time.sleep(0.3)
    (minutes, seconds), *_ = re.findall(r"11 of 1000\D* (\d+):(\d+) left", sys.stderr.getvalue())
    assert 0.3 * 989 <= 60 * int(minutes) + int(seconds) < 0.6 * 989


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

    def __init__(self, at_once: int):
        self.at_once = at_once

    def render(self, values, examples):
        return values[:, None, :, None, None].expand(-1, 1, 3, 1, 1)

    def step(self, gradient):
        return 0.05 * gradient.sign()

    def project(self, values, examples):
        return values.clamp(0, 1)


def attack(model: nn.Module, batch_size: int = 4, at_once: int = 10) -> DescentResult:
    goal = Goal(torch.zeros(10, 1, dtype=torch.int64))
    settings = AttackSettings(max_steps=6, margin=0.0, batch_size=batch_size)
    return descend(model, Shades(at_once), goal, settings, restarts=[Shades.start.flip(0)])


def assert_same(actual: DescentResult, expected: DescentResult) -> None:
    for item in fields(DescentResult):
        assert torch.equal(getattr(actual, item.name), getattr(expected, item.name)), item.name


@pytest.mark.parametrize("error", ERRORS, ids=repr)
def test_an_attack_without_memory_goes_on_in_smaller_batches_with_the_same_result(caplog, error):
    utils._warn_once.cache_clear()
    small = Small(3, error)
    assert_same(attack(small, batch_size=8), attack(Small(), batch_size=2))
    assert small.sizes[:3] == [8, 4, 2] and small.sizes.count(8) <= 2  # not tried again in every step
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert warnings == [f"memory ran out: the attack goes on with {size} images per pass" for size in (4, 2)]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("shapes differ")])
def test_no_memory_for_one_image_and_other_errors_are_raised(error):
    with pytest.raises(type(error)):
        attack(Small(0, error))


@pytest.mark.parametrize("at_once", [1, 3, 4])
def test_an_attack_in_parts_is_the_attack(at_once):
    expected = attack(Small())
    assert 0 < expected.success.sum() < 10 or expected.steps.unique().numel() > 1
    assert_same(attack(Small(), at_once=at_once), expected)


def test_more_than_the_free_memory_is_refused_before_it_is_allocated(tmp_path, monkeypatch):
    monkeypatch.setattr(utils, "MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(utils, "GROUP", tmp_path)
    device = torch.device("cpu")
    require_memory("renders", 2**60, device)  # a system that does not say
    (tmp_path / "meminfo").write_text("MemTotal: 8388608 kB\nMemAvailable: 4194304 kB\n")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("5\n")
    require_memory("renders", 2**32, device)
    with pytest.raises(InputError, match=r"^renders need 8\.0 GB of memory and 4\.0 GB are free"):
        require_memory("renders", 2**33, device)
    (tmp_path / "memory.max").write_text(f"{2**30 + 5}\n")
    with pytest.raises(InputError, match=r"and 1\.0 GB are free"):
        require_memory("renders", 2**32, device)


@pytest.mark.parametrize("at_once, camera", [(2**16, {}), (2**24, {}), (2**24, {"blur": 0.8, "pattern_fraction": 0.7})])
def test_an_attack_on_light_takes_half_to_all_of_the_memory_that_it_must_find_free(monkeypatch, at_once, camera):
    """By torch's profiler, for all images at once and for few; with the renders as bytes, as they are trained on."""
    needed = []
    monkeypatch.setattr(scene, "AT_ONCE", at_once)
    monkeypatch.setattr(scene, "require_memory", lambda name, bytes_, device: needed.append(bytes_))
    settings = AugmentationSettings(attack=TrainingAttackSettings(max_steps=1))
    settings.vary.camera = CameraEffectSettings(**camera)
    grays = {"views": 2, "backgrounds": [row / 128 for row in range(128)], "samples": 1, "rasterizer": "numpy"}
    service = AugmentationService.from_meshes([("solid:orange:0", 0)], 32, settings, **grays)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as recorded:
        to_bytes(service.regenerate(Small(), 0).images)
    events = [event for event in recorded.profiler.kineto_results.events() if event.name() == "[memory]"]
    changes = [event.nbytes() for event in sorted(events, key=lambda event: event.start_ns())]
    assert needed[-1] / 2 < max(itertools.accumulate(changes)) <= needed[-1]


def test_renders_and_their_views_need_their_memory_before_any_is_made(monkeypatch):
    monkeypatch.setattr(utils, "_free", lambda device: 2**26)
    orange, grays = [("solid:orange", "orange")], (0, 0.25, 0.5, 0.75, 1)
    with pytest.raises(InputError, match=r"^1000 renders of 64 pixels per side .* need 0\.4 GB"):
        build_scene(orange, 64, 200, backgrounds=grays, rasterizer="numpy")
    views = build_scene(orange, 64, 100, rasterizer="numpy", samples=1)
    monkeypatch.setattr(utils, "_free", lambda device: 10**6)
    with pytest.raises(InputError, match=r"^100 views of 64 pixels per side .* need "):
        _ = views.stacks


def test_every_key_seeds_another_stream_and_leaves_the_global_generator():
    state = torch.random.get_rng_state()
    first, again = (torch.rand(100, generator=generator(3, 7, "lights")) for _ in range(2))
    assert torch.equal(first, again) and torch.equal(torch.random.get_rng_state(), state)
    keys = list(itertools.product(range(30), range(30), ["lights", "batches", "dropout"]))
    seeds = {stream_seed(*key) for key in keys}
    assert len(seeds) == len(keys) and min(seeds) >= 0 and 2**62 < max(seeds) < 2**63
