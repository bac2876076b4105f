"""Ways to make a file hostile: each gives what changes the file at a path."""

import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from train.run_folder import checkpoint

Edit = Callable[[Path], object]
CODE_RAN = "CODE_RAN"  # a file that appears where a command runs code from its input


def replaced(change: Callable[[bytes], bytes]) -> Edit:
    return lambda path: path.write_bytes(change(path.read_bytes()))


def instead(make: Edit) -> Edit:
    """Something else by the file's name."""

    def edit(path: Path) -> None:
        path.unlink()
        make(path)

    return edit


def content(text: str | bytes) -> Edit:
    return lambda path: path.write_bytes(text.encode() if isinstance(text, str) else text)


def swapped(old: str, new: str, pipe: str | None = None) -> Edit:
    """With one text for another; pipe: a named pipe to make beside. ValueError where the text is not there."""

    def edit(path: Path) -> None:
        text = path.read_text()
        text.index(old)
        path.write_text(text.replace(old, new, 1))
        if pipe:
            os.mkfifo(path.with_name(pipe))

    return edit


def flipped(seed: int | np.random.Generator) -> Edit:
    """Five bytes, wherever: one of padding that nobody reads may be among them, but not five."""

    def change(whole: bytes) -> bytes:
        changed, rng = bytearray(whole), np.random.default_rng(seed)
        for place in rng.integers(0, len(changed), 5):
            changed[place] ^= rng.integers(1, 256)
        return bytes(changed)

    return replaced(change)


def at(*keys: str | int, value: object) -> Callable[[dict[str, Any]], None]:
    """Sets a value in nested mappings and lists."""

    def change(tree: dict[str, Any]) -> None:
        node: Any = tree
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value

    return change


def in_json(*keys: str | int, value: object) -> Edit:
    def edit(path: Path) -> None:
        tree = json.loads(path.read_text())
        at(*keys, value=value)(tree)
        path.write_text(json.dumps(tree))

    return edit


def in_checkpoint(*keys: str, value: object) -> Edit:
    """With a hash that is right."""

    def edit(path: Path) -> None:
        state = checkpoint.load(path)
        at(*keys, value=value)(state)
        checkpoint.save(path, state)

    return edit


def nan_weights(path: Path) -> None:
    state = checkpoint.load(path)
    state["model"]["stem.weight"].fill_(torch.nan)
    checkpoint.save(path, state)


def pickled_code(path: Path) -> None:
    class Code:
        def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
            return os.system, (f"touch {CODE_RAN}",)

    torch.save(Code(), path)


def safetensors(**header: object) -> Edit:
    """A file that ends after the header."""
    text = json.dumps(header).encode()
    return content(struct.pack("<Q", len(text)) + text)


def array(values: np.ndarray) -> Edit:
    return lambda path: np.save(path, values, allow_pickle=values.dtype == object)


def npy_header(shape: str) -> Edit:
    """A file that ends after the header."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return content(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)


def arrays(**changed: np.ndarray | None) -> Edit:
    """With some arrays of an .npz file in other form, or without them."""

    def edit(path: Path) -> None:
        with np.load(path) as archive:
            whole = {name: archive[name] for name in archive.files} | changed
        np.savez(path, **{name: values for name, values in whole.items() if values is not None})

    return edit


def zip_bomb(path: Path) -> None:
    """Arrays of 10 TB, by their headers, in a small file."""
    header = BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (10**13,)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("train_images", "train_labels", "test_images", "test_labels", "classes"):
            archive.writestr(f"{name}.npy", header.getvalue() + bytes(10**6))


def image(mode: str, size: tuple[int, int], kind: str = "PNG") -> Edit:
    return lambda path: Image.new(mode, size).save(path, format=kind)


def png_header(width: int, height: int) -> Edit:
    """A small file that says it is a huge image."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return content(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(10**6))) + chunk(b"IEND", b""))


def ply(vertices: int, rows: str) -> Edit:
    lines = ["ply", "format ascii 1.0", f"element vertex {vertices}", *(f"property float {axis}" for axis in "xyz")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", rows]
    return content("\n".join(lines))
