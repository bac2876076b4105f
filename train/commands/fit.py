"""pnb-fit: camera and light of a photograph."""

import math
import shlex
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from augment.scene.objects import load_object
from augment.settings import ObjectSettings, RendererSettings
from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError
from renderer.fitting import fit_photograph
from renderer.image import decode, encode, to_bytes
from renderer.io.images import read_image, read_rgb, write_image
from renderer.light.light_files import save_light
from train.command_settings import AttackExperimentSettings, AttackSceneSettings, FitSettings
from train.commands.attack_meshes import build_attacked
from train.commands.results import require_replaceable
from train.settings import read_object
from train.system.user_errors import writable_folder

DETAIL = 448  # pixels per side of the background that is written
ATTACKED = 224  # pixels per side of the images that the printed attack renders, for its default classifier
WHOLE = 0.98  # a pixel with a larger share is the object's
DOUBTFUL, WRONG = 0.9, 0.3  # overlap of the outlines, error of the pixels


def fit(settings: FitSettings) -> None:
    """Find camera and light of a photograph, write them, and print the command that attacks them.

    Raises:
        InputError: If a file cannot be read, or no object is found.
    """
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
    attacked = attack_settings(settings, found.scene.camera, out)
    photograph, shown = render_attacked(attacked)
    inside = read_image(out / "mask.png", ATTACKED)[0] > WHOLE
    error = relative_error(shown[:, inside], photograph[:, inside], settings.encoding)
    write_values(out / "comparison.png", torch.cat([photograph, shown], dim=2))
    print(f"outlines overlap by {found.scene.overlap:.1%}; the object's pixels differ by {error:.1%}")
    if found.scene.overlap < DOUBTFUL or error > WRONG:
        print("warning: the mesh hardly fits; look at comparison.png, and check photograph, mask, mesh and fov")
    print(shlex.join(attack_command(attacked)))


def attack_settings(settings: FitSettings, camera: Camera, out: Path) -> AttackExperimentSettings:
    """Choose the settings of an attack on the lighting of the fitted scene.

    Args:
        settings: Settings of the fit.
        camera: The camera, which looks at the mesh's middle.
        out: Folder of the fit.

    Returns:
        Settings of pnb-attack. Numbers are rounded, as they are printed.
    """
    fov = None
    if isinstance(camera, PerspectiveCamera):
        fov = round(math.degrees(camera.angle), 3)
    scene = AttackSceneSettings(
        meshes=[{"mesh": settings.mesh, "albedo_scale": settings.albedo_scale}],
        polar=round(math.degrees(camera.polar), 3),
        azimuth=round(math.degrees(camera.azimuth) % 360, 3),
        width=round(camera.width, 4),
        fov=fov,
        light=str(out / "light.json"),
        backgrounds=[str(out / "background.png")],
        search=0,
    )
    renderer = RendererSettings(
        encoding=settings.encoding,
        shadows=settings.bounces > 0,
        bounces=settings.bounces,
    )
    return AttackExperimentSettings(label=settings.label, scene=scene, renderer=renderer)


def attack_command(settings: AttackExperimentSettings) -> list[str]:
    """Write the command with the settings of `attack_settings`, as a list of its words."""
    scene = settings.scene
    renderer = settings.renderer
    [mesh] = scene.meshes
    words = [
        "pnb-attack",
        "attack=lighting",
        f"label={settings.label}",
        f"scene.meshes=[{{mesh: '{mesh['mesh']}', albedo_scale: {mesh['albedo_scale']:g}}}]",
        f"scene.polar={scene.polar:.3f}",
        f"scene.azimuth={scene.azimuth:.3f}",
        f"scene.width={scene.width:.4f}",
    ]
    if scene.fov is not None:
        words.append(f"scene.fov={scene.fov:.3f}")
    words += [
        f"scene.light={scene.light}",
        f"scene.backgrounds=[{scene.backgrounds[0]}]",
        f"scene.search={scene.search}",
        f"renderer.encoding={renderer.encoding}",
    ]
    if renderer.bounces:
        words.append(f"renderer.bounces={renderer.bounces}")
    else:
        words.append("renderer.shadows=false")
    return words


def render_attacked(settings: AttackExperimentSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Render the scene that pnb-attack would attack.

    Returns:
        The background and the image that is attacked, both encoded, shape (3, ATTACKED, ATTACKED).
    """
    item = read_object(settings.scene.meshes[0], settings.label, "scene.meshes[0]")
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
