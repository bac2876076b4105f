"""Exported meshes: read back, and read by trimesh alone."""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, linear_of
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from renderer.camera import OrthographicCamera, PerspectiveCamera, orbit_cameras
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.shapes import solid
from renderer.io.export import export_mesh
from renderer.io.meshes import load_mesh

EPS32 = np.finfo(np.float32).eps


def painted(mesh: Mesh, textures: int, seed: int = 0) -> Mesh:
    """A color and a uv for each corner, so that every edge is a seam, and textures of different sizes by face."""
    rng = np.random.default_rng(seed)
    count = len(mesh.faces)
    ids = np.sort(rng.integers(-1, textures, count)).astype(np.int32)
    uvs = rng.uniform(-1, 2, (count, 3, 2)).astype(np.float32)
    return replace(
        mesh,
        corner_colors=rng.random((count, 3, 3), dtype=np.float32),
        corner_uvs=np.where((ids < 0)[:, None, None], 0, uvs),
        texture_ids=ids,
        textures=tuple(rng.integers(0, 256, (8, 4 + i, 3), dtype=np.uint8) for i in range(textures)),
    )


def box() -> Mesh:
    geometry = trimesh.creation.box((1, 2, 3))
    return Mesh.plain(geometry.vertices + np.array([0, 0, 0.25]), geometry.faces)


def with_a_seam() -> Mesh:
    """A smooth ball whose uvs, and whose colors at the bottom, end at an edge."""
    ball = trimesh.creation.uv_sphere(count=[8, 12])
    mesh = Mesh.plain(ball.vertices, ball.faces, np.random.default_rng(1).random(ball.vertices.shape))
    azimuth = np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0])[ball.faces] / (2 * np.pi)
    azimuth = np.where(np.ptp(azimuth, axis=1, keepdims=True) > 0.5, azimuth % 1, azimuth)
    uvs = np.stack([azimuth, ball.vertices[:, 2][ball.faces] / 2 + 0.5], axis=-1).astype(np.float32)
    texture = np.random.default_rng(2).integers(0, 256, (16, 32, 3), dtype=np.uint8)
    ids = np.zeros(len(ball.faces), dtype=np.int32)
    return replace(mesh, corner_uvs=uvs, texture_ids=ids, textures=(texture,))


MESHES = {
    "smooth colors": solid("orange"),
    "two parts": solid("cup"),
    "a seam": with_a_seam(),
    "several textures and none": painted(solid("pear"), 3),
    "more textures than ten": painted(solid("pear"), 12),
}


def assert_same_surface(loaded: Mesh, mesh: Mesh) -> None:
    """Positions are rounded to float32 once; so are colors, in linear light, where sRGB's curve only makes their
    relative error smaller, and encoded ones, once more; v is stored as 1 - v, which is at most 2 here."""
    assert_array_equal(corners_of(loaded), corners_of(mesh).astype(np.float32))
    assert_allclose(loaded.corner_colors, mesh.corner_colors, rtol=2 * EPS32, atol=0)
    assert_allclose(loaded.corner_uvs, mesh.corner_uvs, rtol=0, atol=2 * EPS32)
    assert_array_equal(loaded.texture_ids, mesh.texture_ids)
    assert len(loaded.textures) == len(mesh.textures)
    for texture, expected in zip(loaded.textures, mesh.textures, strict=True):
        assert_array_equal(texture, expected)


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_a_glb_gives_back_the_same_surface(tmp_path, mesh):
    export_mesh(mesh, tmp_path / "mesh.glb")
    loaded = load_mesh(tmp_path / "mesh.glb")
    assert_same_surface(loaded, mesh)
    assert len(loaded.vertices) == len(mesh.vertices) and loaded.closed is mesh.closed


def read_glb(path: Path) -> list[trimesh.Trimesh]:
    """The primitives, as trimesh reads them: y up, uvs from the bottom."""
    return list(trimesh.load(path, force="scene", process=False).geometry.values())


def test_a_glb_holds_y_up_positions_linear_colors_and_diffuse_two_sided_materials(tmp_path):
    mesh = painted(box(), 1)
    export_mesh(mesh, tmp_path / "mesh.glb")
    parts, plain = read_glb(tmp_path / "mesh.glb"), mesh.texture_ids < 0
    assert len(parts) == 2 and plain.any() and not plain.all()
    for part, here in zip(parts, (plain, ~plain), strict=True):
        x, y, z = np.moveaxis(corners_of(mesh)[here], -1, 0)
        assert_array_equal(part.triangles, np.stack([x, z, -y], axis=-1).astype(np.float32))
        colors = linear_of(mesh.corner_colors[here].astype(np.float64))
        assert_allclose(part.visual.vertex_attributes["color"][part.faces], colors, rtol=EPS32, atol=0)
        assert_allclose(part.visual.uv[part.faces], mesh.corner_uvs[here], rtol=0, atol=2 * EPS32)
        material = part.visual.material
        assert (material.doubleSided, material.metallicFactor, material.roughnessFactor) == (True, 0, 1)
        assert material.baseColorFactor is None and (material.baseColorTexture is None) == (here is plain)


@pytest.mark.parametrize("normals", ["smooth", "flat"])
def test_a_glb_has_the_normals_that_the_renderer_shades_with(tmp_path, normals):
    """Flat ones by the cross product; smooth ones the area-weighted sum of those around the vertex."""
    mesh = solid("pear")
    export_mesh(mesh, tmp_path / "mesh.glb", normals)
    [part] = read_glb(tmp_path / "mesh.glb")
    a, b, c = np.moveaxis(corners_of(mesh), 1, 0)
    expected = np.cross(b - a, c - a)[:, None].repeat(3, axis=1)
    if normals == "smooth":
        sums = np.zeros_like(mesh.vertices)
        np.add.at(sums, mesh.faces, expected)
        expected = sums[mesh.faces]
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(part.vertex_normals[part.faces], -1, 0)
    assert_allclose(np.stack([x, -z, y], axis=-1), expected, rtol=0, atol=4 * EPS32)


def test_the_cameras_of_a_glb_project_as_ours(tmp_path):
    """A point through the node's matrix, turned from y up, lands where `project` puts it."""
    view = {"polar": 2.0, "azimuth": 1.0, "width": 2.5, "right": 0.3, "up": -0.2}
    close = [PerspectiveCamera(**view, distance=distance) for distance in (1.2, 3.0)]
    cameras = [*orbit_cameras(2, 3.0, 1.0, 0.4), OrthographicCamera(**view), *close]
    export_mesh(box(), tmp_path / "mesh.glb", cameras=cameras)
    blob = (tmp_path / "mesh.glb").read_bytes()
    tree = json.loads(blob[20 : 20 + struct.unpack("<I", blob[12:16])[0]])
    points = np.random.default_rng(0).uniform(-0.6, 0.6, size=(20, 3))
    x, y, z = points.T
    nodes = [tree["nodes"][index] for index in tree["scenes"][0]["nodes"][1:]]
    assert len(nodes) == len(cameras)
    for camera, node in zip(cameras, nodes, strict=True):
        pose, lens = np.reshape(node["matrix"], (4, 4)).T, tree["cameras"][node["camera"]]
        clipped = gltf_projection(lens) @ np.linalg.inv(pose) @ np.stack([x, z, -y, np.ones(20)])
        assert_allclose((clipped[:3] / clipped[3]).T, camera.project(points), atol=1e-12)


def gltf_projection(lens: dict) -> np.ndarray:
    """The matrix of a camera by the specification (glTF 2.0, 3.10.3)."""
    kind = lens[lens["type"]]
    near, far = kind["znear"], kind["zfar"]
    if lens["type"] == "orthographic":
        depth = [0, 0, 2 / (near - far), (far + near) / (near - far)]
        return np.array([[1 / kind["xmag"], 0, 0, 0], [0, 1 / kind["ymag"], 0, 0], depth, [0, 0, 0, 1]])
    tangent = math.tan(kind["yfov"] / 2)
    depth = [0, 0, (far + near) / (near - far), 2 * far * near / (near - far)]
    return np.array([[1 / (kind["aspectRatio"] * tangent), 0, 0, 0], [0, 1 / tangent, 0, 0], depth, [0, 0, -1, 0]])


def test_faces_are_ordered_by_texture_and_textures_of_no_face_left_out(tmp_path):
    mesh = painted(box(), 1)
    mesh = replace(mesh, texture_ids=np.arange(12, dtype=np.int32) % 2 * 2, textures=painted(box(), 3).textures)
    export_mesh(mesh, tmp_path / "mesh.glb")
    loaded = load_mesh(tmp_path / "mesh.glb")
    assert_array_equal(corners_of(loaded), corners_of(mesh)[[0, 2, 4, 6, 8, 10, 1, 3, 5, 7, 9, 11]])
    assert_array_equal(loaded.texture_ids, [0] * 6 + [1] * 6)
    for texture, index in zip(loaded.textures, (0, 2), strict=True):
        assert_array_equal(texture, mesh.textures[index])


@pytest.mark.parametrize("name", ["mesh.obj", "mesh.ply", "folder.glb"])
def test_a_path_that_cannot_be_written_is_refused(tmp_path, name):
    (tmp_path / "folder.glb").mkdir()
    with pytest.raises(InputError, match=name):
        export_mesh(box(), tmp_path / name)


def glossy(mesh: Mesh) -> Mesh:
    """Three kinds of gloss by face, and gloss textures."""
    rng = np.random.default_rng(3)
    kinds = rng.random((3, 3), dtype=np.float32)
    textures = tuple(rng.integers(0, 256, (5, 3 + i, 2), dtype=np.uint8) for i in range(len(mesh.textures)))
    return replace(mesh, gloss=kinds[rng.integers(0, 3, len(mesh.faces))], gloss_textures=textures)


@pytest.mark.parametrize("textures", [0, 2])
def test_a_glb_gives_back_the_gloss_to_those_who_ask(tmp_path, textures):
    mesh = glossy(painted(box(), textures) if textures else box())
    order = np.lexsort([*mesh.gloss.T[::-1], mesh.texture_ids])
    export_mesh(mesh, tmp_path / "mesh.glb")
    loaded, matte = load_mesh(tmp_path / "mesh.glb", gloss=True), load_mesh(tmp_path / "mesh.glb")
    assert matte.gloss is None and matte.gloss_textures == ()
    assert_array_equal(corners_of(loaded), corners_of(mesh)[order].astype(np.float32))
    assert_array_equal(loaded.gloss, mesh.gloss[order])
    for face, other in enumerate(order):
        if mesh.texture_ids[other] >= 0:
            expected = mesh.gloss_textures[mesh.texture_ids[other]]
            assert_array_equal(loaded.gloss_textures[loaded.texture_ids[face]], expected)


def test_gltfs_gloss_has_its_defaults_and_a_texture_without_color(tmp_path):
    """A rough metal where factors are missing, as the standard has it; green is roughness and blue metallic."""
    texels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    material = PBRMaterial(metallicRoughnessTexture=Image.fromarray(texels))
    triangle.visual = TextureVisuals(uv=np.eye(3)[:, :2], material=material)
    triangle.export(tmp_path / "mesh.glb")
    mesh = load_mesh(tmp_path / "mesh.glb", gloss=True)
    assert mesh.gloss.tolist() == [[1, 1, 1]] and mesh.textures[0].tolist() == [[[255, 255, 255]]]
    assert_array_equal(mesh.gloss_textures[0], texels[..., 1:])


@pytest.mark.parametrize("fault", ["differ in specularFactor", "has a specularTexture"])
def test_strengths_that_cannot_be_told_or_read_are_refused(tmp_path, fault):
    export_mesh(glossy(box()), tmp_path / "mesh.glb")
    content = (tmp_path / "mesh.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    tree = json.loads(content[20 : 20 + length])
    for material in tree["materials"]:
        material["name"] = ""
        if "Texture" in fault:
            material["extensions"]["KHR_materials_specular"] = {"specularTexture": {}}
    text = json.dumps(tree, separators=(",", ":")).encode().ljust(length)
    (tmp_path / "mesh.glb").write_bytes(content[:20] + text + content[20 + length :])
    with pytest.raises(InputError, match=fault):
        load_mesh(tmp_path / "mesh.glb", gloss=True)
