"""The option --verbose, which makes commands and their child processes print details."""

import os
from collections.abc import Sequence

# Options of the command line that ask for details.
VERBOSE_FLAGS = frozenset({"--verbose", "-v"})
# Environment variable that is set if commands print details.
VERBOSE = "PNB_VERBOSE"
# Largest number of lines about its result that a command prints without --verbose. Lines
# with the paths of written files may follow.
MAX_LINES = 12


def take_flag(words: list[str]) -> list[str]:
    """Remove --verbose and -v from a command line, and make the process verbose if one is there."""
    others = [word for word in words if word not in VERBOSE_FLAGS]
    if len(others) < len(words):
        os.environ[VERBOSE] = "1"
    return others


def is_verbose() -> bool:
    """Return whether commands of this process print details in addition to their result."""
    return VERBOSE in os.environ


def shortened(lines: Sequence[str], limit: int = MAX_LINES) -> list[str]:
    """Shorten a list of lines that a command prints, unless the command is verbose.

    The last line says how many were left out.
    """
    if is_verbose() or len(lines) <= limit:
        return list(lines)
    kept = limit - 1
    return [*lines[:kept], f"... {len(lines) - kept} more lines: -v shows them"]
