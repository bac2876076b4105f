"""Measure how the cost grows, and write the page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch

from renderer.errors import InputError, require_range
from train.cli import command_line
from train.outputs import writable_file
from train.studies.growth.cost import Cost, Load, described, measure
from train.studies.growth.imagenet import IMAGES, Parts, added_share, measure_parts
from train.studies.page import joined, machine, wrapped, write
from train.tables import markdown

INTRODUCTION = """\
# How the cost of renders grows

Made by `{command}`. {machine}

- One round of adversarial renders: oranges before five greys, 2 × 2 samples per pixel, {steps} steps of the light, one
  thread, against a WideResNet-10-1 that is sure of the label, so that every attack takes all its steps. Each row is
  measured in a process of its own, {rounds} times, of which medians count; **other work shared the cores, so that the
  ratios say more than the seconds**.
- *Memory* is the peak beyond what Python and the libraries take. Images are rendered 16.8 million pixels at a time, so
  that it grows by the renders themselves and by the operators of distinct views; what would not fit is refused before
  it is made, with the number that would.
"""
HEADER = ["load", "views", "operators, s", "attack, s", "ms per render and pass", "outside the network", "memory, MB"]
EXTRAPOLATED = """\
100,000 renders, extrapolated from the last two rows by a straight line: {attack:,.0f} s, {memory:,.1f} GB; 1,000,000:
{more:,.1f} GB.
"""
SHARED = """\
## Processes

Each process attacks its share and gets all renders. {renders:,} renders took {one:.1f} s in one process and {two:.1f} s
in two on this machine's {cores} cores: {ratio:.2f}×. What does not become less by a second process is {serial:.0%} of
one's time (Amdahl), by which 4 processes would be {four:.1f}× and 8 {eight:.1f}× as fast as one.
"""
IMAGENET = """\
## ImageNet on eight GPUs, on paper

Of ResNet-50 at 224², an attack's pass takes {attack:.2f} and a relit image with its gradient {render:.3f} of a training
step's time (medians over {rounds} turns on the CPU; on a GPU the network's ratio is that of the same products). An
epoch has {images:,} images. On eight GPUs the attack is shared like the batches, so that the share stays. The minutes
take {rate:,} images per second on all eight, **a number that was assumed and not measured**.
"""


@dataclass
class GrowthSettings:
    """conf/benchmark_growth.yaml."""

    out: str
    renders: list[int]
    sizes: list[int]
    meshes: list[int]
    shared: int
    steps: int
    rounds: int
    rate: int

    def __post_init__(self) -> None:
        if len(self.renders) < 2 or min(*self.renders, self.shared) < 5 or any(n % 5 for n in self.renders):
            raise InputError("renders and shared: give multiples of the 5 backgrounds, of renders two or more")
        for name, most in {"steps": 1000, "rounds": 1000, "rate": 10**9}.items():
            require_range(name, getattr(self, name), 1, most)


def run(settings: GrowthSettings) -> None:
    """Print the page and write it."""
    out, described_machine = writable_file(settings.out, "out"), machine(torch.device("cpu"))
    few = Load(settings.renders[0], steps=settings.steps)
    by_number = [replace(few, renders=number) for number in settings.renders]
    by_size = [replace(few, size=size) for size in settings.sizes]
    by_mesh = [replace(few, meshes=count, renders=count * few.renders) for count in settings.meshes]
    shared = [replace(few, renders=settings.shared, processes=count) for count in (1, 2)]
    costs = {load: _median(load, settings.rounds) for load in dict.fromkeys([*by_number, *by_size, *by_mesh, *shared])}
    torch.set_num_threads(1)
    parts = measure_parts(settings.rounds)
    introduction = INTRODUCTION.format(
        command=command_line(), machine=described_machine, steps=settings.steps, rounds=settings.rounds
    )
    tables = [markdown(HEADER, [_row(load, costs[load]) for load in loads]) for loads in (by_number, by_size, by_mesh)]
    blocks = [wrapped(introduction), "## Renders", tables[0], wrapped(_extrapolated(by_number, costs))]
    blocks += ["## Size", tables[1], "## Meshes", tables[2], wrapped(_shared(shared, costs))]
    write(out, joined([*blocks, *_imagenet(parts, settings)]))


def _median(load: Load, rounds: int) -> Cost:
    costs = [measure(load) for _ in range(rounds)]
    return Cost(*(median(getattr(cost, name) for cost in costs) for name in Cost.__dataclass_fields__))


def _row(load: Load, cost: Cost) -> list[str]:
    each = 1000 * cost.attack / (load.renders * (load.steps + 1))
    return [
        described(replace(load, steps=Load.steps)),
        f"{load.meshes * load.views:,}",
        f"{cost.operators:.2f}",
        f"{cost.attack:.2f}",
        f"{each:.3f}",
        f"{1 - cost.classifier / cost.attack:.0%}",
        f"{cost.memory / 1e6:,.0f}",
    ]


def _extrapolated(loads: Sequence[Load], costs: dict[Load, Cost]) -> str:
    before, last = loads[-2:]

    def at(renders: int, name: str) -> float:
        low, high = (getattr(costs[load], name) for load in (before, last))
        return high + (high - low) * (renders - last.renders) / (last.renders - before.renders)

    memory, more = (at(renders, "memory") / 1e9 for renders in (100_000, 1_000_000))
    return EXTRAPOLATED.format(attack=at(100_000, "attack"), memory=memory, more=more)


def _shared(loads: Sequence[Load], costs: dict[Load, Cost]) -> str:
    one, two = (costs[load].attack for load in loads)
    serial = min(max(2 * two / one - 1, 0), 1)
    four, eight = (1 / (serial + (1 - serial) / count) for count in (4, 8))
    return SHARED.format(
        renders=loads[0].renders,
        one=one,
        two=two,
        cores=torch.multiprocessing.cpu_count(),
        ratio=one / two,
        serial=serial,
        four=four,
        eight=eight,
    )


def _imagenet(parts: Parts, settings: GrowthSettings) -> list[str]:
    text = IMAGENET.format(
        attack=parts.attack / parts.training,
        render=parts.render / parts.training,
        rounds=settings.rounds,
        images=IMAGES,
        rate=settings.rate,
    )
    plain = 10 * IMAGES / settings.rate / 60
    rows = []
    for renders in (100, 1000, 10_000, 100_000):
        shares = [added_share(parts, renders, steps) for steps in (10, 30)]
        rows.append([f"{renders:,}", *(f"+{share:.2%}" for share in shares), f"{plain * (1 + shares[1]):.1f}"])
    header = ["renders per epoch", "10 steps", "30 steps", "minutes of 10 epochs, 30 steps"]
    return [wrapped(text), markdown(header, [["0", "-", "-", f"{plain:.1f}"], *rows])]
