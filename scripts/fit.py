"""Find camera and light of a photograph: pnb-fit photograph=photo.jpg mask=mask.png mesh=orange.glb"""

import math
import shlex
import sys
from dataclasses import dataclass, field, replace
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
from renderer.camera import PerspectiveCamera
from renderer.errors import InputError, require_range
from renderer.fitting import fit_scene
from renderer.image import MOST_BOUNCES, decode
from renderer.io.images import read_rgb, write_image
from renderer.light.presets import save_light
from renderer.rendering import render
from train.errors import writable_folder
from train.results import require_replaceable

MARGIN = 1.6  # the image's side, in those of the object's box
DETAIL = 448  # pixels per side of the background that is written
DOUBTFUL, WRONG = 0.9, 0.3  # overlap of the outlines, error of the pixels


@dataclass
class Settings:
    photograph: str = MISSING  # an image file
    mesh: str = MISSING  # a file, or solid:NAME:SEED; upright, as in the photograph
    mask: str | None = None  # an image of the photograph's size, white where the object is
    box: list[int] = field(default_factory=list)  # or [left, top, right, bottom] in pixels, for OpenCV's GrabCut
    fov: float | None = None  # degrees between the image's sides, about the object; null: orthographic
    albedo_scale: float = 1.0  # of the mesh; twice as much halves the light
    bounces: int = 3  # of the light between the mesh's surfaces; 0: without shadows, too
    label: str = "orange"  # the class of the printed attack
    size: int = 64  # pixels per side that are compared
    out: str = "runs/fit"  # the folder of background.png, light.json and comparison.png
    overwrite: bool = False  # write over the results that out holds

    def __post_init__(self) -> None:
        require_range("size", self.size, 16, 512)
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
    rows, columns = np.flatnonzero((mask > 127).any(1)), np.flatnonzero((mask > 127).any(0))
    if not len(rows):
        raise InputError("no object is found: give a mask that is white where it is, or a box around it")
    center = np.array([columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1]) / 2
    side = MARGIN * max(int(np.ptp(rows)), int(np.ptp(columns)), 1)
    fov = None if settings.fov is None else math.radians(settings.fov)
    photograph, share = (as_tensor(cropped(array, center, side, settings.size)) for array in (image, mask))
    linear = decode(photograph, "srgb")
    shared: dict[str, Any] = {"albedo_scale": settings.albedo_scale, "bounces": settings.bounces}
    found = fit_scene(linear, share[0], mesh, fov=fov, **shared)
    camera = found.camera
    # The scene's cameras look at the mesh's middle, so the background is cut out around it.
    center = center + np.array([camera.right, -camera.up]) / camera.width * side
    background = cropped(image, center, side, DETAIL)
    out.mkdir(parents=True, exist_ok=True)
    write_image(out / "background.png", Image.fromarray(background))
    save_light(out / "light.json", found.light)
    centered = replace(camera, right=0.0, up=0.0)
    behind = as_tensor(background).double()
    shown = render(mesh, centered, found.light, DETAIL, behind, samples=4, encoding="srgb", **shared)[0]
    pair = torch.cat([behind, shown], dim=2)
    side_by_side = (pair * 255).round().byte().permute(1, 2, 0)
    write_image(out / "comparison.png", Image.fromarray(side_by_side.numpy()))
    print(f"outlines overlap by {found.overlap:.1%}; the object's pixels differ by {found.error:.1%}")
    if found.overlap < DOUBTFUL or found.error > WRONG:
        print("warning: the mesh hardly fits; look at comparison.png, and check photograph, mask, mesh and fov")
    angles = f"scene.polar={math.degrees(camera.polar):.3f}", f"scene.azimuth={math.degrees(camera.azimuth) % 360:.3f}"
    view = [f"scene.fov={math.degrees(camera.angle):.3f}"] if isinstance(camera, PerspectiveCamera) else []
    named = f"scene.meshes=[{{mesh: '{settings.mesh}', albedo_scale: {settings.albedo_scale:g}}}]"
    scene = [named, *angles, f"scene.width={camera.width:.4f}", *view, f"scene.light={out / 'light.json'}"]
    scene += [f"scene.backgrounds=[{out / 'background.png'}]", "scene.search=0", "renderer.encoding=srgb"]
    shadows = f"renderer.bounces={settings.bounces}" if settings.bounces else "renderer.shadows=false"
    print(shlex.join(["pnb-attack", "attack=lighting", f"label={settings.label}", *scene, shadows]))


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


def cropped(array: np.ndarray, center: np.ndarray, side: float, size: int) -> np.ndarray:
    """(size, size, ...) of a square about a point (x, y); beyond the image, its border goes on."""
    pad = math.ceil(side)
    mode = "edge" if array.ndim == 3 else "constant"  # a mask has no object there
    padded = np.pad(array, [(pad, pad), (pad, pad), (0, 0)][: array.ndim], mode=mode)  # type: ignore[call-overload]
    left, top = center - side / 2 + pad
    box = left, top, left + side, top + side
    return np.asarray(Image.fromarray(padded).resize((size, size), Image.Resampling.BOX, box=box))


def as_tensor(array: np.ndarray) -> torch.Tensor:
    """(C, H, W) float32 in [0, 1]."""
    return torch.from_numpy(np.atleast_3d(array).copy()).permute(2, 0, 1) / 255


if __name__ == "__main__":
    main()
