"""Exported meshes, read by the renderer and by trimesh alone."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from gltf_files import read_tree
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, linear_of
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from renderer.camera import OrthographicCamera, PerspectiveCamera, orbit_cameras
from renderer.io.meshes import export_mesh, load_mesh
from renderer.mesh import Mesh
from renderer.pinhole import PinholeCamera
from renderer.solids import solid

EPS32 = np.finfo(np.float32).eps


def painted(mesh: Mesh, textures: int, seed: int = 0) -> Mesh:
    """Give each corner its own color and texture coordinates, and each face a texture or none."""
    rng = np.random.default_rng(seed)
    face_count = len(mesh.faces)
    ids = np.sort(rng.integers(-1, textures, face_count)).astype(np.int32)
    uvs = rng.uniform(-1, 2, (face_count, 3, 2)).astype(np.float32)
    colors = rng.random((face_count, 3, 3), dtype=np.float32)
    shapes = [(8, 4 + number, 3) for number in range(textures)]
    drawn = tuple(rng.integers(0, 256, shape, dtype=np.uint8) for shape in shapes)
    uvs = np.where((ids < 0)[:, None, None], 0, uvs)
    return replace(mesh, corner_colors=colors, corner_uvs=uvs, texture_ids=ids, textures=drawn)


def box() -> Mesh:
    geometry = trimesh.creation.box((1, 2, 3))
    return Mesh.plain(geometry.vertices + np.array([0, 0, 0.25]), geometry.faces)


MESHES = {
    "smooth colors": solid("orange"),
    "two parts": solid("cup"),
    "several textures and none": painted(solid("pear"), 3),
    "more textures than ten": painted(solid("pear"), 12),
}


def assert_same_surface(loaded: Mesh, mesh: Mesh) -> None:
    """Colors are rounded twice, as linear and as encoded values. The file holds 1 - v."""
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
    assert len(loaded.vertices) == len(mesh.vertices)
    assert loaded.closed is mesh.closed


def read_glb(path: Path) -> list[trimesh.Trimesh]:
    """Return the parts as trimesh reads them, with y up and v = 0 at the bottom."""
    return list(trimesh.load(path, force="scene", process=False).geometry.values())


def test_a_mesh_far_from_the_origin_keeps_its_shape_for_every_reader(tmp_path):
    """float32 numbers near 4.5e6 are half a unit apart, more than the width of the faces."""
    near = solid("orange")
    offset = np.array([4.5e6, -3e5, 120])
    export_mesh(replace(near, vertices=near.vertices + offset), tmp_path / "mesh.glb")
    loaded = load_mesh(tmp_path / "mesh.glb")
    by_trimesh = trimesh.load(tmp_path / "mesh.glb", force="scene", process=False).to_mesh()
    x, y, z = np.moveaxis(by_trimesh.triangles, -1, 0)
    for corners in (corners_of(loaded), np.stack([x, -z, y], axis=-1)):
        assert_allclose(corners - offset, corners_of(near), rtol=0, atol=1e-6)


def test_a_glb_has_y_up_linear_colors_and_diffuse_materials_seen_from_both_sides(tmp_path):
    mesh = painted(box(), 1)
    export_mesh(mesh, tmp_path / "mesh.glb")
    is_untextured = mesh.texture_ids < 0
    untextured, textured = read_glb(tmp_path / "mesh.glb")
    for part, mask in ((untextured, is_untextured), (textured, ~is_untextured)):
        x, y, z = np.moveaxis(corners_of(mesh)[mask], -1, 0)
        expected = np.stack([x, z, -y], axis=-1).astype(np.float32)
        assert_array_equal(part.triangles, expected)
        expected = linear_of(mesh.corner_colors[mask].astype(np.float64))
        colors = part.visual.vertex_attributes["color"][part.faces]
        assert_allclose(colors, expected, rtol=EPS32, atol=0)
        uvs = part.visual.uv[part.faces]
        assert_allclose(uvs, mesh.corner_uvs[mask], rtol=0, atol=2 * EPS32)
        material = part.visual.material
        assert material.doubleSided
        assert material.metallicFactor == 0
        assert material.roughnessFactor == 1
        assert material.baseColorFactor is None
    assert untextured.visual.material.baseColorTexture is None
    assert textured.visual.material.baseColorTexture is not None


@pytest.mark.parametrize("normals", ["smooth", "flat"])
def test_a_glb_has_the_normals_that_the_renderer_shades_with(tmp_path, normals):
    """Flat normals are cross products. Smooth normals are their sums over the faces of a vertex."""
    pear = solid("pear")
    mesh = replace(pear, normal_ids=pear.faces)
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
    """The matrices of the file project points with y up to where `project` puts them."""
    view = {"polar": 114.6, "azimuth": 57.3, "width": 2.5, "right": 0.3, "up": -0.2}
    cameras = [
        *orbit_cameras(2, 3.0, 57.3, 22.9),
        OrthographicCamera(**view),
        PerspectiveCamera(**view, distance=1.2),
        PerspectiveCamera(**view | {"polar": torch.tensor(114.6).double()}, distance=3.0),
        PinholeCamera(**view, distance=3.0, roll=20.0, center_z=0.1, pixel_aspect=1.2),
    ]
    export_mesh(box(), tmp_path / "mesh.glb", cameras=cameras)
    tree = read_tree(tmp_path / "mesh.glb")
    points = np.random.default_rng(0).uniform(-0.6, 0.6, size=(20, 3))
    x, y, z = points.T
    y_up = np.stack([x, z, -y, np.ones(20)])
    nodes = [tree["nodes"][index] for index in tree["scenes"][0]["nodes"][1:]]
    assert len(nodes) == len(cameras)
    # The file shows the whole mesh.
    extended = [camera.with_clip_range(2.1) for camera in cameras]
    for camera, node in zip(extended, nodes, strict=True):
        # glTF stores matrices by columns.
        pose = np.reshape(node["matrix"], (4, 4)).T
        projection = gltf_projection(tree["cameras"][node["camera"]])
        homogeneous = projection @ np.linalg.inv(pose) @ y_up
        projected = (homogeneous[:3] / homogeneous[3]).T
        assert_allclose(projected[:, :2], camera.project(points)[:, :2], atol=1e-12)
        if not isinstance(camera, PinholeCamera):
            assert_allclose(projected[:, 2], camera.project(points)[:, 2], atol=1e-12)


def gltf_projection(lens: dict) -> np.ndarray:
    """Return the projection matrix of a camera (glTF 2.0, section 3.10.3)."""
    kind = lens[lens["type"]]
    near, far = kind["znear"], kind["zfar"]
    depth_range = near - far
    if lens["type"] == "orthographic":
        matrix = np.diag([1 / kind["xmag"], 1 / kind["ymag"], 2 / depth_range, 1])
        matrix[2, 3] = (far + near) / depth_range
        return matrix
    tangent = math.tan(kind["yfov"] / 2)
    matrix = np.diag([1 / (kind["aspectRatio"] * tangent), 1 / tangent, 0, 0])
    matrix[2:, 2:] = [[(far + near) / depth_range, 2 * far * near / depth_range], [-1, 0]]
    return matrix


def glossy(mesh: Mesh) -> Mesh:
    rng = np.random.default_rng(3)
    kinds = rng.random((3, 3), dtype=np.float32)
    shapes = [(5, 3 + number, 2) for number in range(len(mesh.textures))]
    textures = tuple(rng.integers(0, 256, shape, dtype=np.uint8) for shape in shapes)
    kind_of_face = rng.integers(0, 3, len(mesh.faces))
    return replace(mesh, gloss=kinds[kind_of_face], gloss_textures=textures)


@pytest.mark.parametrize("textures", [0, 2])
def test_a_glb_gives_back_the_gloss_if_it_is_asked_for(tmp_path, textures):
    mesh = glossy(painted(box(), textures) if textures else box())
    export_mesh(mesh, tmp_path / "mesh.glb")
    loaded = load_mesh(tmp_path / "mesh.glb", gloss=True)
    # Faces are ordered by texture, and then by the three values of gloss.
    order = np.lexsort([*mesh.gloss.T[::-1], mesh.texture_ids])
    assert_array_equal(corners_of(loaded), corners_of(mesh)[order].astype(np.float32))
    assert_array_equal(loaded.gloss, mesh.gloss[order])
    for face, original_face in enumerate(order):
        texture_id = mesh.texture_ids[original_face]
        if texture_id >= 0:
            gloss_texture = loaded.gloss_textures[loaded.texture_ids[face]]
            assert_array_equal(gloss_texture, mesh.gloss_textures[texture_id])


def test_a_matte_mesh_reflects_nothing_in_the_file(tmp_path):
    """A dielectric of glTF reflects 4%, unless its specular factor is 0."""
    export_mesh(box(), tmp_path / "mesh.glb")
    assert load_mesh(tmp_path / "mesh.glb", gloss=True).gloss[:, 1:].max() == 0


def test_gltfs_gloss_has_its_defaults_and_a_texture_without_color(tmp_path):
    """A material without factors is a rough metal. Green is roughness, and blue is metallic."""
    texels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    material = PBRMaterial(metallicRoughnessTexture=Image.fromarray(texels))
    triangle.visual = TextureVisuals(uv=np.eye(3)[:, :2], material=material)
    triangle.export(tmp_path / "mesh.glb")
    mesh = load_mesh(tmp_path / "mesh.glb", gloss=True)
    assert mesh.gloss.tolist() == [[1, 1, 1]]
    assert mesh.textures[0].tolist() == [[[255, 255, 255]]]
    assert_array_equal(mesh.gloss_textures[0], texels[..., 1:])
