"""A small training run to torture: its data, its photographs, and the command that starts or resumes it."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).parents[2]
CLASSES = ["apple", "orange", "pear"]
SETTINGS = [
    "train.resume=true", "data=npz", "data.validation=0.3", "compare=[]", "model.depth=10", "model.width=1",
    "model.dropout=0.3", "train.batch_size=16", "train.learning_rate=0.02", "train.precision=float32",
    "train.device=cpu", "train.threads=1", "augment.examples=4", "augment.lights=continue",
    "augment.attack.max_steps=3", "augment.attack.step_size=0.3", "scene.backgrounds=[0.2,0.8]",
    "renderer.visibility=software", "renderer.samples=2",
]  # fmt: skip

# Python imports a module of this name at every start. On SIGUSR1 the process then writes where it is, and goes on.
SITECUSTOMIZE = """
import faulthandler, os, pathlib, signal
file = open(pathlib.Path(__file__).with_name(f"{os.getpid()}.stacks"), "w")
faulthandler.register(signal.SIGUSR1, file)
file.write("ready\\n")
file.flush()
"""


@dataclass(frozen=True)
class Workshop:
    """A folder that holds all that the runs read and, under `runs`, all that they write. epochs: of every run."""

    folder: Path
    epochs: int

    @property
    def stacks(self) -> Path:
        """Where a process writes its stack, in a file named by its number."""
        return self.folder / "site"

    @property
    def environment(self) -> dict[str, str]:
        paths = os.pathsep.join(map(str, (self.stacks, ROOT)))
        return os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}

    def command(self, run: Path) -> list[str]:
        """`python -m train`, which goes on in the run's folder where it holds a checkpoint."""
        here = [f"{key}={self.folder / name}" for key, name in (("data.path", "data.npz"), ("renderer.cache", "cache"))]
        named = [f"run={run}", f"train.epochs={self.epochs}", f"evaluate.photos={self.folder / 'photographs'}"]
        return [sys.executable, "-m", "train", *named, *here, *SETTINGS]


def furnish(folder: Path, epochs: int) -> Workshop:
    """Write the data, the photographs and what makes a process tell its stack into an empty folder."""
    rng, workshop = np.random.default_rng(0), Workshop(folder, epochs)
    train, test = np.repeat(np.arange(len(CLASSES)), 20), np.repeat(np.arange(len(CLASSES)), 10)
    np.savez(
        folder / "data.npz",
        train_images=_coloured_noise(rng, train),
        train_labels=train,
        test_images=_coloured_noise(rng, test),
        test_labels=test,
        classes=np.array(CLASSES),
    )
    for name in ("orange", "apple", "other_tomato"):
        (folder / "photographs" / name).mkdir(parents=True)
        for number in range(3):
            pixels = rng.integers(0, 256, (20, 24, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(folder / "photographs" / name / f"{number}.png")
    workshop.stacks.mkdir()
    (workshop.stacks / "sitecustomize.py").write_text(SITECUSTOMIZE)
    return workshop


def _coloured_noise(rng: np.random.Generator, labels: np.ndarray) -> np.ndarray:
    """Pictures (N, 3, 16, 16) uint8 whose channel `label` is a little brighter, so that accuracies move for long."""
    images = rng.integers(0, 245, (len(labels), 3, 16, 16))
    images[np.arange(len(labels)), labels] += 10
    return images.astype(np.uint8)
