"""Commands that ask for a great deal, in a folder with the reliability study's corpus."""

import os
import shutil
from pathlib import Path

import trimesh

from train.studies.reliability.corpus import RUN
from train.studies.reliability.doors import BY_NAME

TRAIN = BY_NAME["train data=npz"]


def renders(folder: Path, count: int) -> list[str]:
    """One mesh before twenty grays, of 32 pixels per side."""
    grays = [round(number / 20, 2) for number in range(20)]
    more = ["augment=adversarial", "data.size=32", f"augment.examples={count}", f"scene.backgrounds={grays}"]
    return BY_NAME["train data=folder"].command(*more, "scene.meshes=[mesh.obj]")


def views(folder: Path, count: int) -> list[str]:
    """One mesh before one gray, of 16 pixels per side."""
    return TRAIN.command(f"augment.examples={count}")


def faces(folder: Path, count: int) -> list[str]:
    """A sphere in a .ply file, of about as many."""
    rows = max(4, round((count / 8) ** 0.5 + 0.5))
    trimesh.creation.uv_sphere(count=(rows, 2 * rows)).export(folder / "sphere.ply")
    return TRAIN.command("scene.meshes=[sphere.ply]")


def jpegs(folder: Path, count: int) -> list[str]:
    """Links to one JPEG."""
    many = folder / "many" / "orange"
    many.mkdir(parents=True)
    for number in range(count):
        (many / f"{number}.jpg").symlink_to(folder / "photographs" / "orange" / "4.jpg")
    return BY_NAME["evaluate_photos.py"].command("photos=many")


def runs(folder: Path, count: int) -> list[str]:
    """Copies of one, as if they were seeds."""
    names = [f"runs/{number}" for number in range(count)]
    for name in names:
        shutil.copytree(folder / RUN, folder / name, copy_function=os.link)
    return BY_NAME["compare_runs.py"].command(f"runs=[{','.join(names)}]")
