import os
import subprocess
import sys

import pytest

from train.system import VARIABLES

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only glibc has mallopt")

# Prints the page faults of ten arrays of 64 MB, one after the other.
ARRAYS = """
import resource
import numpy as np

def fill():
    np.empty(2**24, dtype=np.float32).fill(1)

fill()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    fill()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
REUSE = "from train.system import reuse_freed_memory\nreuse_freed_memory()\n"


def count_faults(code):
    others = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    done = subprocess.run(
        [sys.executable, "-c", code + ARRAYS],
        capture_output=True,
        text=True,
        check=True,
        env=others,
    )
    return int(done.stdout)


def test_large_arrays_reuse_the_pages_of_freed_ones():
    assert count_faults(REUSE) < 10
    assert count_faults("") > 100
