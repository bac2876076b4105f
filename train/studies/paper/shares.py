"""Shares of outcomes with their Wilson intervals, as cells of a table."""

from collections.abc import Mapping, Sequence

from train.photographs.shares import share


def interval(found: Mapping[str, float]) -> str:
    """What `share` found."""
    return "{value:.2f} [{low:.2f}, {high:.2f}]".format(**found)


def percent(found: Sequence[bool]) -> str:
    """A share in percent."""
    if not found:
        return "none of 0"
    value, low, high = (100 * share(sum(found), len(found))[name] for name in ("value", "low", "high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}] of {len(found)}"
