"""The figures: fronts of time and error, and how time and memory grow."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from train.studies.figures import pyplot, save
from train.studies.renderer_speed.results import Row, pareto_front
from train.studies.renderer_speed.scaling import Point

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RED = "#c62f2f"
FEW = 12  # settings that can all be named in the figure


def draw_fronts(path: Path, panels: Sequence[Sequence[Row]]) -> None:
    """One set of axes per panel: all settings, by name or coloured by degree, their front and the default."""
    lines = -(-len(panels) // 3)
    figure, axes = pyplot().subplots(lines, 3, figsize=(16, 6 * lines), squeeze=False, layout="constrained")
    for ax, rows in zip(axes.flat, panels, strict=False):
        front = pareto_front(rows)
        ax.plot([row.time_ms for row in front], [row.error for row in front], "k-", lw=1, zorder=1, label="front")
        few = len(rows) <= FEW
        for name, group in _grouped(rows, "setting" if few else "degree").items():
            label = name if few else f"degree {name}"
            ax.plot([row.time_ms for row in group], [row.error for row in group], "o", ms=5, label=label)
        for row in rows:
            if row.default:
                ax.plot(row.time_ms, row.error, "*", ms=15, color=RED, label="default")
        ax.set(title=rows[0].panel, xlabel="milliseconds", ylabel="relative error")
        _logarithmic(ax, "x", *("y" if min(row.error for row in rows) > 0 else ""))
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12)}  # where it hides no setting
        ax.legend(fontsize=8, ncols=1 if few else 4, **below)
    for ax in axes.flat[len(panels) :]:
        ax.axis("off")
    save(figure, path, dpi=100)


def draw_scaling(path: Path, points: Sequence[Point], workloads: Sequence[Sequence[Row]]) -> None:
    """Time and memory of a gradient by its variables, and time of each kind of work by size and by vertices."""
    figure, axes = pyplot().subplots(2, 2, figsize=(12, 10), layout="tight")
    for ax, quantity, unit in ((axes[0, 0], "time_ms", "milliseconds"), (axes[0, 1], "memory_mb", "peak MB allocated")):
        _draw_lines(ax, _grouped(points, "method"), "variables", quantity)
        ax.set(title=f"gradient by the vertices, {points[0].size}², visibility kept", xlabel="variables", ylabel=unit)
    for ax, rows, axis in zip(axes[1], workloads, ("size", "vertices"), strict=True):
        _draw_lines(ax, _grouped(rows, "setting"), axis, "time_ms")
        ax.set(title=rows[0].panel, xlabel=axis, ylabel="milliseconds")
    save(figure, path, dpi=100)


def _grouped(lines: Sequence[Any], name: str) -> dict[Any, list[Any]]:
    """By one of their fields."""
    values = dict.fromkeys(getattr(line, name) for line in lines)
    return {value: [line for line in lines if getattr(line, name) == value] for value in values}


def _draw_lines(ax: "Axes", lines: Mapping[str, Sequence[Any]], x: str, y: str) -> None:
    for name, line in lines.items():
        ax.plot([getattr(point, x) for point in line], [getattr(point, y) for point in line], "o-", ms=4, label=name)
    _logarithmic(ax, "x", "y")
    ax.legend(fontsize=8)


def _logarithmic(ax: "Axes", *names: str) -> None:
    """With as many plain numbers beside an axis as there is room for, also where it spans less than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.set(**{f"{name}scale": "log" for name in names})
    for name in names:
        axis = getattr(ax, f"{name}axis")
        low, high = axis.get_view_interval()
        steps = range(1, 10) if high < 5 * low else (1, 2, 5) if high < 1000 * low else (1,)
        axis.set_major_locator(LogLocator(subs=steps, numticks=12))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.12g}"))
        axis.set_minor_formatter(NullFormatter())
    ax.grid(alpha=0.3, which="both")
