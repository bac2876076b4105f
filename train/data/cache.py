"""Tensors that are kept on disk from run to run, each under a hash of all that went into it.

A file has a checksum and then the tensors in the safetensors format. The tensors are read only if
the checksum holds. A file may be damaged or deleted at any time, and processes may share the
folder.
"""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from renderer.io.files import atomic_write
from train import console
from train.system.hashing import content_hash

# The length of the checksum, a SHA-256.
CHECKSUM_BYTES = 32


def cache_folder(choice: str | None) -> Path | None:
    """Return the folder of a cache.

    Args:
        choice: "auto" for the user's own (in XDG_CACHE_HOME or ~/.cache), another folder, or None.

    Returns:
        The folder. None if nothing is to be kept, or if "auto" finds no home folder.
    """
    if not choice:
        return None
    if choice != "auto":
        return Path(os.path.expanduser(choice))
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches, "parametric-norm-balls") if os.path.isabs(caches) else None


def source_key(*packages: Path) -> str:
    """Hash the Python files of some folders, so that a cache notices when code has changed.

    Args:
        packages: Folders of the files.

    Returns:
        A hash of these files and of the versions of torch and NumPy.
    """
    files = []
    for folder in packages:
        for path in folder.rglob("*.py"):
            files.append((path.relative_to(folder).as_posix(), path))
    sources = [(name, path.read_bytes()) for name, path in sorted(files)]
    return content_hash([torch.__version__, np.__version__, sources])


class TensorCache:
    """Named tensors in files of a folder.

    Args:
        folder: The folder, which is made when it is first written to. If that fails, a warning is
            logged once. None keeps nothing.
    """

    def __init__(self, folder: Path | None = None):
        self.folder = folder
        self.writable = folder is not None

    def read(self, key: str) -> dict[str, Tensor] | None:
        """Read tensors.

        Args:
            key: The key, such as one of `content_hash`.

        Returns:
            The tensors that were written under the key. None if there are none, or if a bit of
            them has changed.
        """
        if self.folder is None:
            return None
        try:
            content = (self.folder / key).read_bytes()
        except OSError:
            return None
        checksum = content[:CHECKSUM_BYTES]
        tensors = content[CHECKSUM_BYTES:]
        if checksum != _checksum(key, tensors):
            return None
        return safetensors.torch.load(tensors)

    def write(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Write tensors. Another process sees the old file or the new one.

        Args:
            key: The key.
            tensors: The tensors by name, on the CPU.
        """
        if self.folder is None or not self.writable:
            return
        content = safetensors.torch.save(dict(tensors))
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            atomic_write(self.folder / key, _checksum(key, content) + content)
        except OSError as error:
            console.warning(f"images and predictions are not cached: {error}")
            self.writable = False


def _checksum(key: str, content: bytes) -> bytes:
    """Return the SHA-256 of a key and of the tensors that are written under it."""
    return hashlib.sha256(key.encode() + content).digest()
