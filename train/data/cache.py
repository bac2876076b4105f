"""Cache of tensors on disk. The key of each file is a hash of all that the tensors depend on.

A file has a checksum, followed by the tensors in the safetensors format. A file
with a wrong checksum counts as missing, so files may be damaged or deleted at
any time. Several processes may use the folder at once.
"""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from renderer.io.files import atomic_write
from train import console

# Each file of the cache begins with a SHA-256 checksum, which has 32 bytes.
CHECKSUM_BYTES = 32


def cache_folder(choice: str | None) -> Path | None:
    """Return the folder of the cache that a user chooses.

    "auto" is a folder in $XDG_CACHE_HOME or ~/.cache, and None is no cache.
    """
    if not choice:
        return None
    if choice != "auto":
        return Path(os.path.expanduser(choice))
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches, "parametric-norm-balls") if os.path.isabs(caches) else None


def source_key(*packages: Path) -> str:
    """Hash the source code of packages.

    As part of the key of a cache, the hash makes cached results of other code
    unused. The versions of torch and NumPy count, too.
    """
    files = []
    for folder in packages:
        for path in folder.rglob("*.py"):
            name = path.relative_to(folder).as_posix()
            files.append((name, path))
    sources = [(name, path.read_bytes()) for name, path in sorted(files)]
    return content_hash([torch.__version__, np.__version__, sources])


def content_hash(state: Any) -> str:
    """Compute a SHA-256 hash of nested values, such as the content of a checkpoint.

    It depends on all keys, values, types and shapes.
    """
    digest = hashlib.sha256()
    _update(digest, state)
    return digest.hexdigest()


def _update(digest: Any, value: Any) -> None:
    """Add a value, with all values inside it, to a hash."""
    match value:
        case Tensor():
            on_cpu = value.detach().cpu().contiguous()
            digest.update(f"{on_cpu.dtype}{tuple(on_cpu.shape)}".encode())
            # The bytes of the tensor, without a copy.
            digest.update(on_cpu.flatten().view(torch.uint8).numpy().data)
        case Mapping():
            for key, item in value.items():
                digest.update(f"{key!r}:".encode())
                _update(digest, item)
        case list() | tuple():
            digest.update(f"[{len(value)}]".encode())
            for item in value:
                _update(digest, item)
        case _:
            digest.update(f"{value!r};".encode())


class TensorCache:
    """Cache of named tensors in the files of a folder.

    Args:
        folder: Folder of the cache. It is created at the first write. If
            writing fails, one warning is logged, and nothing more is written.
            None caches nothing.
    """

    def __init__(self, folder: Path | None = None):
        self.folder = folder
        self.writable = folder is not None

    def read(self, key: str) -> dict[str, Tensor] | None:
        """Read the tensors that were written under a key.

        None if there is no such file, or if it is damaged.
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
        """Write tensors under a key.

        Other processes never read a partly written file: they read the old file
        or the new one.
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
    """Return the SHA-256 checksum of the key and the content of a file of the cache."""
    return hashlib.sha256(key.encode() + content).digest()
