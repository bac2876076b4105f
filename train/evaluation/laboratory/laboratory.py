"""Path-trace shots of objects, and write them as a folder of photographs."""

import csv
import io
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

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
from renderer.io.files import write_whole
from renderer.io.images import read_image, write_image
from renderer.io.mitsuba import Part, load, mitsuba, shape, split_parts
from renderer.io.mitsuba_entries import environment, look_at, projector, sensor
from renderer.light.basis import HARMONICS
from renderer.light.environment import read_panorama, to_map
from renderer.light.presets import PROBES, load_light
from train.command_settings import LabSettings
from train.data.photographs import DESCRIPTION, FOREIGN, TABLE
from train.evaluation.laboratory.lab_patterns import RESOLUTION
from train.evaluation.laboratory.shots import FOV, Shot, draw_shots
from train.runs.run_lock import LOCK, sole_writer
from train.settings import label_names, read_object, solid_name
from train.system.user_errors import writable_folder

RENDERS = "*/[0-9][0-9][0-9][0-9]*_*.png"  # by label, with the number of the setup and the name of its light
PACKAGES = ("mitsuba", "numpy", "torch")  # whose versions may change a pixel
THROW = 2.6  # half of the width that the projector lights where it aims, in world units
PROBE_HEIGHT = 64  # rows of the map of a built-in light
FLOOR = 100.0  # half of the width of table and wall
SHARP = 0.85  # cosine off the vertex normal beyond which a face keeps its own: at a right-angled edge at most 0.82


def lab_parts(mesh: Mesh, albedo_scale: float) -> list[Part]:
    """The mesh by texture: smooth but at sharp edges, with linear colors and textures (H, W, 3) times `albedo_scale`
    and at most 1."""

    def scaled(linear: np.ndarray) -> np.ndarray:
        return np.clip(albedo_scale * linear, 0, 1).astype(np.float32)

    parts = []
    for part in split_parts(mesh, corner_normals(mesh.vertices, mesh.faces, "smooth", SHARP), "srgb"):
        texture = part.texture
        if texture is not None:
            texture = scaled(decode(torch.from_numpy(texture / 255), "srgb").numpy())
        parts.append(replace(part, colors=scaled(part.colors), texture=texture))
    return parts


def path_traced(parts: Sequence[Part], shot: Shot, size: int, spp: int, bounces: int, seed: int) -> np.ndarray:
    """(size, size, 3) float32 linear radiance by Mitsuba 3, from `spp` samples per pixel and light.

    Projectors and surroundings are rendered one by one and added: with both in one scene each path would choose one of
    them at random, which is most of the noise. InputError: Mitsuba is not installed.
    """
    with mitsuba() as module:
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": bounces + 1},
            "sensor": sensor(look_at(shot.camera, shot.aim), size, FOV, "rgb"),
            "table": _plane(np.eye(4), shot.table),
            **({} if shot.wall is None else {"wall": _plane(look_at(shot.wall, shot.center), shot.table)}),
            **{f"part_{index}": part for index, part in enumerate(_object(module, parts, shot))},
        }
        scenes = [load(module, {**scene, "light": light}) for light in _lights(shot)]
        return np.sum([np.array(module.render(scene, spp=spp, seed=seed)) for scene in scenes], axis=0)


def _rgb(color: np.ndarray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(channel) for channel in color]}


def _lights(shot: Shot) -> list[dict[str, Any]]:
    if shot.environment is not None:
        return [environment({"bitmap": shot.environment})]
    lights = []
    for position, pattern in zip(shot.projectors, shot.patterns, strict=True):
        distance = float(np.linalg.norm(position - shot.center))
        fov, scale = 2 * float(np.degrees(np.arctan(THROW / distance))), shot.brightness * distance**2
        pose = look_at(position, shot.center)
        lights.append(projector(pose, fov, {"bitmap": pattern}, scale / len(shot.patterns)))
    return [*lights, {"type": "constant", "radiance": _rgb(shot.ambient)}]


def _plane(pose: np.ndarray, color: np.ndarray) -> dict[str, Any]:
    """A large square whose front is seen from its own z > 0."""
    sides = np.diag([FLOOR, FLOOR, 1.0, 1.0])
    return {"type": "rectangle", "to_world": pose @ sides, "bsdf": {"type": "diffuse", "reflectance": _rgb(color)}}


def _object(module: Any, parts: Sequence[Part], shot: Shot) -> list[Any]:
    """The object rotated, scaled and set down on the table, a shape per part."""
    rotated = [(shot.scale * part.positions @ shot.rotation.T).reshape(-1, 3) for part in parts]
    lowest, shapes = min(positions[:, 2].min() for positions in rotated), []
    for part, positions in zip(parts, rotated, strict=True):
        albedo: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
        if part.texture is not None:
            albedo = {"type": "bitmap", "bitmap": part.texture, "raw": True}
        surface = {"type": "principled", "base_color": albedo, "roughness": shot.roughness}
        faces, normals = np.arange(len(positions)).reshape(-1, 3), (part.normals @ shot.rotation.T).reshape(-1, 3)
        positions, uvs, colors = positions - [0, 0, lowest], part.uvs.reshape(-1, 2), part.colors.reshape(-1, 3)
        twosided = {"type": "twosided", "surface": surface}
        shapes.append(shape(module, twosided, positions, faces, normals, uvs, colors))
    return shapes


def write_laboratory(settings: LabSettings) -> int:
    """Write the folder `settings.out` and return its number of renders; the settings decide their bytes.

    The folder has class folders of PNG files, photos.csv and lab.json, as `train.data.photographs` reads them.
    InputError: a folder that is not empty; meshes that cannot be read or have no label; no mesh of a label under study, or no other;
    Mitsuba is not installed.
    """
    out = writable_folder(settings.out, "out")
    subjects = [read_subject(item, index) for index, item in enumerate(progress(settings.meshes, "meshes"))]
    environments = {Path(path).stem: _read_environment(Path(path)) for path in settings.environments}
    labels = label_names(settings.label)
    groups = {label: [subject for subject in subjects if subject[0] == label] for label in labels}
    others = [subject for subject in subjects if subject[0] not in labels]
    if missing := [label for label, group in groups.items() if not group or (len(labels) == 1 and not others)]:
        raise InputError(f"meshes: name at least one of label={missing[0]} and one of another class")
    slides = [decode(read_image(path, RESOLUTION), "srgb").permute(1, 2, 0).numpy() for path in settings.slides]
    shots = draw_shots(settings, environments, slides)
    with sole_writer("out", out):
        if settings.overwrite:
            for render in out.glob(RENDERS):
                render.unlink()
        elif any(path.name != LOCK for path in out.iterdir()):
            advice = "choose another, or set overwrite=true to write over its results"
            raise InputError(f"out={out} holds other files, and a laboratory needs an empty folder: {advice}")
        rows = []
        for number, shot in progress(enumerate(shots), "setups", settings.setups):
            seed = stream_seed(settings.seed, "samples", number) % 2**32
            for subjects in filter(None, (*groups.values(), others)):
                label, mesh, parts = subjects[number % len(subjects)]
                radiance = path_traced(parts, shot, settings.size, settings.spp, settings.bounces, seed)
                image = encode(torch.from_numpy(settings.exposure * radiance).clamp(0, 1), "srgb")
                path = Path(label) / f"{number:04d}_{shot.family}.png"
                (out / path).parent.mkdir(parents=True, exist_ok=True)
                write_image(out / path, Image.fromarray((image * 255).round().byte().numpy()))
                rows.append((path.as_posix(), shot.family, number, mesh, f"{shot.brightness:.4f}"))
        table = io.StringIO()
        csv.writer(table).writerows([("path", "source_tag", "setup", "mesh", "brightness"), *sorted(rows)])
        write_whole(out / TABLE, table.getvalue())
        versions = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
        description = {**asdict(settings), "versions": versions}
        write_whole(out / DESCRIPTION, json.dumps(description, indent=2) + "\n")
        return len(rows)


def _read_environment(path: Path) -> np.ndarray:
    """Radiance (H, W, 3) of a map, or of a built-in light that is made physical; InputError where no light of a map
    comes from above, and as `read_panorama`."""
    if str(path) in PROBES:
        return to_map(HARMONICS.project_nonnegative(load_light(str(path))), PROBE_HEIGHT).clamp(min=0).numpy()
    radiance = read_panorama(path).numpy()
    if not radiance[: len(radiance) // 2].max() > 0:
        raise InputError(f"environments: {path} is dark above: give a map with light from above the horizon")
    return radiance


def read_subject(item: str | dict[str, Any], index: int) -> tuple[str, str, list[Part]]:
    """The label, mesh and parts of an entry of `meshes`. The label of a solid is its own name by default, with `other_`
    before hard negatives.

    InputError: as `load_object`; a file without a label; a label that is not a folder's name.
    """
    settings = read_object(item, "", f"meshes[{index}]")
    label, name = settings.label, solid_name(settings.mesh)
    if not label and name:
        label = FOREIGN + name if name in HARD_NEGATIVES else name
    if not label:
        raise InputError(f"meshes[{index}] has no label: give {{mesh: {settings.mesh}, label: CLASS or {FOREIGN}NAME}}")
    if Path(label).name != label or label == "..":
        raise InputError(f"meshes[{index}]: the label {label!r} names the renders' folder: leave out slashes")
    return label, settings.mesh, lab_parts(load_object(settings).mesh, settings.albedo_scale)
