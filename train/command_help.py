"""--help of a command: its choices and settings, with their comments in conf/ or beside the dataclass's fields."""

import inspect
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

import conf

CONF = Path(conf.__path__[0])
LINE = re.compile(r"( *)(\w+):(?: .*?)?(?: +# (.*))?$")  # of YAML, or a dataclass's field: its key and comment
GROUPS = {  # by command: folders of conf/ whose files are choices, some for a key of another name
    "train": ("experiment", "data", "augment", "launcher", "attack@augment.attack"),
    "attack": ("attack",),
}


def format_help(name: str, about: str, settings: type, config: DictConfig) -> str:
    """The text of a command, from its docstring, the dataclass of its settings, and its composed configuration."""
    file, groups = CONF / f"{name}.yaml", GROUPS.get(name, ())
    parts, comments = [about.strip(), ""], dict(_comments(inspect.getsource(settings)))
    packages = {key.partition("@")[0]: key.rpartition("@")[2] for key in groups}
    if file.exists():
        parts += [f"The defaults are in {file}", ""]
        for path in sorted(CONF.glob("*/*.yaml")):
            group = path.parent.name
            if group not in ("experiment", "launcher"):
                comments |= _comments(path.read_text(encoding="utf-8"), f"{packages.get(group, group)}.")
        comments |= _comments(file.read_text(encoding="utf-8"))
    for key, group in zip(groups, packages, strict=True):
        choices = [path for path in sorted((CONF / group).glob("*.yaml")) if path.stem != "default"]
        parts += [_aligned(f"{key}={path.stem}", _summary(path)) for path in choices]
    plain: Any = OmegaConf.to_container(config)
    return "\n".join([*parts, "" if groups else "Settings:", *_settings(plain, comments)])


def _comments(text: str, prefix: str = "") -> Iterator[tuple[str, str]]:
    """The comments that end lines of YAML, or of a dataclass, by dotted key."""
    outer: list[tuple[int, str]] = []
    for indent, key, comment in (match.groups() for match in map(LINE.match, text.splitlines()) if match):
        outer = [*((depth, name) for depth, name in outer if depth < len(indent)), (len(indent), key)]
        if comment:
            yield prefix + ".".join(name for _, name in outer), comment


def _summary(path: Path) -> str:
    """The first clause of the comment that begins a file; "" without one."""
    lines = [line.removeprefix("# ") for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("# ")]
    text = " ".join(line for line in lines if not line.startswith("@package"))
    return re.split(r"[.:;](?: |$)", text)[0]


def _settings(node: Mapping[str, Any], comments: Mapping[str, str], prefix: str = "") -> Iterator[str]:
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value:
            yield from [_aligned(f"{name}.", comments[name])] if name in comments else []
            yield from _settings(value, comments, f"{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            yield _aligned(f"{name}={text}", comments.get(name, ""))


def _aligned(setting: str, comment: str) -> str:
    return f"  {setting:<44}  # {comment}" if comment else f"  {setting}"
