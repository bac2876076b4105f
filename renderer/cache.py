"""Rendered tensors on disk, from run to run: each file under a hash of all that went into it.

A file is a checksum and then the tensors in the safetensors format. It is parsed only if the checksum holds. So a
damaged file is computed anew, as is everything after a change to the renderer's code; any file may be deleted at any
time, and processes may share the folder.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from renderer.camera import Camera
from renderer.image import ImageSettings
from renderer.light.basis import HARMONICS, Basis
from renderer.mesh import Mesh
from renderer.rasterizer import Rasterizer
from renderer.transfer import TENSORS, TransferOperator, build_operators
from renderer.transport.local import SparseTransfer


def cache_folder(choice: str | None) -> Path | None:
    """The folder that `renderer.cache` chooses: "auto" is the user's (XDG_CACHE_HOME or ~/.cache), or None without a
    home; None is no cache."""
    if choice != "auto":
        return Path(os.path.expanduser(choice)) if choice else None
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches, "parametric-norm-balls") if os.path.isabs(caches) else None


def content_key(*parts: object) -> str:
    """SHA-256, in hexadecimal, of arrays (type, shape and bytes), plain values, and sequences and data classes of such.
    TypeError for anything else, since a key that misses a change would be worse than no key."""
    digest = hashlib.sha256()
    for part in parts:
        if is_dataclass(part):
            part = (type(part).__name__, *(getattr(part, field.name) for field in fields(part)))
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str}{part.shape};".encode())
            digest.update(np.ascontiguousarray(part).data)
        elif isinstance(part, tuple | list):
            digest.update(content_key(*part).encode())
        elif isinstance(part, str | bytes | int | float | torch.dtype):
            digest.update(f"{part!r};".encode())
        else:
            raise TypeError(f"a {type(part).__name__} has no content key")
    return digest.hexdigest()


def source_key(*packages: Path) -> str:
    """Hash of the Python files in folders, and of the versions of torch and NumPy."""
    files = [(path.relative_to(folder).as_posix(), path) for folder in packages for path in folder.rglob("*.py")]
    return content_key(torch.__version__, np.__version__, *((name, path.read_bytes()) for name, path in sorted(files)))


RENDERER = source_key(Path(__file__).parent)  # on import, so that it is the code that runs


class TensorCache:
    """Named tensors in files of a folder, under content keys.

    folder: made when first written to; None: nothing is written. Where it cannot be written to, a warning is logged,
    and the run goes on, since everything can be computed again.
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
            with tempfile.TemporaryDirectory(dir=self.folder) as temporary:
                file = Path(temporary) / key
                file.write_bytes(_checksum(key, content) + content)
                os.replace(file, self.folder / key)
        except OSError as error:
            logging.getLogger(__name__).warning("renders are not cached: %s", error)
            self.writable = False


def _checksum(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + content).digest()


class OperatorCache(TensorCache):
    """Transfer operators, a file per mesh and view: 5 views find those that a run with 10 has built."""

    def operators(
        self,
        mesh: Mesh,
        cameras: Sequence[Camera],
        settings: ImageSettings,
        rasterizer: Rasterizer,
        albedo_scale: float = 1.0,
        basis: Basis = HARMONICS,
        dtype: torch.dtype = torch.float32,
    ) -> list[TransferOperator]:
        """`transfer.build_operators`, to the bit, but only the views that are not on disk are built."""
        scene = content_key(RENDERER, mesh, settings, rasterizer.name, float(albedo_scale), basis, dtype)
        keys = {camera: content_key(scene, camera) for camera in cameras}
        files = {camera: self.read(key) for camera, key in keys.items()}
        missing = [camera for camera, tensors in files.items() if tensors is None]
        new = build_operators(mesh, missing, settings, rasterizer, albedo_scale, basis, dtype) if missing else []
        operators = dict(zip(missing, new, strict=True))
        for camera, operator in operators.items():
            added = operator.sparse._asdict() if operator.sparse else {}
            self.write(keys[camera], {name: getattr(operator, name) for name in TENSORS} | added)
        for camera, tensors in files.items():
            if tensors is not None:
                parts = [tensors.pop(name) for name in SparseTransfer._fields if name in tensors]
                sparse = SparseTransfer(*parts) if parts else None
                operators[camera] = TransferOperator(**tensors, settings=settings, basis=basis, sparse=sparse)
        return [operators[camera] for camera in cameras]
