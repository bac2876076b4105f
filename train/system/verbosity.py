"""Whether the commands of this process print details. Their child processes follow."""

import os

# Words of the command line that ask for details.
VERBOSE_FLAGS = frozenset({"--verbose", "-v"})
# Environment variable that is set if details are printed.
VERBOSE = "PNB_VERBOSE"


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
