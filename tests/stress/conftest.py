"""A folder with a small good file of every kind that the project reads, and a finished run."""

import contextlib
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import norm_balls as nb
from renderer import export_mesh, save_light, solid
from renderer.light.environment import to_map, write_map
from renderer.light.files import probe
from renderer.light.lamps import Lamps
from tests.helpers import save_colored_noise, save_noise

ROOT = Path(__file__).parents[2]
MAX_SECONDS = 300  # A process that should end is killed after this time.
RENDERER = ("renderer.rasterizer=numpy", "renderer.samples=1")
TRAINING = (
    *("experiment=paper", "data=npz", "data.path=data.npz", "data.validation=0.3", "compare=[]"),
    *("photos=photographs", "model.depth=10", "model.width=1", "model.dropout=0.3"),
    *("train.batch_size=16", "train.precision=float32", "train.device=cpu", "train.threads=1"),
    *("train.learning_rate=0.02", "train.cache=null", "augment.examples=4"),
    *("augment.attack.max_steps=2", "meshes=[mesh.obj]", "scene.backgrounds=[0.2,0.8]", *RENDERER),
)

PHOTOGRAPHS = ("photographs/orange", "photographs/apple", "photographs/other_tomato")
Process = subprocess.Popen[str]


def write_data(folder: Path) -> None:
    rng = np.random.default_rng(0)
    # The accuracy changes for many epochs, because the contrast is so low.
    save_colored_noise(folder / "data.npz", rng, contrast=8)
    for name in ("images/apple", "images/orange", *PHOTOGRAPHS):
        for number in range(3):
            save_noise(folder / name / f"{number}.png", rng)
    write_sources(folder / "photographs")
    write_textured_mesh(folder)


def write_sources(folder: Path) -> None:
    lines = ["path,source_tag"]
    for path in sorted(folder.glob("*/*")):
        lines.append(f"{path.relative_to(folder).as_posix()},web")
    (folder / "photos.csv").write_text("\n".join(lines) + "\n")


def write_textured_mesh(folder: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    lines = ["mtllib mesh.mtl"]
    lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in sphere.vertices]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1", "usemtl peel"]
    lines += [f"f {a}/1 {b}/2 {c}/3" for a, b, c in sphere.faces + 1]
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")
    (folder / "mesh.mtl").write_text("newmtl peel\nKd 1 0.5 0\nmap_Kd peel.png\n")
    Image.new("RGB", (4, 4), "orange").save(folder / "peel.png")


def write_scene_files(folder: Path) -> None:
    export_mesh(solid("lemon", 0), folder / "mesh.glb")
    for name in ("mesh.ply", "mesh.stl", "mesh.off"):
        trimesh.creation.icosphere(subdivisions=2).export(folder / name)
    light = probe("st_peters")  # Its radiance is positive, as that of a map must be.
    for name in ("light.npy", "light.hdr", "light.exr"):
        write_map(folder / name, to_map(light, 8))
    save_light(folder / "light.json", light)
    lamps = Lamps(((2.0, 2.0, 2.0), (-2.0, 2.0, 2.0)))
    save_light(folder / "lamps.json", torch.ones(2, 3), lamps)
    for name in ("background.png", "pattern.png"):
        Image.new("RGB", (20, 24), "gray").save(folder / name)


def run_here(name: str, *arguments: str, folder: Path) -> int:
    """Run a command in this process, in a folder, without a report, and return its exit status."""
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setattr(sys, "argv", [f"{name}.py", *arguments])
        patch.setattr("train.commands.experiment.report_of", lambda folders, out: "no report")
        try:
            import_module("train.__main__" if name == "train" else f"scripts.{name}").main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def start_command(*arguments, folder, **environment) -> Process:
    """Start `python` with these arguments in a process."""
    defaults = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    options = {"cwd": folder, "env": os.environ | defaults | environment, "text": True}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, *arguments], **options, **pipes)


def end(process: Process) -> tuple[int, str, str]:
    """Wait for a process, and return its status, its output, and its errors without progress."""
    try:
        output, errors = process.communicate(timeout=MAX_SECONDS)
    finally:
        process.kill()
    return process.returncode, output, re.sub(r".* \.\.\.\n", "", errors)


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_data(folder)
    return folder


@pytest.fixture(scope="session")
def corpus(tmp_path_factory) -> Path:
    """Return a folder of good files with the run finished/, whose network is in published/."""
    folder = tmp_path_factory.mktemp("corpus")
    write_data(folder)
    write_scene_files(folder)
    assert run_here("train", "out=finished", "train.epochs=2", *TRAINING, folder=folder) == 0
    nb.publish(folder / "finished", folder / "published")
    return folder
