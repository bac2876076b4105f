"""Hashes of tensors and plain values."""

import hashlib
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


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
