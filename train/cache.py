"""Tensors on disk, from run to run: each file under a hash of all that went into it.

A file is a checksum and then the tensors in the safetensors format, parsed only if the checksum holds. A file may be
damaged or deleted at any time, and processes may share the folder.
"""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from renderer.io.files import write_whole
from train import console
from train.checkpoint import content_hash


def cache_folder(choice: str | None) -> Path | None:
    """The folder that `train.cache` chooses: "auto" is the user's (XDG_CACHE_HOME or ~/.cache), or None without a
    home; None is no cache."""
    if choice != "auto":
        return Path(os.path.expanduser(choice)) if choice else None
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches, "parametric-norm-balls") if os.path.isabs(caches) else None


def source_key(*packages: Path) -> str:
    """Hash of the Python files in folders, and of the versions of torch and NumPy."""
    files = [(path.relative_to(folder).as_posix(), path) for folder in packages for path in folder.rglob("*.py")]
    sources = [(name, path.read_bytes()) for name, path in sorted(files)]
    return content_hash([torch.__version__, np.__version__, sources])


class TensorCache:
    """Named tensors in files of a folder, under keys of `content_hash`.

    folder: made when first written to, or a warning is logged where it cannot be; None: nothing is written.
    """

    def __init__(self, folder: Path | None = None):
        self.folder, self.writable = folder, folder is not None

    def read(self, key: str) -> dict[str, Tensor] | None:
        """The tensors that were written under the key; None where there are none, or where a bit has changed."""
        try:
            content = (self.folder / key).read_bytes() if self.folder else b""
        except OSError:
            return None
        checksum, tensors = content[:32], content[32:]
        return safetensors.torch.load(tensors) if checksum == _checksum(key, tensors) else None

    def write(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Write CPU tensors. Another process sees the old file or the new one, and `read` passes over a torn one."""
        if self.folder is None or not self.writable:
            return
        content = safetensors.torch.save(dict(tensors))
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(self.folder / key, _checksum(key, content) + content)
        except OSError as error:
            console.warning(f"images and predictions are not cached: {error}")
            self.writable = False


def _checksum(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + content).digest()
