"""Imports go one way: train → augment → renderer."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ALLOWED = {"renderer": {"renderer"}, "augment": {"augment", "renderer"}, "train": {"train", "augment", "renderer"}}


def imported_packages(module: Path) -> set[str]:
    nodes = list(ast.walk(ast.parse(module.read_text())))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("package", ALLOWED)
def test_a_package_imports_no_package_above_it(package):
    modules = list((ROOT / package).rglob("*.py"))
    assert len(modules) > 5
    for module in modules:
        assert imported_packages(module) & ALLOWED.keys() <= ALLOWED[package], module


def test_only_one_module_imports_opengl():
    users = [
        path.relative_to(ROOT).as_posix()
        for package in ALLOWED
        for path in (ROOT / package).rglob("*.py")
        if "moderngl" in imported_packages(path)
    ]
    assert users == ["renderer/visibility/rasterizers/opengl.py"]


def test_no_import_within_the_renderer_leads_back_also_inside_functions():
    names = {
        path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."): path
        for path in (ROOT / "renderer").rglob("*.py")
    }
    imported = {}
    for name, path in names.items():
        nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        members = {f"{node.module}.{alias.name}" for node in nodes for alias in node.names}
        imported[name] = (members | {node.module for node in nodes}) & names.keys()
    order = list(TopologicalSorter(imported).static_order())  # CycleError names the circle
    modules = ["renderer.geometry.normals", "renderer.geometry.mesh", "renderer.io.meshes"]
    assert sorted(modules, key=order.index) == modules


def test_settings_need_neither_torch_nor_numpy():
    """Commands check their settings and print --help before anything that takes seconds to import."""
    modules = [path.relative_to(ROOT).with_suffix("").as_posix() for path in ROOT.glob("*/**/settings.py")]
    names = [name.replace("/", ".") for name in modules if name.partition("/")[0] in ALLOWED]
    code = f"import sys; sys.modules['torch'] = sys.modules['numpy'] = None; import {', '.join(names)}"
    assert len(names) > 2
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
