"""One example as it leaves the program: everything that its images follow from, and the images."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from augment.backgrounds import load_background
from augment.objects import SceneObject
from augment.scene import Conditions, Example, Scene
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.errors import FACTOR, InputError, require_bounded, require_file, require_range
from renderer.image import ImageSettings, to_bytes
from renderer.io.export import export_mesh
from renderer.io.images import read_numbers
from renderer.io.lights import read_light, save_light
from renderer.io.mitsuba import mitsuba_map, write_mitsuba_scene
from renderer.io.texture_bake import with_added_albedo
from renderer.light.basis import Basis, parts_of, with_local_lights
from renderer.light.environment import negative_fraction, to_map, write_map
from renderer.light.local import Lamps, Projector
from renderer.light.presets import load_light
from renderer.mesh import load_mesh
from renderer.rasterizer import Rasterizer


@dataclass(frozen=True)
class Adversary:
    """V views of one object, each (3, size, size), before an attack and after.

    shown: with the shape and the colors that the attack left, in the scene's own coordinates. light: (size, 3) of the
    basis, exposure included. background: (C, size, size), C 3 or 1. pixels: (V, 3, size, size) added to the images, or
    None.
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
    def of(scene: Scene, example: int, after: Conditions, before: Tensor, images: Tensor) -> Adversary:
        """An example of a scene under its row of all conditions, with its images (V, 3, size, size)."""
        row, shown = scene.examples[example], scene.objects[scene.examples[example].object]
        mesh, albedo_scale = shown.mesh, shown.albedo_scale
        if after.albedo is not None:
            added = after.albedo[example, : len(mesh.faces)].detach().cpu().double().numpy()
            mesh, albedo_scale = with_added_albedo(mesh, added, scene.settings.encoding, albedo_scale)
        if after.vertices is not None:
            vertices = after.vertices[example, : len(mesh.vertices)].detach().cpu().double().numpy()
            mesh = replace(mesh, vertices=vertices)
        return Adversary(
            shown=replace(shown, mesh=mesh, albedo_scale=albedo_scale),
            cameras=row.cameras,
            light=after.light[example].detach().cpu() * row.exposure,
            basis=scene.basis_under(after, example),
            background=scene.backgrounds[row.background].cpu(),
            settings=scene.settings,
            images_before=before.cpu(),
            images=images.cpu(),
            pixels=None if after.pixels is None else after.pixels[example].detach().cpu(),
        )

    def scene(self, rasterizer: Rasterizer, device: torch.device | str = "cpu") -> Scene:
        """Its one example."""
        background, light = self.background[None], self.light.to(device)
        return Scene(
            [self.shown], [Example(0, self.cameras, 0)], background, light, self.settings, rasterizer, basis=self.basis
        )

    @torch.no_grad()
    def render(self, rasterizer: Rasterizer) -> Tensor:
        """Its images (V, 3, size, size) anew."""
        pixels = None if self.pixels is None else self.pixels[None]
        return self.scene(rasterizer).render(Conditions(self.light[None], pixels=pixels), torch.arange(1))[0]


DESCRIPTION, MESH, LIGHT = "adversary.json", "mesh.glb", "light.json"
BACKGROUND, PIXELS = "background.png", "pixels.npy"
BEFORE, AFTER, MITSUBA = "before", "after", "mitsuba"
MAP_HEIGHT = 256
NOWHERE = 2.0**-8  # of the brightest radiance: what an .hdr file rounds off


def write_adversary(adversary: Adversary, folder: Path) -> dict[str, float]:
    """Write the folder; what its light lacks to be physical: {"negative_light": the negative share}."""
    folder.mkdir(parents=True, exist_ok=True)
    shown, settings = adversary.shown, adversary.settings
    export_mesh(shown.mesh, folder / MESH, settings.normals, adversary.cameras, shown.own)
    (where, sky), *placed = parts_of(adversary.basis)
    save_light(folder / LIGHT, adversary.light[where], sky)
    for own, basis in placed:
        save_light(folder / f"{basis.name}.json", adversary.light[own], basis)
    description = {
        "label": shown.label,
        "name": Path(shown.name).name,
        "mesh": MESH,
        "own_faces": shown.own,
        "albedo_scale": shown.albedo_scale,
        "light": LIGHT,
        "placed_lights": [f"{basis.name}.json" for _, basis in placed],
        "background": _write_background(adversary.background, folder),
        "cameras": [asdict(camera) for camera in adversary.cameras],
        "image": asdict(settings),
    }
    if adversary.pixels is not None:
        np.save(folder / PIXELS, adversary.pixels.numpy())
        description["pixels"] = PIXELS
    for name, images in ((BEFORE, adversary.images_before), (AFTER, adversary.images)):
        np.save(folder / f"{name}.npy", images.numpy())
        for view, image in enumerate(to_bytes(images)):
            Image.fromarray(image.permute(1, 2, 0).numpy()).save(folder / f"{name}_{view}.png")
    (folder / DESCRIPTION).write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")
    return _write_radiance(adversary, folder)


def _write_radiance(adversary: Adversary, folder: Path) -> dict[str, float]:
    """The light's maps, and the Mitsuba scene, in which what is negative of the light is left out."""
    where, _ = parts_of(adversary.basis)[0]
    radiance = to_map(adversary.light[where], MAP_HEIGHT)
    if radiance.min() >= -NOWHERE * radiance.max():
        for suffix in (".hdr", ".exr"):
            write_map(folder / f"light{suffix}", radiance)
    shown, placed = adversary.shown, [(basis, adversary.light[own]) for own, basis in parts_of(adversary.basis)[1:]]
    cameras, settings = adversary.cameras, adversary.settings
    write_mitsuba_scene(folder / MITSUBA, shown.mesh, shown.albedo_scale, cameras, settings, "light.exr", placed)
    write_map(folder / MITSUBA / "light.exr", mitsuba_map(adversary.light[where], MAP_HEIGHT).clamp(min=0))
    return {"negative_light": negative_fraction(radiance)}


def read_adversary(folder: Path) -> Adversary:
    """What `write_adversary` wrote. InputError: something is missing, damaged or not to be rendered."""
    path = folder / DESCRIPTION
    require_file(path, "give a folder that an attack wrote, such as .../example_000")
    try:
        description = json.loads(path.read_text(encoding="utf-8"))
        settings = ImageSettings(**description["image"])
        cameras = tuple(_camera(**camera) for camera in description["cameras"])
        label, name, albedo_scale = (
            str(description["label"]),
            str(description["name"]),
            float(description["albedo_scale"]),
        )
        mesh, light, pixels = (folder / str(description.get(key)) for key in ("mesh", "light", "pixels"))
        background = description["background"]
        own = None if description.get("own_faces") is None else int(description["own_faces"])
        placed = [read_light(folder / str(each), Projector, Lamps) for each in description.get("placed_lights", [])]
        surface = load_mesh(mesh)
        for camera in cameras:
            camera.depths(surface.vertices)  # which refuses a mesh around the camera
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} does not describe an adversary ({error}): write it again") from error
    require_range(f"{path}: albedo_scale", albedo_scale, 1 / FACTOR, FACTOR)
    if not cameras:
        raise InputError(f"{path} has no cameras: write it again")
    shape = (len(cameras), 3, settings.size, settings.size)
    if own is not None:
        require_range(f"{path}: own_faces", own, 1, len(surface.faces))
    basis, coefficients = with_local_lights(load_light(str(light)), placed)
    return Adversary(
        shown=SceneObject(label, surface, albedo_scale, name, own),
        cameras=cameras,
        light=coefficients,
        basis=basis,
        background=load_background(
            folder / background if isinstance(background, str) else background, settings.size, f"{path}: background"
        ),
        settings=settings,
        images_before=_read_images(folder / f"{BEFORE}.npy", shape),
        images=_read_images(folder / f"{AFTER}.npy", shape),
        pixels=_read_images(pixels, shape) if "pixels" in description else None,
    )


def _camera(**described: float) -> Camera:
    return PerspectiveCamera(**described) if "distance" in described else OrthographicCamera(**described)


def _write_background(background: Tensor, folder: Path) -> float | str:
    """A gray value, or the file of what is none."""
    gray = float(background.flatten()[0])
    if (background == gray).all():
        return gray
    Image.fromarray(to_bytes(background.expand(3, -1, -1)).permute(1, 2, 0).numpy()).save(folder / BACKGROUND)
    return BACKGROUND


def _read_images(path: Path, shape: tuple[int, ...]) -> Tensor:
    require_file(path, "write the adversary again")
    try:
        images = torch.from_numpy(read_numbers(path))
        require_bounded(images=images)
    except Exception as error:  # Python's parser raises many kinds for a damaged header
        raise InputError(f"{path} cannot be read ({error}): write the adversary again") from error
    if images.shape != shape:
        raise InputError(f"{path} has shape {tuple(images.shape)}, not {shape}: write the adversary again")
    return images
