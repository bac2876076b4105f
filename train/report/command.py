"""The command that repeats a run or an attack: the settings in its configuration that are not the defaults."""

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from augment.attacks.parameters import PARAMETERS
from train.settings import compose, dotted, is_within, quoted

CIRCUMSTANCES = ("run", "sweep", "compare", "versions", "inputs", "out", "train.resume", "data.images")
DATA = ("cifar100", "npz", "folder")  # besides the default
PLAIN = re.compile(r"(?!(null|true|false|nan|inf)$)[A-Za-z_/][\w./:-]*", re.ASCII | re.IGNORECASE)


def training_command(config: DictConfig) -> str:
    """The command of a run's configuration."""
    return _command("python -m train", "train", config, "attack@augment.attack", config.augment.attack)


def attack_command(config: DictConfig) -> str:
    """The command of an attack's configuration."""
    return _command("python scripts/attack.py", "attack", config, "attack", config.attack)


def _command(start: str, name: str, config: DictConfig, group: str, attack: Mapping[str, Any]) -> str:
    """Keys of another version that this one lacks are left out."""
    parameters = [parameter for parameter in PARAMETERS if attack.get(parameter) is not None]
    groups = [f"{group}=[{','.join(parameters)}]"] if parameters else []
    if config.get("data", {}).get("name") in DATA:
        groups.append(f"data={config.data.name}")
    defaults, values = _by_key(compose(name, groups)), _by_key(config)
    if values.get("evaluate.photos") and values.get("evaluate.photos") == values.get("data.images"):
        del values["evaluate.photos"]  # the run's own renders, which it makes again
    changed = {key: value for key, value in values.items() if key in defaults and value != defaults[key]}
    overrides = [f"{key}={_value(value)}" for key, value in changed.items() if not is_within(key, CIRCUMSTANCES)]
    return shlex.join([*start.split(), *groups, *overrides])


def _by_key(config: DictConfig) -> dict[str, Any]:
    return dict(dotted(cast(dict[str, Any], OmegaConf.to_container(config))))


def _value(value: object) -> str:
    """In Hydra's grammar."""
    if isinstance(value, str):
        return value if PLAIN.fullmatch(value) else quoted(value)
    if isinstance(value, list):
        return f"[{','.join(map(_value, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_value(item)}" for key, item in value.items()) + "}"
    return json.dumps(value)
