"""The command that trains a run, or makes an attack, again: what its configuration has otherwise than the defaults."""

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from augment.attacks.parameters import PARAMETERS
from train.configuration import compose, dotted, is_within, quoted

CIRCUMSTANCES = ("run", "sweep", "compare", "versions", "inputs", "out", "train.resume", "data.images")
DATA = ("cifar100", "npz", "folder")  # besides the default
PLAIN = re.compile(r"(?!(null|true|false|nan|inf)$)[A-Za-z_/][\w./:-]*", re.ASCII | re.IGNORECASE)


def training_command(config: DictConfig) -> str:
    return _command("python -m train", "train", config, "attack@augment.attack", config.augment.attack)


def attack_command(config: DictConfig) -> str:
    return _command("python scripts/attack.py", "attack", config, "attack", config.attack)


def _command(start: str, name: str, config: DictConfig, group: str, attack: Mapping[str, Any]) -> str:
    """Also of a run from another version, whose keys this one may lack; they are left out."""
    kinds = [kind for kind in PARAMETERS if attack.get(kind) is not None]
    chosen = [f"{group}=[{','.join(kinds)}]"] if kinds else []
    if config.get("data", {}).get("name") in DATA:
        chosen.append(f"data={config.data.name}")
    defaults = dict(dotted(OmegaConf.to_container(compose(name, chosen))))
    own = dict(dotted(OmegaConf.to_container(config)))
    if own.get("evaluate.photos") and own.get("evaluate.photos") == own.get("data.images"):
        del own["evaluate.photos"]  # the run's own renders, which it makes again
    changed = {key: value for key, value in own.items() if key in defaults and value != defaults[key]}
    overrides = [f"{key}={_value(value)}" for key, value in changed.items() if not is_within(key, CIRCUMSTANCES)]
    return shlex.join([*start.split(), *chosen, *overrides])


def _value(value: object) -> str:
    """In Hydra's grammar."""
    if isinstance(value, str):
        return value if PLAIN.fullmatch(value) else quoted(value)
    if isinstance(value, list):
        return f"[{','.join(map(_value, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_value(each)}" for key, each in value.items()) + "}"
    return json.dumps(value)
