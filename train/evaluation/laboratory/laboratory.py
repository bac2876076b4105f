"""Render the path-traced test set of pnb-lab, and write it as a folder of photographs."""

import csv
import io
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image

from augment.progress import progress
from augment.random_streams import stream_seed
from augment.scene.objects import load_object
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.normals import corner_normals
from renderer.geometry.shapes import HARD_NEGATIVES
from renderer.image import decode, encode
from renderer.io.files import atomic_write
from renderer.io.images import read_image, write_image
from renderer.io.mitsuba_entries import environment, look_at, projector, sensor
from renderer.light.basis import HARMONICS
from renderer.light.environment import read_panorama, to_map
from renderer.light.presets import PROBES, load_light
from renderer.mitsuba_scene import Part, load, mitsuba, shape, split_parts
from train.command_settings import LabSettings
from train.data.photographs import DESCRIPTION, OTHER_PREFIX, TABLE
from train.evaluation.laboratory.lab_patterns import RESOLUTION
from train.evaluation.laboratory.shots import FOV, Shot, draw_shots
from train.runs.run_lock import LOCK, sole_writer
from train.settings import label_names, read_object, solid_name
from train.system.user_errors import writable_folder

# Pattern of the renders below the folder: LABEL/SETUP_FAMILY.png.
RENDERS = "*/[0-9][0-9][0-9][0-9]*_*.png"
# Columns of the table of renders.
COLUMNS = ("path", "source_tag", "setup", "mesh", "brightness")
# Packages whose versions may change a pixel.
PACKAGES = ("mitsuba", "numpy", "torch")
# A projector lights a square around the object with this half-width, in world
# units.
PROJECTOR_HALF_WIDTH = 2.6
# Rows of the map of a built-in light.
PROBE_HEIGHT = 64
# The table and the wall are squares of this half-width, in world units.
PLANE_HALF_WIDTH = 100.0
# Smallest cosine between the normals of a face and of a vertex at which the
# shading is smooth. At a right-angled edge, the cosine is at most 0.82.
MIN_SMOOTH_COSINE = 0.85
# Mitsuba's seeds are below this number.
SEED_COUNT = 2**32


class Subject(NamedTuple):
    """A mesh to render.

    Attributes:
        label: Class of the mesh, and name of the folder of its renders.
        mesh: File of the mesh, or name of the solid.
        parts: Parts of the mesh. Each part has one texture, or none.
    """

    label: str
    mesh: str
    parts: list[Part]


def lab_parts(mesh: Mesh, albedo_scale: float) -> list[Part]:
    """Split a mesh by texture, and convert its colors to linear RGB.

    The shading is smooth, except at sharp edges.

    Args:
        mesh: Mesh with colors and textures in sRGB.
        albedo_scale: Factor of all colors. The product is limited to [0, 1].

    Returns:
        Parts with linear colors, and linear textures of shape (H, W, 3).
    """
    normals = corner_normals(mesh.vertices, mesh.faces, "smooth", MIN_SMOOTH_COSINE)
    parts = []
    for part in split_parts(mesh, normals, "srgb"):
        texture = part.texture
        if texture is not None:
            linear = decode(torch.from_numpy(texture / 255), "srgb").numpy()
            texture = _scale_albedo(linear, albedo_scale)
        colors = _scale_albedo(part.colors, albedo_scale)
        parts.append(replace(part, colors=colors, texture=texture))
    return parts


def _scale_albedo(albedo: np.ndarray, factor: float) -> np.ndarray:
    """Multiply an albedo by a factor, and limit it to [0, 1]."""
    return np.clip(factor * albedo, 0, 1).astype(np.float32)


def path_traced(
    parts: Sequence[Part],
    shot: Shot,
    size: int,
    spp: int,
    bounces: int,
    seed: int,
) -> np.ndarray:
    """Render an object with the path tracer of Mitsuba 3.

    Each light source is rendered alone, and the images are added. With all
    light sources in one scene, each path would choose one of them at random,
    and this choice would cause most of the noise.

    Args:
        parts: Parts of the object, see `lab_parts`.
        shot: Lighting, camera, pose and table.
        size: Pixels per side of the image.
        spp: Paths per pixel and light source.
        bounces: Maximum number of reflections of a path.
        seed: Seed of the paths.

    Returns:
        Radiance in linear RGB, shape (size, size, 3), float32.

    Raises:
        InputError: If Mitsuba is not installed.
    """
    with mitsuba() as module:
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": bounces + 1},
            "sensor": sensor(look_at(shot.camera, shot.aim), size, FOV, "rgb"),
            "table": _plane(np.eye(4), shot.table),
        }
        if shot.wall is not None:
            scene["wall"] = _plane(look_at(shot.wall, shot.center), shot.table)
        for index, part in enumerate(_object(module, parts, shot)):
            scene[f"part_{index}"] = part
        scenes = [load(module, {**scene, "light": light}) for light in _lights(shot)]
        images = [np.array(module.render(scene, spp=spp, seed=seed)) for scene in scenes]
        return np.sum(images, axis=0)


def _rgb(color: np.ndarray) -> dict[str, Any]:
    """Describe a linear color (3,) for Mitsuba."""
    return {"type": "rgb", "value": [float(channel) for channel in color]}


def _lights(shot: Shot) -> list[dict[str, Any]]:
    """Describe the light sources of a shot for Mitsuba.

    Returns:
        Entries of a Mitsuba scene: the environment map, if the shot has one.
        Otherwise a projector for each pattern, and even light from all
        around.
    """
    if shot.environment is not None:
        return [environment({"bitmap": shot.environment})]
    lights = []
    for position, pattern in zip(shot.projectors, shot.patterns, strict=True):
        distance = float(np.linalg.norm(position - shot.center))
        # At the object, the light covers a square of this half-width.
        fov = 2 * float(np.degrees(np.arctan(PROJECTOR_HALF_WIDTH / distance)))
        # The irradiance of a projector falls with the square of the distance.
        power = shot.brightness * distance**2
        pose = look_at(position, shot.center)
        lights.append(projector(pose, fov, {"bitmap": pattern}, power / len(shot.patterns)))
    lights.append({"type": "constant", "radiance": _rgb(shot.ambient)})
    return lights


def _plane(pose: np.ndarray, color: np.ndarray) -> dict[str, Any]:
    """Describe a large diffuse square, the table or the wall, for Mitsuba.

    Args:
        pose: Matrix from the coordinates of the square to the world, shape
            (4, 4). The square lies in its plane z = 0, and its front faces +z.
        color: Albedo in linear RGB, shape (3,).
    """
    scale = np.diag([PLANE_HALF_WIDTH, PLANE_HALF_WIDTH, 1.0, 1.0])
    surface = {"type": "diffuse", "reflectance": _rgb(color)}
    return {"type": "rectangle", "to_world": pose @ scale, "bsdf": surface}


def _object(module: Any, parts: Sequence[Part], shot: Shot) -> list[Any]:
    """Make a Mitsuba shape of each part of the object in the pose of a shot.

    The object is scaled and rotated. Its lowest point then touches the table
    z = 0.

    Args:
        module: The module `mitsuba`.
        parts: Parts of the object.
        shot: Shot with scale, rotation and roughness.
    """
    positions_by_part = []
    for part in parts:
        positions = shot.scale * part.positions @ shot.rotation.T
        positions_by_part.append(positions.reshape(-1, 3))
    lowest = min(positions[:, 2].min() for positions in positions_by_part)
    shapes = []
    for part, positions in zip(parts, positions_by_part, strict=True):
        albedo: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
        if part.texture is not None:
            albedo = {"type": "bitmap", "bitmap": part.texture, "raw": True}
        surface = {"type": "principled", "base_color": albedo, "roughness": shot.roughness}
        # Each face has three vertices of its own.
        faces = np.arange(len(positions)).reshape(-1, 3)
        normals = (part.normals @ shot.rotation.T).reshape(-1, 3)
        shapes.append(
            shape(
                module,
                {"type": "twosided", "surface": surface},
                positions - [0, 0, lowest],
                faces,
                normals,
                part.uvs.reshape(-1, 2),
                part.colors.reshape(-1, 3),
            )
        )
    return shapes


def write_laboratory(settings: LabSettings) -> int:
    """Render the test set, and write it to the folder `settings.out`.

    The folder gets a subfolder of PNG files for each class, photos.csv and
    lab.json. `train.data.photographs` reads such a folder. The settings and the
    versions of the packages decide every byte.

    Args:
        settings: Settings of pnb-lab.

    Returns:
        Number of renders.

    Raises:
        InputError: If the folder is not empty, if a mesh cannot be read or has
            no label, if there is no mesh of a label or no hard negative, or if
            Mitsuba is not installed.
    """
    out = writable_folder(settings.out, "out")
    subjects = []
    for index, item in enumerate(progress(settings.meshes, "meshes")):
        subjects.append(read_subject(item, index))
    paths = [Path(path) for path in settings.environments]
    environments = {path.stem: _read_environment(path) for path in paths}
    groups = _group_subjects(subjects, label_names(settings.label))
    slides = [_read_slide(path) for path in settings.slides]
    shots = draw_shots(settings, environments, slides)
    with sole_writer("out", out):
        _clear(out, settings.overwrite)
        rows = []
        for number, shot in progress(enumerate(shots), "setups", settings.setups):
            for group in groups:
                subject = group[number % len(group)]
                path = _write_render(out, settings, subject, shot, number)
                brightness = f"{shot.brightness:.4f}"
                rows.append((path, shot.family, number, subject.mesh, brightness))
        table = io.StringIO()
        csv.writer(table).writerows([COLUMNS, *sorted(rows)])
        atomic_write(out / TABLE, table.getvalue())
        versions = {"python": platform.python_version()}
        versions |= {name: version(name) for name in PACKAGES}
        description = {**asdict(settings), "versions": versions}
        atomic_write(out / DESCRIPTION, json.dumps(description, indent=2) + "\n")
        return len(rows)


def _group_subjects(subjects: Sequence[Subject], labels: Sequence[str]) -> list[list[Subject]]:
    """Group the meshes by label.

    Args:
        subjects: Meshes with their labels.
        labels: Positive classes.

    Returns:
        The meshes of each label. The last group has the meshes of all other
        classes, if there are any.

    Raises:
        InputError: If a label has no mesh, or if there is a single label and no
            mesh of another class.
    """
    negatives = [subject for subject in subjects if subject.label not in labels]
    groups = []
    for label in labels:
        group = [subject for subject in subjects if subject.label == label]
        # If there are several labels, the meshes of a label are negatives of the
        # other labels.
        needs_negatives = len(labels) == 1
        if not group or (needs_negatives and not negatives):
            raise InputError(f"meshes: name at least one of label={label} and one of another class")
        groups.append(group)
    if negatives:
        groups.append(negatives)
    return groups


def _clear(out: Path, overwrite: bool) -> None:
    """Prepare the folder of the test set.

    Args:
        out: The folder.
        overwrite: Whether earlier renders in the folder are removed.

    Raises:
        InputError: If the folder has files, and `overwrite` is false.
    """
    if overwrite:
        for render in out.glob(RENDERS):
            render.unlink()
    elif any(path.name != LOCK for path in out.iterdir()):
        raise InputError(
            f"out={out} holds other files, and a laboratory needs an empty folder: "
            "choose another, or set overwrite=true to write over its results",
        )


def _write_render(
    out: Path,
    settings: LabSettings,
    subject: Subject,
    shot: Shot,
    number: int,
) -> str:
    """Render a mesh in a shot, and write the image as sRGB of 8 bits.

    Args:
        out: Folder of the test set.
        settings: Settings of pnb-lab.
        subject: The mesh.
        shot: Lighting, camera and pose.
        number: Number of the shot, from 0.

    Returns:
        Path of the image in `out`: LABEL/NUMBER_FAMILY.png.
    """
    seed = stream_seed(settings.seed, "samples", number) % SEED_COUNT
    radiance = path_traced(subject.parts, shot, settings.size, settings.spp, settings.bounces, seed)
    exposed = torch.from_numpy(settings.exposure * radiance).clamp(0, 1)
    values = (encode(exposed, "srgb") * 255).round().byte()
    path = Path(subject.label) / f"{number:04d}_{shot.family}.png"
    (out / path).parent.mkdir(parents=True, exist_ok=True)
    write_image(out / path, Image.fromarray(values.numpy()))
    return path.as_posix()


def _read_slide(path: str) -> np.ndarray:
    """Read the picture of a slide as linear RGB (RESOLUTION, RESOLUTION, 3)."""
    return decode(read_image(path, RESOLUTION), "srgb").permute(1, 2, 0).numpy()


def _read_environment(path: Path) -> np.ndarray:
    """Read the radiance of an environment map, or of a built-in light.

    Args:
        path: File of the map, or name of a built-in light. Negative radiance of
            a built-in light is removed.

    Returns:
        Linear RGB, shape (H, W, 3). The upper half is above the horizon.

    Raises:
        InputError: If no light comes from above the horizon.
    """
    if str(path) in PROBES:
        light = HARMONICS.project_nonnegative(load_light(str(path)))
        return to_map(light, PROBE_HEIGHT).clamp(min=0).numpy()
    radiance = read_panorama(path).numpy()
    upper_half = radiance[: len(radiance) // 2]
    # With `not`, the condition is also true if the largest radiance is NaN.
    if not upper_half.max() > 0:
        raise InputError(
            f"environments: {path} is dark above: give a map with light from above the horizon",
        )
    return radiance


def read_subject(item: str | dict[str, Any], index: int) -> Subject:
    """Read an entry of `meshes`.

    A solid without a label gets its own name as its label. For a hard negative,
    OTHER_PREFIX precedes the name.

    Args:
        item: File of a mesh, name of a solid, or settings of an object.
        index: Index of the entry, for error messages.

    Returns:
        The mesh with its label.

    Raises:
        InputError: If the mesh cannot be read, if a file has no label, or if
            the label cannot be the name of a folder.
    """
    settings = read_object(item, "", f"meshes[{index}]")
    label = settings.label
    name = solid_name(settings.mesh)
    if not label and name:
        label = OTHER_PREFIX + name if name in HARD_NEGATIVES else name
    if not label:
        raise InputError(
            f"meshes[{index}] has no label: "
            f"give {{mesh: {settings.mesh}, label: CLASS or {OTHER_PREFIX}NAME}}",
        )
    if Path(label).name != label or label == "..":
        raise InputError(
            f"meshes[{index}]: the label {label!r} names the renders' folder: leave out slashes",
        )
    parts = lab_parts(load_object(settings).mesh, settings.albedo_scale)
    return Subject(label, settings.mesh, parts)
