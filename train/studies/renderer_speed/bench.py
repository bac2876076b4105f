"""What every panel of time against error needs: the axes that are measured, the clock, the rasterisers, the device."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from renderer.image import ImageSettings
from renderer.transfer import DEGREE
from renderer.visibility import Backend
from train.studies.renderer_speed.measure import Clock
from train.studies.renderer_speed.results import Row
from train.studies.renderer_speed.scenes import View, coefficients, ellipsoid

SAMPLES = ImageSettings().samples

Entries = Iterable[tuple[Row, Callable[[], object]]]


@dataclass(frozen=True)
class Plan:
    """Every axis that is measured. small, large, sizes: of images in pixels. samples: per side of a pixel. mesh and
    vertices: how many of the latter a mesh has about. views: of each mesh whose operators are built."""

    small: int = 32
    large: int = 224
    mesh: int = 10_000
    sizes: tuple[int, ...] = (32, 64, 128, 224, 512)
    vertices: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000)
    variables: tuple[int, ...] = (100, 1_000, 10_000, 100_000, 300_000, 1_000_000)
    degrees: tuple[int, ...] = (2, 4, 6, 8, 10, 12)
    samples: tuple[int, ...] = (1, 2, 4, 8, 16)
    shaped_samples: tuple[int, ...] = (2, 4, 8, 16)
    directions: tuple[int, ...] = (64, 128, 256, 512, 1024, 2048)
    converged: tuple[int, int, int] = (2**14, 2**13, 2**8)  # directions, patches and theirs
    workload_samples: int = 4
    batches: tuple[int, ...] = (1, 10, 100, 1_000)
    views: int = 10
    refreshes: tuple[int, ...] = (1, 2, 5, 10)
    steps: int = 20
    rounds: int = 21


QUICK = Plan(
    small=8,
    large=12,
    mesh=160,
    sizes=(8, 12),
    vertices=(40, 160),
    variables=(100,),
    degrees=(2, 6),
    samples=(1, 8),
    shaped_samples=(2, 8),
    directions=(64, 512),
    converged=(2**10, 2**8, 2**6),
    batches=(1, 4),
    views=1,
    refreshes=(1, 2),
    steps=2,
    rounds=1,
)


@dataclass(frozen=True)
class Bench:
    """What every panel needs: the plan, the clock, the rasterisers (the default first) and the device."""

    plan: Plan
    clock: Clock
    backends: tuple[Backend, ...]
    device: torch.device

    def view(self, vertices: int, size: int) -> View:
        return View(ellipsoid(vertices), size, self.backends[0], self.device)

    def light(self, degree: int = DEGREE, dtype: torch.dtype = torch.float32) -> Tensor:
        return coefficients(degree).to(self.device, dtype)

    def timed(self, entries: Entries, share: float = 1.0) -> list[Row]:
        """The entries' rows with their times, from this share of the plan's rounds."""
        rows, calls = zip(*entries, strict=True)
        times = self.clock.medians(dict(enumerate(calls)), max(1, round(share * self.plan.rounds)))
        return [replace(row, time_ms=times[index]) for index, row in enumerate(rows)]


def row_of(view: View, panel: str, setting: str, samples: int, **found: Any) -> Row:
    """Of a view with so many samples per side of a pixel, at the default degree unless found says so."""
    axes: dict[str, Any] = {"degree": DEGREE, "size": view.size, "vertices": len(view.mesh.vertices)}
    return Row(panel=panel, setting=setting, samples=samples**2, **axes | found)
