"""Shares of outcomes with their Wilson intervals, in words and in figures."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from train.photographs.shares import share

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def interval(found: Mapping[str, float]) -> str:
    """What `share` found, as a cell of a table."""
    return "{value:.2f} [{low:.2f}, {high:.2f}]".format(**found)


def percent(found: Sequence[bool]) -> str:
    """A share in percent with its interval, as a cell of a table."""
    if not found:
        return "none of 0"
    value, low, high = (100 * share(sum(found), len(found))[name] for name in ("value", "low", "high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}] of {len(found)}"


def draw_shares(
    panel: "Axes", places: Sequence[float], shares: Sequence[Mapping[str, float]], scale: float = 1, **style: Any
) -> None:
    """A line of shares with their intervals as error bars."""
    value, low, high = (scale * np.array([each[name] for each in shares]) for name in ("value", "low", "high"))
    panel.errorbar(places, value, np.maximum([value - low, high - value], 0), **style)  # below 0 by rounding alone
