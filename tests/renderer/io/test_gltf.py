"""Features of glTF 2.0, compared with the formulas of its specification and with closed forms."""

import base64
import json
import math
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
import torch
from gltf_files import SQUARE, SQUARE_FACES, SQUARE_UVS, Gltf
from numpy.testing import assert_allclose, assert_array_equal
from oracles import bilinear, corners_of, encoded, srgb_of
from PIL import Image

from renderer import errors
from renderer.errors import InputError
from renderer.image import decode
from renderer.io import gltf as gltf_reader
from renderer.io.meshes import files_beside, load_mesh, read_parts
from renderer.mesh import Mesh


def linear(colors: np.ndarray) -> np.ndarray:
    return decode(torch.from_numpy(np.float64(colors)), "srgb").numpy()


def albedo_at(mesh: Mesh, uvs: np.ndarray) -> np.ndarray:
    """Interpolate the linear albedo bilinearly at texture coordinates of the mesh, v up."""
    [texture] = mesh.textures
    height, width = texture.shape[:2]
    row, column = (1 - uvs[:, 1]) * height - 0.5, uvs[:, 0] * width - 0.5
    return bilinear(linear(texture / 255), row, column)


def triangle_corners(folder: Path, gltf: Gltf) -> np.ndarray:
    return corners_of(gltf.load(folder))


def normals_in(folder: Path) -> np.ndarray:
    """Return the unit normals (F, 3 corners, 3) of the only part of the file that was loaded."""
    [part] = read_parts(folder / "mesh.gltf")
    _, normals = part.placed()
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


POINTS = np.float32([[0, 0, 0], [1, 0, 0], [0, 2, 0], [1, 2, 0], [0, 4, 1]])


def test_arrays_may_be_interleaved_and_have_no_indices(tmp_path):
    gltf = Gltf()
    records = np.zeros(3, dtype=[("position", "<f4", 3), ("color", "u1", 4)])
    records["position"] = POINTS[:3]
    records["color"] = [[51, 102, 255, 0]] * 3
    view = gltf.view(records.tobytes(), byteStride=16)
    for offset, kind, component in ((0, "VEC3", 5126), (12, "VEC4", 5121)):
        accessor = {"bufferView": view, "byteOffset": offset, "componentType": component}
        accessor |= {"count": 3, "type": kind, "normalized": component == 5121}
        gltf.tree["accessors"].append(accessor)
    gltf.mesh({"POSITION": 0, "COLOR_0": 1})
    mesh = gltf.load(tmp_path)
    assert_array_equal(corners_of(mesh), POINTS[None, :3])
    assert_allclose(mesh.corner_colors[0], [[srgb_of(0.2), srgb_of(0.4), 1]] * 3, atol=1e-6)


@pytest.mark.parametrize("has_base", [False, True])
def test_sparse_arrays_replace_rows_of_an_array_or_of_zeros(tmp_path, has_base):
    gltf = Gltf()
    index = gltf.array(np.float32([[9, 9, 9], [1, 0, 0], [9, 9, 9]]))
    if not has_base:
        del gltf.tree["accessors"][index]["bufferView"]
    gltf.sparse(index, np.uint16([0, 2]), np.float32([[3, 0, 0], [0, 3, 0]]))
    gltf.mesh({"POSITION": index})
    expected = [[3, 0, 0], [float(has_base), 0, 0], [0, 3, 0]]
    assert_array_equal(triangle_corners(tmp_path, gltf), [expected])


@pytest.mark.parametrize(
    ("points", "normalized", "expected"),
    [
        *((POINTS[:3].astype(dtype), False, POINTS[:3]) for dtype in ("int8", "uint16", "float32")),
        # max(c / 127, -1), and alike for 16 bits.
        (np.diag(np.int8([-128, 127, 64])), True, np.diag([-1, 1, 64 / 127])),
    ],
)
def test_quantized_positions_are_those_of_the_specification(tmp_path, points, normalized, expected):
    gltf = Gltf()
    gltf.tree["extensionsUsed"] = gltf.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    gltf.tree["nodes"][0]["scale"] = [0.5, 0.5, 0.5]
    gltf.mesh({"POSITION": gltf.array(points, normalized)})
    assert_allclose(triangle_corners(tmp_path, gltf), expected[None] / 2, rtol=1e-12)


@pytest.mark.parametrize(
    ("dtype", "channels", "has_material"),
    [("uint8", 3, True), ("uint8", 4, False), ("uint16", 4, True), ("float32", 3, False)],
)
def test_vertex_colors_are_multiplied_by_the_material(tmp_path, dtype, channels, has_material):
    largest = 1 if dtype == "float32" else np.iinfo(dtype).max
    colors = np.array([[0.5, 0.25, 0.1, 0.3]] * 3)[:, :channels]
    stored = (np.rint(colors * largest) if largest > 1 else colors).astype(dtype)
    gltf = Gltf()
    primitive = gltf.mesh({"POSITION": POINTS[:3], "COLOR_0": gltf.array(stored, largest > 1)})
    factor = np.array([1.0, 1, 1])
    if has_material:
        factor = np.array([0.123456, 0.5, 0.7])
        primitive["material"] = 0
        model = {"baseColorFactor": [*factor, 0.2]}
        gltf.tree["materials"].append({"pbrMetallicRoughness": model})
    expected = srgb_of(stored[0, :3] / largest * factor)
    assert_allclose(gltf.load(tmp_path).corner_colors[0], [expected] * 3, atol=1e-6)


def color_texels(height: int, width: int, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, channels)).astype(np.uint8)


def wrapped(index: np.ndarray, count: int, mode: int) -> np.ndarray:
    if mode == 33071:
        return index.clip(0, count - 1)
    if mode == 33648:
        return np.minimum(index % (2 * count), 2 * count - 1 - index % (2 * count))
    return index % count


@pytest.mark.parametrize(("wrap_u", "wrap_v"), [(10497, 33071), (33071, 33648), (33648, 10497)])
@pytest.mark.parametrize("gloss_side", [None, 1, 2, 5])
def test_textures_are_wrapped_as_opengl_wraps_them(tmp_path, wrap_u, wrap_v, gloss_side):
    """The texture coordinates of the square are from -0.7 to 2.3."""
    texels = color_texels(3, 4)
    gltf = Gltf()
    samplers = {"wrapS": wrap_u, "wrapT": wrap_v}
    model = {"baseColorTexture": gltf.texture(texels, **samplers)}
    if gloss_side:
        # A gloss texture of another size changes no color.
        factors = color_texels(gloss_side, gloss_side)
        model["metallicRoughnessTexture"] = gltf.texture(factors, **samplers)
    gltf.square(pbrMetallicRoughness=model)
    gltf.tree["accessors"][1]["bufferView"] = gltf.view((3 * SQUARE_UVS - 0.7).tobytes())
    mesh = gltf.load(tmp_path, gloss=gloss_side is not None)
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], (2, 50))
    points = np.einsum("fnc,fci->fni", weights, corners_of(mesh)).reshape(-1, 3)
    uvs = np.einsum("fnc,fci->fni", weights, mesh.corner_uvs).reshape(-1, 2)
    # Position in the texture of the file, by the formula of OpenGL.
    column = (3 * points[:, 0] - 0.7) * 4 - 0.5
    row = (3 * (1 - points[:, 1]) - 0.7) * 3 - 0.5
    index = np.arange(-9, 12)
    around = texels[wrapped(index, 3, wrap_v)[:, None], wrapped(index, 4, wrap_u)]
    expected = bilinear(linear(around / 255), row + 9, column + 9)
    assert_allclose(albedo_at(mesh, uvs), expected, atol=1e-5)


def test_a_node_of_scale_0_is_hidden(tmp_path):
    gltf = plain()
    gltf.tree["nodes"].append({"mesh": 0, "scale": [0, 0, 0], "translation": [9, 9, 9]})
    gltf.tree["scenes"] = [{"nodes": [0, 1]}]
    shown = plain().load(tmp_path)
    assert_array_equal(gltf.load(tmp_path).vertices, shown.vertices)


@pytest.mark.parametrize("wrap", [33071, 33648])
def test_parts_with_one_texture_share_its_extended_copy(tmp_path, wrap):
    gltf = Gltf()
    texture = gltf.texture(color_texels(3, 4), wrapS=wrap, wrapT=wrap)
    gltf.square(pbrMetallicRoughness={"baseColorTexture": texture})
    gltf.mesh({"POSITION": SQUARE + 1, "TEXCOORD_0": SQUARE_UVS / 2}, SQUARE_FACES, material=0)
    gltf.tree["nodes"] = [{"mesh": 0}, {"mesh": 1}]
    gltf.tree["scenes"] = [{"nodes": [0, 1]}]
    mesh = gltf.load(tmp_path)
    assert len(mesh.faces) == 4 and len(mesh.textures) == 1


def test_texture_coordinates_are_scaled_then_rotated_then_shifted(tmp_path):
    """The corner (1, 0) turns towards (0, -1): counter-clockwise, as v points down."""
    gltf = Gltf()
    info = gltf.texture(color_texels(2, 2))
    transform = {"offset": [0.1, 0.2], "rotation": math.pi / 6, "scale": [2, 3], "texCoord": 1}
    info |= {"extensions": {"KHR_texture_transform": transform}, "texCoord": 0}
    gltf.tree["extensionsUsed"] = gltf.tree["extensionsRequired"] = ["KHR_texture_transform"]
    gltf.square(pbrMetallicRoughness={"baseColorTexture": info})
    attributes = gltf.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = attributes.pop("TEXCOORD_0")
    mesh = gltf.load(tmp_path)
    u, v = (SQUARE_UVS * [2, 3]).T
    cosine, sine = math.cos(math.pi / 6), math.sin(math.pi / 6)
    expected = np.stack([cosine * u + sine * v + 0.1, 1 - (-sine * u + cosine * v + 0.2)], axis=1)
    assert_allclose(mesh.corner_uvs.reshape(-1, 2), expected[SQUARE_FACES], atol=1e-6)
    assert_array_equal(corners_of(mesh).reshape(-1, 3), SQUARE[SQUARE_FACES])


def hole(size: int, radius: float, width: float = 1) -> np.ndarray:
    """Return texels with alpha 0 in a circle in the middle, whose border has a width in texels."""
    position = np.arange(size) + 0.5 - size / 2
    distance = np.hypot(position[:, None], position)
    alpha = np.clip((distance - radius) / width + 0.5, 0, 1)
    texels = np.full((size, size, 4), 200.0)
    texels[..., 3] = 255 * alpha
    return np.rint(texels).astype(np.uint8)


def masked(texels: np.ndarray, mode: str = "MASK", **entries: Any) -> Gltf:
    gltf = Gltf()
    model = {"baseColorTexture": gltf.texture(texels)}
    return gltf.square(pbrMetallicRoughness=model, alphaMode=mode, **entries)


def test_a_circle_of_alpha_is_cut_out_without_cracks(tmp_path):
    """Each inner edge belongs to two faces, so the rim of the hole is one closed line."""
    mesh = masked(hole(64, 20)).load(tmp_path)
    circle = math.pi * (20 / 64) ** 2
    assert mesh.face_areas().sum() == pytest.approx(1 - circle, abs=1e-3 * circle)
    # No corner is further inside of the circle than a fraction of a texel.
    distance = np.linalg.norm(corners_of(mesh)[..., :2] - 0.5, axis=-1) * 64
    assert distance.min() == pytest.approx(20, abs=0.15)
    assert_allclose(mesh.corner_uvs, corners_of(mesh)[..., :2], atol=1e-6)
    assert (mesh.face_normals()[:, 2] > 0.99).all()
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2
    lengths = np.linalg.norm(np.diff(mesh.vertices[pairs[counts == 1]], axis=1), axis=-1)
    assert lengths.sum() == pytest.approx(4 + 2 * math.pi * 20 / 64, rel=0.01)


@pytest.mark.parametrize(("cutoff", "radius"), [(0.25, 8), (0.75, 12), (None, 10)])
def test_alpha_is_cut_at_the_cutoff_of_the_file(tmp_path, cutoff, radius):
    """Alpha rises from 0 to 1 within eight texels at the border."""
    entries = {} if cutoff is None else {"alphaCutoff": cutoff}
    mesh = masked(hole(32, 10, width=8), **entries).load(tmp_path)
    circle = math.pi * (radius / 32) ** 2
    assert 1 - mesh.face_areas().sum() == pytest.approx(circle, rel=0.01)


def test_a_mask_with_too_long_a_border_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(gltf_reader, "MAX_FACES", 1000)
    gltf = masked(hole(16, 5))
    gltf.tree["accessors"][1]["bufferView"] = gltf.view((1e5 * SQUARE_UVS).tobytes())
    with pytest.raises(InputError, match="needs more than 1000 faces"):
        gltf.load(tmp_path)


def test_the_alpha_of_vertices_and_of_the_material_is_cut_exactly(tmp_path):
    """Alpha is .8 x on the square, and at least .5 from x = .625 on."""
    gltf = Gltf().square(pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.8]}, alphaMode="MASK")
    colors = np.float32(np.column_stack([SQUARE, SQUARE[:, 0]]))
    gltf.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = gltf.array(colors)
    mesh = gltf.load(tmp_path)
    assert mesh.face_areas().sum() == pytest.approx(0.375, rel=1e-6)
    assert mesh.vertices[:, 0].min() == pytest.approx(0.625, rel=1e-6)
    # Colors are interpolated linearly before they are encoded.
    expected = np.float64(corners_of(mesh))
    assert_allclose(linear(mesh.corner_colors)[..., :2], expected[..., :2], atol=1e-6)


def one_transparent_texel() -> np.ndarray:
    texels = np.full((16, 16, 4), 255, np.uint8)
    texels[4, 9, 3] = 254
    return texels


def test_a_blended_surface_is_read_if_its_part_of_the_texture_is_opaque(tmp_path):
    """The transparent half of the texture is not on the square."""
    texels = hole(16, -1)
    texels[:, 9:, 3] = 0
    gltf = masked(texels, "BLEND")
    gltf.tree["accessors"][1]["bufferView"] = gltf.view((SQUARE_UVS * 0.4 + 0.1).tobytes())
    assert len(gltf.load(tmp_path).faces) == 2


@pytest.mark.parametrize(
    "gltf",
    [
        masked(hole(16, 5), "BLEND"),
        masked(one_transparent_texel(), "BLEND"),
        Gltf().square(pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.9]}, alphaMode="BLEND"),
        Gltf().square(extensions={"KHR_materials_transmission": {"transmissionFactor": 0.5}}),
    ],
    ids=["texture", "one texel", "factor", "transmission"],
)
def test_transparent_surfaces_are_refused(tmp_path, gltf):
    with pytest.raises(InputError, match=r"mesh\.gltf.*(transparent|lets light pass)"):
        gltf.load(tmp_path)


SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"


def specular_glossiness(gltf: Gltf, **model: Any) -> Gltf:
    return gltf.square(extensions={SPECULAR_GLOSSINESS: model})


def test_the_albedo_below_a_specular_color_is_the_diffuse_color_without_what_it_reflects(tmp_path):
    """c_diff = diffuse · (1 - max(specular)), by the text of the extension."""
    model = {"diffuseFactor": [0.5, 0.25, 0.1, 1], "specularFactor": [0.1, 0.2, 0.05]}
    mesh = specular_glossiness(Gltf(), **model).load(tmp_path)
    assert_allclose(linear(mesh.corner_colors)[0], [[0.4, 0.2, 0.08]] * 3, atol=1e-6)
    assert mesh.gloss is None


@pytest.mark.parametrize("has_diffuse_texture", [False, True])
def test_the_albedo_below_a_specular_texture_is_that_of_each_texel(tmp_path, has_diffuse_texture):
    gltf = Gltf()
    diffuse = color_texels(4, 6)
    specular = color_texels(4, 6, 4)[::-1] // 2
    model: dict[str, Any] = {"specularGlossinessTexture": gltf.texture(specular)}
    model |= {"specularFactor": [0.5, 1, 0.8], "diffuseFactor": [0.6, 1, 1, 1]}
    if has_diffuse_texture:
        model["diffuseTexture"] = gltf.texture(diffuse)
    else:
        diffuse = np.full((4, 6, 3), 255)
    mesh = specular_glossiness(gltf, **model).load(tmp_path)
    reflected = (linear(specular[..., :3] / 255) * [0.5, 1, 0.8]).max(axis=-1, keepdims=True)
    expected = srgb_of(linear(diffuse / 255) * (1 - reflected))
    assert_allclose(mesh.textures[0] / 255, expected, atol=0.502 / 255)
    assert_allclose(mesh.corner_colors[0, 0], srgb_of(np.array([0.6, 1, 1])), atol=1e-6)


def test_the_gloss_of_a_specular_color_has_its_reflectance_and_roughness(tmp_path):
    gltf = Gltf()
    texels = np.full((2, 2, 4), 255, np.uint8)
    texels[0, 0, 3] = 51
    model = {"specularFactor": [0.02] * 3, "glossinessFactor": 0.75}
    mesh = specular_glossiness(gltf, **model).load(tmp_path, gloss=True)
    assert_allclose(mesh.gloss[0], [0.25, 0, 0.5], atol=1e-6)
    gltf = Gltf()
    model["specularGlossinessTexture"] = gltf.texture(texels)
    mesh = specular_glossiness(gltf, **model).load(tmp_path, gloss=True)
    assert_allclose(mesh.gloss[0], [1, 0, 0.5], atol=1e-6)
    roughness = mesh.gloss_textures[0][..., 0] / 255
    assert_allclose(roughness, [[0.85, 0.25], [0.25, 0.25]], atol=0.5 / 255)
    assert (mesh.gloss_textures[0][..., 1] == 255).all()


def test_a_specular_color_that_gloss_cannot_hold_is_named(tmp_path):
    gltf = specular_glossiness(Gltf(), specularFactor=[0.5, 0.3, 0.1])
    with pytest.warns(UserWarning, match="specular color"):
        mesh = gltf.load(tmp_path, gloss=True)
    assert mesh.gloss[0].tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("mesh_weights", "node_weights", "height"),
    [([1.0], None, 3), ([0.5], None, 2), ([1.0], [0.25], 1.5), (None, None, 1), (None, [1.0], 3)],
)
def test_morph_targets_move_vertices_by_their_weights(tmp_path, mesh_weights, node_weights, height):
    gltf = Gltf()
    primitive = gltf.mesh({"POSITION": np.float32([[0, 0, 0], [1, 0, 0], [0, 0, 1]])})
    primitive["targets"] = [{"POSITION": gltf.array(np.float32([[0] * 3, [0] * 3, [0, 0, 2]]))}]
    if mesh_weights:
        gltf.tree["meshes"][0]["weights"] = mesh_weights
    if node_weights:
        gltf.tree["nodes"][0]["weights"] = node_weights
    assert gltf.load(tmp_path).vertices[:, 2].max() == height


def test_morph_targets_are_added_to_each_attribute(tmp_path):
    """Two targets change positions, colors and normals, the second one by a sparse array."""
    gltf = Gltf()
    colors = np.float32([[0.2, 0.4, 0.6]] * 3)
    attributes = {"POSITION": POINTS[:3], "COLOR_0": colors, "NORMAL": np.float32([[0, 0, 1]] * 3)}
    primitive = gltf.mesh(attributes)
    sparse = gltf.array(np.float32([[0, 0, 0]] * 3))
    del gltf.tree["accessors"][sparse]["bufferView"]
    gltf.sparse(sparse, np.uint8([1]), np.float32([4, 0, 0]))
    changes = {"POSITION": [0, 0, 1], "COLOR_0": [0.4, 0, 2], "NORMAL": [2, 0, 0]}
    arrays = {name: gltf.array(np.float32([row] * 3)) for name, row in changes.items()}
    primitive["targets"] = [arrays, {"POSITION": sparse}]
    gltf.tree["meshes"][0]["weights"] = [0.5, 0.25]
    mesh = gltf.load(tmp_path)
    expected = POINTS[:3] + [0, 0, 0.5] + 0.25 * np.float32([[0] * 3, [4, 0, 0], [0] * 3])
    assert_allclose(corners_of(mesh)[0], expected, atol=1e-6)
    assert_allclose(linear(mesh.corner_colors)[0], [[0.4, 0.4, 1]] * 3, atol=1e-6)
    assert_allclose(normals_in(tmp_path), [[[math.sqrt(0.5), 0, math.sqrt(0.5)]] * 3])


def test_nodes_with_translation_rotation_and_scale_place_their_meshes(tmp_path):
    """Point · scale, rotated by 90° about z, then moved; the parent mirrors x."""
    gltf = Gltf()
    gltf.mesh({"POSITION": POINTS[:3], "NORMAL": np.float32([[0, 0.6, 0.8]] * 3)})
    turn = [0, 0, math.sqrt(0.5), math.sqrt(0.5)]
    gltf.tree["nodes"] = [
        {"children": [1], "scale": [-1, 1, 1]},
        {"mesh": 0, "translation": [5, 6, 7], "rotation": turn, "scale": [2, 3, 4]},
        {"mesh": 0},
    ]
    x, y, z = (POINTS[:3] * [2, 3, 4]).T
    expected = np.stack([-(-y + 5), x + 6, z + 7], axis=1)
    # A mirrored face has its corners in the opposite order.
    assert_allclose(triangle_corners(tmp_path, gltf)[0], expected[[0, 2, 1]], atol=1e-6)
    normal = np.array([0.2, 0, 0.2]) / math.sqrt(0.08)
    assert_allclose(normals_in(tmp_path), np.broadcast_to(normal, (1, 3, 3)), atol=1e-6)


def test_copies_of_a_mesh_share_its_texture(tmp_path):
    gltf = Gltf()
    texture = gltf.texture(color_texels(2, 2))
    gltf.square(pbrMetallicRoughness={"baseColorTexture": texture}).mesh({"POSITION": POINTS[:3]})
    gltf.tree["nodes"] = [{"mesh": 0}, {"mesh": 1}, {"mesh": 0, "translation": [5, 0, 0]}]
    gltf.tree["scenes"][0]["nodes"] = [0, 1, 2]
    mesh = gltf.load(tmp_path)
    assert len(mesh.textures) == 1
    assert mesh.texture_ids.tolist() == [0, 0, -1, 0, 0]


@pytest.mark.parametrize("roots", [[0, 2, 3], [0, 2]])
def test_hidden_nodes_and_their_children_are_not_read_and_others_once(tmp_path, roots):
    """Nodes 0 and 1 are hidden. A scene should list roots only, but may list children."""
    gltf = Gltf()
    gltf.mesh({"POSITION": POINTS[:3]})
    hidden = {"KHR_node_visibility": {"visible": False}}
    gltf.tree["nodes"] = [
        {"mesh": 0, "children": [1], "extensions": hidden},
        {"mesh": 0, "translation": [1, 1, 1]},
        {"children": [3]},
        {"mesh": 0, "translation": [0, 0, 5]},
    ]
    gltf.tree["scenes"] = [{"nodes": roots}]
    gltf.tree["extensionsUsed"] = ["KHR_node_visibility"]
    assert_allclose(triangle_corners(tmp_path, gltf), [POINTS[:3] + np.array([0, 0, 5])])


@pytest.mark.parametrize("form", ["base64", "percent"])
def test_data_uris_have_the_encodings_of_rfc_2397(tmp_path, form):
    gltf = Gltf()
    gltf.mesh({"POSITION": POINTS[:3]})
    text = quote(gltf.buffer)
    if form == "base64":
        text = quote(base64.b64encode(gltf.buffer).decode(), safe="")
    uri = "data:application/octet-stream" + (";base64," if form == "base64" else ",") + text
    gltf.tree["buffers"] = [{"byteLength": len(gltf.buffer), "uri": uri}]
    (tmp_path / "mesh.gltf").write_text(json.dumps(gltf.tree))
    assert_allclose(corners_of(load_mesh(tmp_path / "mesh.gltf", up="z")), [POINTS[:3]])


def test_only_the_first_buffer_of_a_glb_is_its_binary_chunk(tmp_path):
    gltf = plain()
    gltf.tree["buffers"] = [{"byteLength": len(gltf.buffer)}]
    gltf.tree["bufferViews"][0]["buffer"] = 1
    with pytest.raises(InputError, match=r"mesh\.glb"):
        load_mesh(gltf.write(tmp_path / "mesh.glb"))


def test_a_text_file_reads_its_buffer_and_its_images_below_its_folder(tmp_path):
    """A file of the same name beside it does not count."""
    gltf = masked(hole(8, -1), "OPAQUE")
    folder = tmp_path / "mesh"
    (folder / "parts of it").mkdir(parents=True)
    (folder / "parts of it" / "data.bin").write_bytes(gltf.buffer)
    (folder / "data.bin").write_bytes(bytes(len(gltf.buffer)))
    Image.fromarray(color_texels(2, 2)).save(folder / "peel.webp", lossless=True)
    gltf.tree["buffers"] = [{"byteLength": len(gltf.buffer), "uri": "parts%20of%20it/data.bin"}]
    gltf.tree["images"][0] = {"uri": "peel.webp"}
    gltf.tree["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    (folder / "mesh.gltf").write_text(json.dumps(gltf.tree))
    mesh = load_mesh(folder / "mesh.gltf")
    assert_array_equal(mesh.textures[0], color_texels(2, 2))


@pytest.mark.parametrize("kind", ["buffers", "images"])
@pytest.mark.parametrize("uri", ["../data.bin", "{folder}/data.bin", "file:///etc/passwd", "link"])
def test_files_outside_of_the_folder_are_not_read(tmp_path, kind, uri):
    gltf = masked(hole(8, -1), "OPAQUE")
    content = gltf.buffer if kind == "buffers" else encoded(hole(8, -1))
    (tmp_path / "data.bin").write_bytes(content)
    folder = tmp_path / "mesh"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path / "data.bin")
    (folder / "own.bin").write_bytes(gltf.buffer)
    gltf.tree["buffers"] = [{"byteLength": len(gltf.buffer), "uri": "own.bin"}]
    gltf.tree[kind][0]["uri"] = uri.format(folder=tmp_path)
    (folder / "mesh.gltf").write_text(json.dumps(gltf.tree))
    with pytest.raises(InputError, match="not below its folder"):
        load_mesh(folder / "mesh.gltf")


def small_file_of_many_copies() -> Gltf:
    gltf = Gltf()
    gltf.mesh({"POSITION": SQUARE}, np.tile(np.uint16([0, 1, 2]), 10_000))
    gltf.tree["nodes"] = [{"mesh": 0}] * 3000
    gltf.tree["scenes"][0]["nodes"] = list(range(3000))
    return gltf


def small_file_of_many_zeros() -> Gltf:
    gltf = Gltf()
    gltf.tree["accessors"].append({"componentType": 5126, "count": 2 * 10**9, "type": "VEC3"})
    gltf.mesh({"POSITION": 0})
    return gltf


def small_file_of_a_large_image() -> Gltf:
    gltf = Gltf()
    texture = gltf.texture(np.zeros((1, 1), np.uint8))
    gltf.tree["images"][0]["bufferView"] = gltf.view(encoded(Image.new("L", (5000, 5000))))
    return gltf.square(pbrMetallicRoughness={"baseColorTexture": texture})


@pytest.mark.parametrize(
    "create",
    [small_file_of_many_copies, small_file_of_many_zeros, small_file_of_a_large_image],
    ids=["copies", "zeros", "image"],
)
def test_a_small_file_that_needs_more_memory_than_is_free_is_refused(tmp_path, monkeypatch, create):
    (tmp_path / "meminfo").write_text("MemAvailable: 100000 kB\n")
    monkeypatch.setattr(errors, "MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(errors, "GROUP", tmp_path)
    create().write(tmp_path / "mesh.glb")
    assert (tmp_path / "mesh.glb").stat().st_size < 400_000
    with pytest.raises(InputError, match=r"need .* GB of memory, and 0\.1 GB are free"):
        load_mesh(tmp_path / "mesh.glb")


def plain(**entries: Any) -> Gltf:
    return Gltf().square(**entries)


def with_tree(material: dict[str, Any] | None = None, **entries: Any) -> Gltf:
    """Return a square with a material and with other entries of the file."""
    gltf = plain(**material or {})
    gltf.tree |= entries
    return gltf


def with_mode(mode: int, **attributes: np.ndarray) -> Gltf:
    """Return a square of triangles (mode 4), strips (5) or others with more attributes."""
    gltf = plain()
    primitive = gltf.tree["meshes"][0]["primitives"][0]
    primitive["mode"] = mode
    primitive["attributes"] |= {name: gltf.array(array) for name, array in attributes.items()}
    return gltf


def with_points() -> Gltf:
    gltf = plain()
    gltf.tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 0})
    return gltf


IGNORED = {
    "points and lines": with_points(),
    "normalTexture": plain(normalTexture={"index": 0}),
    "occlusionTexture": plain(occlusionTexture={"index": 0}),
    "emitted light": plain(emissiveFactor=[0, 1, 0]),
    "KHR_materials_clearcoat": plain(extensions={"KHR_materials_clearcoat": {}}),
    "KHR_materials_unlit": with_tree(
        {"extensions": {"KHR_materials_unlit": {}}}, extensionsRequired=["KHR_materials_unlit"]
    ),
    "KHR_materials_variants": with_tree(extensionsUsed=["KHR_materials_variants"]),
    "KHR_lights_punctual": with_tree(extensionsUsed=["KHR_lights_punctual"]),
    "animations": with_tree(animations=[{}]),
    "other scenes": with_tree(scenes=[{"nodes": [0]}, {}]),
}


@pytest.mark.parametrize("feature", IGNORED)
def test_what_changes_neither_shape_nor_color_is_named_once(tmp_path, feature):
    with pytest.warns(UserWarning, match=rf"ignored in .gltf files, .*: {feature}$") as record:
        mesh = IGNORED[feature].load(tmp_path)
    assert len(record) == 1
    assert_array_equal(corners_of(mesh).reshape(-1, 3), SQUARE[SQUARE_FACES])
    assert (mesh.corner_colors == 1).all()


def test_a_texture_that_is_shown_without_shading_is_the_color(tmp_path):
    """Blender 4.4 writes a texture that is connected to the shader Emission in this way."""
    gltf = Gltf()
    emitted = {"emissiveTexture": gltf.texture(color_texels(3, 4)), "emissiveFactor": [1, 1, 0.5]}
    gltf.square(pbrMetallicRoughness={"baseColorFactor": [0, 0, 0, 1]}, **emitted)
    with pytest.warns(UserWarning, match="black material") as record:
        mesh = gltf.load(tmp_path)
    assert len(record) == 1
    assert_array_equal(mesh.textures[0], color_texels(3, 4))
    assert_allclose(linear(mesh.corner_colors), np.broadcast_to([1, 1, 0.5], (2, 3, 3)), atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*black material")
def test_colors_of_vertices_do_not_change_emitted_light(tmp_path):
    """Section 3.9.2 multiplies them with the base color alone."""
    black = {"baseColorFactor": [0, 0, 0, 1]}
    gltf = Gltf().square(pbrMetallicRoughness=black, emissiveFactor=[1, 0.5, 0.25])
    halves = gltf.array(np.full((4, 3), 0.5, np.float32))
    gltf.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = halves
    colors = linear(gltf.load(tmp_path).corner_colors)
    assert_allclose(colors, np.broadcast_to([1, 0.5, 0.25], (2, 3, 3)), atol=1e-6)


@pytest.mark.parametrize(
    "entries",
    [
        {"alphaMode": "MASK"},
        {"extensions": {"KHR_materials_unlit": {}}},
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0, 0, 0, 1]}}},
    ],
)
def test_the_emission_is_no_color_beside_an_opacity_or_another_model(tmp_path, entries):
    black = {"baseColorFactor": [0, 0, 0, 1]}
    gltf = Gltf().square(pbrMetallicRoughness=black, emissiveFactor=[1, 1, 1], **entries)
    with pytest.warns(UserWarning, match="emitted light"):
        assert not gltf.load(tmp_path).corner_colors.any()


def changed(kind: str, **entries: Any) -> Gltf:
    gltf = plain()
    gltf.tree[kind][0] |= entries
    return gltf


def basis_texture() -> Gltf:
    gltf = Gltf()
    texture = gltf.texture(color_texels(2, 2))
    gltf.tree["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    return gltf.square(pbrMetallicRoughness={"baseColorTexture": texture})


def different_places() -> Gltf:
    gltf = Gltf()
    color = gltf.texture(color_texels(2, 2))
    gloss = gltf.texture(color_texels(2, 2), wrapS=33071)
    model = {"baseColorTexture": color, "metallicRoughnessTexture": gloss}
    return gltf.square(pbrMetallicRoughness=model)


@pytest.mark.parametrize("wrap", [10497, 33071, 33648])
@pytest.mark.parametrize("color_side", [0, 2, 8])
def test_a_gloss_texture_keeps_its_texels_in_every_wrap_mode(tmp_path, wrap, color_side):
    """With coordinates in [0, 1], all modes show the same interior (glTF 2.0, 3.8.4)."""
    texels = np.full((8, 8, 3), 255, np.uint8)
    texels[:4, :, 1] = 60
    gltf = Gltf()
    samplers = {"wrapS": wrap, "wrapT": wrap}
    model = {"metallicRoughnessTexture": gltf.texture(texels, **samplers)}
    if color_side:
        colors = color_texels(color_side, color_side)
        model["baseColorTexture"] = gltf.texture(colors, **samplers)
    mesh = gltf.square(pbrMetallicRoughness=model).load(tmp_path, gloss=True)
    assert {60, 255} <= {*np.unique(mesh.gloss_textures[0][..., 0])}


def short_morph_target() -> Gltf:
    gltf = plain()
    target = {"POSITION": gltf.array(np.float32([[0, 0, 1]]))}
    gltf.tree["meshes"][0] |= {"weights": [1]}
    gltf.tree["meshes"][0]["primitives"][0]["targets"] = [target]
    return gltf


REFUSED = {
    "an array overlaps itself": changed("bufferViews", byteStride=0),
    "overlaps itself or leaves": changed("bufferViews", byteStride=8),
    "a morph target has 1 entries": short_morph_target(),
    "strips or fans": with_mode(5),
    "EXT_mesh_gpu_instancing": with_tree(extensionsUsed=["EXT_mesh_gpu_instancing"]),
    "COLOR_0": with_mode(4, COLOR_0=np.ones((4, 2), np.float32)),
    "armature": with_tree(nodes=[{"mesh": 0, "skin": 0}]),
    "leaves its buffer view": changed("accessors", byteOffset=-4),
    "KHR_draco_mesh_compression": with_tree(extensionsUsed=["KHR_draco_mesh_compression"]),
    "EXT_meshopt_compression": with_tree(extensionsRequired=["EXT_meshopt_compression"]),
    "KHR_meshopt_compression": with_tree(extensionsUsed=["KHR_meshopt_compression"]),
    "KHR_texture_basisu": basis_texture(),
    "two parents": with_tree(nodes=[*({"children": [i + 1] * 2} for i in range(40)), {"mesh": 0}]),
    "child of itself": with_tree(nodes=[{"mesh": 0}, {"children": [1]}]),
    "number 7 of 1 nodes": with_tree(scenes=[{"nodes": [7]}]),
    "number -1 of 1 meshes": with_tree(nodes=[{"mesh": -1}]),
    "glTF 1.0": with_tree(asset={"version": "1.0"}),
    "ends behind its buffer": changed("bufferViews", byteLength=10**6),
    "differ in texture coordinates": different_places(),
    "cuts out all faces": plain(
        pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.4]}, alphaMode="MASK"
    ),
    "specular color": plain(
        extensions={"KHR_materials_specular": {"specularColorFactor": [1, 0, 0]}}
    ),
    "unequal numbers": with_mode(4, COLOR_0=np.ones((1, 4), np.float32)),
    "weights for 0 morph targets": with_tree(nodes=[{"mesh": 0, "weights": [1.0]}]),
    "alphaMode blend": plain(alphaMode="blend"),
    "into shape": plain(pbrMetallicRoughness={"baseColorFactor": [0.5]}),
    "color or texture": plain(extensions={"KHR_materials_specular": {"specularTexture": {}}}),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_what_would_change_shape_or_color_is_refused(tmp_path, reason):
    with pytest.raises(InputError, match=rf"mesh\.gltf .*{reason}"):
        REFUSED[reason].load(tmp_path, gloss=True)


def test_a_file_is_found_beside_a_mesh_whose_gloss_is_refused(tmp_path):
    gltf = REFUSED["specular color"]
    (tmp_path / "mesh.bin").write_bytes(gltf.buffer)
    buffers = [{"byteLength": len(gltf.buffer), "uri": "mesh.bin"}]
    (tmp_path / "mesh.gltf").write_text(json.dumps(gltf.tree | {"buffers": buffers}))
    assert files_beside(tmp_path / "mesh.gltf") == [tmp_path / "mesh.bin"]


@pytest.mark.parametrize("color", [0.8, 1.6])
def test_the_reflectance_follows_from_the_refractive_index(tmp_path, color):
    """((1.2 - 1) / (1.2 + 1))² = .0083, and .04 is the specular factor 1."""
    extensions = {
        "KHR_materials_ior": {"ior": 1.2},
        "KHR_materials_specular": {"specularFactor": 0.5, "specularColorFactor": [color] * 3},
    }
    mesh = plain(extensions=extensions).load(tmp_path, gloss=True)
    assert mesh.gloss[0, 2] == pytest.approx(0.5 * color * (0.2 / 2.2) ** 2 / 0.04)
