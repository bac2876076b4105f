"""Find camera and light of a photograph: pnb-fit photograph=photo.jpg mask=mask.png mesh=orange.glb"""

import math
import shlex
import sys
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

import numpy as np
import torch
from omegaconf import MISSING
from PIL import Image

from augment.objects import ObjectSettings, load_object
from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError, require_choice, require_range
from renderer.fitting import fit_photograph
from renderer.image import ENCODINGS, MOST_BOUNCES, decode, encode, to_bytes
from renderer.io.images import read_image, read_rgb, write_image
from renderer.light.files import save_light
from train.attack import AttackExperimentSettings, build_attacked
from train.errors import writable_folder
from train.results import require_replaceable
from train.settings import compose, read_object, read_settings

DETAIL = 448  # pixels per side of the background that is written
ATTACKED = 224  # pixels per side of the images that the printed attack renders, for its default classifier
WHOLE = 0.98  # a pixel with a larger share is the object's
DOUBTFUL, WRONG = 0.9, 0.3  # overlap of the outlines, error of the pixels


@dataclass
class Settings:
    photograph: str = MISSING  # an image file
    mesh: str = MISSING  # a file, or solid:NAME:SEED; upright, as in the photograph
    mask: str | None = None  # an image of the photograph's size, white where the object is
    box: list[int] = field(default_factory=list)  # or [left, top, right, bottom] in pixels, for OpenCV's GrabCut
    fov: float | None = None  # degrees across a square 1.6 times as wide as the object; null: orthographic
    albedo_scale: float = 1.0  # of the mesh; twice as much halves the light
    encoding: str = "srgb"  # of the photograph, the mesh's colors and the printed attack's images: srgb | linear
    bounces: int = 3  # of the light between the mesh's surfaces; 0: without shadows, too
    label: str = "orange"  # the class of the printed attack
    size: int = 64  # pixels per side that are compared
    out: str = "runs/fit"  # the folder of background.png, mask.png, light.json and comparison.png
    overwrite: bool = False  # write over the results that out holds

    def __post_init__(self) -> None:
        require_range("size", self.size, 16, 512)
        require_choice("encoding", self.encoding, ENCODINGS)
        require_range("bounces", self.bounces, 0, MOST_BOUNCES)
        require_range("albedo_scale", self.albedo_scale, 1e-3, 1e3)
        if self.fov is not None:
            require_range("fov", self.fov, 0.1, 120)
        if bool(self.mask) == bool(self.box):
            raise InputError("give mask=FILE or box=[left,top,right,bottom], one of them")


@cli.command()
def main(settings: Settings) -> None:
    image, out = read_file(settings.photograph), writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite)
    mask = read_mask(settings.mask, image) if settings.mask else grab_cut(image, settings.box)
    mesh = load_object(ObjectSettings(settings.mesh, label="", albedo_scale=settings.albedo_scale)).mesh
    found = fit_photograph(
        image,
        mask,
        mesh,
        settings.size,
        fov=None if settings.fov is None else math.radians(settings.fov),
        albedo_scale=settings.albedo_scale,
        encoding=settings.encoding,
        bounces=settings.bounces,
    )
    behind = found.window.cut(image, DETAIL, settings.encoding)
    share = found.window.cut(mask[..., None], DETAIL, beyond=0)
    out.mkdir(parents=True, exist_ok=True)
    write_values(out / "background.png", encode(behind, settings.encoding))
    write_values(out / "mask.png", share.expand(3, -1, -1))
    save_light(out / "light.json", found.scene.light)
    command = attack_command(settings, found.scene.camera, out)
    photograph, shown = rendered_by(command)
    inside = read_image(out / "mask.png", ATTACKED)[0] > WHOLE
    error = relative_error(shown[:, inside], photograph[:, inside], settings.encoding)
    write_values(out / "comparison.png", torch.cat([photograph, shown], dim=2))
    print(f"outlines overlap by {found.scene.overlap:.1%}; the object's pixels differ by {error:.1%}")
    if found.scene.overlap < DOUBTFUL or error > WRONG:
        print("warning: the mesh hardly fits; look at comparison.png, and check photograph, mask, mesh and fov")
    print(shlex.join(command))


def attack_command(settings: Settings, camera: Camera, out: Path) -> list[str]:
    """Write the command that attacks the light of the fitted scene, as a list of its words."""
    mesh = f"scene.meshes=[{{mesh: '{settings.mesh}', albedo_scale: {settings.albedo_scale:g}}}]"
    polar = f"scene.polar={math.degrees(camera.polar):.3f}"
    azimuth = f"scene.azimuth={math.degrees(camera.azimuth) % 360:.3f}"
    scene = [mesh, polar, azimuth, f"scene.width={camera.width:.4f}"]
    if isinstance(camera, PerspectiveCamera):
        scene.append(f"scene.fov={math.degrees(camera.angle):.3f}")
    scene += [f"scene.light={out / 'light.json'}", f"scene.backgrounds=[{out / 'background.png'}]", "scene.search=0"]
    shadows = f"renderer.bounces={settings.bounces}" if settings.bounces else "renderer.shadows=false"
    renderer = [f"renderer.encoding={settings.encoding}", shadows]
    return ["pnb-attack", "attack=lighting", f"label={settings.label}", *scene, *renderer]


def rendered_by(command: list[str]) -> tuple[torch.Tensor, torch.Tensor]:
    """Read a command of `attack_command` and its files as pnb-attack does.

    Returns:
        The background and the image that is attacked, both encoded, shape (3, ATTACKED, ATTACKED).
    """
    settings = read_settings(AttackExperimentSettings, compose("attack", command[1:]))
    item = read_object(settings.scene.meshes[0], settings.label, 0)
    scene = build_attacked(settings, item, settings.scene, ATTACKED, torch.device("cpu"))
    first = torch.arange(1)
    return scene.backgrounds[0], scene.render(scene.conditions(first), first)[0, 0]


def relative_error(shown: torch.Tensor, photograph: torch.Tensor, encoding: str) -> float:
    """Root mean square difference of encoded pixels in linear light, relative to the photograph's root mean square."""
    expected = decode(photograph.double(), encoding)
    return float((decode(shown.double(), encoding) - expected).norm() / expected.norm())


def read_file(path: str) -> np.ndarray:
    """(H, W, 3) uint8, upright."""
    try:
        return np.asarray(read_rgb(Path(path), 10**6))
    except Exception as error:  # Pillow's decoders raise almost anything at a broken file
        raise InputError(f"{path} cannot be read ({error}): give an image file") from error


def read_mask(path: str, image: np.ndarray) -> np.ndarray:
    """(H, W) uint8."""
    mask = read_file(path)[..., 0]
    if mask.shape != image.shape[:2]:
        size, expected = (" × ".join(map(str, shape[1::-1])) for shape in (mask.shape, image.shape))
        raise InputError(f"mask={path} has {size} pixels: give one of the photograph's size, {expected}")
    return mask


def grab_cut(image: np.ndarray, box: list[int]) -> np.ndarray:
    """(H, W) uint8: what OpenCV takes for the foreground in a box (Rother et al. 2004)."""
    try:
        cv2: Any = import_module("cv2")
    except ImportError as error:
        raise InputError("box= needs OpenCV: pip install opencv-python-headless, or give mask=FILE") from error
    height, width = image.shape[:2]
    if len(box) != 4 or not (0 <= box[0] < box[2] <= width and 0 <= box[1] < box[3] <= height):
        raise InputError(f"box={box} is not [left, top, right, bottom] within {width} × {height} pixels")
    labels, models = np.zeros((height, width), np.uint8), np.zeros((2, 1, 65))
    rectangle = box[0], box[1], box[2] - box[0], box[3] - box[1]
    cv2.grabCut(image[..., ::-1].copy(), labels, rectangle, *models, 5, cv2.GC_INIT_WITH_RECT)
    return np.where(labels % 2 == 1, 255, 0).astype(np.uint8)  # certain and probable foreground


def write_values(path: Path, image: torch.Tensor) -> None:
    """Write values (3, H, W) in [0, 1] as an image of 8 bits."""
    write_image(path, Image.fromarray(to_bytes(image.permute(1, 2, 0)).numpy()))


if __name__ == "__main__":
    main()
