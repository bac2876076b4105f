"""A laboratory on disk: class folders of PNG files, photos.csv and lab.json, as `train.photographs` reads them."""

import csv
import json
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from augment.objects import load_object
from augment.utils import progress, stream_seed
from renderer.errors import InputError
from renderer.image import encode
from renderer.light.environment import read_panorama
from renderer.shapes import LOOK_ALIKES
from train.command_line.outputs import writable_folder
from train.laboratory.props import Part, split_parts
from train.laboratory.settings import LabSettings, environment_name
from train.laboratory.shots import Shot, draw_shots
from train.laboratory.studio import photograph
from train.photographs.folder import DESCRIPTION, FOREIGN, TABLE
from train.run_folder.files import LOCK, sole_writer
from train.settings import read_object

PACKAGES = ("mitsuba", "numpy", "torch")  # whose versions may decide a pixel
COLUMNS = ("path", "source_tag", "light", "mesh", "brightness")


@dataclass(frozen=True)
class Subject:
    """An object: the name of its class, that of its mesh, and its parts."""

    label: str
    mesh: str
    parts: list[Part]


def write_laboratory(settings: LabSettings) -> int:
    """Write the folder `settings.out` and return its number of photographs; their bytes follow from the settings.

    InputError: a folder that is not empty; meshes that cannot be read or have no label; none of the label under study
    or none beside it; Mitsuba is not installed.
    """
    out = writable_folder(settings.out, "out")
    subjects = [read_subject(item, index) for index, item in enumerate(settings.meshes)]
    environments = {environment_name(path): _read_environment(Path(path)) for path in settings.environments}
    sides = [[item for item in subjects if (item.label == settings.label) is wanted] for wanted in (True, False)]
    if not all(sides):
        raise InputError(f"meshes: name at least one of label={settings.label} and one of something else")
    with sole_writer("out", out):
        if any(path.name != LOCK for path in out.iterdir()):
            raise InputError(f"out={out} is not an empty folder: name another, or delete it")
        return _write(_sittings(sides, settings, environments), settings, out)


def _read_environment(path: Path) -> np.ndarray:
    """Radiance (H, W, 3), which is nowhere negative; InputError otherwise, and where nothing falls from above."""
    radiance = read_panorama(path).numpy()
    if radiance.min() < 0 or not radiance[: len(radiance) // 2].max() > 0:
        raise InputError(f"environments: {path} is negative somewhere or dark above: give a map of what lamps emit")
    return radiance


def _write(sittings: Iterator[tuple[int, Shot, Subject]], settings: LabSettings, out: Path) -> int:
    """Photograph and write; the number of photographs."""
    rows = []
    for light, shot, subject in progress(sittings, "photographs", 2 * settings.lights):
        path = Path(subject.label) / f"{light:04d}_{shot.family}.png"
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(_image(subject, shot, light, settings)).save(out / path)
        rows.append((path.as_posix(), shot.family, light, subject.mesh, f"{shot.brightness:.4f}"))
    with open(out / TABLE, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([COLUMNS, *sorted(rows)])
    versions = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
    (out / DESCRIPTION).write_text(json.dumps({**asdict(settings), "versions": versions}, indent=2) + "\n", "utf-8")
    return len(rows)


def read_subject(item: str | dict[str, Any], index: int) -> Subject:
    """An entry of `meshes`. Without a label, a solid has its own name, with `other_` before that of a hard negative.

    InputError: as `load_object`; a file without a label.
    """
    named = read_object(item, "", index, "meshes")
    label = named.label or _label_of_solid(named.mesh)
    if not label:
        raise InputError(
            f"meshes[{index}]: {named.mesh} has no label: give {{mesh: {named.mesh}, label: CLASS}}, with "
            f"{FOREIGN}NAME for what the network has no class for"
        )
    if Path(label).name != label or label == "..":
        raise InputError(
            f"meshes[{index}]: the label {label!r} is no folder's name, where its photographs go: rename it"
        )
    return Subject(label, named.mesh, split_parts(load_object(named).mesh, named.albedo_scale, named.mesh))


def _label_of_solid(mesh: str) -> str:
    """The label of `solid:NAME:SEED`; nothing for a file."""
    kind, _, name = mesh.partition(":")
    name = name.partition(":")[0]
    if kind != "solid":
        return ""
    return FOREIGN + name if name in LOOK_ALIKES else name


def _sittings(
    sides: list[list[Subject]], settings: LabSettings, environments: Mapping[str, np.ndarray]
) -> Iterator[tuple[int, Shot, Subject]]:
    """Each light with its number, once with an object of the label and once with another; either side takes turns."""
    shots = draw_shots(settings.lights, settings.patterns, settings.brightness, settings.seed, environments)
    for light, shot in enumerate(shots):
        for side in sides:
            yield light, shot, side[light % len(side)]


def _image(subject: Subject, shot: Shot, light: int, settings: LabSettings) -> np.ndarray:
    """(size, size, 3) uint8 sRGB. The seed of the samples is the light's, too."""
    seed = stream_seed(settings.seed, "samples", light) % 2**32
    radiance = photograph(subject.parts, shot, settings.size, settings.samples, settings.bounces, seed)
    exposed = torch.from_numpy(settings.exposure * radiance).clamp(0, 1)
    return (encode(exposed, "srgb") * 255).round().byte().numpy()
