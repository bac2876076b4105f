"""Processor time of a call, for the studies that are left."""

import time
from collections.abc import Callable


def seconds(call: Callable[[], object]) -> float:
    """Processor time over all threads."""
    start = time.process_time()
    call()
    return time.process_time() - start
