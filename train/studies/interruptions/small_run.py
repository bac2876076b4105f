"""A small training run to interrupt: its data, its photographs and its settings."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

import train

ROOT = Path(train.__file__).parents[1]  # of the installation that runs
CLASSES = ["apple", "orange", "pear"]
SETTINGS = [
    "train.resume=true", "data=npz", "data.validation=0.3", "compare=[]", "model.depth=10", "model.width=1",
    "model.dropout=0.3", "train.batch_size=16", "train.learning_rate=0.02", "train.precision=float32",
    "train.device=cpu", "train.threads=1", "augment.examples=4", "augment.lights=continue",
    "augment.attack.max_steps=3", "augment.attack.step_size=0.3", "scene.backgrounds=[0.2,0.8]",
    "renderer.visibility=software", "renderer.samples=2",
]  # fmt: skip


@dataclass(frozen=True)
class SmallRun:
    """A folder that holds all that the runs read and, under `runs`, all that they write. epochs: of every run."""

    folder: Path
    epochs: int

    @property
    def environment(self) -> dict[str, str]:
        return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}

    def overrides(self, run: Path) -> list[str]:
        """Of `python -m train`, which goes on in the run's folder where it holds a checkpoint."""
        here = [f"{key}={self.folder / name}" for key, name in (("data.path", "data.npz"), ("renderer.cache", "cache"))]
        named = [f"run={run}", f"train.epochs={self.epochs}", f"evaluate.photos={self.folder / 'photographs'}"]
        return [*named, *here, *SETTINGS]


def write_inputs(folder: Path, epochs: int) -> SmallRun:
    """Write the data and the photographs into an empty folder."""
    rng = np.random.default_rng(0)
    trained, tested = np.repeat(np.arange(len(CLASSES)), 20), np.repeat(np.arange(len(CLASSES)), 10)
    np.savez(
        folder / "data.npz",
        train_images=_coloured_noise(rng, trained),
        train_labels=trained,
        test_images=_coloured_noise(rng, tested),
        test_labels=tested,
        classes=np.array(CLASSES),
    )
    for name in ("orange", "apple", "other_tomato"):
        (folder / "photographs" / name).mkdir(parents=True)
        for number in range(3):
            pixels = rng.integers(0, 256, (20, 24, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(folder / "photographs" / name / f"{number}.png")
    return SmallRun(folder, epochs)


def _coloured_noise(rng: np.random.Generator, labels: np.ndarray) -> np.ndarray:
    """Images (N, 3, 16, 16) uint8 whose channel `label` is a little brighter, so that accuracies move for long."""
    images = rng.integers(0, 245, (len(labels), 3, 16, 16))
    images[np.arange(len(labels)), labels] += 10
    return images.astype(np.uint8)
