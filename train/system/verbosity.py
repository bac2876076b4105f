"""Whether the commands of this process print details. Their child processes follow."""

import os
from collections.abc import Sequence

# Words of the command line that ask for details.
VERBOSE_FLAGS = frozenset({"--verbose", "-v"})
# Environment variable that is set if details are printed.
VERBOSE = "PNB_VERBOSE"
# Lines that a command prints without details, before those with paths.
MAX_LINES = 12


def take_flag(words: list[str]) -> list[str]:
    """Make this process verbose if a word of a command line asks for it.

    Args:
        words: Words of the command line.

    Returns:
        The other words.
    """
    others = [word for word in words if word not in VERBOSE_FLAGS]
    if len(others) < len(words):
        os.environ[VERBOSE] = "1"
    return others


def is_verbose() -> bool:
    """Return whether a command prints more than its result."""
    return VERBOSE in os.environ


def shortened(lines: Sequence[str], limit: int = MAX_LINES) -> list[str]:
    """Cut a list of lines that is too long for a command without details.

    Args:
        lines: Lines of a result. The first ones matter most.
        limit: Largest number of lines that are returned.

    Returns:
        All lines if details are printed or the list is short. Otherwise the
        first lines, and a line that says how many are left out.
    """
    if is_verbose() or len(lines) <= limit:
        return list(lines)
    kept = limit - 1
    return [*lines[:kept], f"... {len(lines) - kept} more lines: -v shows them"]
