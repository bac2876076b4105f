"""pnb-fit: find the camera and the lighting of a photograph that shows a mesh."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.lib.stride_tricks import sliding_window_view

from augment.scene.objects import load_object
from augment.settings import ObjectSettings, RendererSettings
from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError, explained, import_package, require_file
from renderer.image import decode, encode
from renderer.io import images
from renderer.light.files import save_light
from renderer.photograph import fit_photograph
from train.cli import quoted
from train.command_settings import AttackExperimentSettings, AttackSceneSettings, FitSettings
from train.commands.attack import build_attacked
from train.results.overwrite import output_folder

# Width and height of the background image that is written, in pixels.
BACKGROUND_SIZE = 448
# Width and height of the images that pnb-attack renders for its default classifier, in
# pixels.
ATTACKED_SIZE = 224
# A pixel counts as a pixel of the object if the mask covers more than 98% of it.
MIN_COVERAGE = 0.98
# A warning is printed if the silhouettes of the mesh and of the object overlap less than
# this, as intersection over union.
MIN_OVERLAP = 0.9
# A warning is printed if the relative error of the rendered pixels is larger than this.
MAX_ERROR = 0.3
# Number of iterations of GrabCut. OpenCV's tutorial uses the same number.
GRAB_CUT_STEPS = 5

# Gray values from this one on count as white, because JPEG files change white a little.
WHITE = 250
# Channels that differ by at most this are of a gray image, which JPEG files tint a little.
TINT = 8


def run(settings: FitSettings) -> None:
    """Find camera and lighting of a photograph, and print a command that attacks the lighting."""
    with explained(f"{settings.photograph} cannot be read", "give an image file"):
        # The full size, because images whose shorter side has more pixels than this may be reduced.
        image = np.asarray(images.read_rgb(settings.photograph, 10**6))
    out = output_folder(settings.out, settings.overwrite)
    # The mask is 255 where the object is, shape (H, W).
    if settings.mask:
        mask = read_mask(settings.mask, *image.shape[:2])
    else:
        mask = grab_cut(image, settings.box)
    mesh_settings = ObjectSettings(settings.mesh, label="", albedo_scale=settings.albedo_scale)
    names = ("fov", "albedo_scale", "encoding", "bounces")
    options = {name: getattr(settings, name) for name in names}
    fitted = fit_photograph(image, mask, load_object(mesh_settings).mesh, settings.size, **options)
    out.mkdir(parents=True, exist_ok=True)
    # The window is the square of the photograph that the found camera shows.
    background = fitted.window.cut(image, BACKGROUND_SIZE, settings.encoding)
    images.write_image(out / "background.png", encode(background, settings.encoding))
    # Outside of the photograph, there is no object.
    coverage = fitted.window.cut(mask[..., None], BACKGROUND_SIZE, beyond=0)
    images.write_image(out / "mask.png", coverage.expand(3, -1, -1))
    save_light(out / "light.json", fitted.scene.light)
    # The result is checked in the picture that pnb-attack will render from the written files.
    scene, renderer = attacked_scene(settings, fitted.scene.camera, out)
    photograph, rendered = render_attacked(mesh_settings, scene, renderer)
    images.write_image(out / "comparison.png", torch.cat([photograph, rendered], dim=2))
    # The three channels of the mask are equal, so the first one is enough.
    is_object = images.read_image(out / "mask.png", ATTACKED_SIZE)[0] > MIN_COVERAGE
    # Relative root mean square error in linear RGB.
    # Both have the shape (3, n), with the n pixels of the object.
    linear = decode(photograph[:, is_object].double(), settings.encoding)
    difference = decode(rendered[:, is_object].double(), settings.encoding) - linear
    error = float(difference.norm() / linear.norm())
    overlap = fitted.scene.overlap
    print(f"outlines overlap by {overlap:.1%}; the object's pixels differ by {error:.1%}")
    if overlap < MIN_OVERLAP or error > MAX_ERROR:
        print("warning: the mesh hardly fits; see comparison.png, and check mask, mesh and fov")
    # The command that is printed.
    words = ["pnb-attack", "attack=lighting"]
    if settings.label is not None:
        words.append(f"label={settings.label}")
    given = quoted(str(settings.mesh))
    words.append(f"meshes=[{{mesh: {given}, albedo_scale: {settings.albedo_scale:g}}}]")
    shown = scene | {"backgrounds": f"[{quoted(str(out / 'background.png'))}]"}
    words += [f"scene.{key}={value}" for key, value in shown.items()]
    words += [f"renderer.{key}={value}" for key, value in renderer.items()]
    print(shlex.join(words))


def attacked_scene(
    settings: FitSettings, camera: Camera, out: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Choose settings of the scene and of the renderer with which pnb-attack shows the photograph.

    The camera looks at the center of the mesh. Numbers are rounded.
    """
    scene = {
        "polar": round(camera.polar, 3),
        "azimuth": round(camera.azimuth % 360, 3),
        "width": round(camera.width, 4),
        "light": str(out / "light.json"),
        "backgrounds": [str(out / "background.png")],
        # The found scene is kept, even if the network does not recognize the object in it.
        "search": 0,
    }
    if isinstance(camera, PerspectiveCamera):
        scene["fov"] = round(camera.angle, 3)
    bounces = {"bounces": settings.bounces} if settings.bounces else {"shadows": False}
    return scene, {"encoding": settings.encoding, **bounces}


def render_attacked(
    mesh: ObjectSettings, scene: Mapping[str, Any], renderer: Mapping[str, Any]
) -> tuple[Float[torch.Tensor, "3 size size"], Float[torch.Tensor, "3 size size"]]:
    """Return the encoded background, and the render as it is before an attack by pnb-attack."""
    rendered = RendererSettings(**{"shadows": True, **renderer})
    chosen = AttackSceneSettings(**scene)
    attacked = AttackExperimentSettings(scene=chosen, renderer=rendered, device="cpu")
    shown = build_attacked(attacked, mesh, chosen, ATTACKED_SIZE)
    first_example = torch.arange(1)
    # The render has one example and one view, shape (1, 1, 3, size, size).
    return shown.backgrounds[0], shown.render(shown.conditions(first_example), first_example)[0, 0]


def read_mask(path: str, height: int, width: int) -> UInt8[np.ndarray, "height width"]:
    """Read the mask of the object in a photograph.

    The opaque part of an image with transparency is the object. In an image of two
    values or colors, of which one is black, the other one is the object. Otherwise,
    white is the object. What is not plain white on black is printed. The mask is 255 where the
    object is, and less where it covers a part of a pixel.
    """
    require_file(path, "give an image file as mask")
    with explained(f"mask={path} cannot be read", "save the object in white on black"):
        levels = _levels(path)
    if levels.shape != (height, width):
        fault = f"mask={path} has {levels.shape[1]} × {levels.shape[0]} pixels"
        raise InputError(f"{fault}: give a mask of {width} × {height}, as the photograph")
    return levels


def _levels(path: str) -> np.ndarray:
    """Read the coverage of pixels by the object, 0 to 255, or raise ValueError if it is unclear."""
    pixels = _pixels(path)
    # Opacity and gray images have one channel. Equal channels are a gray image, too.
    is_colored = pixels.ndim == 3 and np.ptp(pixels, axis=-1).max() > TINT
    if is_colored:
        pixels = pixels @ np.array([2**16, 2**8, 1])  # One number for each color.
    elif pixels.ndim == 3:
        pixels = pixels[..., 0]
    # Now `pixels` has the shape (H, W), with a number for each gray value or color.
    values = np.unique(pixels)
    if len(values) == 1:
        raise ValueError(f"all of its pixels have the value {values[0]}")
    # In an image of two values or colors, all that is not black is the object.
    if len(values) == 2 and values[0] == 0 and values[1] > 0:
        if values[1] not in (1, 255):
            print(f"mask={path}: all that is not black is the object")
        return np.where(pixels > 0, 255, 0).astype(np.uint8)
    if is_colored:
        raise ValueError(f"it has {len(values)} colors")
    # NaN, which sorts last, is not white.
    if not values[-1] >= WHITE or values[0] > 255 - WHITE:
        raise ValueError(f"its values are from {values[0]} to {values[-1]} of 255")
    # Edges of the object may be gray, but have a neighbor of another value. Gray areas are unclear.
    neighbors = sliding_window_view(pixels, (3, 3))
    is_flat = neighbors.min(axis=(2, 3)) == neighbors.max(axis=(2, 3))
    areas = np.unique(pixels[1:-1, 1:-1][is_flat])
    gray = areas[(areas > 255 - WHITE) & (areas < WHITE)]
    if len(gray):
        raise ValueError(f"areas of it have the gray value {gray[0]}")
    # A share of 254 of 255 would count as a pixel on the edge of the object.
    not_white = np.where(pixels > 255 - WHITE, pixels, 0)
    return np.where(pixels >= WHITE, 255, not_white).astype(np.uint8)


def _pixels(path: str) -> np.ndarray:
    """Read the opacity or the only channel of an image, (H, W), or else its colors, (H, W, 3)."""
    with images.open_image(path) as image:
        images.turn_upright(image)
        if image.has_transparency_data:
            rgba = np.asarray(images.eight_bits(image).convert("RGBA"))
            alpha = rgba[..., 3]
            # Constant opacity says nothing, so the colors do.
            if alpha.min() == alpha.max():
                return rgba[..., :3]
            # Either the opaque part or its white part could be the object.
            if {*np.unique(rgba[..., :3][alpha >= WHITE]).tolist()} == {0, 255}:
                raise ValueError("it is black and white, and a part is transparent")
            print(f"mask={path}: the opaque part is the object")
            return alpha
        # The modes of images with one channel: bits, 8-bit, integers, floats and 16-bit.
        if image.mode not in ("1", "L", "I", "F") and not image.mode.startswith("I;16"):
            return np.asarray(image.convert("RGB"))
        # Two values stay as they are, because 8 bits could make both black.
        values = np.asarray(image)
        return values if len(np.unique(values)) <= 2 else np.asarray(images.eight_bits(image))


def grab_cut(image: UInt8[np.ndarray, "H W 3"], box: list[int]) -> UInt8[np.ndarray, "H W"]:
    """Segment the object inside a box with OpenCV's GrabCut (Rother et al. 2004).

    The box is left, top, right and bottom in pixels. The mask is 255 on the object, otherwise 0.
    """
    cv2 = import_package("cv2", "opencv-python-headless")
    height, width = image.shape[:2]
    left, top, right, bottom = box if len(box) == 4 else [0, 0, 0, 0]
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        expected = f"[left, top, right, bottom] within {width} × {height} pixels"
        raise InputError(f"box={box}: give {expected}")
    rectangle = (left, top, right - left, bottom - top)
    labels = np.zeros((height, width), np.uint8)
    # OpenCV takes the color channels in the order blue, green, red.
    bgr = image[..., ::-1].copy()
    # `grabCut` stores its color models in two arrays of this size.
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(bgr, labels, rectangle, *models, GRAB_CUT_STEPS, cv2.GC_INIT_WITH_RECT)
    return np.where(np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)), 255, 0).astype(np.uint8)
