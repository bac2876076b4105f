"""Measure how the cost grows, and write the page's section."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from renderer.errors import InputError, require_range
from renderer.image import LARGEST_SIZE
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.report.tables import markdown
from train.settings import MOST_IMAGES
from train.studies.growth.cost import GRAYS, Cost, Load, described, measure
from train.studies.growth.imagenet import IMAGES, SIZE, Parts, added_share, measure_parts
from train.studies.page import filled, machine, wrapped, write_section

ON_PAPER = (0, 100, 1000, 10_000, 100_000)  # renders per epoch
FURTHER = (10**5, 10**6)  # renders per round


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
    """Print the section and write it."""
    out, description = writable_file(settings.out, "out"), machine(torch.device("cpu"))
    few = Load(settings.renders[0], steps=settings.steps)
    renders = [replace(few, renders=number) for number in settings.renders]
    large = replace(few, size=SIZE)
    loads = [
        *renders,
        *(replace(few, size=size) for size in settings.sizes),
        *(replace(few, meshes=count, renders=count * few.renders) for count in settings.meshes),
    ]
    shared = [replace(few, renders=settings.shared, processes=count) for count in settings.processes]
    costs = {load: measure(load) for load in dict.fromkeys([*loads, *shared])}
    torch.set_num_threads(1)
    parts = measure_parts(settings.rounds)
    operator, kept = (each / large.views for each in (costs[large].operators, costs[large].kept))
    text = filled(
        __file__,
        command=command_line(),
        machine=description,
        steps=settings.steps,
        default=described(few),
        loads=_table({load: costs[load] for load in loads}, few),
        further="; ".join(_further(number, {load: costs[load] for load in renders[-2:]}) for number in FURTHER),
        shared=settings.shared,
        cores=torch.multiprocessing.cpu_count(),
        processes=_processes([(load.processes, costs[load]) for load in shared]),
        images=IMAGES,
        attack=parts.attack / parts.training,
        render=parts.render / parts.training,
        rounds=settings.rounds,
        operator=operator,
        megabytes=kept / 1e6,
        rates=" and ".join(f"{rate:,} ({name})" for name, rate in settings.rates.items()),
        imagenet=on_paper(parts, operator, kept, settings.rates),
    )
    write_section(out, wrapped(text))


def _table(costs: dict[Load, Cost], usual: Load) -> str:
    rows = [
        (
            described(load, usual),
            load.meshes * load.views,
            f"{cost.operators:.2f}",
            f"{cost.attack:.2f}",
            f"{1000 * cost.attack / (load.renders * (load.steps + 1)):.3f}",
            f"{1 - cost.network:.0%}",
            f"{cost.memory / 1e6:,.0f}",
        )
        for load, cost in costs.items()
    ]
    header = ["load", "views", "operators, s", "attack, s", "ms per render and pass"]
    return markdown([*header, "outside the network", "memory, MB"], rows)


def _further(renders: int, costs: dict[Load, Cost]) -> str:
    """What more renders would take, by a straight line through two loads."""
    (low, first), (high, last) = costs.items()
    beyond = (renders - high.renders) / (high.renders - low.renders)
    seconds = last.attack + beyond * (last.attack - first.attack)
    memory = last.memory + beyond * (last.memory - first.memory)
    return f"{renders:,} renders would take {seconds:,.0f} s and {memory / 1e9:,.1f} GB"


def _processes(costs: Sequence[tuple[int, Cost]]) -> str:
    _, first = costs[0]
    rows = [
        (
            count,
            *(f"{part:.2f}" for part in (cost.operators, cost.attack, cost.elapsed)),
            f"{first.attack / cost.attack:.2f}×",
            f"{cost.memory / 1e6:,.0f}",
        )
        for count, cost in costs
    ]
    return markdown(["processes", "operators, s", "attack, s", "elapsed, s", "as fast", "memory of each, MB"], rows)


def on_paper(parts: Parts, operator: float, kept: float, rates: dict[str, int]) -> str:
    """A line for each number of renders per epoch. operator, kept: seconds and bytes of a view's. rates: images per
    second."""
    rows = []
    for renders in ON_PAPER:
        ten, thirty = (added_share(parts, renders, steps) for steps in (10, 30))
        minutes = (f"{(1 + thirty) * IMAGES / rate / 60:.1f}" for rate in rates.values())
        views = renders / len(GRAYS)
        operators = f"{views * operator / 60:,.1f}", f"{views * kept / 1e9:,.1f}"
        rows.append((renders, f"+{ten:.2%}", f"+{thirty:.2%}", *minutes, *operators))
    header = ["renders per epoch", "10 steps", "30 steps", *(f"{name}, min" for name in rates)]
    return markdown([*header, "operators, min", "operators, GB"], rows)
