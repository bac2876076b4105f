"""Write, read and compare config.yaml, the file with the settings of a command.

A run that continues must have the same decisive settings and the same input
files as before. Decisive settings are the settings that change the result. The
number of threads, for example, is not decisive.
"""

import os
import platform
import shlex
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from renderer.errors import InputError
from renderer.io.files import atomic_write
from train.run_folder import opened_text
from train.settings import CIRCUMSTANCES, ExperimentSettings, dotted
from train.system import program

CONFIG = "config.yaml"
# Packages whose versions config.yaml records, in addition to Python and torch.
PACKAGES = ("torchvision", "numpy")
# Arguments that are left out when the command line of a run is recorded. Whoever
# resumes the run gives other values.
NOT_RECORDED = ("out=", "train.resume=")


def read_config(path: Path) -> DictConfig:
    """Read a config.yaml that a command wrote.

    The file may come from someone else. YAML aliases are refused, because a few
    nested aliases can stand for more values than fit into memory.
    Interpolations such as "${oc.env:HOME}" are refused, because they can reveal
    environment variables.
    """
    # `opened_text` turns any error in its block into an InputError that names the file.
    with opened_text(path) as text:
        events = yaml.parse(text, yaml.SafeLoader)
        if "${" in text or any(isinstance(event, yaml.AliasEvent) for event in events):
            raise ValueError("it holds an alias or an interpolation")
        plain = yaml.safe_load(text)
        if not isinstance(plain, dict):
            raise ValueError("it holds no keys")
        return OmegaConf.create(plain)


def write_config(folder: Path, settings: Any, **facts: object) -> None:
    """Write config.yaml: settings, facts, hashes of the input files, and versions of packages.

    A fact that contains "${" is left out, because `read_config` refuses it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if "command" in facts:
        facts["working_folder"] = _working_folder(folder, str(facts["command"]))
    # These imports are here because results of runs are read without torch.
    from torch import __version__ as torch_version

    from train.fingerprints import fingerprints

    versions = {"python": platform.python_version(), "torch": str(torch_version)}
    versions |= {name: version(name) for name in PACKAGES}
    content = asdict(settings)
    content |= {name: fact for name, fact in facts.items() if "${" not in str(fact)}
    content |= {"inputs": fingerprints(settings), "versions": versions}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    atomic_write(folder / CONFIG, text.encode(), durable=True)


def _working_folder(folder: Path, command: str) -> str:
    """Return the folder in which the command of a run was started for the first time.

    A command that begins with the recorded command continues the run.
    """
    with suppress(InputError):
        recorded = read_config(folder / CONFIG)
        if command.startswith(str(recorded.get("command"))):
            return recorded.get("working_folder") or os.getcwd()
    return os.getcwd()


def decisive_settings(settings: Any) -> dict[str, object]:
    """Select the settings that decide the result of a run.

    The number of threads, for example, is left out. In paths, "<run>" stands for
    the folder of the run. A run whose folder was moved then has equal settings. The keys are
    dotted, such as "train.epochs".
    """
    if isinstance(settings, DictConfig):
        nested: Any = OmegaConf.to_container(settings)
    else:
        nested = asdict(settings)
    nested = _move_paths(nested, str(nested.get("out")), "<run>")
    # Each key gets a dot at its end, so that "out" does not match "outer".
    circumstances = tuple(f"{key}." for key in CIRCUMSTANCES)
    decisive = {}
    for key, value in dotted(nested):
        if not f"{key}.".startswith(circumstances):
            decisive[key] = value
    return decisive


def _move_paths(value: Any, folder: str, to: str) -> Any:
    """Replace the path of a folder at the start of all texts in nested settings."""

    def move(text: str) -> str:
        is_inside = f"{text}/".startswith(f"{folder}/")
        return to + text.removeprefix(folder) if is_inside else text

    return mapped(value, move)


def format_command(overrides: Sequence[str]) -> str:
    """Format the command line of a training run, as config.yaml records it."""
    return shlex.join([*program("train"), *_recorded(overrides)])


def _recorded(overrides: Sequence[str]) -> list[str]:
    """Return the arguments of a command that config.yaml records.

    The folder of the run and the request to resume it are left out.
    """
    return [override for override in overrides if not override.startswith(NOT_RECORDED)]


def resume_config(config: DictConfig, overrides: Sequence[str]) -> tuple[DictConfig, str]:
    """Combine the settings of an earlier run with the arguments of a command that resumes it.

    Return the configuration, and the recorded command followed by the new arguments.
    """
    # This import takes a fifth of a second, and only a resumed run needs it.
    from hydra.core.override_parser.overrides_parser import OverridesParser

    folder = Path(config.out).absolute()
    recorded = _read_recorded(folder)
    names = [item.name for item in fields(ExperimentSettings)]
    settings = {name: recorded[name] for name in names if name in recorded}
    # If the folder was moved, the paths of its files have changed. A baseline, which was
    # trained for comparison, lies in a sub-folder of the recorded folder, and was not moved.
    is_below_recorded = Path(recorded["out"]) in folder.parents
    if not is_below_recorded:
        settings = _move_paths(settings, recorded["out"], str(folder))
    merged = OmegaConf.create(settings)
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if key != "out":
            value = OmegaConf.select(config, key)
            OmegaConf.update(merged, key, value, merge=False, force_add=True)
    words = [*shlex.split(str(recorded.get("command", ""))), *_recorded(overrides)]
    # A dictionary has each word once, in the same order.
    return merged, shlex.join(dict.fromkeys(words))


def _read_recorded(folder: Path) -> dict[str, Any]:
    """Read the config.yaml of a training run that is to be resumed."""
    recorded: Any = {}
    if (folder / CONFIG).is_file():
        recorded = OmegaConf.to_container(read_config(folder / CONFIG))
    is_training = isinstance(recorded.get("train"), dict)
    if not is_training or not isinstance(recorded.get("out"), str):
        raise InputError(
            f"out={folder} holds no run to resume: "
            "give the folder of a training run, or leave train.resume out",
        )
    return recorded


def require_same_run(
    folder: Path,
    settings: ExperimentSettings,
    finished: bool = False,
) -> DictConfig:
    """Check that the training run in a folder has the settings and input files of a command.

    The command may give a run that is not finished more epochs, and other
    photographs to score.
    """

    def is_permitted(key: str, old: Any, new: Any) -> bool:
        if finished:
            return False
        is_longer = key == "train.epochs" and isinstance(old, int) and new > old
        return is_longer or key.startswith(("evaluate.", "photos"))

    return require_same(folder, settings, "out= (sweep=)", is_permitted)


def require_same(
    folder: Path,
    settings: Any,
    elsewhere: str,
    is_permitted: Callable[[str, Any, Any], bool],
) -> DictConfig:
    """Check that an earlier command wrote a folder with the same settings and input files.

    Only settings that decide the result are compared (see `decisive_settings`). `is_permitted` gets
    the dotted key, the old value and the new value of a setting that differs. Return the recorded
    configuration.
    """
    config = read_config(folder / CONFIG)
    # A setting that the earlier version did not have has its default value.
    defaults = OmegaConf.structured(type(settings))
    before = decisive_settings(defaults) | decisive_settings(config)
    now = decisive_settings(settings)
    for key in sorted(before.keys() | now.keys()):
        old = before.get(key)
        new = now.get(key)
        if old != new and not is_permitted(key, old, new):
            raise InputError(
                f"{folder} was made with {key}={old}, not {new}: "
                f"set {key} to the former value, or choose another folder with {elsewhere}",
            )
    hashes = config.get("inputs") or {}
    from train.fingerprints import fingerprints

    for path, fingerprint in fingerprints(settings).items():
        if hashes.get(path, fingerprint) != fingerprint:
            raise InputError(
                f"{path} has changed since {folder} began: "
                f"put it back, or start in another folder with {elsewhere}",
            )
    return config


def mapped(value: Any, change: Callable[[str], str]) -> Any:
    """Return a copy of nested settings in which a function has replaced each text.

    Keys of dictionaries and values other than texts stay the same.
    """
    if isinstance(value, dict):
        return {key: mapped(item, change) for key, item in value.items()}
    if isinstance(value, list):
        return [mapped(item, change) for item in value]
    return change(value) if isinstance(value, str) else value
