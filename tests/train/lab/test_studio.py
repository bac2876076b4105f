"""Photographs against closed forms, with the light that comes from the table and the surroundings without bounces."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from renderer.mesh import Mesh
from renderer.normals import corner_normals
from renderer.shapes import solid
from train.lab.shots import FOV, Shot, draw_shots
from train.lab.studio import ROUGHNESS, SHARP, lab_parts, photograph

pytest.importorskip("mitsuba")


def frontal(**changes) -> Shot:
    """A camera and a projector in front of an upright object, in white light on a black table."""
    [shot] = draw_shots(1, ["solid"], (1, 1), seed=0, environments={})
    center, front = np.array([0, 0, 1.0]), np.array([0, -6.0, 1.0])
    plain = {
        "pattern": np.ones((4, 4, 3), np.float32), "ambient": np.zeros(3), "table": np.zeros(3), "projector": front,
        "camera": front, "center": center, "aim": center, "rotation": np.eye(3), "scale": 1.0,
    }  # fmt: skip
    return replace(shot, **plain | changes)


def card(texture: np.ndarray) -> Mesh:
    """A square that faces -y, with the texture upright on it."""
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = (square[:, [0, 2]] + 1) / 2
    return replace(
        Mesh.plain(square, faces),
        corner_uvs=uvs[faces].astype(np.float32),
        texture_ids=np.zeros(2, dtype=np.int32),
        textures=(texture,),
    )


def directions(shot: Shot, size: int) -> np.ndarray:
    """(size, size, 3) from the camera through the pixels' middles."""
    ahead = (shot.aim - shot.camera) / np.linalg.norm(shot.aim - shot.camera)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    reach = np.tan(np.radians(FOV / 2)) * ((np.arange(size) + 0.5) / size * 2 - 1)
    return ahead + reach[None, :, None] * right - reach[:, None, None] * np.cross(right, ahead)


@pytest.mark.parametrize("seed", range(3))
def test_the_table_reflects_projector_and_surroundings_as_formulas_say(seed):
    """Beyond an object too small to see. A projector lights the planes that face it evenly: by 1 / z² at depth z."""
    [shot] = draw_shots(1, ["solid"], (1.5, 1.5), seed, {})
    shot = replace(shot, scale=1e-4, ambient=np.array([0.1, 0.2, 0.3]))
    image = photograph(lab_parts(solid("orange"), 1.0), shot, 8, 4096, bounces=1, seed=0)

    rays = directions(shot, 8)
    places = shot.camera - rays * (shot.camera[2] / rays[..., 2:])
    axis, ray = shot.center - shot.projector, places - shot.projector
    depth = ray @ axis / np.linalg.norm(axis)
    evenly = axis @ axis / depth**2 * (-ray[..., 2] / depth)
    lit = evenly[..., None] * shot.brightness * shot.pattern[0, 0] + shot.ambient
    inside = np.linalg.norm(places, axis=-1) < 1.5  # of what the projector reaches
    assert inside.mean() > 0.3
    np.testing.assert_allclose(image[inside], (shot.table * lit)[inside], rtol=0.03)


def test_a_texture_lies_upright_on_its_faces():
    red, green, blue, white = [220, 0, 0], [0, 220, 0], [0, 0, 220], [220, 220, 220]
    texture = np.array([[red, green], [blue, white]], dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    image = photograph(lab_parts(card(texture), 1.0), frontal(), 16, 16, bounces=1, seed=0)
    strong = image > image.max() / 2
    for row, column, expected in [(5, 5, red), (5, 10, green), (10, 5, blue), (10, 10, white)]:
        np.testing.assert_array_equal(strong[row, column], np.array(expected) > 0)


def test_a_card_reflects_its_linear_albedo_times_the_albedo_scale_and_the_brightness():
    """Facing projector and camera, with its gloss: 4 % of the light times the GGX peak, 1 / (4 α²)."""
    gray = np.full((4, 4, 3), 128, dtype=np.uint8)  # linear 0.216
    gloss = 0.04 / (4 * ROUGHNESS**4)  # α is the roughness's square
    for albedo_scale, brightness in [(1, 1), (2, 1), (1, 0.5)]:
        shot = frontal(brightness=brightness)
        image = photograph(lab_parts(card(gray), albedo_scale), shot, 8, 16, bounces=1, seed=0)
        assert image[3:5, 3:5].mean() == pytest.approx((0.216 * albedo_scale + gloss) * brightness, rel=0.05)


def test_an_object_stands_on_the_table():
    """A cube's front, lit by its surroundings, reaches from the table up to its height."""
    cube = trimesh.creation.box((2, 2, 2))
    shot = frontal(ambient=np.ones(3), brightness=1e-9)
    image = photograph(lab_parts(Mesh.plain(cube.vertices, cube.faces), 1), shot, 32, 64, bounces=1, seed=0)
    ray = directions(shot, 32)[:, 15]
    height = shot.camera[2] + ray[:, 2] * (5 / ray[:, 1])  # where it meets the plane of the front, y = -1
    clear = (height < 2) & (np.abs(height) > 0.04)  # not the row that the lower edge runs through
    np.testing.assert_array_equal((image[:, 15] > 0.1).all(axis=1)[clear], (height > 0)[clear])


def test_a_texture_on_colored_corners_is_their_product():
    """A white texture on a red card: red, to the 8 bits that the texture is painted anew in."""
    red = card(np.full((4, 4, 3), 255, dtype=np.uint8))
    red = replace(red, corner_colors=np.tile(np.float32([1, 0.5, 0]), (2, 3, 1)))
    [part] = lab_parts(red, 0.5)
    assert part.texture is not None
    np.testing.assert_allclose(part.texture[0, 0], [0.5, 0.5 * 0.2140, 0], atol=0.01)


def test_the_table_under_an_environment_has_the_brightness_times_its_albedo_at_every_azimuth():
    """A map of one direction, off the vertical, is a distant lamp: the table under it is even."""
    sky = np.zeros((64, 128, 3), np.float32)
    sky[16, 40] = 1e4, 1e4, 1e4
    for seed in range(2):
        [shot] = draw_shots(1, [], (0.7, 0.7), seed, {"lamp": sky})
        shot = replace(shot, scale=1e-4)
        image = photograph(lab_parts(solid("orange"), 1.0), shot, 8, 256, bounces=1, seed=0)
        assert shot.family == "lamp"
        # The map is sampled by bilinear interpolation, which spreads the lamp over two texels.
        np.testing.assert_allclose(image, np.broadcast_to(0.7 * shot.table, image.shape), rtol=0.02)


def test_an_environment_lights_from_where_its_map_says():
    """The upper half of a map towards +x lights a card's side that faces +x, and not the one that faces -x."""
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:, 16:48] = 1.0
    mesh = card(np.full((2, 2, 3), 255, np.uint8))
    parts = lab_parts(replace(mesh, vertices=mesh.vertices[:, [1, 0, 2]]), 1.0)  # in the plane x = 0
    shots = [frontal(environment=sky, camera=np.array([x, 0, 1.0]), table=np.zeros(3)) for x in (6.0, -6.0)]
    front, back = (photograph(parts, shot, 8, 256, bounces=1, seed=0)[3:5, 3:5].mean() for shot in shots)
    assert front > 20 * back


@pytest.mark.parametrize("divisions", [0, 2])
def test_right_angles_stay_sharp_and_round_surfaces_are_smooth(divisions):
    cube, ball = trimesh.creation.box((2, 2, 2)), trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = cube.vertices, cube.faces
    for _ in range(divisions):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    mesh = Mesh.plain(vertices, faces)
    np.testing.assert_array_equal(corner_normals(mesh, "smooth", SHARP), mesh.face_normals()[:, None].repeat(3, axis=1))
    mesh = Mesh.plain(ball.vertices, ball.faces)
    np.testing.assert_allclose(corner_normals(mesh, "smooth", SHARP), mesh.vertices[mesh.faces], atol=0.02)
