"""A share of outcomes and how surely it is known."""

from collections.abc import Mapping
from math import sqrt
from statistics import NormalDist
from typing import Any


def share(hits: int, n: int) -> dict[str, Any]:
    """The share hits / n with its 95 % Wilson score interval (Wilson 1927).

    Returns {value, low, high, hits, n}, the first three in [0, 1], or None with n = 0.
    """
    if n == 0:
        return {"value": None, "low": None, "high": None, "hits": 0, "n": 0}
    return {"value": hits / n, "low": _low(hits, n), "high": 1 - _low(n - hits, n), "hits": hits, "n": n}


def counted(found: Mapping[str, Any]) -> str:
    """What `share` found, as a cell of a table."""
    return "{hits} of {n} [{low:.0%}, {high:.0%}]".format(**found) if found["n"] else "none of 0"


def _low(hits: int, n: int) -> float:
    z = NormalDist().inv_cdf(0.975)
    return (hits + z * z / 2 - z * sqrt(hits * (n - hits) / n + z * z / 4)) / (n + z * z)
