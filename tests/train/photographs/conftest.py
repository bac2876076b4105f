from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import torch
from PIL import Image


class TableModel(torch.nn.Module):
    """Predicts row i of a table of logits for an image whose red is i."""

    def __init__(self, table):
        super().__init__()
        self.table = torch.as_tensor(table, dtype=torch.float32)

    def forward(self, images):
        assert images.dtype == torch.float32 and images.ndim == 4 and images.shape[1] == 3
        return self.table[(images[:, 0].mean(dim=(1, 2)) * 255).round().long()]


@pytest.fixture
def known_model(tmp_path) -> Callable[..., tuple[TableModel, list[str], Path]]:
    """Makes a folder of the named images and a model that gives the i-th of them the i-th row of logits.

    Returns the model, its classes and the folder, in the order in which `evaluate_photographs` takes them.
    """

    def make(names: Sequence[str], logits: Sequence, classes: list[str]) -> tuple[TableModel, list[str], Path]:
        folder = tmp_path / "photos"
        for red, name in enumerate(names):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (32, 32), (red, 0, 0)).save(folder / name)
        return TableModel(logits), classes, folder

    return make


FRUIT_CLASSES = ["apple", "fig", "lime", "orange", "pear", "plum"]

# Photograph, source, and the model's classes from best to worst.
FRUIT = [
    ("orange/a.png", "lab", "orange pear plum fig lime apple"),
    ("orange/b.png", "lab", "pear orange plum fig lime apple"),
    ("orange/c.png", "street", "apple pear plum fig lime orange"),
    ("orange/d.png", "", "plum pear apple fig orange lime"),
    ("orange/e.png", "street", "pear orange plum fig lime apple"),
    ("other_lemon/f.png", "street", "orange pear plum fig lime apple"),
    ("other_lemon/g.png", "street", "lime pear plum fig orange apple"),
    ("pear/h.png", "shop", "pear orange plum fig lime apple"),
    ("pear/i.png", "shop", "orange apple plum fig lime pear"),
    ("pear/j.png", "", "apple orange plum fig pear lime"),
]


@pytest.fixture
def fruit(known_model):
    """A model whose every prediction is known, its classes and a folder of photographs with sources."""
    logits = [[-order.split().index(name) for name in FRUIT_CLASSES] for _, _, order in FRUIT]
    model, classes, folder = known_model([name for name, _, _ in FRUIT], logits, FRUIT_CLASSES)
    lines = [f"{name},{source}" for name, source, _ in FRUIT]
    (folder / "photos.csv").write_text("\n".join(["path,source_tag", *lines]))
    return model, classes, folder
