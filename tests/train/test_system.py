"""Memory of a process, and the lines that a command prints."""

import os
import subprocess
import sys

import pytest

from train.system import VARIABLES, shortened

# Prints the page faults of ten arrays of 64 MB, one after the other.
ARRAYS = """
import resource
import numpy as np

fill = lambda: np.empty(2**24, dtype=np.float32).fill(1)
fill()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    fill()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
REUSE = "from train.system import reuse_freed_memory\nreuse_freed_memory()\n"


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc has mallopt")
def test_large_arrays_reuse_the_pages_of_freed_ones():
    others = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    faults = []
    for code in (REUSE, ""):
        command = [sys.executable, "-c", code + ARRAYS]
        faults.append(
            int(subprocess.run(command, capture_output=True, check=True, env=others).stdout)
        )
    assert faults[0] < 10
    assert faults[1] > 100


def test_a_command_prints_at_most_twelve_lines_and_says_how_many_it_left_out(monkeypatch):
    lines = [f"line {index}" for index in range(30)]
    assert shortened(lines[:12]) == lines[:12]
    assert shortened(lines) == [*lines[:11], "... 19 more lines: -v shows them"]
    monkeypatch.setenv("PNB_VERBOSE", "1")
    assert shortened(lines) == lines
