"""Shares of outcomes with their Wilson intervals, as cells of a table and as points of a figure."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from train.photographs.shares import share

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def interval(found: Mapping[str, float]) -> str:
    """What `share` found."""
    return "{value:.2f} [{low:.2f}, {high:.2f}]".format(**found)


def percent(found: Sequence[bool]) -> str:
    """A share in percent."""
    if not found:
        return "none of 0"
    value, low, high = (100 * share(sum(found), len(found))[name] for name in ("value", "low", "high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}] of {len(found)}"


def draw_shares(panel: "Axes", places: Sequence[float], found: Sequence[Sequence[bool]], **style: Any) -> None:
    """Shares in percent with their intervals, over one place each; none where nothing is counted."""
    shares = [share(sum(some), len(some)) for some in found]
    value, low, high = (100 * np.array([each[name] for each in shares], float) for name in ("value", "low", "high"))
    panel.errorbar(places, value, np.maximum([value - low, high - value], 0), capsize=2, **style)
