"""Examples after an attack, with their light, shapes, cameras and images, and files of them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.attacks.objective import Examples, Images, Values
from augment.attacks.problem import SceneProblem
from augment.progress import progress
from augment.scene.objects import Conditions, Example, SceneObject
from augment.scene.scene import Scene
from renderer import errors
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.io.files import atomic_write, read_numbers, write_numbers
from renderer.io.images import gray_or_image, write_image
from renderer.io.meshes import export_mesh, load_mesh
from renderer.light import environment, files, lamps
from renderer.light.basis import Basis, with_local_lights
from renderer.mesh import select_faces
from renderer.mitsuba_scene import mitsuba_map, write_mitsuba_scene
from renderer.pinhole import PinholeCamera
from renderer.settings import ImageSettings
from renderer.surface.albedo import with_added_albedo
from renderer.surface.gloss import Gloss
from renderer.visibility import Rasterizer, choose

# Names of files in the folder of an adversary, and of the images before and after the attack.
DESCRIPTION = "adversary.json"
MESH = "mesh.glb"
LIGHT = "light.json"
BACKGROUND = "background.png"
PIXELS = "pixels.npy"
BEFORE = "before"
AFTER = "after"
# Name of the renderer Mitsuba, and of the folder with the scene that it renders.
MITSUBA = "mitsuba"
# Height in pixels of the environment maps that are written. The width is twice this number.
MAP_HEIGHT = 256

# Rounding error of an .hdr file (RGBE), as a fraction of the brightest radiance. Light whose
# negative radiance is smaller than this counts as not negative.
RGBE_TOLERANCE = 2.0**-8


@dataclass(frozen=True, repr=False)
class Adversary(errors.ShortRepr):
    """All that is needed to render one example after an attack, and its images before and after.

    An example is one object in front of a background, seen from V cameras.

    Attributes:
        shown: The object with its attacked shape and colors, in the coordinates
            of the scene.
        cameras: The V cameras.
        light: RGB coefficients of the light after the attack, multiplied by the
            exposure, shape (size of the basis, 3).
        basis: Basis of the light, such as spherical harmonics.
        background: Background in [0, 1], RGB or gray, shape (3 or 1, height, width).
        settings: Settings of the images.
        images_in_views_before: Images before the attack, in [0, 1], shape
            (V, 3, height, width).
        images_in_views: Images after the attack, of the same shape.
        pixels: Offset of each pixel value by the attack, of the same shape. None
            if the attack did not change pixels directly.
    """

    shown: SceneObject
    cameras: tuple[Camera, ...]
    light: Tensor
    basis: Basis
    background: Tensor
    settings: ImageSettings
    images_in_views_before: Tensor
    images_in_views: Tensor
    pixels: Tensor | None = None

    @property
    def images_before(self) -> Tensor:
        """Images before the attack, (V, 3, height, width), or (3, height, width) if V is 1."""
        return self.images_in_views_before.squeeze(0)

    @property
    def images(self) -> Tensor:
        """Images after the attack, (V, 3, height, width), or (3, height, width) if V is 1."""
        return self.images_in_views.squeeze(0)

    @staticmethod
    def of(
        scene: Scene,
        example: int,
        after: Conditions,
        before: Tensor,
        images: Tensor,
        row: int | None = None,
    ) -> Adversary:
        """Collect one example of a scene after an attack.

        Args:
            scene: The attacked scene.
            example: Index of the example in the scene.
            after: Light, shape, colors and pose of some or all examples after
                the attack.
            before: Images of the V views before the attack, shape
                (V, 3, height, width).
            images: Images after the attack, of the same shape.
            row: Index of the example in the first dimension of `after`. None if
                `after` has all examples of the scene.

        Returns:
            The adversary.
        """
        row = example if row is None else row
        before_attack = scene.examples[example]
        item = scene.objects[before_attack.object]
        # The method `fixed` replaces the tensors of cameras that an attack has moved by numbers.
        return Adversary(
            shown=_attacked_object(item, after.row(row, item.mesh), scene.settings.encoding),
            cameras=tuple(camera.fixed() for camera in scene.cameras_under(after, row, example)),
            light=scene.exposed(after.light[row].detach().cpu(), example),
            basis=scene.basis_under(after, row),
            background=scene.backgrounds[before_attack.background].cpu(),
            settings=scene.settings,
            images_in_views_before=before.cpu(),
            images_in_views=images.cpu(),
            pixels=None if after.pixels is None else after.pixels[row].detach().cpu(),
        )

    def scene(self, rasterizer: Rasterizer, device: torch.device | str = "cpu") -> Scene:
        """Build a scene that shows this example after the attack, and nothing else.

        Args:
            rasterizer: Rasterizer with which the scene is rendered.
            device: Device on which the scene is rendered.
        """
        return Scene(
            objects=[self.shown],
            examples=[Example(0, self.cameras, 0)],
            backgrounds=self.background[None],
            lights=self.light.to(device),
            settings=self.settings,
            rasterizer=rasterizer,
            basis=self.basis,
        )

    def render(self, rasterizer: Rasterizer | str | None = None) -> Tensor:
        """Render the attacked example from its V cameras.

        Args:
            rasterizer: A rasterizer or its name. None for the default one.

        Returns:
            Images in [0, 1], shape (V, 3, height, width), or (3, height, width) if
            there is one camera.
        """
        return self.render_views(rasterizer).squeeze(0)

    @torch.no_grad()
    def render_views(self, rasterizer: Rasterizer | str | None = None) -> Tensor:
        """Render the attacked example from its V cameras, and keep the dimension of the views.

        Args:
            rasterizer: A rasterizer or its name. None for the default one.

        Returns:
            Images in [0, 1], shape (V, 3, height, width), also if there is one camera.
        """
        if not isinstance(rasterizer, Rasterizer):
            rasterizer = choose(rasterizer or "auto")
        pixels = None if self.pixels is None else self.pixels[None]
        conditions = Conditions(self.light[None], pixels=pixels)
        return self.scene(rasterizer).changed(one_light=True).render(conditions, torch.arange(1))[0]


def _attacked_object(item: SceneObject, changed: Conditions, encoding: str) -> SceneObject:
    """Copy an object with the shape, colors and gloss of conditions; None changes nothing."""
    mesh, albedo_scale = item.mesh, item.albedo_scale
    # Arrays of float64. None stays None.
    albedo, hue, vertices = (
        None if values is None else values.detach().cpu().double().numpy()
        for values in (changed.albedo, changed.hue, changed.vertices)
    )
    if albedo is not None:
        mesh, albedo_scale = with_added_albedo(mesh, albedo, encoding, albedo_scale, hue)
    if vertices is not None:
        mesh = replace(mesh, vertices=vertices)
    if changed.gloss is not None:
        mesh = Gloss(*changed.gloss.unbind(1), textured=True).on(mesh)
    return replace(item, mesh=mesh, albedo_scale=albedo_scale)


def write_adversary(adversary: Adversary, folder: Path) -> dict[str, float]:
    """Write the files of an adversary: those that `reload` reads, and a scene for Mitsuba.

    In the scene for Mitsuba, negative radiance is replaced by 0. Environment maps (.hdr and .exr)
    are written only if the light is nowhere negative. Return the fraction of the energy of the
    environment light that is negative, under the key "negative_light".
    """
    folder.mkdir(parents=True, exist_ok=True)
    shown, settings, cameras = adversary.shown, adversary.settings, adversary.cameras
    height, width = settings.shape
    export_mesh(shown.mesh, folder / MESH, settings.normals, cameras, shown.ends, width / height)
    (_, light), *local_lights = save_lights(folder, adversary.light, adversary.basis)
    # A background of one gray value needs no file. Its value is in the description.
    gray = float(adversary.background.flatten()[0])
    is_gray = bool((adversary.background == gray).all())
    if not is_gray:
        write_image(folder / BACKGROUND, adversary.background.expand(3, -1, -1))
    if adversary.pixels is not None:
        write_numbers(folder / PIXELS, _as_numpy(adversary.pixels))
    # NAME.npy has the exact values of all views, and NAME_0.png and so on have 8 bits.
    views = {BEFORE: adversary.images_in_views_before, AFTER: adversary.images_in_views}
    for name, images in views.items():
        write_numbers(folder / f"{name}.npy", _as_numpy(images))
        for view, image in enumerate(images):
            write_image(folder / f"{name}_{view}.png", image)
    description = {
        "label": str(shown.label),
        "name": Path(shown.name).name,
        "own_faces": shown.own,
        "others": [[str(label), len(mesh.faces)] for label, mesh in shown.others],
        "albedo_scale": shown.albedo_scale,
        "gloss": shown.mesh.gloss is not None,
        "local_lights": [basis.name for basis, _ in local_lights],
        "background": gray if is_gray else BACKGROUND,
        "cameras": [asdict(camera) for camera in cameras],
        "image": asdict(settings),
        "pixels": adversary.pixels is not None,
    }
    atomic_write(folder / DESCRIPTION, json.dumps(description, indent=2) + "\n")

    # Radiance in each direction. It counts as not negative up to the rounding of an .hdr file.
    radiance = environment.to_map(light, MAP_HEIGHT)
    if radiance.min() >= -RGBE_TOLERANCE * radiance.max():
        for suffix in (".hdr", ".exr"):
            environment.write_map(folder / f"light{suffix}", radiance)
    mitsuba = folder / MITSUBA
    scale = shown.albedo_scale
    write_mitsuba_scene(mitsuba, shown.mesh, scale, cameras, settings, "light.exr", local_lights)
    environment.write_map(mitsuba / "light.exr", mitsuba_map(light, MAP_HEIGHT).clamp(min=0))
    return {"negative_light": environment.negative_fraction(radiance)}


def _as_numpy(values: Tensor) -> np.ndarray:
    """Convert a tensor on the CPU to an array. NumPy has no bfloat16, which becomes float32."""
    return (values.float() if values.dtype == torch.bfloat16 else values).numpy()


def save_lights(
    folder: Path, light: Float[Tensor, "_ 3"], basis: Basis, when: str = ""
) -> list[tuple[Any, Tensor]]:
    """Write the environment light to light.json, and each local light to a file of its name.

    Local lights are the projector and the lamps. The suffix `when`, such as "_before", ends the
    name of each file. Return basis and coefficients of each light, the environment light first.
    """
    lights: list[tuple[Any, Tensor]] = [(part.basis, light[part.rows]) for part in basis.lights]
    for index, (basis_of_light, coefficients) in enumerate(lights):
        # The first light is the environment.
        name = basis_of_light.name if index else Path(LIGHT).stem
        files.save_light(folder / f"{name}{when}.json", coefficients, basis_of_light)
    return lights


def reload(folder: str | Path) -> Adversary:
    """Read the folder of an example that `nb.save` wrote.

    Args:
        folder: The folder, such as "adversaries/example_000".

    Returns:
        The adversary.

    Raises:
        InputError: If a file is missing or damaged.

    Example:
        >>> import norm_balls as nb
        >>> lines = nb.save(result, "adversaries")
        >>> adversary = nb.reload("adversaries/example_000")
        >>> bool((adversary.render() - result.images[0]).abs().max() < 1e-5)
        True
    """
    folder = errors.as_folder("folder", folder)
    path = folder / DESCRIPTION
    errors.require_file(path, "give a folder that an attack wrote, such as .../example_000")
    with errors.reading(path, "does not describe an adversary", "write it again"):
        return _read_adversary(folder, json.loads(path.read_text(encoding="utf-8")))


def _read_adversary(folder: Path, description: dict[str, Any]) -> Adversary:
    """Return the adversary in a folder, whose JSON file has the given content."""
    settings = ImageSettings(**description["image"])
    cameras: list[Camera] = []
    # Only pinhole cameras have a roll, and orthographic cameras have no distance.
    for fields in description["cameras"]:
        kind = PerspectiveCamera if "distance" in fields else OrthographicCamera
        cameras.append((PinholeCamera if "roll" in fields else kind)(**fields))
    mesh = load_mesh(folder / MESH, gloss=bool(description["gloss"]))
    albedo_scale = float(description["albedo_scale"])
    errors.require_range("albedo_scale", albedo_scale, 1 / errors.MAX_SCALE, errors.MAX_SCALE)
    own_faces = description["own_faces"]
    errors.require_range("own_faces", own_faces, 1, len(mesh.faces))
    label, name = str(description["label"]), str(description["name"])
    # The faces of the object come first, then those of each other object, and then the table.
    others, start = [], own_faces
    for other, count in description.get("others", []):
        errors.require_range("others", count, 1, len(mesh.faces) - start)
        others.append((str(other), select_faces(mesh, slice(start, start + count))))
        start += count
    for camera in cameras:
        # This raises InputError if the camera is inside of the mesh.
        camera.depths(mesh.vertices)
    paths = [folder / f"{Path(light).name}.json" for light in description["local_lights"]]
    local_lights = [files.read_light(path, *lamps.LOCAL_LIGHTS.values()) for path in paths]
    sky = files.load_light(str(folder / LIGHT), degree=None)
    basis, light = with_local_lights(sky, local_lights)
    gray = description["background"]
    background = folder / BACKGROUND if isinstance(gray, str) else gray
    shape = (len(cameras), 3, *settings.shape)
    return Adversary(
        shown=SceneObject(label, mesh, albedo_scale, name, own_faces, others),
        cameras=tuple(cameras),
        light=light,
        basis=basis,
        background=gray_or_image("background", background, settings.size),
        settings=settings,
        images_in_views_before=_read_images(folder / f"{BEFORE}.npy", shape),
        images_in_views=_read_images(folder / f"{AFTER}.npy", shape),
        pixels=_read_images(folder / PIXELS, shape) if description["pixels"] else None,
    )


def _read_images(path: Path, shape: tuple[int, ...]) -> Tensor:
    """Read images from a .npy file."""
    errors.require_file(path, "write the adversary again")
    with errors.reading(path, "cannot be read", "write the adversary again"):
        images = torch.from_numpy(read_numbers(path))
        errors.require_bounded(images=images)
        errors.require_shape("images", images, *shape)
    return images


def final_images(
    problem: SceneProblem, values: Values, examples: Examples, images: Images
) -> Images:
    """Return the images after a search, with the shadows and bounces of the attacked shape.

    A search that changes shape, colors or gloss computes shadows and bounces
    once, for the original shape. This function renders its images again. The
    images of all other searches are returned as they are.
    """
    scene = problem.scene
    conditions = problem.conditions(values, examples)
    changes = (conditions.vertices, conditions.albedo, conditions.gloss)
    is_changed = any(change is not None for change in changes)
    if not (is_changed and scene.settings.global_illumination and len(examples)):
        return images
    rendered = []
    for row, example in enumerate(progress(examples.tolist(), "final images")):
        # `Adversary` needs images, but does not use them for rendering.
        adversary = Adversary.of(scene, example, conditions, images[row], images[row], row)
        rendered.append(adversary.render_views(scene.rasterizer))
    return torch.stack(rendered).to(images)
