"""Commands that ask for a great deal, in a folder with the reliability study's corpus."""

import os
import shutil
from pathlib import Path

import numpy as np

from train.studies.reliability.corpus import RUN
from train.studies.reliability.doors import BY_NAME

MOST_LINKS = 50_000  # to one file; ext4 takes 65,000
TRAIN = BY_NAME["train data=npz"]


def renders(folder: Path, count: int) -> list[str]:
    """One mesh before twenty greys, of 32 pixels per side."""
    greys = [round(number / 20, 2) for number in range(20)]
    more = ["augment=adversarial", "data.size=32", f"augment.examples={count}", f"scene.backgrounds={greys}"]
    return BY_NAME["train data=folder"].command(*more, "scene.meshes=[mesh.obj]")


def views(folder: Path, count: int) -> list[str]:
    """One mesh before one grey, of 16 pixels per side."""
    return TRAIN.command(f"augment.examples={count}")


def faces(folder: Path, count: int) -> list[str]:
    """A sphere in a .ply file."""
    write_sphere(folder / "sphere.ply", count)
    return TRAIN.command("scene.meshes=[sphere.ply]")


def jpegs(folder: Path, count: int) -> list[str]:
    """Links to copies of one JPEG."""
    many = folder / "many" / "orange"
    many.mkdir(parents=True)
    for number in range(count):
        if number % MOST_LINKS == 0:
            copy = shutil.copy(folder / "photographs" / "orange" / "4.jpg", folder / f"{number}.jpg")
        os.link(copy, many / f"{number}.jpg")
    return BY_NAME["evaluate_photos.py"].command("photos=many")


def runs(folder: Path, count: int) -> list[str]:
    """Copies of one, as if they were seeds."""
    names = [f"runs/{number}" for number in range(count)]
    for name in names:
        shutil.copytree(folder / RUN, folder / name, copy_function=os.link)
    return BY_NAME["compare_runs.py"].command(f"runs=[{','.join(names)}]")


def write_sphere(path: Path, count: int) -> None:
    """Of about as many triangles, two for each cell of a grid of latitudes and longitudes."""
    rows = max(2, round((count / 4) ** 0.5))
    theta, phi = np.meshgrid(np.linspace(0.001, np.pi - 0.001, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1))
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=2)
    corner = np.arange(points[..., 0].size).reshape(theta.shape)
    first, below, beside, across = (
        part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:])
    )
    triangles = np.concatenate([np.stack([first, below, across], 1), np.stack([first, across, beside], 1)])
    faces = np.empty(len(triangles), dtype=[("corners", "u1"), ("index", "<i4", 3)])
    faces["corners"], faces["index"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {corner.size}"]
    header += [*(f"property float {axis}" for axis in "xyz"), f"element face {len(faces)}"]
    header += ["property list uchar int vertex_indices", "end_header\n"]
    path.write_bytes("\n".join(header).encode() + points.astype("<f4").tobytes() + faces.tobytes())
