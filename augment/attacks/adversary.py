"""One example of an attack as a value and as a folder: everything that its images are rendered from, and the images."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from augment.build import load_background
from augment.objects import SceneObject
from augment.scene import Conditions, Example, Scene
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.errors import FACTOR, InputError, in_one_line, require_bounded, require_file, require_range
from renderer.gloss import Gloss
from renderer.image import ImageSettings, to_bytes
from renderer.io.export import export_mesh
from renderer.io.files import write_whole
from renderer.io.images import read_numbers, write_image, write_numbers
from renderer.io.mitsuba import mitsuba_map, write_mitsuba_scene
from renderer.io.texture_bake import with_added_albedo
from renderer.light.basis import Basis, LocalBasis, parts_of, with_local_lights
from renderer.light.environment import negative_fraction, to_map, write_map
from renderer.light.local import Lamps, Projector
from renderer.light.presets import load_light, read_light, save_light
from renderer.mesh import load_mesh
from renderer.rasterizer import Rasterizer, choose
from renderer.validation import as_folder


@dataclass(frozen=True)
class Adversary:
    """V views of one object, each (3, size, size), before an attack and after.

    shown: the object with its attacked shape and colors, in the scene's coordinates. light: (size, 3) coefficients of
    the basis, exposure included. background: (3 or 1, size, size). pixels: (V, 3, size, size) added to images, or None.
    """

    shown: SceneObject
    cameras: tuple[Camera, ...]
    light: Tensor
    basis: Basis
    background: Tensor
    settings: ImageSettings
    images_before: Tensor
    images: Tensor
    pixels: Tensor | None = None

    @staticmethod
    def of(
        scene: Scene, example: int, after: Conditions, before: Tensor, images: Tensor, row: int | None = None
    ) -> Adversary:
        """An example of a scene and its images (V, 3, size, size) under a row of conditions, by default its own row."""
        of_example, row = scene.examples[example], example if row is None else row
        shown = scene.objects[of_example.object]
        mesh, albedo_scale, changed = shown.mesh, shown.albedo_scale, after.row(row, shown.mesh)
        if changed.albedo is not None:
            added, hue = _as_numpy(changed.albedo), None if changed.hue is None else _as_numpy(changed.hue)
            mesh, albedo_scale = with_added_albedo(mesh, added, scene.settings.encoding, albedo_scale, hue)
        if changed.vertices is not None:
            mesh = replace(mesh, vertices=_as_numpy(changed.vertices), skin=None)
        if changed.gloss is not None:
            mesh = Gloss(*changed.gloss.unbind(1), textured=True).on(mesh)
        return Adversary(
            shown=replace(shown, mesh=mesh, albedo_scale=albedo_scale),
            cameras=tuple(camera.fixed() for camera in scene.cameras_under(after, row, example)),
            light=after.light[row].detach().cpu() * of_example.exposure,
            basis=scene.basis_under(after, row),
            background=scene.backgrounds[of_example.background].cpu(),
            settings=scene.settings,
            images_before=before.cpu(),
            images=images.cpu(),
            pixels=None if after.pixels is None else after.pixels[row].detach().cpu(),
        )

    def scene(self, rasterizer: Rasterizer, device: torch.device | str = "cpu") -> Scene:
        """A scene of this one example."""
        rows, background, light = [Example(0, self.cameras, 0)], self.background[None], self.light.to(device)
        return Scene([self.shown], rows, background, light, self.settings, rasterizer, basis=self.basis)

    @torch.no_grad()
    def render(self, rasterizer: Rasterizer | str | None = None) -> Tensor:
        """Render the images (V, 3, size, size) again; with the default rasterizer, unless another is given."""
        rasterizer = rasterizer if isinstance(rasterizer, Rasterizer) else choose(rasterizer or "auto")
        pixels = None if self.pixels is None else self.pixels[None]
        return self.scene(rasterizer).render(Conditions(self.light[None], pixels=pixels), torch.arange(1))[0]


def _as_numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()


DESCRIPTION, MESH, LIGHT = "adversary.json", "mesh.glb", "light.json"
BACKGROUND, PIXELS = "background.png", "pixels.npy"
BEFORE, AFTER, MITSUBA = "before", "after", "mitsuba"
MAP_HEIGHT = 256
NOWHERE = 2.0**-8  # of the brightest radiance: what an .hdr file rounds off


def write_adversary(adversary: Adversary, folder: Path) -> dict[str, float]:
    """Write the folder; returns {"negative_light": the fraction of the light's energy that is negative}.

    Mitsuba's scene leaves out negative light, and maps are written only of light that is positive all round.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shown, settings = adversary.shown, adversary.settings
    export_mesh(shown.mesh, folder / MESH, settings.normals, adversary.cameras, shown.own)
    (_, light), *local = save_lights(folder, adversary.light, adversary.basis)
    description = {
        "label": shown.label,
        "name": Path(shown.name).name,
        "own_faces": shown.own,
        "albedo_scale": shown.albedo_scale,
        "gloss": shown.mesh.gloss is not None,
        "local_lights": [basis.name for basis, _ in local],
        "background": _write_background(adversary.background, folder),
        "cameras": [asdict(camera) for camera in adversary.cameras],
        "image": asdict(settings),
        "pixels": adversary.pixels is not None,
    }
    if adversary.pixels is not None:
        write_numbers(folder / PIXELS, adversary.pixels.numpy())
    for name, images in ((BEFORE, adversary.images_before), (AFTER, adversary.images)):
        write_numbers(folder / f"{name}.npy", images.numpy())
        for view, image in enumerate(to_bytes(images)):
            write_image(folder / f"{name}_{view}.png", Image.fromarray(image.permute(1, 2, 0).numpy()))
    write_whole(folder / DESCRIPTION, json.dumps(description, indent=2) + "\n")
    radiance = to_map(light, MAP_HEIGHT)
    if radiance.min() >= -NOWHERE * radiance.max():
        for suffix in (".hdr", ".exr"):
            write_map(folder / f"light{suffix}", radiance)
    cameras = adversary.cameras
    write_mitsuba_scene(folder / MITSUBA, shown.mesh, shown.albedo_scale, cameras, settings, "light.exr", local)
    write_map(folder / MITSUBA / "light.exr", mitsuba_map(light, MAP_HEIGHT).clamp(min=0))
    return {"negative_light": negative_fraction(radiance)}


def save_lights(folder: Path, light: Tensor, basis: Basis, when: str = "") -> list[tuple[Any, Tensor]]:
    """Write light.json and NAME.json of each local light, `when` after the name; returns bases and coefficients."""
    lights = [(part, light[rows]) for rows, part in parts_of(basis)]
    for part, coefficients in lights:
        name = part.name if isinstance(part, LocalBasis) else Path(LIGHT).stem
        save_light(folder / f"{name}{when}.json", coefficients, part)
    return lights


def reload(folder: str | Path) -> Adversary:
    """Read the folder of an example that `augment.save` wrote. InputError where a file is missing or damaged.

    >>> lines = augment.save(result, "adversaries")
    >>> adversary = augment.reload("adversaries/example_000")
    >>> bool((adversary.render() - result.images[0]).abs().max() < 1e-5)
    True
    """
    folder = as_folder("folder", folder)
    path = folder / DESCRIPTION
    require_file(path, "give a folder that an attack wrote, such as .../example_000")
    try:
        return _described(folder, json.loads(path.read_text(encoding="utf-8")))
    except InputError as error:
        named = str(error).startswith(str(folder))  # the file of the folder that is at fault
        raise InputError(str(error) if named else f"{path}: {error}") from error
    except Exception as error:  # JSON, and the types that it may hold in place of a description
        raise InputError(f"{path} does not describe an adversary ({in_one_line(error)}): write it again") from error


def _described(folder: Path, description: dict[str, Any]) -> Adversary:
    settings = ImageSettings(**description["image"])
    kinds = [PerspectiveCamera if "distance" in camera else OrthographicCamera for camera in description["cameras"]]
    cameras = tuple(kind(**camera) for kind, camera in zip(kinds, description["cameras"], strict=True))
    mesh, own = load_mesh(folder / MESH, gloss=bool(description.get("gloss"))), description["own_faces"]
    for camera in cameras:
        camera.depths(mesh.vertices)  # which refuses a mesh around the camera
    albedo_scale, own = float(description["albedo_scale"]), None if own is None else int(own)
    require_range("albedo_scale", albedo_scale, 1 / FACTOR, FACTOR)
    require_range("own_faces", own, 1, len(mesh.faces))
    local = [read_light(folder / f"{Path(name).name}.json", Projector, Lamps) for name in description["local_lights"]]
    basis, light = with_local_lights(load_light(str(folder / LIGHT), degree=None), local)
    background, shape = description["background"], (len(cameras), 3, settings.size, settings.size)
    background = folder / BACKGROUND if isinstance(background, str) else background
    return Adversary(
        shown=SceneObject(str(description["label"]), mesh, albedo_scale, str(description["name"]), own),
        cameras=cameras,
        light=light,
        basis=basis,
        background=load_background(background, settings.size, "background"),
        settings=settings,
        images_before=_read_images(folder / f"{BEFORE}.npy", shape),
        images=_read_images(folder / f"{AFTER}.npy", shape),
        pixels=_read_images(folder / PIXELS, shape) if description["pixels"] else None,
    )


def _write_background(background: Tensor, folder: Path) -> float | str:
    """A gray value, or the name of an image file."""
    gray = float(background.flatten()[0])
    if (background == gray).all():
        return gray
    pixels = to_bytes(background.expand(3, -1, -1)).permute(1, 2, 0)
    write_image(folder / BACKGROUND, Image.fromarray(pixels.numpy()))
    return BACKGROUND


def _read_images(path: Path, shape: tuple[int, ...]) -> Tensor:
    require_file(path, "write the adversary again")
    try:
        images = torch.from_numpy(read_numbers(path))
        require_bounded(images=images)
        if images.shape != shape:
            raise InputError(f"it has shape {tuple(images.shape)}, not {shape}")
    except Exception as error:  # Python's parser raises many types for a damaged header
        raise InputError(f"{path} cannot be read ({in_one_line(error)}): write the adversary again") from error
    return images
