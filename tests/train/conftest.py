"""A small data set, a configuration to match, and one finished run that several tests look at."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import save_colored_noise, save_noise
from tests.runs import completed_run
from tests.train.helpers import read_quickly
from train.__main__ import main as train_command
from train.run_config import write_config
from train.settings import ExperimentSettings

TINY = [
    *("data=npz", "model.depth=10", "model.width=1", "model.dropout=0.3", "train.epochs=3"),
    *("train.batch_size=16", "train.learning_rate=0.05", "train.precision=float32"),
    *("train.device=cpu", "train.threads=1", "photos=null"),
    "seed=7",  # The attack moves the lights in every epoch with this seed.
    *("augment.examples=4", "augment.warm_start=true", "augment.attack.max_steps=3"),
    *("augment.attack.step_size=0.3", "scene.backgrounds=[0.2,0.8]"),
    *("renderer.rasterizer=numpy", "renderer.samples=2"),
]


@pytest.fixture(scope="session")
def tiny_npz(tmp_path_factory) -> Path:
    """Save 60 training and 30 test images of three classes, 16 × 16 pixels each."""
    path = tmp_path_factory.mktemp("data") / "tiny.npz"
    save_colored_noise(path, np.random.default_rng(0), contrast=30)
    return path


@pytest.fixture(scope="session")
def photos(tmp_path_factory) -> Path:
    """Save seven photographs of two classes and of a thing that has no class."""
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(1)
    for name, count in [("orange", 3), ("apple", 2), ("other_tomato", 2)]:
        for number in range(count):
            save_noise(folder / name / f"{number}.png", rng)
    return folder


@pytest.fixture(scope="session")
def half_dark(tmp_path_factory) -> Path:
    """Save twelve photographs near the limit of `bright_or_dark`, in two sub-folders."""
    folder = tmp_path_factory.mktemp("half_dark")
    rng = np.random.default_rng(0)
    for index in range(12):
        save_noise(folder / f"part_{index % 2}" / f"{index}.png", rng, high=2 * (20 + 2 * index))
    return folder


@pytest.fixture(scope="session")
def tiny(tiny_npz) -> Callable[..., ExperimentSettings]:
    """Return a function that reads the real configuration with small sizes and other overrides."""

    words = ["experiment=paper", *TINY, f"data.path={tiny_npz}"]
    return lambda *overrides: read_quickly(train_command, words, overrides)


@pytest.fixture(scope="session")
def finished(tiny, photos, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "finished"
    completed_run(tiny(f"photos={photos}"), folder)
    return folder


@pytest.fixture
def no_report(monkeypatch) -> None:
    """Write no page of a training, whose plots take longer than the training."""
    monkeypatch.setattr("train.commands.experiment.report_of", lambda folders, out: "no report")


LOG = (
    '{"epoch": 1}\n{"epoch": 2}\n'
    '{"test/accuracy": 0.76543, "test/accuracy_last": 0.75, "test/epoch": 2}\n'
)


@pytest.fixture(scope="session")
def made_up_run(tiny) -> Callable[..., Path]:
    """Return a function that writes a finished run without checkpoints, with these summaries."""

    def make(folder: Path, method="none", photographs=None, *overrides: str) -> Path:
        write_config(folder, tiny(f"augment={method}", "seed=0", *overrides))
        (folder / "metrics.jsonl").write_text(LOG)
        for name, summary in (photographs or {}).items():
            (folder / name).mkdir()
            (folder / name / "summary.json").write_text(json.dumps(summary))
        return folder

    return make
