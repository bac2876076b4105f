"""Read the materials of glTF 2.0 files.

The color and the alpha of a surface are read, and on request its roughness,
metallic value and specular factor. Other properties of a material are ignored
(`ignored_features`). What lets light pass through the surface is refused.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from renderer.image import decode, encode
from renderer.io.gltf_file import INSTANCING, TEXEL_BYTES, VISIBILITY, WEBP, GltfFile
from renderer.memory import require_memory

TRANSFORM = "KHR_texture_transform"
QUANTIZATION = "KHR_mesh_quantization"
SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
SPECULAR = "KHR_materials_specular"
IOR = "KHR_materials_ior"
# Extensions that are read. SPECULAR and IOR are read only for the gloss.
READ = {
    *(TRANSFORM, QUANTIZATION, SPECULAR_GLOSSINESS, SPECULAR, IOR),
    *(WEBP, INSTANCING, VISIBILITY),
}
# Beginnings of the names of extensions that may be required by a
# file but ignored, because they change neither shape nor color.
HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_animation_")
# Extensions by which a surface lets light pass, and their factors.
TRANSPARENT = {
    "KHR_materials_transmission": "transmissionFactor",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
}
# Reflectance at normal incidence of a surface with the specular factor 1.
DIELECTRIC = 0.04
# Numbers of OpenGL for the use of textures (5.26).
REPEAT = 10497
CLAMP = 33071
MIRROR = 33648
NEAREST = 9728


class Placement(NamedTuple):
    """Place of a texture on a surface.

    Attributes:
        uv_set: Number n of the texture coordinates TEXCOORD_n.
        transform: Rows of the matrix (2, 3) that maps a column (u, v, 1) of texture coordinates.
        wraps: How the texture continues beyond [0, 1] in u and in v.
    """

    uv_set: int
    transform: tuple[tuple[float, ...], ...]
    wraps: tuple[int, int]


@dataclass(frozen=True)
class Material:
    """Material of a surface.

    Attributes:
        color: Linear color and alpha by which those of the texture are multiplied, shape (4,).
        mode: Use of alpha: "OPAQUE", "MASK" or "BLEND".
        cutoff: Alpha below which the mode "MASK" cuts out the surface.
        placement: Place of the textures. None without textures.
        texture: sRGB-encoded color, uint8, shape (H, W, 3), or None.
        alpha: Alpha of the texture, uint8, shape (H, W). None if it is 1 everywhere.
        gloss: Roughness, metallic and specular factor, shape (3,). None for a matte surface.
        gloss_texture: Factors of roughness and metallic, uint8, shape (H, W, 2), or None.
    """

    color: Float[np.ndarray, " 4"]
    mode: str = "OPAQUE"
    cutoff: float = 0.5
    placement: Placement | None = None
    texture: UInt8[np.ndarray, "H W 3"] | None = None
    alpha: UInt8[np.ndarray, "H W"] | None = None
    gloss: Float[np.ndarray, " 3"] | None = None
    gloss_texture: UInt8[np.ndarray, "H W 2"] | None = None

    def placed(self, uvs: np.ndarray) -> tuple["Material", np.ndarray]:
        """Convert texture coordinates (V, 2) of the file to those of `Mesh`.

        The textures of `Mesh` repeat. A texture that is mirrored is therefore
        doubled, and a clamped texture is extended at its edges.
        """
        if self.placement is None or self.texture is None:
            return self, np.zeros((len(uvs), 2))
        matrix = np.array(self.placement.transform)
        uvs = uvs @ matrix[:, :2].T + matrix[:, 2]
        placed = self
        for axis, wrap in enumerate(self.placement.wraps):
            size = self.texture.shape[1 - axis]
            coordinates = uvs[:, axis]
            if wrap == MIRROR:
                before, after, mode = 0, size, "symmetric"
            elif wrap == CLAMP:
                # Interpolation needs one texel more than the surface covers.
                before = 1 + max(0, math.ceil(-coordinates.min() * size))
                after = 1 + max(0, math.ceil((coordinates.max() - 1) * size))
                mode = "edge"
            else:
                continue
            placed = placed._extended(1 - axis, before, after, mode)
            uvs[:, axis] = (coordinates * size + before) / (before + size + after)
        # v points down in glTF, and up in `Mesh`.
        uvs[:, 1] = 1 - uvs[:, 1]
        return placed, uvs

    def _extended(self, axis: int, before: int, after: int, mode: Any) -> "Material":
        """Return a copy whose textures have more texels before and after the present ones."""
        assert self.texture is not None
        size = list(self.texture.shape[:2])
        size[axis] += before + after
        require_memory("textures", TEXEL_BYTES * math.prod(size), torch.device("cpu"))
        textures: dict[str, Any] = {}
        for name in ("texture", "alpha", "gloss_texture"):
            texels = getattr(self, name)
            if texels is not None:
                padding = [(0, 0)] * texels.ndim
                padding[axis] = (before, after)
                textures[name] = np.pad(texels, padding, mode=mode)
        return replace(self, **textures)


def ignored_features(tree: dict[str, Any]) -> list[str]:
    """List the features of a file that change neither its shape nor its base color.

    Light that a surface emits is among them: the renderer alone lights a mesh.
    """
    features = set()
    for material in tree.get("materials", []):
        features |= {"normalTexture", "occlusionTexture"} & material.keys()
        if any(material.get("emissiveFactor", ())):
            features.add("emitted light")
        features |= set(material.get("extensions", ())) - READ
    for sampler in tree.get("samplers", []):
        if sampler.get("magFilter") == NEAREST:
            features.add("textures without interpolation")
    if "animations" in tree:
        features.add("animations")
    if len(tree.get("scenes", ())) > 1:
        features.add("all scenes but the first" if "scene" not in tree else "other scenes")
    for name in tree.get("extensionsRequired", []):
        if name not in READ and not name.startswith(HARMLESS):
            raise ValueError(f"it needs the extension {name}: export the mesh without it")
    return sorted(features | set(tree.get("extensionsUsed", ())) - READ)


def read_material(file: GltfFile, index: int | None, gloss: bool) -> Material:
    """Read a material. Without an index, it is white and matte. Without `gloss`, it is matte."""
    if index is None:
        return Material(color=np.ones(4))
    entry = file.entry("materials", index)
    extensions = entry.get("extensions", {})
    for name, factor in TRANSPARENT.items():
        if extensions.get(name, {}).get(factor, 0) > 0:
            raise ValueError(f"a material lets light pass ({name}): make it opaque")
    mode = entry.get("alphaMode", "OPAQUE")
    if mode not in ("OPAQUE", "MASK", "BLEND"):
        raise ValueError(f"a material has the alphaMode {mode}: use OPAQUE, MASK or BLEND")
    if SPECULAR_GLOSSINESS in extensions:
        material = _specular_glossiness(file, extensions[SPECULAR_GLOSSINESS], gloss)
    else:
        material = _metallic_roughness(file, entry, gloss)
    return replace(material, mode=mode, cutoff=entry.get("alphaCutoff", 0.5))


def _metallic_roughness(file: GltfFile, entry: dict[str, Any], gloss: bool) -> Material:
    """Read a material of glTF's own model (3.9.2)."""
    model = entry.get("pbrMetallicRoughness", {})
    material = _with_texture(
        Material(color=_factor(model, "baseColorFactor", 4)), file, model.get("baseColorTexture")
    )
    if not gloss:
        return material
    factors = [model.get("roughnessFactor", 1), model.get("metallicFactor", 1)]
    factors = [*factors, _specular_factor(entry.get("extensions", {}))]
    material = replace(material, gloss=np.clip(factors, 0, 1))
    if "metallicRoughnessTexture" not in model:
        return material
    image, placement = _image(file, model["metallicRoughnessTexture"])
    # glTF stores roughness in green and metallic in blue.
    return _with_gloss_texture(material, np.array(image.convert("RGB"))[..., 1:], placement)


def _specular_factor(extensions: dict[str, Any]) -> float:
    """Compute the specular factor, which is 1 for a reflectance of 4%, by its two extensions."""
    specular = extensions.get(SPECULAR, {})
    colors = _factor(specular, "specularColorFactor", 3)
    textures = {"specularTexture", "specularColorTexture"} & specular.keys()
    if textures or np.ptp(colors) > 0:
        raise ValueError(
            f"a material has a specular color or texture ({SPECULAR}): read it without gloss"
        )
    ior = extensions.get(IOR, {}).get("ior", 1.5)
    reflectance = ((ior - 1) / (ior + 1)) ** 2
    factor: float = specular.get("specularFactor", 1.0) * colors[0] * reflectance / DIELECTRIC
    return factor


def _specular_glossiness(file: GltfFile, model: dict[str, Any], gloss: bool) -> Material:
    """Read a material of the extension KHR_materials_pbrSpecularGlossiness.

    Its diffuse albedo is diffuse · (1 - max(specular)).
    """
    material = _with_texture(
        Material(color=_factor(model, "diffuseFactor", 4)), file, model.get("diffuseTexture")
    )
    specular = _factor(model, "specularFactor", 3)
    glossiness = np.array(model.get("glossinessFactor", 1.0))
    placement = None
    if "specularGlossinessTexture" in model:
        image, placement = _image(file, model["specularGlossinessTexture"])
        texels = torch.from_numpy(np.array(image.convert("RGBA"), dtype=np.float32) / 255)
        specular = specular * decode(texels[..., :3], "srgb").numpy()
        glossiness = glossiness * texels[..., 3].numpy()
    reflectance = np.clip(specular, 0, 1).max(axis=-1)
    if placement is None:
        material.color[:3] *= 1 - reflectance
    else:
        material = _dimmed(material, 1 - reflectance, placement)
    if not gloss:
        return material
    factor = min(float(reflectance.mean()) / DIELECTRIC, 1)
    if np.abs(specular - factor * DIELECTRIC).max() > 1e-3:
        file.file.assume(f"the specular factor {factor:.2g} stands for a specular color")
    material = replace(material, gloss=np.array([1, 0, factor]))
    roughness = np.clip(1 - glossiness, 0, 1)
    if placement is None:
        return replace(material, gloss=np.array([roughness, 0, factor]))
    factors = np.stack([np.rint(255 * roughness), np.full(roughness.shape, 255)], axis=-1)
    return _with_gloss_texture(material, factors.astype(np.uint8), placement)


def _dimmed(material: Material, factors: np.ndarray, placement: Placement) -> Material:
    """Multiply the texture of a material by factors (H, W), which lie at the given place."""
    material = _with_common_placement(material, placement, factors.shape)
    assert material.texture is not None
    height, width = material.texture.shape[:2]
    image = Image.fromarray(factors.astype(np.float32)).resize(
        (width, height), Image.Resampling.BILINEAR
    )
    linear = decode(torch.from_numpy(material.texture).float() / 255, "srgb")
    dimmed = encode(linear * torch.from_numpy(np.array(image))[..., None], "srgb")
    return replace(material, texture=(255 * dimmed).round().to(torch.uint8).numpy())


def _with_gloss_texture(material: Material, texels: np.ndarray, placement: Placement) -> Material:
    """Add a gloss texture (H, W, 2) to a material."""
    material = _with_common_placement(material, placement, (1, 1))
    assert material.texture is not None
    if placement.wraps != (REPEAT, REPEAT) and texels.shape[:2] != material.texture.shape[:2]:
        # Textures that will be extended need the same size.
        height, width = material.texture.shape[:2]
        channels = [Image.fromarray(channel) for channel in np.moveaxis(texels, 2, 0)]
        resized = [np.array(c.resize((width, height), Image.Resampling.BILINEAR)) for c in channels]
        texels = np.stack(resized, axis=-1)
    return replace(material, gloss_texture=texels)


def _with_common_placement(
    material: Material, placement: Placement, shape: tuple[int, ...]
) -> Material:
    """Return a material with a texture at a place, which is white if there was none."""
    if material.placement is None:
        white = np.full((*shape, 3), 255, dtype=np.uint8)
        return replace(material, placement=placement, texture=white)
    if material.placement != placement:
        raise ValueError(
            "the textures of a material differ in texture coordinates, transform or wrap mode: "
            "use the same for all"
        )
    return material


def _factor(model: dict[str, Any], name: str, count: int) -> np.ndarray:
    """Return a factor of a material in [0, 1], which is 1 by default."""
    factor = np.array(model.get(name, [1] * count), dtype=np.float64)
    if factor.shape != (count,):
        raise ValueError(f"{name} has the shape {factor.shape} instead of ({count},)")
    return np.clip(factor, 0, 1)


def _with_texture(material: Material, file: GltfFile, info: dict[str, Any] | None) -> Material:
    """Add a texture of color and alpha to a material."""
    if info is None:
        return material
    image, placement = _image(file, info)
    alpha = None
    if image.has_transparency_data:
        alpha = np.array(image.convert("RGBA"))[..., 3]
        alpha = None if alpha.min() == 255 else alpha
    texture = np.array(image.convert("RGB"))
    return replace(material, placement=placement, texture=texture, alpha=alpha)


def _image(file: GltfFile, info: dict[str, Any]) -> tuple[Image.Image, Placement]:
    """Decode the image of a texture, and find its place on the surface."""
    transform = info.get("extensions", {}).get(TRANSFORM, {})
    cosine = math.cos(transform.get("rotation", 0))
    sine = math.sin(transform.get("rotation", 0))
    # v points down, and the rotation is counter-clockwise as one sees it. The
    # matrix in the text of the extension has another sign, which is an error
    # (github.com/KhronosGroup/glTF/issues/1563).
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    linear = rotation * transform.get("scale", (1, 1))
    rows = np.column_stack([linear, transform.get("offset", (0, 0))])
    sampler_index = file.entry("textures", info["index"]).get("sampler")
    sampler = {} if sampler_index is None else file.entry("samplers", sampler_index)
    placement = Placement(
        uv_set=transform.get("texCoord", info.get("texCoord", 0)),
        transform=tuple(map(tuple, rows.tolist())),
        wraps=(sampler.get("wrapS", REPEAT), sampler.get("wrapT", REPEAT)),
    )
    return file.image(info["index"]), placement
