"""A folder with one small good file of every kind that the project reads, and a finished run in it."""

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from renderer import export_mesh, save_light, solid
from renderer.light.environment import to_map, write_map
from renderer.light.lamps import Lamps
from renderer.light.presets import probe

ROOT = Path(__file__).parents[2]
PATIENCE = 300  # seconds for a process that should end
RENDERER = ("renderer.rasterizer=numpy", "renderer.samples=1")
TRAINING = (
    *(
        "experiment=paper",
        "data=npz",
        "data.path=data.npz",
        "data.validation=0.3",
        "compare=[]",
        "evaluate.photos=photographs",
    ),
    *("model.depth=10", "model.width=1", "model.dropout=0.3", "train.batch_size=16", "train.precision=float32"),
    *("train.device=cpu", "train.threads=1", "train.learning_rate=0.02", "augment.examples=4"),
    *("augment.attack.max_steps=2", "scene.meshes=[mesh.obj]", "scene.backgrounds=[0.2,0.8]", *RENDERER),
    "train.cache=null",
)

Process = subprocess.Popen[str]


def colored_noise(rng: np.random.Generator, labels: np.ndarray) -> np.ndarray:
    """Images (N, 3, 16, 16) uint8 with a little brighter channel `label`: accuracy changes for many epochs."""
    images = rng.integers(0, 245, (len(labels), 3, 16, 16))
    images[np.arange(len(labels)), labels] += 10
    return images.astype(np.uint8)


def write_data(folder: Path) -> None:
    """data.npz, class folders, photographs and the textured mesh.obj."""
    rng, arrays = np.random.default_rng(0), {"classes": np.array(["apple", "orange", "pear"])}
    for part, count in (("train", 20), ("test", 10)):
        arrays[f"{part}_labels"] = np.repeat(np.arange(3), count)
        arrays[f"{part}_images"] = colored_noise(rng, arrays[f"{part}_labels"])
    np.savez(folder / "data.npz", **arrays)
    shown = ("images/apple", "images/orange", "photographs/orange", "photographs/apple", "photographs/other_tomato")
    for name, number in product(shown, range(3)):
        (folder / name).mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (20, 24, 3)).astype(np.uint8)).save(folder / name / f"{number}.png")
    paths = [path.relative_to(folder / "photographs").as_posix() for path in sorted(folder.glob("photographs/*/*"))]
    (folder / "photographs" / "photos.csv").write_text("path,source_tag\n" + "".join(f"{path},web\n" for path in paths))
    sphere = trimesh.creation.icosphere(subdivisions=2)
    lines = ["mtllib mesh.mtl", *(f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in sphere.vertices)]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1", "usemtl peel"]
    lines += [f"f {a}/1 {b}/2 {c}/3" for a, b, c in sphere.faces + 1]
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")
    (folder / "mesh.mtl").write_text("newmtl peel\nKd 1 0.5 0\nmap_Kd peel.png\n")
    Image.new("RGB", (4, 4), "orange").save(folder / "peel.png")


def write_scene_files(folder: Path) -> None:
    """Meshes, lights, lamps, a projector's pattern and a background."""
    light = probe("st_peters")  # positive, as maps are
    export_mesh(solid("lemon", 0), folder / "mesh.glb")
    for name in ("mesh.ply", "mesh.stl", "mesh.off"):
        trimesh.creation.icosphere(subdivisions=2).export(folder / name)
    for name in ("light.npy", "light.hdr", "light.exr"):
        write_map(folder / name, to_map(light, 8))
    save_light(folder / "light.json", light)
    save_light(folder / "lamps.json", torch.ones(2, 3), Lamps(((2.0, 2.0, 2.0), (-2.0, 2.0, 2.0))))
    for name in ("background.png", "pattern.png"):
        Image.new("RGB", (20, 24), "gray").save(folder / name)


def run_here(name: str, *arguments: str, folder: Path) -> int:
    """`python -m train`, or a script, without its report, in this process, in a folder: the status."""
    module = "train.__main__" if name == "train" else f"scripts.{name}"
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setattr(sys, "argv", [f"{name}.py", *arguments])
        patch.setattr("train.commands.experiment.report_of", lambda folders, out: "no report")
        try:
            import_module(module).main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def start_command(
    *arguments: str, folder: Path, limit: Callable[[], object] = lambda: None, **environment: str
) -> Process:
    """`python` with these arguments in a process of its own, in a folder.

    limit: is called in the process before Python starts.
    """
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limit,
    )


def end(process: Process) -> tuple[int, str, str]:
    """Status, output and errors, without what took long, once it has ended by itself."""
    try:
        output, errors = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    return process.returncode, output, re.sub(r".* \.\.\.\n", "", errors)


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """The folder of what a training run reads."""
    folder = tmp_path_factory.mktemp("data")
    write_data(folder)
    return folder


@pytest.fixture(scope="session")
def corpus(tmp_path_factory) -> Path:
    """A folder of good files, and a finished run of two epochs in finished/, its network also in published/."""
    folder = tmp_path_factory.mktemp("corpus")
    write_data(folder)
    write_scene_files(folder)
    assert run_here("train", "run=finished", "train.epochs=2", *TRAINING, folder=folder) == 0
    assert run_here("publish", "run=finished", "out=published", folder=folder) == 0
    return folder
