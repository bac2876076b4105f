"""Scenes for Mitsuba 3, as files of their own or in memory.

A scene is a dictionary of `mitsuba_entries`. `load` gives it to Mitsuba, and `write_mitsuba_scene` writes it as
scene.xml with .ply parts and textures beside it, which needs no Mitsuba.

Mitsuba's diffuse surfaces reflect albedo / π of the irradiance, ours all of it: the scale of a light makes up for that,
and for the albedo's scale, which a bounce would otherwise have more than once. Shadows are always on: without shadows
here, a concave mesh has dark places there. Gloss is its `principled`, with the same lobe; its diffuse part is Disney's,
which loses nothing to the coat: the color is scaled by what ours keeps on average, and 1 to 3 % are left. Its
radiance is premultiplied with alpha, as ours with the coverage.
"""

import math
import xml.etree.ElementTree as xml
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from renderer.camera import Camera
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.normals import corner_normals
from renderer.image import decode, encode, to_bytes
from renderer.io.files import write_whole
from renderer.io.images import write_image
from renderer.io.mitsuba_entries import Scene, environment, integrator, sensor_of
from renderer.io.texture_bake import with_added_albedo
from renderer.light.basis import LocalBasis
from renderer.light.environment import light_radiance, write_map
from renderer.light.harmonics import equirectangular
from renderer.settings import MIN_ROUGHNESS, ImageSettings
from renderer.surface.microfacets import coat_mean

SCENE = "scene.xml"
SAMPLES = 256  # per pixel, spread evenly: the noise in a smooth light is then below 1/255
VARIANT = "scalar_rgb"  # needs no LLVM, and renders the same bits on any number of threads
DIFFERENTIABLE = "llvm_ad_rgb"
VALUE_TAGS = {bool: "boolean", int: "integer", float: "float", str: "string", list: "point"}
PLUGINS = {  # by the tags that they have in files
    "integrator": ("path", "direct"),
    "emitter": ("area", "constant", "directional", "envmap", "point", "projector", "spot"),
    "shape": ("ply", "disk"),
    "sensor": ("perspective", "orthographic"),
    "bsdf": ("twosided", "diffuse", "principled"),
    "texture": ("bitmap", "mesh_attribute"),
    "film": ("hdrfilm",),
    "rfilter": ("box",),
    "sampler": ("multijitter",),
}


@contextmanager
def mitsuba(variant: str = VARIANT) -> Iterator[Any]:
    """The module under a variant; that of before, if any, comes back. InputError: it, or its LLVM, is not installed."""
    try:
        import drjit
        import mitsuba as module
    except ImportError as error:
        raise InputError("Mitsuba is not installed: pip install '.[lab]'") from error
    before = module.variant()
    try:
        module.set_variant(variant)
    except ImportError as error:
        raise InputError(f"Mitsuba finds no LLVM: install libllvm19, or set DRJIT_LIBLLVM_PATH ({error})") from error
    drjit.set_thread_count(max(2, drjit.thread_count()))  # with one, of one core, its reader of .exr waits forever
    try:
        yield module
    finally:
        if before:
            module.set_variant(before)


def load(module: Any, scene: Mapping[str, Any]) -> Any:
    """Mitsuba's object of a dictionary, with its arrays as transforms and bitmaps."""
    scene = dict(scene)
    for name, value in scene.items():
        if isinstance(value, dict) and value["type"] != "rgb":
            scene[name] = load(module, value)
        elif isinstance(value, np.ndarray):
            scene[name] = module.ScalarTransform4f(value) if value.shape == (4, 4) else module.Bitmap(value)
    return module.load_dict(scene)


def render_mitsuba_scene(path: Path, views: int) -> torch.Tensor:
    """(views, 4, size, size) float32 linear radiance and coverage of a scene's .xml file, a sensor each.
    InputError: Mitsuba is not installed, or refuses the file."""
    with mitsuba() as module:
        try:
            scene = module.load_file(str(path))
            images = [np.array(module.render(scene, sensor=view)) for view in range(views)]
        except RuntimeError as error:
            raise InputError(f"{path} is not rendered by Mitsuba: {str(error).splitlines()[0]}") from error
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)


def mitsuba_map(coefficients: torch.Tensor, height: int) -> torch.Tensor:
    """Radiance (height, 2 · height, 3) float64 of a light's coefficients at the texels as Mitsuba's `envmap` places
    them: its outermost rows are the poles. At 256 rows those of `to_map` would be taken for light 0.2 % dimmer."""
    around, _ = equirectangular(1, 2 * height)  # z is 0, the mean
    polar = torch.linspace(0, math.pi, height, dtype=torch.float64)[:, None, None]
    return light_radiance(coefficients, polar.sin() * around + polar.cos() * torch.tensor([0.0, 0.0, 1.0]))


@dataclass(frozen=True)
class Part:
    """F faces of one texture (H, W, 3) uint8, or of none, and of one gloss, if any, with corners of their own.
    positions, normals, colors: (F, 3, 3), the last linear. uvs: (F, 3, 2), and gloss: (3,), as in `Mesh`. factors: the
    gloss texture (H, W, 2)."""

    positions: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray
    texture: np.ndarray | None
    gloss: np.ndarray | None = None
    factors: np.ndarray | None = None


def split_parts(mesh: Mesh, normals: np.ndarray, encoding: str) -> list[Part]:
    """The faces of each texture and gloss, and those of none. normals: (F, 3, 3), of the corners.

    Textures are on white corners: where they are on others they are painted anew, since Mitsuba has no product of the
    two.
    """
    if (mesh.corner_colors[mesh.texture_ids >= 0] != 1).any():
        mesh, _ = with_added_albedo(mesh, np.zeros((len(mesh.faces), 3)), encoding)
    colors = decode(torch.from_numpy(mesh.corner_colors), encoding).numpy()
    parts, kinds = [], mesh.texture_ids[:, None]
    kinds = kinds if mesh.gloss is None else np.concatenate([kinds, mesh.gloss], axis=1)
    for kind in np.unique(kinds, axis=0):
        faces, index = (kinds == kind).all(axis=1), int(kind[0])
        texture, factors = (of[index] if of and index >= 0 else None for of in (mesh.textures, mesh.gloss_textures))
        corners, gloss = mesh.vertices[mesh.faces[faces]], None if mesh.gloss is None else kind[1:]
        parts.append(Part(corners, normals[faces], mesh.corner_uvs[faces], colors[faces], texture, gloss, factors))
    return parts


def shape(
    module: Any,
    surface: Scene,
    positions: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None = None,
    uvs: np.ndarray | None = None,
    colors: np.ndarray | None = None,
) -> Any:
    """A mesh in memory of vertices (V, 3) with normals (V, 3), uvs (V, 2), as in `Mesh`, and linear colors (V, 3) as
    the attribute "vertex_color"; shaded flat without normals. surface: the dictionary of its bsdf."""
    properties = module.Properties()
    properties["bsdf"], properties["face_normals"] = load(module, surface), normals is None
    has = {"has_vertex_normals": normals is not None, "has_vertex_texcoords": uvs is not None}
    mesh = module.Mesh("mesh", len(positions), len(faces), props=properties, **has)
    if colors is not None:
        mesh.add_attribute("vertex_color", 3, colors.astype(np.float32).ravel())
    buffers = module.traverse(mesh)
    buffers["faces"] = faces.astype(np.uint32).ravel()
    texcoords = None if uvs is None else uvs * [1, -1] + [0, 1]
    for name, values in (("positions", positions), ("normals", normals), ("texcoords", texcoords)):
        if values is not None:
            buffers[f"vertex_{name}"] = values.astype(np.float32).ravel()
    buffers.update()
    return mesh


def write_mitsuba_scene(
    folder: Path,
    mesh: Mesh,
    albedo_scale: float,
    cameras: Sequence[Camera],
    settings: ImageSettings,
    light: str,
    local_lights: Sequence[tuple[LocalBasis, torch.Tensor]] = (),
) -> None:
    """Write a folder whose scene.xml shows a mesh to each camera, a sensor each. light: the map's file, as seen from
    there. local_lights: with their coefficients (size, 3)."""
    folder.mkdir(parents=True, exist_ok=True)
    emitters = _local_emitters(folder, local_lights, albedo_scale)
    # Surfaces find the sky by themselves, with less noise.
    sky = environment({"filename": light}, math.pi * albedo_scale) | {"sampling_weight": 0.0 if emitters else 1.0}
    sampler = {"type": "multijitter", "sample_count": SAMPLES}
    sensors = [sensor_of(camera, settings.size) | {"sampler": sampler} for camera in cameras]
    scene = xml.Element("scene", version="3.0.0")
    for entry in (integrator(settings.bounces, int(bool(emitters))), sky, *emitters, *sensors):
        _append(scene, "", entry)
    normals = corner_normals(mesh.vertices, mesh.faces, settings.normals)
    for number, part in enumerate(split_parts(mesh, normals, settings.encoding)):
        _append(scene, "", _write_part(folder, number, part, settings.encoding, albedo_scale))
    xml.indent(scene, "    ")
    write_whole(folder / SCENE, xml.tostring(scene, "unicode") + "\n")


def _append(parent: xml.Element, name: str, value: Any) -> None:
    """Write an entry of a dictionary below an element."""
    named = {"name": name} if name else {}
    if isinstance(value, np.ndarray):
        transform = xml.SubElement(parent, "transform", named)
        xml.SubElement(transform, "matrix", value=" ".join(f"{entry:.17g}" for entry in value.ravel()))
    elif not isinstance(value, dict):
        text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
        xml.SubElement(parent, VALUE_TAGS[type(value)], named, value=text.lower() if isinstance(value, bool) else text)
    elif value["type"] == "rgb":
        xml.SubElement(parent, "rgb", named, value=" ".join(map(str, value["value"])))
    else:
        [tag] = [tag for tag, plugins in PLUGINS.items() if value["type"] in plugins]
        element = xml.SubElement(parent, tag, named, type=value["type"])
        for key, entry in value.items():
            if key != "type":
                _append(element, key, entry)


def _local_emitters(
    folder: Path, lights: Sequence[tuple[LocalBasis, torch.Tensor]], albedo_scale: float
) -> list[Scene]:
    """Describe local lights for a scene file, and write their bitmaps beside it as .exr files."""
    emitters = []
    for basis, coefficients in lights:
        emitters += basis.mitsuba_emitters(coefficients, albedo_scale)
    projectors = [emitter for emitter in emitters if emitter["type"] == "projector"]
    for number, emitter in enumerate(projectors):
        file = f"pattern_{number}.exr" if number else "pattern.exr"
        options = dict(emitter["irradiance"])
        write_map(folder / file, torch.from_numpy(options.pop("bitmap")))
        emitter["irradiance"] = {"type": options.pop("type"), "filename": file, **options}
    return emitters


def _write_part(folder: Path, number: int, part: Part, encoding: str, albedo_scale: float) -> Scene:
    """A shape of part_0.ply and so on, with its texture_0.png."""
    import trimesh

    file, texture = f"part_{number}.ply", f"texture_{number}.png"
    gloss = part.gloss if part.gloss is not None and part.gloss[1:].any() else None  # of a matte part
    kept = 1.0 if gloss is None else _kept(gloss)
    corners = np.concatenate([part.uvs, kept * part.colors], axis=-1).reshape(-1, 5).astype(np.float32)
    surface = trimesh.Trimesh(
        part.positions.reshape(-1, 3),
        np.arange(len(corners)).reshape(-1, 3),
        vertex_normals=part.normals.reshape(-1, 3),
        vertex_attributes=dict(zip("uvrgb", corners.T, strict=True)),
        process=False,
    )
    write_whole(folder / file, surface.export(file_type="ply", vertex_normal=True))
    albedo: Scene = {"type": "mesh_attribute", "name": "vertex_color"}
    if part.texture is not None:
        scaled = to_bytes(encode(kept * decode(torch.from_numpy(part.texture) / 255, encoding), encoding))
        write_image(folder / texture, Image.fromarray(scaled.numpy()))
        albedo = {"type": "bitmap", "filename": texture, "raw": encoding == "linear"}
    material: Scene = {"type": "diffuse", "reflectance": albedo}
    if gloss is not None:
        roughness, metallic, strength = (gloss / [1, kept, 1]).tolist()
        # The light's scale has the albedo's. F0 is 0.08 × specular, and 0.04 for a refractive index of 1.5.
        specular = min(strength / 2 / max(albedo_scale, 1e-6), 1.0)
        material = {"type": "principled", "base_color": albedo, "specular": specular}
        factors = (("roughness", roughness, MIN_ROUGHNESS), ("metallic", metallic, 0.0))
        for index, (name, factor, least) in enumerate(factors):
            material[name] = max(factor, least)
            if part.factors is not None:
                image = np.maximum(part.factors[..., index] * factor, 255 * least).round().astype(np.uint8)
                write_image(folder / f"{name}_{number}.png", Image.fromarray(image))
                material[name] = {"type": "bitmap", "filename": f"{name}_{number}.png", "raw": True}
    bsdf = {"type": "twosided", "material": material}
    return {"type": "ply", "filename": file, "flip_tex_coords": True, "bsdf": bsdf}


def _kept(gloss: np.ndarray) -> float:
    """Compute the fraction of the albedo that a gloss (3,) reflects of an even sky, as metal or below the coat, on
    average over all directions."""
    roughness, metallic, strength = torch.from_numpy(gloss).double()[:, None]
    below = 1 - strength * coat_mean(roughness.clamp(min=MIN_ROUGHNESS))
    return float(metallic + (1 - metallic) * below)
