"""A small data set, a configuration to match, and one finished run that several tests look at."""

import json
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.runs import completed_run
from train.__main__ import main as train_command
from train.runs.run_config import write_config
from train.settings import ExperimentSettings

CLASSES = ["apple", "orange", "pear"]
TINY = [
    "data=npz", "model.depth=10", "model.width=1", "model.dropout=0.3", "train.epochs=3", "train.batch_size=16",
    "train.learning_rate=0.05", "train.precision=float32", "train.device=cpu", "train.threads=1",
    "evaluate.photos=null",
    "seed=7",  # the attack then moves the lights in every epoch
    "augment.examples=4", "augment.warm_start=true", "augment.attack.max_steps=3", "augment.attack.step_size=0.3",
    "scene.backgrounds=[0.2,0.8]", "renderer.rasterizer=numpy", "renderer.samples=2",
]  # fmt: skip


def colored_noise(rng: np.random.Generator, labels: np.ndarray) -> np.ndarray:
    """Images (N, 3, 16, 16) uint8 whose channel `label` is somewhat brighter."""
    images = rng.integers(0, 200, (len(labels), 3, 16, 16))
    images[np.arange(len(labels)), labels] += 30
    return images.astype(np.uint8)


@pytest.fixture(scope="session")
def tiny_npz(tmp_path_factory) -> Path:
    """60 training and 30 test images of three classes, 16 × 16."""
    path = tmp_path_factory.mktemp("data") / "tiny.npz"
    rng, arrays = np.random.default_rng(0), {"classes": np.array(CLASSES)}
    for part, labels in [("train", np.repeat(np.arange(3), 20)), ("test", np.repeat(np.arange(3), 10))]:
        arrays |= {f"{part}_images": colored_noise(rng, labels), f"{part}_labels": labels}
    np.savez(path, **arrays)
    return path


@pytest.fixture(scope="session")
def photos(tmp_path_factory) -> Path:
    """Seven images: of two classes, and of a thing that the data has no class for."""
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(1)
    for name, count in [("orange", 3), ("apple", 2), ("other_tomato", 2)]:
        (folder / name).mkdir()
        for number in range(count):
            pixels = rng.integers(0, 256, (20, 24, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(folder / name / f"{number}.png")
    return folder


@pytest.fixture(scope="session")
def tiny(tiny_npz) -> Callable[..., ExperimentSettings]:
    """The settings of the real configuration, small; arguments are further overrides."""

    @cache  # composing takes half a second
    def read(*overrides: str) -> ExperimentSettings:
        experiment = [] if any(item.startswith("experiment=") for item in overrides) else ["experiment=paper"]
        all_overrides = [*experiment, *TINY, f"data.path={tiny_npz}", *overrides]
        return train_command.read(all_overrides)

    return lambda *overrides: deepcopy(read(*overrides))


@pytest.fixture(scope="session")
def finished(tiny, photos, tmp_path_factory) -> Path:
    """The folder of a finished adversarial run, scored on photographs."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    settings = tiny(f"evaluate.photos={photos}")
    completed_run(settings, folder)
    return folder


@pytest.fixture(scope="session")
def made_up_run(tiny) -> Callable[..., Path]:
    """Makes a folder with what a finished run of two epochs writes, but for its checkpoints.

    photographs: the summaries of evaluations by the name of their sub-folder.
    """

    def make(folder: Path, arm: str = "none", photographs: dict | None = None, *overrides: str) -> Path:
        write_config(folder, tiny(f"augment={arm}", "seed=0", *overrides))
        seconds = {"attack": 0.5, "attack_classifier": 0.25, "training": 3.0, "evaluation": 1.0, "input_output": 0.5}
        seconds = {f"seconds/{phase}": value for phase, value in seconds.items()}
        lines = [{"epoch": epoch} | {name: epoch * value for name, value in seconds.items()} for epoch in (1, 2)]
        lines[0]["seconds/operators"] = 7.0
        lines.append({"test/accuracy": 0.76543, "test/accuracy_last": 0.75, "test/epoch": 2})
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        for name, summary in (photographs or {}).items():
            (folder / name).mkdir()
            (folder / name / "summary.json").write_text(json.dumps(summary))
        return folder

    return make


@pytest.fixture(scope="session")
def read_markdown() -> Callable[[str], dict[str, list[list[str]]]]:
    """Reads the tables of a text, rows of cells, the header first, by the heading or line before each, or ""."""

    def read(text: str) -> dict[str, list[list[str]]]:
        tables, title = {}, ""
        for paragraph in text.split("\n\n"):
            lines = [line for line in paragraph.splitlines() if line.startswith("|")]
            if heading := [line for line in paragraph.splitlines() if not line.startswith("|")]:
                title = heading[-1].removeprefix("### ").removesuffix(":")
            if lines:
                assert len({len(line) for line in lines}) == 1 and set(lines[1]) == {"|", "-", " "}
                rows = [lines[0], *lines[2:]]
                tables[title] = [[cell.strip() for cell in line.strip("|").split("|")] for line in rows]
        return tables

    return read
