"""How the C library of Linux manages the memory of this process."""

import ctypes
import os
import sys

# Number of a parameter of the function mallopt of the C library glibc: free memory above
# this number of bytes is returned to the system.
M_TRIM_THRESHOLD = -1
# Number of a parameter of mallopt: the memory of an array of at least this number of
# bytes is returned to the system as soon as the array is freed.
M_MMAP_THRESHOLD = -3
# Environment variables with which a user can set these parameters.
VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
# Largest array in bytes whose memory is reused. For larger arrays, the time to get new
# memory is small beside the time to fill it.
LARGEST_REUSED = 2**30


def reuse_freed_memory() -> None:
    """Make the C library reuse the memory of large arrays instead of returning it to the system.

    By default, glibc returns the memory of an array above 32 MB when the array is
    freed. For the next array, Linux fills new memory with zeros, which takes
    longer than a depthwise convolution. Nothing changes if the user has set one
    of the environment variables VARIABLES, or if the C library is another one.
    """
    if sys.platform != "linux" or any(name in os.environ for name in VARIABLES):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_REUSED)
        mallopt(M_TRIM_THRESHOLD, LARGEST_REUSED)
