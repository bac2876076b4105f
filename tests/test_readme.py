"""README's Python, block by block, in a folder that holds what it reads."""

import json
import re
from pathlib import Path

import pytest
import torch
import trimesh
from torch import nn
from torch.utils.data import Dataset

from augment.attacks import evaluate

README = (Path(__file__).parents[1] / "README.md").read_text()
HEADINGS = re.split(r"^#{2,3} (.*)$", README, flags=re.MULTILINE)
BLOCKS = {
    heading: "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    for heading, text in zip(HEADINGS[1::2], HEADINGS[2::2], strict=True)
    if "```python" in text
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    trimesh.creation.icosphere(2).export(tmp_path / "orange.glb")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def run(heading: str, **names) -> dict[str, object]:
    """The names that the block under a heading leaves behind, given those of its reader."""
    exec(BLOCKS[heading], names)
    return names


def test_every_block_of_python_is_run_here():
    assert BLOCKS.keys() == {"Attack a classifier", "In your own training loop", "The renderer by itself"}
    assert README.count("```python") == len(BLOCKS)


def test_the_renderer_by_itself():
    names = run("The renderer by itself")
    assert names["images"].shape == (10, 3, 224, 224) and names["image"].shape == (3, 224, 224)
    assert names["light"].grad.any()


class Brightness(nn.Module):
    """Bright is an orange, dark a plum."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        mean = 30 * images.mean((1, 2, 3))
        return torch.stack([mean, 20.5 - mean], dim=1)


def test_attack_a_classifier(folder, capsys, monkeypatch):
    monkeypatch.setattr(evaluate, "GROWTH", (1,))  # ten times as many steps take some 20 s
    names = run("Attack a classifier", network=Brightness(), CLASSES=["orange", "plum"])
    attacked = names["attacked"]
    assert capsys.readouterr().out and names["after"].shape == names["before"].shape == (1, 3, 3, 224, 224)
    assert 0 < float((names["lights"] - attacked.problem.scene.lights).norm()) <= 1 + 1e-5
    assert attacked.descent.cost < attacked.descent.cost_before
    (line,) = [json.loads(line) for line in (folder / "adversaries" / "attack.jsonl").read_text().splitlines()]
    assert (
        line["success"] == bool(attacked.success) and (folder / "adversaries" / "example_000" / "light.json").is_file()
    )


class Photographs(Dataset):
    """Labels are numbers, as torchvision's are."""

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> tuple[torch.Tensor, int]:
        return torch.full((3, 32, 32), index / 8), index


def test_in_your_own_training_loop():
    torch.manual_seed(0)
    network = nn.Sequential(nn.Flatten(), nn.Linear(3 * 32**2, 100))
    before = network[1].weight.detach().clone()
    optimizer = torch.optim.SGD(network.parameters(), lr=0.01)
    names = run("In your own training loop", torch=torch, network=network, data=Photographs(), optimizer=optimizer)
    assert len(names["renders"]) == 10 and names["renders"].labels.eq(53).all()
    assert names["renders"].images.shape == (10, 3, 32, 32) and not torch.equal(network[1].weight, before)
