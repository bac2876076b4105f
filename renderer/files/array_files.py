"""Arrays of numbers as .npy files."""

from pathlib import Path

import numpy as np


def read_numbers(path: Path) -> np.ndarray:
    """A file's real numbers as float32; what is beyond is infinite. Reads no more than the file holds, whatever its
    header announces. ValueError for what is empty or no real number; whatever NumPy raises at a damaged header."""
    array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.kind not in "fiu" or not array.size:
        raise ValueError(f"it holds {array.dtype} of shape {array.shape}, not real numbers")
    with np.errstate(over="ignore"):
        return array.astype(np.float32)
