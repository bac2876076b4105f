"""Whether a run can go on, or is done: by what decides its result, its settings and, by content, its input files."""

import hashlib
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from renderer.errors import InputError
from train.command_line.configuration import as_dict, dotted, is_within
from train.run_folder.files import CONFIG, read_config
from train.settings import ExperimentSettings

# Where, how and with what a run was made: these do not decide its result, nor name a sweep's cell.
CIRCUMSTANCES = (
    *("run", "sweep", "launcher", "compare", "versions", "inputs", "hardware", "renderer.cache"),
    *("train.resume", "train.device", "train.threads", "train.compile", "train.checkpoint_every"),
)
INPUTS = "inputs"  # in a run's config.yaml
KEYS = (
    "data.path",
    "scene.meshes",
    "scene.hard_negatives",
    "scene.backgrounds",
    "scene.light",
    "augment.vary.environments",
)


def decisive_settings(config: DictConfig) -> dict[str, object]:
    """What decides a run's result, by dotted key: all but the circumstances, with `${run}` for its own folder."""
    settings = as_dict(config, resolve=True)
    own = re.compile(f"^{re.escape(str(settings.get('run')))}(?=/|$)")
    return {
        key: own.sub("${run}", value) if isinstance(value, str) else value
        for key, value in dotted(settings)
        if not is_within(key, CIRCUMSTANCES)
    }


def differing_settings(folder: Path, config: DictConfig) -> Iterator[tuple[str, Any, Any]]:
    """The decisive keys in which the run in a folder and a configuration differ, with both values.

    A key that the run is older than has its default.
    """
    defaults = decisive_settings(OmegaConf.structured(ExperimentSettings))
    found, asked = ({**defaults, **decisive_settings(each)} for each in (read_config(folder / CONFIG), config))
    for key in sorted(found.keys() | asked.keys()):
        if found.get(key) != asked.get(key):
            yield key, found.get(key), asked.get(key)


def require_same_settings(folder: Path, config: DictConfig) -> None:
    """InputError where the run in a folder cannot go on under a configuration; with more epochs it can.

    Nor does what comes after training have to be the same.
    """
    for key, found, asked in differing_settings(folder, config):
        longer = key == "train.epochs" and isinstance(found, int) and asked > found
        if not longer and not key.startswith("evaluate."):
            raise InputError(
                f"run={folder} was trained with {key}={found}, and train.resume=true asks for {asked}: resume with the "
                f"settings of {folder / CONFIG}, or start in another folder with run="
            )


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
            yield from _paths([value.get("mesh"), value.get("props")])


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
