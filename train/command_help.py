"""--help of a command, read as text, since its modules take seconds to import: choices, settings and their comments."""

import ast
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra import initialize_config_module
from omegaconf import OmegaConf

import conf

CONF = Path(conf.__path__[0])
FIELD = re.compile(r"^    (\w+): [^=\n]+ = (?:field\(default_factory=(?:lambda: )?(.+?)\)|(.+?))(?:  # (.*))?$", re.M)
LINE = re.compile(r"( *)(\w+):(?: .*?)?(?: +# (.*))?$")  # of YAML: its key and comment
GROUPS = {  # by command: folders of conf/ whose files are choices, some for a key of another name
    "train": ("experiment", "data", "augment", "launcher", "attack@augment.attack"),
    "attack": ("attack",),
}
SCHEMAS = {"lab": "train/lab/shots.py", "audit": "train/audit/audit.py"}  # with a command's settings, if not its own


def format_help(name: str, arguments: Sequence[str]) -> str:
    """The text of a command, under the choices among its arguments."""
    file, groups = CONF / f"{name}.yaml", GROUPS.get(name, ())
    own = "train/__main__.py" if name == "train" else f"*scripts/{name}.py"  # in pnb_scripts/, once installed
    code = min(CONF.parent.glob(own)).read_text(encoding="utf-8")
    parts = [str(ast.get_docstring(ast.parse(code))), ""]
    if not file.exists():
        code += (CONF.parent / SCHEMAS[name]).read_text(encoding="utf-8") if name in SCHEMAS else ""
        schema = code.partition("Settings:\n")[2].partition("\n    def ")[0].replace("= MISSING", "= ???")
        settings = (_aligned(f"{k}={_value(a or b)}", comment) for k, a, b, comment in FIELD.findall(schema))
        return "\n".join([*parts, "Settings:", *settings])
    packages, comments = {key.partition("@")[0]: key.rpartition("@")[2] for key in groups}, dict[str, str]()
    parts += [f"The defaults are in {file}", ""]
    for path in sorted(CONF.glob("*/*.yaml")):
        group = path.parent.name
        if group not in ("experiment", "launcher"):
            comments |= _comments(path.read_text(encoding="utf-8"), f"{packages.get(group, group)}.")
    comments |= _comments(file.read_text(encoding="utf-8"))
    for key, group in zip(groups, packages, strict=True):
        choices = [path for path in sorted((CONF / group).glob("*.yaml")) if path.stem != "default"]
        parts += [_aligned(f"{key}={path.stem}", _summary(path)) for path in choices]
    with initialize_config_module("conf", version_base="1.3"):
        config = hydra.compose(name, [text for text in arguments if text.split("=")[0] in groups and "+" not in text])
    plain: Any = OmegaConf.to_container(config)
    return "\n".join([*parts, "", *_settings(plain, comments)])


def _value(code: str) -> str:
    """A field's default, as it is given on the command line; code where it is computed."""
    try:
        value = [] if code == "list" else ast.literal_eval(code)
    except (ValueError, SyntaxError):
        return code
    return value if isinstance(value, str) else json.dumps(value)


def _comments(text: str, prefix: str = "") -> Iterator[tuple[str, str]]:
    """The comments that end lines of YAML, by dotted key."""
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
