"""Imports go one way: train → augment → renderer."""

import ast
import importlib
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ALLOWED = {"renderer": {"renderer"}, "augment": {"augment", "renderer"}}
ALLOWED["train"] = {"train", *ALLOWED["augment"]}


def modules() -> dict[str, Path]:
    paths = [path for package in ALLOWED for path in (ROOT / package).rglob("*.py")]
    names = [path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".") for path in paths]
    return dict(zip((name.removesuffix(".__init__") for name in names), paths, strict=True))


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text())))


@cache
def imported_modules() -> dict[str, set[str]]:
    """Map each module to what it imports of the packages, also in functions and for types."""
    known = modules()
    imported = {}
    for name, path in known.items():
        nodes = nodes_of(path)
        plain = {item.name for node in nodes if isinstance(node, ast.Import) for item in node.names}
        froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
        members = {f"{node.module}.{item.name}" for node in froms for item in node.names}
        parents = plain | {f"{node.module}" for node in froms} - {name}
        imported[name] = (members | parents) & known.keys() - {name}
    return imported


@pytest.mark.parametrize("package", ALLOWED)
def test_a_package_imports_no_package_above_it(package):
    inside = {
        name: used for name, used in imported_modules().items() if name.partition(".")[0] == package
    }
    assert len(inside) > 5
    for name, used in inside.items():
        assert {other.partition(".")[0] for other in used} <= ALLOWED[package], name


def test_no_import_leads_back_to_its_module():
    # A circle raises CycleError, which names it.
    order = list(TopologicalSorter(imported_modules()).static_order())
    path = ["renderer.mesh", "renderer.io.meshes", "augment.scene.scene", "train.training.run"]
    assert sorted(path, key=order.index) == path


def test_the_longest_chain_of_imports_has_at_most_22_modules():
    """Each further module is one more that a reader opens before the last."""
    depths: dict[str, int] = {}
    imported = imported_modules()
    for name in TopologicalSorter(imported).static_order():
        depths[name] = 1 + max((depths[other] for other in imported[name]), default=0)
    assert 15 < max(depths.values()) <= 22


def test_a_module_has_at_most_600_lines():
    lines = {name: path.read_text().count("\n") for name, path in modules().items()}
    assert [name for name, count in lines.items() if count > 600] == []


@pytest.mark.parametrize("package", ALLOWED)
def test_no_folder_of_a_package_imports_one_that_imports_it(package):
    folders: dict[str, set[str]] = {}
    for name, imported in imported_modules().items():
        if name.startswith(f"{package}."):
            folder = folder_of(name)
            inside = {folder_of(other) for other in imported if other.startswith(f"{package}.")}
            folders.setdefault(folder, set()).update(inside - {folder})
    assert len(list(TopologicalSorter(folders).static_order())) > 10


def folder_of(module: str) -> str:
    parts = module.split(".")
    return ".".join(parts[:2])


def test_only_commands_and_what_gets_all_their_settings_name_keys():
    """Other modules name Python arguments. `keyed` replaces them by settings."""
    main = importlib.import_module("train.__main__").main
    # A group of settings may have the name of a function, such as augment.attack.
    groups = {key.rpartition(".")[0] for key in main.keys}
    keys = {key for key in main.keys if "." in key} - groups
    assert "train.precision" in keys
    gets_settings = re.compile("ExperimentSettings|DictConfig")
    names = ("cli", "commands", "run_config", "system", "__main__", "results")
    command_layer = tuple(f"train.{name}" for name in names)
    checked = 0
    for name, path in modules().items():
        has_help = name.endswith("settings")
        if has_help or name.startswith(command_layer) or gets_settings.search(path.read_text()):
            continue
        checked += 1
        for text in texts(path):
            assert keys.isdisjoint(re.findall(r"[a-z_]+\.[a-z_.]+", text)), f"{path}: {text}"
    assert checked > 100


def texts(path: Path) -> list[str]:
    """List the strings of a module, except for docstrings."""
    nodes = nodes_of(path)
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    constants = [node for node in nodes if isinstance(node, ast.Constant)]
    others = [node.value for node in constants if id(node) not in docstrings]
    return [value for value in others if isinstance(value, str)]


def test_settings_need_neither_torch_nor_numpy():
    """Commands check settings and print --help before they import slow libraries."""
    names = [name for name in modules() if name.endswith("settings")]
    hide = "import sys; sys.modules['torch'] = sys.modules['numpy'] = None"
    code = f"{hide}; import {', '.join(names)}"
    assert len(names) > 2
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
