"""Scenes for Mitsuba 3, as files or in memory.

A scene is a dictionary (see `renderer.io.mitsuba_entries`). `load` passes it to
Mitsuba. `write_mitsuba_scene` writes it as a file scene.xml, with .ply files and
textures, and does not need Mitsuba.

The renderers differ in these ways:

- The radiance of a diffuse surface is the irradiance times albedo / π in
  Mitsuba, and the irradiance times the albedo in our renderer. The lights for
  Mitsuba are therefore multiplied by π. Without bounces and gloss, they are also
  multiplied by the albedo scale. With bounces, the colors of the materials are,
  because the albedo scale applies again at each bounce. With gloss, they are, too,
  because specular reflection does not have the albedo.
- Mitsuba always has shadows. If our render has none, a concave mesh is darker in
  Mitsuba.
- Specular reflection is the plugin `principled`, with the same lobe. Below its
  coat, the diffuse reflection does not lose the light that the coat reflects.
  The color is therefore multiplied by the fraction of the light that passes the
  coat on average. A difference of 1 to 3% remains. With metallic textures, it is
  up to 6%.

Both renderers return radiance that is premultiplied with the coverage.
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
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8

from renderer.camera import Camera
from renderer.errors import explained, import_package, reading
from renderer.image import decode, encode, to_bytes
from renderer.io.files import atomic_write
from renderer.io.images import write_image
from renderer.io.mitsuba_entries import Scene, environment, integrator, sensor_of
from renderer.light.basis import LitBasis
from renderer.light.environment import light_radiance, write_map
from renderer.light.harmonics import equirectangular
from renderer.mesh import Mesh, by_material
from renderer.settings import MIN_ROUGHNESS, ImageSettings
from renderer.surface.albedo import with_added_albedo
from renderer.surface.lobes import coat_mean

# Name of the file in which a Mitsuba scene is written.
SCENE = "scene.xml"
# Number of samples per pixel in Mitsuba. With 256
# samples, the noise under smooth lighting is below 1/255.
SAMPLES = 256
# XML tag in a Mitsuba scene file for a value of each Python type.
VALUE_TAGS = {bool: "boolean", int: "integer", float: "float", str: "string", list: "point"}
# Types of objects in a Mitsuba scene file, such as an envmap, by their XML tag.
PLUGINS = {
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
PLUGIN_TAGS = {plugin: tag for tag, plugins in PLUGINS.items() for plugin in plugins}
# Smallest parameter `specular` of Mitsuba's material
# "principled". With 0, metals would reflect nothing.
# With 1e-4, the reflectance at normal incidence is 8e-6.
MIN_SPECULAR = 1e-4


@contextmanager
def mitsuba(variant: str = "scalar_rgb") -> Iterator[Any]:
    """Import Mitsuba, and set its variant for a `with` block.

    The previous variant is restored at the end of the block. A variant that needs LLVM raises an
    `InputError` without it.
    """
    install = '"parametric-norm-balls[lab]"'
    drjit, module = (import_package(name, install) for name in ("drjit", "mitsuba"))
    previous = module.variant()
    advice = "install libllvm19, or set DRJIT_LIBLLVM_PATH"
    with explained(f"the variant {variant} of Mitsuba needs LLVM, which was not found", advice):
        module.set_variant(variant)
    # Mitsuba needs two threads. With one, it would
    # wait forever when it reads an .exr file.
    drjit.set_thread_count(max(2, drjit.thread_count()))
    try:
        yield module
    finally:
        if previous:
            module.set_variant(previous)


def load(module: Any, scene: Mapping[str, Any]) -> Any:
    """Create a Mitsuba object from a dictionary with NumPy arrays as transformations and images."""
    converted = dict(scene)
    for name, value in scene.items():
        # A dictionary of the type "rgb" is a
        # color, which Mitsuba itself converts.
        if isinstance(value, dict) and value["type"] != "rgb":
            converted[name] = load(module, value)
        elif isinstance(value, np.ndarray):
            convert = module.ScalarTransform4f if value.shape == (4, 4) else module.Bitmap
            converted[name] = convert(value)
    return module.load_dict(converted)


def render_mitsuba_scene(path: Path, views: int, shape: tuple[int, int]) -> torch.Tensor:
    """Render the first cameras of a file: linear RGB and coverage, (views, 4, *shape)."""
    with mitsuba() as module, reading(path, "cannot be rendered by Mitsuba"):
        scene = module.load_file(str(path))
        rendered = [np.array(module.render(scene, sensor=view)) for view in range(views)]
    images = [torch.from_numpy(image).permute(2, 0, 1)[None] for image in rendered]
    # Mitsuba's pixels are square. Those of the camera may have another aspect ratio.
    return torch.cat([F.interpolate(one, shape, mode="bilinear", antialias=True) for one in images])


def mitsuba_map(coefficients: torch.Tensor, height: int) -> torch.Tensor:
    """Compute an environment map of a light with Mitsuba's layout of rows.

    In Mitsuba, the centers of the first and the last row are the poles. In our
    maps, the outer edges of these rows are the poles. If Mitsuba read one of our
    maps with 256 rows, the light would be 0.2% too dim. The map has 2 · height columns.
    """
    # The directions of a map with a single row are horizontal: they have z = 0.
    horizontal, _ = equirectangular(1, 2 * height)
    polar = torch.linspace(0, math.pi, height, dtype=torch.float64)[:, None, None]
    up = torch.tensor([0.0, 0.0, 1.0])
    return light_radiance(coefficients, polar.sin() * horizontal + polar.cos() * up)


@dataclass(frozen=True)
class Part:
    """F faces of a mesh that have the same texture and the same specular reflection.

    Arrays of corners have one row for each face and one column for each of its
    three corners.

    Attributes:
        positions: Positions of the corners in world axes, shape (F, 3, 3).
        normals: Unit normals of the corners, shape (F, 3, 3).
        uvs: Texture coordinates of the corners as in `Mesh`, shape (F, 3, 2).
        colors: Linear colors of the corners, shape (F, 3, 3).
        texture: Texture, shape (H, W, 3), uint8, or linear floats. None for faces without a
            texture.
        gloss: Roughness, metallic and specular factor of all faces, shape (3,).
            None for a matte mesh.
        factors: Texture with factors for roughness and metallic, uint8,
            shape (H, W, 2). None for faces without such a texture.
    """

    positions: Float[np.ndarray, "F 3 3"]
    normals: Float[np.ndarray, "F 3 3"]
    uvs: Float[np.ndarray, "F 3 2"]
    colors: Float[np.ndarray, "F 3 3"]
    texture: UInt8[np.ndarray, "H W 3"] | Float[np.ndarray, "H W 3"] | None
    gloss: Float[np.ndarray, " 3"] | None = None
    factors: UInt8[np.ndarray, "_ _ 2"] | None = None


def split_parts(mesh: Mesh, normals: Float[np.ndarray, "F 3 3"], encoding: str) -> Iterator[Part]:
    """Split a mesh into parts, each of which has one texture and one specular reflection.

    Mitsuba cannot multiply a texture by corner colors. If corners of faces with a
    texture are not white, the colors are first multiplied into new textures. Parts ascend by the
    index of the texture and of the gloss.
    """
    if (mesh.corner_colors[mesh.texture_ids >= 0] != 1).any():
        mesh, _ = with_added_albedo(mesh, np.zeros((len(mesh.faces), 3)), encoding)
    colors = decode(torch.from_numpy(mesh.corner_colors), encoding).numpy()
    # A mask of the faces of the part, its texture or NO_TEXTURE, and its gloss, empty if matte.
    for is_in_part, texture_id, gloss in by_material(mesh):
        has_texture = texture_id >= 0
        # Mitsuba shows either a texture or the colors of corners, which a white one would hide.
        is_white = has_texture and mesh.textures[texture_id].min() == 255
        has_factors = has_texture and mesh.gloss_textures
        yield Part(
            positions=mesh.vertices[mesh.faces[is_in_part]],
            normals=normals[is_in_part],
            uvs=mesh.corner_uvs[is_in_part],
            colors=colors[is_in_part],
            texture=mesh.textures[texture_id] if has_texture and not is_white else None,
            gloss=np.array(gloss) if gloss else None,
            factors=mesh.gloss_textures[texture_id] if has_factors else None,
        )


def shape(
    module: Any,
    surface: Scene,
    positions: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "V 3"] | None = None,
    uvs: Float[np.ndarray, "V 2"] | None = None,
    colors: Float[np.ndarray, "V 3"] | None = None,
) -> Any:
    """Create a Mitsuba mesh in memory.

    Without normals, each face is shaded with its own. Colors are linear, and become the attribute
    "vertex_color".
    """
    properties = module.Properties()
    properties["bsdf"] = load(module, surface)
    properties["face_normals"] = normals is None
    # Mitsuba creates empty buffers of these sizes, which are filled below.
    given = {"has_vertex_normals": normals is not None, "has_vertex_texcoords": uvs is not None}
    mesh = module.Mesh("mesh", len(positions), len(faces), props=properties, **given)
    if colors is not None:
        mesh.add_attribute("vertex_color", 3, colors.astype(np.float32).ravel())
    buffers = module.traverse(mesh)
    buffers["faces"] = faces.astype(np.uint32).ravel()
    # The texture coordinate v = 0 is the upper edge of a
    # texture in Mitsuba, and the lower edge in our meshes.
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
    local_lights: Sequence[LitBasis] = (),
) -> None:
    """Write a scene file for Mitsuba, with the mesh and texture files that it refers to.

    The environment map `light` is a path relative to the folder. Local lights have the
    coefficients (N, 3).
    """
    folder.mkdir(parents=True, exist_ok=True)
    # The first lines of this module explain these factors.
    is_colored = settings.bounces or mesh.gloss is not None
    color_scale, light_scale = (albedo_scale, 1.0) if is_colored else (1.0, albedo_scale)
    local_emitters = _local_emitters(folder, local_lights, light_scale)
    sky = environment({"filename": light}, math.pi * light_scale)
    # Rays with random directions from surfaces find the environment
    # with little noise. The rays that are aimed at emitters are
    # therefore all aimed at local lights, if there are any.
    sky["sampling_weight"] = 0.0 if local_emitters else 1.0
    sampler = {"type": "multijitter", "sample_count": SAMPLES}
    sensors = [{**sensor_of(camera, settings.size), "sampler": sampler} for camera in cameras]
    normals = mesh.written_normals(settings.normals)
    shapes = [
        _write_part(folder, number, part, settings.encoding, color_scale)
        for number, part in enumerate(split_parts(mesh, normals, settings.encoding))
    ]
    method = integrator(settings.bounces, emitter_samples=1 if local_emitters else 0)
    scene = xml.Element("scene", version="3.0.0")
    for entry in (method, sky, *local_emitters, *sensors, *shapes):
        _append(scene, "", entry)
    xml.indent(scene, "    ")
    atomic_write(folder / SCENE, xml.tostring(scene, "unicode") + "\n")


def _append(parent: xml.Element, name: str, value: Any) -> None:
    """Append a value to an XML element. An array (4, 4) is a transformation."""
    attributes = {"name": name} if name else {}
    if isinstance(value, np.ndarray):
        transform = xml.SubElement(parent, "transform", attributes)
        text = " ".join(f"{number:.17g}" for number in value.ravel())
        xml.SubElement(transform, "matrix", value=text)
    elif not isinstance(value, dict):
        xml.SubElement(parent, VALUE_TAGS[type(value)], attributes, value=_as_text(value))
    elif value["type"] == "rgb":
        xml.SubElement(parent, "rgb", attributes, value=_as_text(value["value"]))
    else:
        plugin = value["type"]
        element = xml.SubElement(parent, PLUGIN_TAGS[plugin], attributes, type=plugin)
        # The type is an attribute. All other entries become elements inside.
        for key, item in value.items():
            if key != "type":
                _append(element, key, item)


def _as_text(value: Any) -> str:
    """Convert a number, a flag, a string or a list of numbers to text for a Mitsuba scene file."""
    if isinstance(value, list):
        return " ".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _local_emitters(folder: Path, lights: Sequence[LitBasis], albedo_scale: float) -> list[Scene]:
    """Describe local lights for Mitsuba, and write the patterns of projectors as .exr files."""
    emitters: list[Scene] = []
    for basis, coefficients in lights:
        emitters += basis.mitsuba_emitters(coefficients, albedo_scale)
    projectors = [emitter for emitter in emitters if emitter["type"] == "projector"]
    for number, emitter in enumerate(projectors):  # A bitmap in memory becomes one in a file.
        name = f"pattern_{number}.exr" if number else "pattern.exr"
        pattern = dict(emitter["irradiance"])
        write_map(folder / name, torch.from_numpy(pattern.pop("bitmap")))
        emitter["irradiance"] = {"type": pattern.pop("type"), "filename": name, **pattern}
    return emitters


def _write_part(folder: Path, number: int, part: Part, encoding: str, color_scale: float) -> Scene:
    """Write a part to files such as part_0.ply and texture_0.png, and return its Mitsuba entry.

    The colors of the part are multiplied by `color_scale`.
    """
    import trimesh

    # A surface whose metallic value and specular factor are 0 is matte.
    gloss = part.gloss if part.gloss is not None and part.gloss[1:].any() else None
    # Factor for the albedo, because less light is reflected below a coat.
    albedo_factor = 1.0 if gloss is None else _reflected_albedo(gloss)
    color_factor = color_scale * albedo_factor
    corner_values = np.concatenate([part.uvs, color_factor * part.colors], axis=-1)
    corner_values = corner_values.reshape(-1, 5).astype(np.float32)
    # Each corner of each face is a vertex of its own.
    surface = trimesh.Trimesh(
        part.positions.reshape(-1, 3),
        np.arange(len(corner_values)).reshape(-1, 3),
        vertex_normals=part.normals.reshape(-1, 3),
        # Mitsuba reads the attributes u, v, r, g and b of the vertices of a .ply file.
        vertex_attributes=dict(zip("uvrgb", corner_values.T, strict=True)),
        process=False,
    )
    mesh_file = f"part_{number}.ply"
    atomic_write(folder / mesh_file, surface.export(file_type="ply", vertex_normal=True))

    def bitmap(name: str, image: UInt8[np.ndarray, "..."], raw: bool) -> Scene:
        """Write a texture of the part, and return its entry."""
        file = f"{name}_{number}.png"
        write_image(folder / file, image, compress_level=1)
        return {"type": "bitmap", "filename": file, "raw": raw}

    albedo: Scene = {"type": "mesh_attribute", "name": "vertex_color"}
    if part.texture is not None:
        linear = color_factor * decode(torch.from_numpy(part.texture) / 255, encoding)
        if linear.max() <= 1:
            texture = to_bytes(encode(linear, encoding)).numpy()
            albedo = bitmap("texture", texture, raw=encoding == "linear")
        else:
            file = f"texture_{number}.exr"
            write_map(folder / file, linear)
            albedo = {"type": "bitmap", "filename": file, "raw": True}
    material: Scene = {"type": "diffuse", "reflectance": albedo}
    if gloss is not None:
        roughness, metallic, specular_factor = gloss.tolist()
        # Mitsuba's reflectance at normal incidence is 0.08 · specular. It must be 0.04 times the
        # specular factor, for a refractive index of 1.5.
        specular = max(specular_factor / 2, MIN_SPECULAR)
        material = {"type": "principled", "base_color": albedo, "specular": specular}
        # A metal has no coat and needs the full albedo, but the albedo was multiplied by a factor.
        # A larger value for metallic compensates for this.
        factors = {"roughness": roughness, "metallic": metallic / albedo_factor}
        minimums = {"roughness": MIN_ROUGHNESS, "metallic": 0.0}
        for channel, (name, factor) in enumerate(factors.items()):
            material[name] = max(factor, minimums[name])
            if part.factors is not None:
                values = np.maximum(part.factors[..., channel] * factor, 255 * minimums[name])
                material[name] = bitmap(name, values.round().astype(np.uint8), raw=True)
    bsdf = {"type": "twosided", "material": material}
    return {"type": "ply", "filename": mesh_file, "flip_tex_coords": True, "bsdf": bsdf}


def _reflected_albedo(gloss: Float[np.ndarray, " 3"]) -> float:
    """Compute which fraction of its albedo a glossy surface reflects under uniform light.

    A metal reflects all of the albedo. A dielectric reflects the albedo times the
    fraction of the light that passes its coat.
    """
    roughness, metallic, specular_factor = torch.from_numpy(gloss).double()[:, None]
    below_coat = 1 - specular_factor * coat_mean(roughness.clamp(min=MIN_ROUGHNESS))
    return float(metallic + (1 - metallic) * below_coat)
