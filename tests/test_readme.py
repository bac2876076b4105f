"""README's Python, block by block, in a folder that holds what it reads."""

import re
from pathlib import Path

import pytest
import trimesh

README = (Path(__file__).parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"### ([^\n]+)\n(?:(?!\n#).)*?```python\n(.*?)```", README, re.DOTALL)


def run(title: str) -> dict[str, object]:
    """The names that the only block under a heading leaves behind."""
    (block,) = [block for heading, block in BLOCKS if heading == title]
    names = {}
    exec(block, names)
    return names


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    trimesh.creation.icosphere(2).export(tmp_path / "orange.glb")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_block_of_python_stands_under_a_heading_that_is_tested():
    assert README.count("```python") == len(BLOCKS)
    assert {heading for heading, _ in BLOCKS} == {"The renderer by itself"}


def test_the_renderer_by_itself():
    names = run("The renderer by itself")
    assert names["images"].shape == (10, 3, 224, 224) and names["image"].shape == (3, 224, 224)
    assert names["light"].grad.any()
