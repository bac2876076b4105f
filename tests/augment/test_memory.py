import itertools
from collections.abc import Callable

import pytest
import torch
from torch import nn

from augment import AugmentationService, AugmentationSettings
from augment.attack_settings import AttackSettings, StepSettings
from augment.attacks.problem import build_problem
from augment.augmentation_settings import CameraEffectSettings, TrainingAttackSettings
from augment.scene import scene
from augment.scene.build import build_scene
from renderer import errors
from renderer.errors import InputError, require_memory
from renderer.image import to_bytes

CPU = torch.device("cpu")
ORANGE = [("solid:orange", "orange")]


def test_more_than_the_free_memory_of_the_system_and_of_the_group_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(errors, "MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(errors, "GROUP", tmp_path)
    require_memory("renders", 2**60, CPU)  # The system does not say how much is free.
    (tmp_path / "meminfo").write_text("MemTotal: 8388608 kB\nMemAvailable: 4194304 kB\n")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text(f"{2**30}\n")
    require_memory("renders", 2**32, CPU)
    with pytest.raises(InputError, match=r"^renders .* 8\.0 GB .* 4\.0 GB"):
        require_memory("renders", 2**33, CPU)
    (tmp_path / "memory.max").write_text(f"{2**31}\n")
    with pytest.raises(InputError, match=r"1\.0 GB"):
        require_memory("renders", 2**32, CPU)


def peak_memory(function: Callable[[], object]) -> int:
    activities = [torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities, profile_memory=True) as profile:
        function()
    events = [e for e in profile.profiler.kineto_results.events() if e.name() == "[memory]"]
    events.sort(key=lambda event: event.start_ns())
    return max(itertools.accumulate(event.nbytes() for event in events))


@pytest.mark.parametrize(
    ("at_once", "camera"),
    [
        (2**16, CameraEffectSettings()),
        (2**24, CameraEffectSettings()),
        (2**24, CameraEffectSettings(blur=0.8, pattern_fraction=0.7)),
    ],
    ids=["few images", "all images", "camera effects"],
)
def test_attacks_on_light_take_half_to_all_of_the_memory_they_require(monkeypatch, at_once, camera):
    """The renders are bytes, as they are in training."""
    required = []
    monkeypatch.setattr(scene, "AT_ONCE", at_once)
    monkeypatch.setattr(errors, "require_memory", lambda *arguments: required.append(arguments[1]))
    settings = AugmentationSettings(attack=TrainingAttackSettings(max_steps=1))
    settings.vary.camera = camera
    grays = [row / 128 for row in range(128)]
    shown = {"views": 2, "backgrounds": grays, "samples": 1, "rasterizer": "numpy"}
    service = AugmentationService.from_meshes([("solid:orange:0", 0)], 32, settings, **shown)
    model = nn.Sequential(nn.Flatten(), nn.Linear(3 * 32**2, 2))
    peak = peak_memory(lambda: to_bytes(service.regenerate(model, 0).images))
    assert required[-1] / 2 < peak <= required[-1]


def test_renders_and_views_need_their_memory_before_any_is_made(monkeypatch):
    shown = build_scene(ORANGE, 64, 100, rasterizer="numpy", samples=1)
    monkeypatch.setattr(errors, "free_memory", lambda device: 10**6)
    grays = (0, 0.25, 0.5, 0.75, 1)
    many = build_scene(ORANGE, 64, 200, backgrounds=grays, rasterizer="numpy")
    with pytest.raises(InputError, match=r"^1000 renders of 64 × 64 pixels .* 0\.4 GB"):
        build_problem(AttackSettings(lighting=StepSettings()), many)
    with pytest.raises(InputError, match=r"^100 views of 64 × 64 pixels"):
        first = torch.arange(1)
        shown.render(shown.conditions(first), first)
