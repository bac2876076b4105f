"""Write, read and compare config.yaml, the file with the settings of a command.

A run that continues must have the same decisive settings and the same input
files as before. Decisive settings are the settings that change the result. The
number of threads, for example, is not decisive.
"""

import hashlib
import json
import os
import platform
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from renderer.errors import InputError, single_line
from renderer.io.files import atomic_write
from train.command import program
from train.former_keys import rename_former_keys
from train.runs.saved_networks import selected_file
from train.settings import CIRCUMSTANCES, INPUTS, ExperimentSettings, dotted, mapped

CONFIG = "config.yaml"
# Packages whose versions config.yaml records, in addition to Python and torch.
PACKAGES = ("torchvision", "numpy")
# Settings that are not recorded with the command of a run, because each command
# that resumes the run sets them.
NOT_RECORDED = ("run=", "train.resume=")


@contextmanager
def opened_text(path: Path) -> Iterator[str]:
    """Read a text file, and report every error of reading and parsing as InputError.

    Args:
        path: File in UTF-8.

    Yields:
        Text of the file. Errors of the block are reported, too.

    Raises:
        InputError: If the file is missing or damaged. The message names it.
    """
    try:
        if not path.is_file():
            raise ValueError("there is no such file")
        yield path.read_text(encoding="utf-8")
    except Exception as error:
        raise InputError(
            f"{path} is damaged or of another kind ({single_line(error)}): use another run",
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Args:
        path: The file.

    Returns:
        Contents of the object, which is not empty.

    Raises:
        InputError: If the file is missing or damaged.
    """
    with opened_text(path) as text:
        return parse_object(text)


def parse_object(text: str) -> dict[str, Any]:
    """Parse a JSON object.

    Args:
        text: The object as JSON.

    Returns:
        Contents of the object, which is not empty.

    Raises:
        ValueError: If the text is no JSON, no object, or an empty object.
    """
    parsed = json.loads(text)
    if not isinstance(parsed, dict) or not parsed:
        raise ValueError("it holds no object of keys and values")
    return parsed


def read_config(path: Path) -> DictConfig:
    """Read a config.yaml that a command wrote.

    The file may come from someone else. Aliases are refused, because a few
    nested aliases can stand for more values than the memory holds.
    Interpolations are refused, because they can show the environment variables
    of the reader. Settings that had other names get their present names.

    Args:
        path: The file.

    Returns:
        The configuration.

    Raises:
        InputError: If the file is missing or damaged, or holds an alias or an
            interpolation.
    """
    with opened_text(path) as text:
        events = yaml.parse(text, yaml.SafeLoader)
        if "${" in text or any(isinstance(event, yaml.AliasEvent) for event in events):
            raise ValueError("it holds an alias or an interpolation")
        plain = yaml.safe_load(text)
        if not isinstance(plain, dict):
            raise ValueError("it holds no keys")
        rename_former_keys(plain)
        return OmegaConf.create(plain)


def write_config(folder: Path, settings: Any, **facts: object) -> None:
    """Write config.yaml with the settings, the facts, hashes of the inputs and versions.

    Args:
        folder: Folder of the file. If it does not exist, it is made.
        settings: Settings of the command, a dataclass.
        **facts: What the command found at its start, such as the hardware. A
            fact with an interpolation is left out, because `read_config`
            refuses interpolations. With the fact `command`, the file also
            records the folder in which the command was first given.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if "command" in facts:
        facts["working_folder"] = _working_folder(folder, str(facts["command"]))
    versions = {"python": platform.python_version(), "torch": str(torch.__version__)}
    versions |= {name: version(name) for name in PACKAGES}
    content = asdict(settings)
    content |= {name: fact for name, fact in facts.items() if "${" not in str(fact)}
    content |= {"inputs": fingerprints(settings), "versions": versions}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    atomic_write(folder / CONFIG, text.encode(), durable=True)


def _working_folder(folder: Path, command: str) -> str:
    """Return the folder in which a command was first given.

    Args:
        folder: Folder of the run, which may hold the config.yaml of an earlier
            command.
        command: Command line of this command. If it begins with the recorded
            command, it continues the run, and the recorded folder is returned.
    """
    with suppress(InputError):
        before = read_config(folder / CONFIG)
        if command.startswith(str(before.get("command"))):
            return before.get("working_folder") or os.getcwd()
    return os.getcwd()


def decisive_settings(settings: Any) -> dict[str, object]:
    """Select the settings that change the result of a run.

    Args:
        settings: Settings of a command, a dataclass or a DictConfig.

    Returns:
        Values by dotted key. A path inside the folder of the run starts with
        "<run>", so that a run that was moved has equal settings.
    """
    if isinstance(settings, DictConfig):
        plain: Any = OmegaConf.to_container(settings)
    else:
        plain = asdict(settings)
    moved = _move_paths(plain, str(plain.get("run")), "<run>")
    circumstances = tuple(f"{key}." for key in CIRCUMSTANCES)
    return {key: value for key, value in dotted(moved) if not f"{key}.".startswith(circumstances)}


def _move_paths(value: Any, folder: str, to: str) -> Any:
    """Replace a folder at the start of all paths in nested settings.

    Args:
        value: Settings as nested mappings and lists. Any text may be a path.
        folder: Folder to replace.
        to: Text that takes the place of the folder.
    """

    def move(text: str) -> str:
        is_inside = f"{text}/".startswith(f"{folder}/")
        return to + text.removeprefix(folder) if is_inside else text

    return mapped(value, move)


def given_command(overrides: Sequence[str]) -> str:
    """Format the command of a training run without the folder of the run.

    Args:
        overrides: Overrides of the run, such as "train.epochs=3".

    Returns:
        Command line.
    """
    return shlex.join([*program("train"), *_recorded(overrides)])


def _recorded(overrides: Sequence[str]) -> list[str]:
    """Return the overrides without run= and train.resume=, see NOT_RECORDED."""
    return [override for override in overrides if not override.startswith(NOT_RECORDED)]


def resumed(config: DictConfig, overrides: Sequence[str]) -> tuple[DictConfig, str]:
    """Combine the settings of an earlier run with the overrides of a command.

    Args:
        config: Configuration of the command. `config.run` is the folder of the
            earlier run.
        overrides: Overrides of the command. `config` has their values.

    Returns:
        Configuration, and the command that began the run followed by the new
        overrides.

    Raises:
        InputError: If the folder holds no training run.
    """
    folder = Path(config.run).absolute()
    saved: Any = {}
    if (folder / CONFIG).is_file():
        saved = OmegaConf.to_container(read_config(folder / CONFIG))
    if not isinstance(saved.get("train"), dict) or not isinstance(saved.get("run"), str):
        raise InputError(
            f"run={config.run} holds no run to resume: "
            "give the folder of one, or leave train.resume out",
        )
    names = [item.name for item in fields(ExperimentSettings)]
    settings = {name: saved[name] for name in names if name in saved}
    # The baselines of a run lie in folders below it. Their settings name the
    # folder of the whole run, and their paths need no change.
    if Path(saved["run"]) not in folder.parents:
        settings = _move_paths(settings, saved["run"], str(folder))
    merged = OmegaConf.create(settings)
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if key != "run":
            value = OmegaConf.select(config, key)
            OmegaConf.update(merged, key, value, merge=False, force_add=True)
    words = [*shlex.split(str(saved.get("command", ""))), *_recorded(overrides)]
    # A dictionary removes words that occur twice and keeps the order.
    return merged, shlex.join(dict.fromkeys(words))


def require_same_run(
    folder: Path,
    settings: ExperimentSettings,
    finished: bool = False,
) -> DictConfig:
    """Check that a training run in a folder has given settings and input files.

    A run that is not finished may get more epochs and another evaluation.

    Args:
        folder: Folder of the run.
        settings: Settings of the command.
        finished: Whether the run is finished.

    Returns:
        Configuration that the folder has.

    Raises:
        InputError: See `require_same`.
    """

    def is_permitted(key: str, old: Any, new: Any) -> bool:
        if finished:
            return False
        is_longer = key == "train.epochs" and isinstance(old, int) and new > old
        return is_longer or key.startswith("evaluate.")

    return require_same(folder, settings, "run= (sweep=)", is_permitted)


def require_same(
    folder: Path,
    settings: Any,
    elsewhere: str,
    permitted: Callable[[str, Any, Any], bool],
) -> DictConfig:
    """Check that the config.yaml of a folder has given decisive settings and input files.

    Args:
        folder: Folder with config.yaml.
        settings: Settings of the command, a dataclass.
        elsewhere: Setting that names the folder, for the error message.
        permitted: Function of a dotted key, its old value and its new value.
            It returns whether this change is allowed.

    Returns:
        Configuration that the folder has.

    Raises:
        InputError: If a decisive setting has another value and the change is
            not allowed, or if an input file has changed.
    """
    config = read_config(folder / CONFIG)
    # A setting that did not exist when the file was written has its default.
    before = decisive_settings(OmegaConf.structured(type(settings))) | decisive_settings(config)
    asked = decisive_settings(settings)
    for key in sorted(before.keys() | asked.keys()):
        old = before.get(key)
        new = asked.get(key)
        if old != new and not permitted(key, old, new):
            raise InputError(
                f"{folder} was made with {key}={old}, not {new}: "
                f"give its setting, or another folder with {elsewhere}",
            )
    hashes = config.get("inputs") or {}
    for path, fingerprint in fingerprints(settings).items():
        if hashes.get(path, fingerprint) != fingerprint:
            raise InputError(
                f"{path} has changed since {folder} began: "
                f"put it back, or start in another folder with {elsewhere}",
            )
    return config


def fingerprints(settings: Any) -> dict[str, str]:
    """Hash the input files that the settings name.

    Args:
        settings: Settings of a command, a dataclass.

    Returns:
        SHA-256 by path. For a file, the hash covers its contents. For the
        folder of a run, it covers the contents of the selected network. For
        any other folder, it covers the names and sizes of the files.
    """
    values = dict(dotted(asdict(settings)))
    texts = _collect_texts([values.get(key) for key in INPUTS])
    paths = {text.removeprefix("run:") for text in texts}
    return {path: _fingerprint(Path(path)) for path in sorted(paths) if os.path.exists(path)}


def _collect_texts(value: Any) -> set[str]:
    """Collect the texts of a setting that may be paths of input files.

    Args:
        value: A text, a mapping with the keys "mesh" and "props", or a list of
            these. All other values have no path.
    """
    if isinstance(value, dict):
        value = [value.get("mesh"), value.get("props")]
    if isinstance(value, list):
        return set().union(*map(_collect_texts, value))
    return {value} if isinstance(value, str) else set()


def _fingerprint(path: Path) -> str:
    """Hash a file or a folder, see `fingerprints`."""
    path = selected_file(path) or path
    if path.is_dir():
        files = [file for file in path.rglob("*") if file.is_file()]
        sizes = sorted((str(file.relative_to(path)), file.stat().st_size) for file in files)
        return hashlib.sha256(repr(sizes).encode(errors="surrogateescape")).hexdigest()
    return _content_hash(path, path.stat().st_size, path.stat().st_mtime_ns)


@cache
def _content_hash(path: Path, size: int, modified: int) -> str:
    """Hash the contents of a file. A new size or time of change renews the cached hash."""
    with open(path, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
