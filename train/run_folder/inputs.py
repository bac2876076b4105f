"""The files that a run's result depends on, known by their content: nobody goes on with others of the same names."""

import hashlib
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from renderer.errors import InputError
from train.command_line.configuration import as_dict, dotted
from train.run_folder.files import CONFIG, read_config

INPUTS = "inputs"  # in a run's config.yaml
KEYS = ("data.path", "scene.meshes", "scene.look_alikes", "scene.backgrounds", "scene.light", "augment.vary.lights")


def fingerprints(config: DictConfig) -> dict[str, str]:
    """By path, of every file and folder that KEYS name: SHA-256 of a file, or of a folder's names and sizes."""
    settings = dict(dotted(as_dict(config, resolve=True)))
    paths = {path for key in KEYS for path in _paths(settings.get(key)) if os.path.exists(path)}
    return {path: _of_folder(path) if os.path.isdir(path) else _of_file(path, _version(path)) for path in sorted(paths)}


def require_same_inputs(folder: Path, config: DictConfig) -> None:
    """InputError naming a file that is not what the run in the folder began with; of older runs that is not known."""
    known = read_config(folder / CONFIG).get(INPUTS)
    for path, found in fingerprints(config).items():
        if isinstance(known, DictConfig) and known.get(path, found) != found:
            raise InputError(
                f"{path} is not what {folder} was trained with: put that back, or start in another folder with run= "
                "(sweep=)"
            )


def _paths(value: Any) -> Iterator[str]:
    """What may be one in a setting: text, or the meshes of a mapping."""
    match value:
        case str():
            yield value
        case list():
            for item in value:
                yield from _paths(item)
        case dict():
            yield from _paths([value.get("mesh"), value.get("beside")])


def _of_folder(path: str) -> str:
    files = sorted(
        (str(file.relative_to(path)), file.stat().st_size) for file in Path(path).rglob("*") if file.is_file()
    )
    return hashlib.sha256(repr(files).encode(errors="surrogateescape")).hexdigest()


def _version(path: str) -> tuple[int, ...]:
    """Another one where a file has been written to."""
    found = os.stat(path)
    return found.st_ino, found.st_size, found.st_mtime_ns


@cache
def _of_file(path: str, _: tuple[int, ...]) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
