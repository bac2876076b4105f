"""Hashes of tensors and plain values."""

import hashlib
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


def content_hash(state: Any) -> str:
    """Compute the SHA-256 of keys, types, shapes and values.

    Args:
        state: A tensor, a plain value, or nested mappings and sequences of these.

    Returns:
        The hash as 64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    _update(digest, state)
    return digest.hexdigest()


def _update(digest: Any, value: Any) -> None:
    """Add a value to a hash.

    Args:
        digest: Hash of hashlib, which is changed.
        value: A tensor, a mapping, a list, a tuple, or a plain value.
    """
    match value:
        case Tensor():
            plain = value.detach().cpu().contiguous()
            digest.update(f"{plain.dtype}{tuple(plain.shape)}".encode())
            digest.update(plain.flatten().view(torch.uint8).numpy().data)
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
