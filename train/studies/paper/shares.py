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


def share_of(found: Sequence[bool]) -> dict[str, Any]:
    """`share` of outcomes."""
    return share(sum(found), len(found))


def percent(found: Sequence[bool]) -> str:
    """A share in percent."""
    if not found:
        return "none of 0"
    value, low, high = (100 * share_of(found)[name] for name in ("value", "low", "high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}] of {len(found)}"


def draw_shares(
    panel: "Axes", places: Sequence[float], shares: Sequence[Mapping[str, Any]], scale: float, **style: Any
) -> None:
    """What `share` found with its intervals, times a scale, over one place each; nothing where nothing is counted."""
    value, low, high = (scale * np.array([each[name] for each in shares], float) for name in ("value", "low", "high"))
    error = np.maximum([value - low, high - value], 0)  # below 0 by rounding alone
    panel.errorbar(places, value, error, **style)
