"""A laboratory on disk: class folders of PNG files, photos.csv and lab.json, as `train.photographs` reads them."""

import csv
import json
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import MISSING
from PIL import Image

from augment.objects import load_object
from augment.utils import progress, stream_seed
from renderer.errors import FACTOR, InputError, require_choice, require_limits, require_range
from renderer.image import LARGEST_SIZE, encode
from renderer.io.mitsuba import Part
from renderer.light.environment import read_panorama
from renderer.shapes import HARD_NEGATIVES
from train.errors import writable_folder
from train.lab.patterns import FAMILIES
from train.lab.shots import Shot, draw_shots
from train.lab.studio import lab_parts, photograph
from train.photographs.folder import DESCRIPTION, FOREIGN, TABLE
from train.run_folder import LOCK, sole_writer
from train.settings import LARGEST_SEED, read_object

PACKAGES = ("mitsuba", "numpy", "torch")  # whose versions may change a pixel
COLUMNS = ("path", "source_tag", "setup", "mesh", "brightness")
SOLIDS = (
    *("orange:101", "orange:102", "orange:103", "orange:104", "orange:105", "orange:106", "apple:101", "apple:102"),
    *("pear:101", "sweet_pepper:101", "lemon:101", "lemon:102", "peach:101", "peach:102", "ball:101", "ball:103"),
)
LARGEST = {"setups": 10**6, "size": LARGEST_SIZE, "spp": 10**5, "bounces": 1000}


@dataclass
class LabSettings:
    """The settings of scripts/lab.py. A mesh is a file, `solid:NAME:SEED` or a mapping with the keys of ObjectSettings,
    whose label is a class, or other_NAME if the network lacks it."""

    out: str = MISSING  # a new folder, for photos= of scripts/evaluate_photos.py
    label: str = "orange"  # the class under study: one of its objects and one other stand in each setup
    meshes: list[Any] = field(default_factory=lambda: [f"solid:{solid}" for solid in SOLIDS])
    setups: int = 180  # draws of light, camera and pose; two photographs each
    patterns: list[str] = field(default_factory=lambda: list(FAMILIES))  # of the projector, for as many setups each
    environments: list[str] = field(default_factory=list)  # maps (.npy, .hdr, .exr) instead, for as many setups each
    brightness: list[float] = field(default_factory=lambda: [0.2, 2.5])  # of white surfaces that face the light
    exposure: float = 1.0  # multiplies radiance; at 1, a radiance of 1 is white
    size: int = 64  # pixels per side
    spp: int = 32  # paths per pixel and light
    bounces: int = 4  # of light, at most
    seed: int = 0

    def __post_init__(self) -> None:
        for name in self.patterns:
            require_choice("patterns", name, FAMILIES)
        sources = [*self.patterns, *(Path(path).stem for path in self.environments)]
        if not sources or self.setups < 1 or self.setups % len(sources):
            raise InputError(
                f"setups={self.setups} must be a positive multiple of the {len(sources)} patterns and environments"
            )
        if repeated := next((name for name in sources if sources.count(name) > 1), None):
            raise InputError(f"patterns and environments: {repeated} is named twice, and names the photographs' source")
        require_limits("brightness", self.brightness, 1 / FACTOR, FACTOR)
        require_range("exposure", self.exposure, 1 / FACTOR, FACTOR)
        require_range("seed", self.seed, 0, LARGEST_SEED)
        for name, most in LARGEST.items():
            require_range(name, getattr(self, name), 1, most)


@dataclass(frozen=True)
class Subject:
    """An object: the name of its class, that of its mesh, and its parts."""

    label: str
    mesh: str
    parts: list[Part]


def write_laboratory(settings: LabSettings) -> int:
    """Write the folder `settings.out` and return its number of photographs; the settings decide their bytes.

    InputError: a folder that is not empty; meshes that cannot be read or have no label; no mesh of the label under
    study, or no other; Mitsuba is not installed.
    """
    out = writable_folder(settings.out, "out")
    subjects = [read_subject(item, index) for index, item in enumerate(settings.meshes)]
    environments = {Path(path).stem: _read_environment(Path(path)) for path in settings.environments}
    positives = [subject for subject in subjects if subject.label == settings.label]
    negatives = [subject for subject in subjects if subject.label != settings.label]
    if not (positives and negatives):
        raise InputError(f"meshes: name at least one of label={settings.label} and one of another class")
    with sole_writer("out", out):
        if any(path.name != LOCK for path in out.iterdir()):
            raise InputError(f"out={out} is not an empty folder: name another, or delete it")
        rows = []
        for number, shot, subject in progress(
            _pairs(positives, negatives, settings, environments), "photographs", 2 * settings.setups
        ):
            path = Path(subject.label) / f"{number:04d}_{shot.family}.png"
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(_image(subject, shot, number, settings)).save(out / path)
            rows.append((path.as_posix(), shot.family, number, subject.mesh, f"{shot.brightness:.4f}"))
        with open(out / TABLE, "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([COLUMNS, *sorted(rows)])
        versions = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
        (out / DESCRIPTION).write_text(json.dumps({**asdict(settings), "versions": versions}, indent=2) + "\n", "utf-8")
        return len(rows)


def _pairs(
    positives: list[Subject], negatives: list[Subject], settings: LabSettings, environments: Mapping[str, np.ndarray]
) -> Iterator[tuple[int, Shot, Subject]]:
    """Each setup with its number, once with an object of the label and once with another; both take turns."""
    shots = draw_shots(settings.setups, settings.patterns, settings.brightness, settings.seed, environments)
    for number, shot in enumerate(shots):
        yield number, shot, positives[number % len(positives)]
        yield number, shot, negatives[number % len(negatives)]


def _image(subject: Subject, shot: Shot, number: int, settings: LabSettings) -> np.ndarray:
    """(size, size, 3) uint8 sRGB. Both photographs of a setup have the same seed."""
    seed = stream_seed(settings.seed, "samples", number) % 2**32
    radiance = photograph(subject.parts, shot, settings.size, settings.spp, settings.bounces, seed)
    exposed = torch.from_numpy(settings.exposure * radiance).clamp(0, 1)
    return (encode(exposed, "srgb") * 255).round().byte().numpy()


def _read_environment(path: Path) -> np.ndarray:
    """Radiance (H, W, 3); InputError where it is negative somewhere, or no light comes from above."""
    radiance = read_panorama(path).numpy()
    if radiance.min() < 0 or not radiance[: len(radiance) // 2].max() > 0:
        raise InputError(f"environments: {path} is negative somewhere or dark above: give a map of emitted light")
    return radiance


def read_subject(item: str | dict[str, Any], index: int) -> Subject:
    """An entry of `meshes`. The label of a solid is its own name by default, with `other_` before hard negatives.

    InputError: as `load_object`; a file without a label; a label that is not a folder's name.
    """
    settings = read_object(item, "", index, "meshes")
    label = settings.label or _label_of_solid(settings.mesh)
    if not label:
        raise InputError(
            f"meshes[{index}]: {settings.mesh} has no label: give {{mesh: {settings.mesh}, label: CLASS}}, with "
            f"{FOREIGN}NAME if the network lacks the class"
        )
    if Path(label).name != label or label == "..":
        raise InputError(f"meshes[{index}]: the label {label!r} names the photographs' folder: leave out slashes")
    return Subject(label, settings.mesh, lab_parts(load_object(settings).mesh, settings.albedo_scale))


def _label_of_solid(mesh: str) -> str:
    """The label of `solid:NAME:SEED`; "" for a file."""
    kind, _, name = mesh.partition(":")
    name = name.partition(":")[0]
    if kind != "solid":
        return ""
    return FOREIGN + name if name in HARD_NEGATIVES else name
