"""Measure how the cost grows, and write the page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import torch

from renderer.errors import InputError, require_range
from renderer.image import LARGEST_SIZE
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.report.tables import markdown
from train.settings import MOST_IMAGES
from train.studies.growth.cost import GREYS, Cost, Load, described, measure
from train.studies.growth.imagenet import IMAGES, SIZE, Parts, added_share, measure_parts
from train.studies.page import filled, joined, machine, wrapped, write

HEADER = ["load", "views", "operators, s", "attack, s", "ms per render and pass", "outside the network", "memory, MB"]
FURTHER = "{n:,} renders would take {attack:,.0f} s and {memory:,.1f} GB"
SHARED = """\
## Processes

{renders:,} renders. Each process builds all operators, attacks its share of the renders and gets all of them. Seconds
are the slowest process's on a core of its own; this machine has {cores} cores, so that more processes took turns.
"""
IMAGENET = """\
## ImageNet on eight GPUs, on paper

What fine-tuning ResNet-50 costs at 224² with renders that are attacked anew in each epoch of {images:,} images.

- **Measured**: an attack's pass takes {attack:.2f} and a relit image with its gradient {render:.3f} of a training
  step's time (medians over {rounds} turns of one core); a view's operators {operator:.2f} s of a core and
  {kept:.1f} MB.
- **Assumed**: these ratios hold on a GPU; the attack is shared evenly by eight; images per second of eight GPUs that
  train ResNet-50 in mixed precision are {rates}, as published in the
  [table of NVIDIA's implementation]({source}). The time per epoch is of 30 steps.
- **Operators** are built once, where only the light changes, or else in each epoch, in each process on the CPU.
"""
SOURCE = "https://github.com/NVIDIA/DeepLearningExamples/tree/master/PyTorch/Classification/ConvNets/resnet50v1.5"
ON_PAPER = (0, 100, 1000, 10_000, 100_000)


@dataclass
class GrowthSettings:
    """conf/benchmark_growth.yaml."""

    out: str
    renders: list[int]
    sizes: list[int]
    meshes: list[int]
    shared: int
    processes: list[int]
    steps: int
    rounds: int
    rates: dict[str, int]

    def __post_init__(self) -> None:
        if len(set(self.renders)) < 2 or any(n < 5 or n % 5 for n in [*self.renders, self.shared]):
            raise InputError("renders and shared: give multiples of the 5 backgrounds, of renders two or more")
        if SIZE not in self.sizes:
            raise InputError(f"sizes: {SIZE} is what ImageNet on paper is made of; add it")
        for name, most in {"renders": MOST_IMAGES, "sizes": LARGEST_SIZE, "meshes": 1000, "processes": 64}.items():
            for number in getattr(self, name):
                require_range(name, number, 1, most)
        require_range("shared", self.shared, 5, MOST_IMAGES)
        for name in ("steps", "rounds"):
            require_range(name, getattr(self, name), 1, 1000)
        for name, rate in self.rates.items():
            require_range(f"rates.{name}", rate, 1, 10**9)


def run(settings: GrowthSettings) -> None:
    """Print the page and write it."""
    out, described_machine = writable_file(settings.out, "out"), machine(torch.device("cpu"))
    few = Load(settings.renders[0], steps=settings.steps)
    loads = {
        "## Renders": [replace(few, renders=number) for number in settings.renders],
        "## Size": [replace(few, size=size) for size in settings.sizes],
        "## Meshes": [replace(few, meshes=count, renders=count * few.renders) for count in settings.meshes],
    }
    shared = [replace(few, renders=settings.shared, processes=count) for count in settings.processes]
    costs = {load: measure(load) for load in dict.fromkeys([*chain(*loads.values()), *shared])}
    torch.set_num_threads(1)
    introduction = filled(
        __file__, command=command_line(), machine=described_machine, steps=settings.steps, default=described(few)
    )
    blocks = [wrapped(introduction)]
    for title, rows in loads.items():
        blocks += [title, markdown(HEADER, [_row(few, load, costs[load]) for load in rows])]
    blocks.insert(3, wrapped(_further(loads["## Renders"][-2:], costs)))
    blocks += _shared(settings.shared, {load.processes: costs[load] for load in shared})
    large = replace(few, size=SIZE)
    blocks += on_paper(measure_parts(settings.rounds), costs[large], large.views, settings)
    write(out, joined(blocks))


def _row(usual: Load, load: Load, cost: Cost) -> list[str]:
    each = 1000 * cost.attack / (load.renders * (load.steps + 1))
    return [
        described(load, usual),
        f"{load.meshes * load.views:,}",
        f"{cost.operators:.2f}",
        f"{cost.attack:.2f}",
        f"{each:.3f}",
        f"{1 - cost.network:.0%}",
        f"{cost.memory / 1e6:,.0f}",
    ]


def _further(loads: Sequence[Load], costs: dict[Load, Cost]) -> str:
    """What more renders would take, by a straight line through two loads."""
    low, high = loads

    def at(renders: int, name: str) -> float:
        first, last = (float(getattr(costs[load], name)) for load in loads)
        return last + (last - first) * (renders - high.renders) / (high.renders - low.renders)

    further = [FURTHER.format(n=n, attack=at(n, "attack"), memory=at(n, "memory") / 1e9) for n in (10**5, 10**6)]
    return f"By a straight line through the last two rows, {'; '.join(further)}."


def _shared(renders: int, costs: dict[int, Cost]) -> list[str]:
    text = SHARED.format(renders=renders, cores=torch.multiprocessing.cpu_count())
    first = next(iter(costs.values()))
    rows = []
    for count, cost in costs.items():
        seconds = [f"{part:.2f}" for part in (cost.operators, cost.attack, cost.elapsed)]
        rows.append([count, *seconds, f"{first.attack / cost.attack:.2f}×", f"{cost.memory / 1e6:,.0f}"])
    header = ["processes", "operators, s", "attack, s", "elapsed, s", "as fast", "memory of each, MB"]
    return [wrapped(text), markdown(header, rows)]


def on_paper(parts: Parts, view: Cost, views: int, settings: GrowthSettings) -> list[str]:
    """Blocks of the page; view: of `views` at ImageNet's size."""
    text = IMAGENET.format(
        attack=parts.attack / parts.training,
        render=parts.render / parts.training,
        rounds=settings.rounds,
        operator=view.operators / views,
        kept=view.kept / views / 1e6,
        images=IMAGES,
        rates=" and ".join(f"{rate:,} ({name})" for name, rate in settings.rates.items()),
        source=SOURCE,
    )
    header = ["renders per epoch", "10 steps", "30 steps", *(f"{name}, min" for name in settings.rates)]
    header += ["operators, min", "operators, GB"]
    return [wrapped(text), markdown(header, [_on_paper(n, parts, view, views, settings.rates) for n in ON_PAPER])]


def _on_paper(renders: int, parts: Parts, view: Cost, views: int, rates: dict[str, int]) -> Sequence[str]:
    ten, thirty = (added_share(parts, renders, steps) for steps in (10, 30))
    built = renders / len(GREYS) / views  # times what was measured
    minutes = [f"{(1 + thirty) * IMAGES / rate / 60:.1f}" for rate in rates.values()]
    operators = [f"{built * view.operators / 60:,.1f}", f"{built * view.kept / 1e9:,.1f}"]
    return [f"{renders:,}", f"+{ten:.2%}", f"+{thirty:.2%}", *minutes, *operators]
