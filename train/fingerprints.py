"""Fingerprints of input files, by which a stopped command notices that they have changed."""

import hashlib
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from train.checkpoints import selected_file
from train.data.photographs import visible_files
from train.networks import PYTHON
from train.settings import dotted, published

# The files of a folder with more bytes are not read. Their sizes and times count instead.
MAX_FOLDER_BYTES = 2**32
# What a line of a .obj, .mtl or .ply file says before the path of another file, and such a path in
# a .gltf file.
REFERENCE = re.compile(
    rb"^[ \t]*(?:mtllib|map_\w+|bump|norm|disp|refl|comment TextureFile)[ \t]+(.+?)[ \t\r]*$"
    rb'|"uri"\s*:\s*"([^"]{1,1000})"',
    re.MULTILINE | re.IGNORECASE,
)
REFERRING = (".obj", ".mtl", ".ply", ".gltf")
# Settings that can name input files. Their hashes are recorded with a run.
INPUTS = (
    *(
        "data.path",
        "weights",
        "classes",
        "augment.folder",
        "augment.vary.environments",
        "augment.vary.backgrounds",
        "augment.vary.camera.slides",
        "scene.projector.pattern",
        "scene.lamps.start",
        "scene.backgrounds",
        "scene.light",
    ),
    *("network", "hardened", "meshes", "hard_negatives", "environments", "photos", "laboratory"),
    "unlabeled",
)


def fingerprints(settings: Any) -> dict[str, str]:
    """Compute the fingerprint of each input file and folder that the settings of a command name.

    The fingerprint of a training run covers its selected network, that of a mesh its materials and
    textures, and that of a network python:MODULE:FUNCTION the file of the module.
    """
    values = dict(dotted(asdict(settings)))
    texts = _collect_texts([values.get(key) for key in INPUTS]) - {""}
    paths = {text.removeprefix("run:"): _path_of(text) for text in sorted(texts)}
    return {name: _fingerprint(path) for name, path in paths.items() if path.exists()}


def _path_of(text: str) -> Path:
    """Return the file or folder that a setting such as run:FOLDER names, which may be missing."""
    if text.startswith(PYTHON):
        module = text.removeprefix(PYTHON).partition(":")[0]
        # `find_spec` imports the packages above the module.
        with suppress(Exception):
            spec = find_spec(module)
            if spec and spec.origin:
                return Path(spec.origin)
    return published(Path(text.removeprefix("run:")))


def _collect_texts(value: Any) -> set[str]:
    """Collect the texts in a setting that may be paths of input files.

    An object can have a "mesh" and "props", which are other meshes beside it.
    """
    if isinstance(value, dict):
        value = [value.get("mesh"), value.get("props")]
    if isinstance(value, list):
        texts: set[str] = set()
        for item in value:
            texts |= _collect_texts(item)
        return texts
    return {value} if isinstance(value, str) else set()


def _fingerprint(path: Path) -> str:
    """Compute the fingerprint of a file, of a training run or of another folder that exists."""
    path = selected_file(path) or path
    if path.is_dir():
        return _hash_contents(path)
    companions = [(str(name), _hash_file(name)) for name in sorted(_companions(path))]
    return _hash([_hash_file(path), *companions]) if companions else _hash_file(path)


def _hash_contents(folder: Path) -> str:
    """Hash the names and contents of the files of a folder, or their times if it is too large."""
    paths = sorted(map(str, visible_files(folder)))
    files = [(path, folder / path) for path in paths if (folder / path).is_file()]
    statuses = [file.stat() for _, file in files]
    if sum(status.st_size for status in statuses) > MAX_FOLDER_BYTES:
        times = [(status.st_size, status.st_mtime_ns) for status in statuses]
        return _hash([*zip(paths, times, strict=False)])
    return _hash([(path, _hash_file(file)) for path, file in files])


def _companions(mesh: Path) -> set[Path]:
    """Find the materials, textures and buffers that a mesh file or its materials name."""
    if mesh.suffix.lower() not in REFERRING:
        return set()
    found = set()
    for name in _references(mesh.read_bytes()):
        for file in (mesh.parent / name, mesh.parent / Path(name).name):
            with suppress(OSError, ValueError):  # The name is too long or has a NUL.
                if file.is_file() and file != mesh:
                    found.add(file)
    return found.union(*(_companions(file) for file in found if file.suffix.lower() == ".mtl"))


def _references(content: bytes) -> Iterator[str]:
    """Yield what may be the path of another file: each end of a line that has options before it."""
    for line, uri in REFERENCE.findall(content):
        words = unquote((line or uri).decode(errors="replace")).replace("\\", "/").split(" ")
        yield from (" ".join(words[start:]).strip('"') for start in range(len(words)))


def _hash(value: object) -> str:
    """Compute the SHA-256 of the representation of a plain value."""
    return hashlib.sha256(repr(value).encode(errors="surrogateescape")).hexdigest()


def _hash_file(path: Path) -> str:
    """Compute the SHA-256 of a file."""
    status = path.stat()
    return _hash_version(path, status.st_size, status.st_mtime_ns)


@cache
def _hash_version(path: Path, size: int, modified: int) -> str:
    """Compute the SHA-256 of a file, once for each of its sizes and times of change."""
    with open(path, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
