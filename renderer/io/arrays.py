"""Read and write arrays of numbers as .npy files."""

import io
from pathlib import Path

import numpy as np

from renderer.io.files import atomic_write


def write_numbers(path: Path, numbers: np.ndarray) -> None:
    """Write an array to an .npy file.

    A reader never sees a part of the new file: see `atomic_write`.
    """
    content = io.BytesIO()
    np.save(content, numbers)
    atomic_write(path, content.getbuffer())


def read_numbers(path: Path) -> np.ndarray:
    """Read an array of real numbers from an .npy file.

    The file is mapped into memory. A damaged header that claims a huge array
    therefore raises an error instead of allocating memory. Numbers that are too large for float32
    become infinite.
    """
    array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.kind not in "fiu" or not array.size:
        raise ValueError(
            f"the array has the type {array.dtype} and the shape {array.shape}, but real numbers "
            "are needed"
        )
    with np.errstate(over="ignore"):
        return array.astype(np.float32)
