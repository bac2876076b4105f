"""The memory of this process."""

import ctypes
import os
import sys

# Parameters of glibc's mallopt, and the environment variables that set them, too.
# glibc returns more free memory than M_TRIM_THRESHOLD to the system, and maps each
# array of at least M_MMAP_THRESHOLD bytes by itself, which it returns at once.
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
# Bytes. Larger arrays are rare, and returning them costs little beside filling them.
LARGEST_REUSED = 2**30


def reuse_freed_memory() -> None:
    """Reuse the memory of large arrays instead of returning it to the system.

    By default, glibc returns each array above 32 MB when it is freed. The kernel
    then fills the pages of the next array with zeros, which takes longer than to
    compute a depthwise layer. The values of the environment are kept if it has
    some. Other C libraries stay as they are.
    """
    if sys.platform != "linux" or any(name in os.environ for name in VARIABLES):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_REUSED)
        mallopt(M_TRIM_THRESHOLD, LARGEST_REUSED)
