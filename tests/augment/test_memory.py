"""Memory is asked for before it is allocated."""

import itertools

import pytest
import torch
from torch import nn

from augment import AugmentationService, AugmentationSettings, memory
from augment.memory import require_memory
from augment.scene import scene
from augment.scene.build import build_scene
from augment.settings import CameraEffectSettings, TrainingAttackSettings
from renderer.errors import InputError
from renderer.image import to_bytes


def test_more_than_the_free_memory_is_refused_before_it_is_allocated(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "GROUP", tmp_path)
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


@pytest.mark.parametrize(
    "at_once, camera", [(2**16, {}), (2**24, {}), (2**24, {"blur": 0.8, "pattern_fraction": 0.7})]
)
def test_an_attack_on_light_takes_half_to_all_of_the_memory_that_it_must_find_free(
    monkeypatch, at_once, camera
):
    """By torch's profiler, for all images at once and for few; with the renders as bytes, as they are trained on."""
    needed = []
    monkeypatch.setattr(scene, "AT_ONCE", at_once)
    monkeypatch.setattr(scene, "require_memory", lambda name, bytes_, device: needed.append(bytes_))
    settings = AugmentationSettings(attack=TrainingAttackSettings(max_steps=1))
    settings.vary.camera = CameraEffectSettings(**camera)
    grays = {
        "views": 2,
        "backgrounds": [row / 128 for row in range(128)],
        "samples": 1,
        "rasterizer": "numpy",
    }
    service = AugmentationService.from_meshes([("solid:orange:0", 0)], 32, settings, **grays)
    with torch.profiler.profile(
        activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True
    ) as recorded:
        to_bytes(service.regenerate(nn.Sequential(nn.Flatten(), nn.Linear(3 * 32**2, 2)), 0).images)
    events = [
        event for event in recorded.profiler.kineto_results.events() if event.name() == "[memory]"
    ]
    changes = [event.nbytes() for event in sorted(events, key=lambda event: event.start_ns())]
    assert needed[-1] / 2 < max(itertools.accumulate(changes)) <= needed[-1]


def test_renders_and_their_views_need_their_memory_before_any_is_made(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda device: 2**26)
    orange, grays = [("solid:orange", "orange")], (0, 0.25, 0.5, 0.75, 1)
    with pytest.raises(InputError, match=r"^1000 renders of 64 pixels per side .* need 0\.4 GB"):
        build_scene(orange, 64, 200, backgrounds=grays, rasterizer="numpy")
    views = build_scene(orange, 64, 100, rasterizer="numpy", samples=1)
    monkeypatch.setattr(memory, "free_memory", lambda device: 10**6)
    with pytest.raises(InputError, match=r"^100 views of 64 pixels per side .* need "):
        _ = views.stacks
