"""A folder with one small good file of every kind that a door reads, made by the project itself."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from renderer.io.export import export_mesh
from renderer.io.lights import save_light
from renderer.light.environment import to_map, write_map
from renderer.light.presets import probe
from renderer.shapes import solid

LIGHTS = ("light.npy", "light.hdr", "light.exr", "light.json")
MESHES = ("mesh.obj", "mesh.glb", "mesh.gltf", "mesh.ply", "mesh.stl", "mesh.off")
BESIDE = {"mesh.mtl": "mesh.obj", "peel.png": "mesh.obj", "gltf_buffer_0.bin": "mesh.gltf"}  # and the mesh they serve
CLASSES = ["apple", "orange", "pear"]
RUN, PUBLISHED = "finished", "published"


def write_corpus(folder: Path) -> None:
    """Fill an empty folder: data, photographs, meshes, lights, a background. A run and its network come later."""
    write_inputs(folder)
    _write_photographs(folder / "photographs")
    _write_class_folders(folder / "images")
    _write_meshes(folder)
    light = probe("grace")
    for name in LIGHTS[:3]:
        write_map(folder / name, to_map(light, 8))
    save_light(folder / LIGHTS[3], light)
    Image.new("RGB", (20, 24), "gray").save(folder / "background.png")


def write_inputs(folder: Path) -> None:
    """Data and photographs, in an empty folder."""
    rng = np.random.default_rng(0)
    trained, tested = np.repeat(np.arange(len(CLASSES)), 20), np.repeat(np.arange(len(CLASSES)), 10)
    np.savez(
        folder / "data.npz",
        train_images=_colored_noise(rng, trained),
        train_labels=trained,
        test_images=_colored_noise(rng, tested),
        test_labels=tested,
        classes=np.array(CLASSES),
    )
    for name in ("orange", "apple", "other_tomato"):
        (folder / "photographs" / name).mkdir(parents=True)
        for number in range(3):
            pixels = rng.integers(0, 256, (20, 24, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(folder / "photographs" / name / f"{number}.png")


def _colored_noise(rng: np.random.Generator, labels: np.ndarray) -> np.ndarray:
    """Images (N, 3, 16, 16) uint8 whose channel `label` is a little brighter, so that accuracies move for long."""
    images = rng.integers(0, 245, (len(labels), 3, 16, 16))
    images[np.arange(len(labels)), labels] += 10
    return images.astype(np.uint8)


def _write_photographs(folder: Path) -> None:
    Image.open(folder / "orange" / "0.png").save(folder / "orange" / "4.jpg")
    paths = sorted(path.relative_to(folder).as_posix() for path in folder.glob("*/*"))
    (folder / "photos.csv").write_text("path,source_tag\n" + "".join(f"{path},web\n" for path in paths))


def _write_class_folders(folder: Path) -> None:
    rng = np.random.default_rng(1)
    for name in ("apple", "orange"):
        (folder / name).mkdir(parents=True)
        for number in range(6):
            Image.fromarray(rng.integers(0, 256, (20, 20, 3)).astype(np.uint8)).save(folder / name / f"{number}.png")


def _write_meshes(folder: Path) -> None:
    textured, sphere = solid("lemon", 0), trimesh.creation.icosphere(subdivisions=2)
    for suffix in (".glb", ".ply"):
        export_mesh(textured, folder / f"mesh{suffix}")
    for suffix in (".stl", ".off"):
        sphere.export(folder / f"mesh{suffix}")
    for name, content in trimesh.Scene([sphere]).export(file_type="gltf").items():
        (folder / ("mesh.gltf" if name == "model.gltf" else name)).write_bytes(content)
    lines = ["mtllib mesh.mtl", *(f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in sphere.vertices)]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1", "usemtl peel"]
    lines += [f"f {a}/1 {b}/2 {c}/3" for a, b, c in sphere.faces + 1]
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")
    (folder / "mesh.mtl").write_text("newmtl peel\nKd 1 0.5 0\nmap_Kd peel.png\n")
    Image.new("RGB", (4, 4), "orange").save(folder / "peel.png")
