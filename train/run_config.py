"""Write, read and compare config.yaml, the file with the settings of a command.

A run that continues must have the same decisive settings and the same input
files as before. Decisive settings are the settings that change the result. The
number of threads, for example, is not decisive. Fingerprints (hashes) tell whether
input files have changed.
"""

import hashlib
import os
import platform
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from augment.settings import PYTHON, split_function
from renderer.errors import InputError
from renderer.io.files import atomic_write
from train.run_folder import opened_text
from train.settings import CIRCUMSTANCES, ExperimentSettings, dotted, published_folder
from train.system import YAML_LOADER, program

CONFIG = "config.yaml"
# Arguments that are left out when the command line of a run is recorded. Whoever
# resumes the run gives other values.
NOT_RECORDED = ("out=", "train.resume=")
# The files of a folder with more bytes are not read. Their sizes and times count instead.
MAX_FOLDER_BYTES = 2**32
# Settings that can name input files. Their hashes are recorded with a run.
INPUTS = (
    *("data.path", "weights", "classes", "scene.backgrounds", "scene.light", "augment.folder"),
    *("augment.vary.environments", "augment.vary.backgrounds", "augment.vary.camera.slides"),
    *("scene.projector.pattern", "scene.lamps.start", "unlabeled", "network", "hardened"),
    *("meshes", "hard_negatives", "environments", "photos", "laboratory", "model.name"),
)


def read_config(path: Path) -> DictConfig:
    """Read a config.yaml that a command wrote.

    The file may come from someone else. YAML aliases are refused, because a few
    nested aliases can stand for more values than fit into memory.
    Interpolations such as "${oc.env:HOME}" are refused, because they can reveal
    environment variables.
    """
    # `opened_text` turns any error in its block into an InputError that names the file.
    with opened_text(path) as text:
        events = yaml.parse(text, YAML_LOADER)
        if "${" in text or any(isinstance(event, yaml.AliasEvent) for event in events):
            raise ValueError("it holds an alias or an interpolation")
        plain = yaml.load(text, YAML_LOADER)
        if not isinstance(plain, dict):
            raise ValueError("it holds no keys")
        return OmegaConf.create(plain)


def write_config(folder: Path, settings: Any, **facts: object) -> None:
    """Write config.yaml: settings, facts, hashes of the input files, and versions of packages.

    A fact that contains "${" is left out, because `read_config` refuses it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # Relative paths in the command are relative to this folder.
    facts["working_folder"] = os.getcwd()
    # This import is here because results of runs are read without torch.
    from torch import __version__ as torch_version

    versions = {name: version(name) for name in ("torchvision", "numpy")}
    versions |= {"python": platform.python_version(), "torch": str(torch_version)}
    content = asdict(settings)
    content |= {name: fact for name, fact in facts.items() if "${" not in str(fact)}
    content |= {"inputs": fingerprints(settings), "versions": versions}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    atomic_write(folder / CONFIG, text.encode(), durable=True)


def decisive_settings(settings: Any) -> dict[str, object]:
    """Select the settings that decide the result of a run.

    The number of threads, for example, is left out. In paths, "<run>" stands for
    the folder of the run. A run whose folder was moved then has equal settings. The keys are
    dotted, such as "train.epochs".
    """
    is_config = isinstance(settings, DictConfig)
    nested: Any = OmegaConf.to_container(settings) if is_config else asdict(settings)
    nested = _move_paths(nested, str(nested.get("out")), "<run>")
    # Each key gets a dot at its end, so that "out" does not match "outer".
    circumstances = tuple(f"{key}." for key in CIRCUMSTANCES)
    return {key: value for key, value in dotted(nested) if not f"{key}.".startswith(circumstances)}


def _move_paths(value: Any, folder: str, to: str) -> Any:
    """Replace the path of a folder at the start of all texts in nested settings."""

    def move(text: str) -> str:
        return to + text.removeprefix(folder) if f"{text}/".startswith(f"{folder}/") else text

    return mapped(value, move)


def format_command(overrides: Sequence[str]) -> str:
    """Format the command line of a training run, as config.yaml records it.

    The folder of the run and the request to resume it are left out.
    """
    recorded = [override for override in overrides if not override.startswith(NOT_RECORDED)]
    return shlex.join([*program("train"), *recorded])


def resume_config(config: DictConfig, overrides: Sequence[str]) -> tuple[DictConfig, str]:
    """Combine the settings of an earlier run with the arguments of a command that resumes it.

    Return the configuration, and the recorded command followed by the new arguments.
    """
    # This import takes a fifth of a second, and only a resumed run needs it.
    from hydra.core.override_parser.overrides_parser import OverridesParser

    folder = Path(config.out).absolute()
    recorded: Any = {}
    if (folder / CONFIG).is_file():
        recorded = OmegaConf.to_container(read_config(folder / CONFIG))
    if not isinstance(recorded.get("train"), dict) or not isinstance(recorded.get("out"), str):
        raise InputError(f"out={folder} holds no run: give another, or no train.resume")
    names = [item.name for item in fields(ExperimentSettings)]
    settings = {name: recorded[name] for name in names if name in recorded}
    # If the folder was moved, the paths of its files have changed. A baseline, which was
    # trained for comparison, lies in a sub-folder of the recorded folder, and was not moved.
    if Path(recorded["out"]) not in folder.parents:
        settings = _move_paths(settings, recorded["out"], str(folder))
    merged = OmegaConf.create(settings)
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if key != "out":
            value = OmegaConf.select(config, key)
            OmegaConf.update(merged, key, value, merge=False, force_add=True)
    words = shlex.split(str(recorded.get("command", "")))
    words += [override for override in overrides if not override.startswith(NOT_RECORDED)]
    # A dictionary has each word once, in the same order.
    return merged, shlex.join(dict.fromkeys(words))


def require_same_run(folder: Path, settings: ExperimentSettings, done: bool = False) -> DictConfig:
    """Check that the training run in a folder has the settings and input files of a command.

    The command may give a run that is not finished more epochs, and other
    photographs to score.
    """

    def is_permitted(key: str, old: Any, new: Any) -> bool:
        is_longer = key == "train.epochs" and new > old
        # A finished run may not differ at all.
        return not done and (is_longer or key.startswith(("evaluate.", "photos")))

    return require_same(folder, settings, "out= (sweep=)", is_permitted)


def require_same(
    folder: Path, settings: Any, elsewhere: str, is_permitted: Callable[[str, Any, Any], bool]
) -> DictConfig:
    """Check that an earlier command wrote a folder with the same settings and input files.

    Only settings that decide the result are compared (see `decisive_settings`). `is_permitted` gets
    the dotted key, the old value and the new value of a setting that differs. Return the recorded
    configuration.
    """
    config = read_config(folder / CONFIG)
    # A setting that the earlier version did not have has its default value.
    before = decisive_settings(OmegaConf.structured(type(settings))) | decisive_settings(config)
    now = decisive_settings(settings)
    for key in sorted(before.keys() | now.keys()):
        old, new = before.get(key), now.get(key)
        if old != new and not is_permitted(key, old, new):
            advice = f"set it so, or another {elsewhere}"
            raise InputError(f"{folder} was made with {key}={old}, not {new}: {advice}")
    require_same_inputs(folder, settings, config, elsewhere)
    return config


def require_same_inputs(
    folder: Path, settings: Any, recorded: Mapping[Any, Any], elsewhere: str
) -> None:
    """Check that input files are as when a folder began, by the fingerprints in its facts."""
    for path, fingerprint in fingerprints(settings).items():
        if recorded.get("inputs", {}).get(path, fingerprint) != fingerprint:
            advice = f"put it back, or set another {elsewhere}"
            raise InputError(f"{path} has changed since {folder} began: {advice}")


def require_same_weights(
    folder: Path, hashes: Mapping[str, str], names: Mapping[str, str], recorded: Mapping[Any, Any]
) -> None:
    """Check that networks have the weights with which a folder began, by the hashes in its facts.

    The networks are found by the same keys in `hashes`, in `names` and in the facts.
    """
    for key, found in hashes.items():
        if recorded.get("hashes", {}).get(key, found) != found:
            fault = f"{names[key]} has other weights than when {folder} began"
            raise InputError(f"{fault}: put them back, or set another out=")


def mapped(value: Any, change: Callable[[str], str]) -> Any:
    """Return a copy of nested settings in which a function has replaced each text.

    Keys of dictionaries and values other than texts stay the same.
    """
    if isinstance(value, dict):
        return {key: mapped(item, change) for key, item in value.items()}
    if isinstance(value, list):
        return [mapped(item, change) for item in value]
    return change(value) if isinstance(value, str) else value


def fingerprints(settings: Any) -> dict[str, str]:
    """Compute the fingerprint of each input file and folder that the settings of a command name.

    The fingerprint of a training run covers its selected network, that of a mesh its materials and
    textures, and that of a function, such as python:MODULE:FUNCTION, the file of its module.
    """
    # Values of the settings by their dotted keys. Those of INPUTS may name files.
    values = dict(dotted(asdict(settings)))
    # The folders of photos={NAME: FOLDER} have keys such as photos.NAME.
    others = [value for key, value in values.items() if key.startswith("photos.")]
    if values.get("decode"):
        others.append(f"{PYTHON}{values['decode']}")
    texts = _collect_texts([*(values.get(key) for key in INPUTS), *others]) - {""}
    paths = {text.removeprefix("run:"): _path_of(text) for text in sorted(texts)}
    return {name: _fingerprint(path) for name, path in paths.items() if path.exists()}


def _collect_texts(value: Any) -> set[str]:
    """Collect the texts in a setting that may be paths of input files.

    An object can have a "mesh" and "others", which are other objects beside it. A text such as
    dim:A+B names two networks.
    """
    from augment.switch import SWITCHES
    from train.checkpoints import split_switch

    if isinstance(value, dict):
        value = [value.get("mesh"), value.get("others")]
    if isinstance(value, str) and value.startswith(SWITCHES):
        value = [*split_switch(value)]
    if isinstance(value, list):
        return set().union(*map(_collect_texts, value))
    return {value} if isinstance(value, str) else set()


def _path_of(text: str) -> Path:
    """Return the file or folder that a setting such as run:FOLDER names, which may be missing."""
    if text.startswith(PYTHON):
        # `find_spec` imports the packages above the module, which can raise errors of any type.
        with suppress(Exception):
            spec = find_spec(split_function(text)[0])
            if spec and spec.origin:
                return Path(spec.origin)
    return published_folder(Path(text.removeprefix("run:").removeprefix("hf:")))


def _fingerprint(path: Path) -> str:
    """Compute the fingerprint of a file, of a training run or of another folder that exists."""
    # Results of runs are read without torch, which these imports need.
    from renderer.io.meshes import files_beside
    from train.checkpoints import selected_file
    from train.data.photographs import visible_files

    path = selected_file(path) or path
    if path.is_file():
        # The materials, textures and buffers of a mesh, and the weights of a network of ONNX.
        data = path.with_name(f"{path.name}.data")
        beside = [_hash_file(file) for file in (*files_beside(path), data) if file.is_file()]
        return _hash([_hash_file(path), *beside]) if beside else _hash_file(path)
    names = sorted(map(str, visible_files(path)))
    files = {name: path / name for name in names if (path / name).is_file()}
    statuses = [file.stat() for file in files.values()]
    # A large folder is compared by the sizes and times of its files, not by their contents.
    if sum(status.st_size for status in statuses) > MAX_FOLDER_BYTES:
        times = [(status.st_size, status.st_mtime_ns) for status in statuses]
        return _hash([*zip(names, times, strict=False)])
    return _hash([(name, _hash_file(file)) for name, file in files.items()])


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
