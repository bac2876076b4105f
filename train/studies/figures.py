"""Figures on disk."""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def pyplot() -> ModuleType:
    """matplotlib.pyplot without a display."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def panels_beside(count: int, size: tuple[float, float], layout: str = "tight") -> tuple["Figure", Sequence["Axes"]]:
    """(figure, panels) side by side on one vertical scale. size: of each, in inches."""
    width, height = size
    figure, panels = pyplot().subplots(
        1, count, figsize=(count * width, height), sharey=True, squeeze=False, layout=layout
    )
    for panel in panels[0]:
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels[0]


def save(figure: "Figure", path: Path, dpi: int = 110) -> None:
    """Write the figure and let go of it."""
    figure.savefig(path, dpi=dpi)
    pyplot().close(figure)
