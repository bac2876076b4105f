"""Scenes of cameras that users give, compared with `renderer.render` of the mesh where it is."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import augment
import renderer
from augment.augmentation_settings import VariationSettings
from augment.scene.vary import vary
from tests.helpers import bright_or_dark, images_of

SIZE = 24
PLACE = np.array([120.0, -40.0, 15.0])
SCALE = 7.0
INTRINSICS = [[40.0, 0.0, 10.0], [0.0, 42.0, 13.0], [0.0, 0.0, 1.0]]


def placed(name: str = "cup") -> renderer.Mesh:
    mesh = renderer.solid(name)
    return replace(mesh, vertices=SCALE * mesh.vertices + PLACE)


def cameras() -> list[renderer.Camera]:
    """Return a camera of each kind that sees the mesh. The origin lies behind the first."""
    view = np.eye(4)
    view[:3, :3] = Rotation.from_euler("xyz", [100.0, 20.0, 30.0], degrees=True).as_matrix()
    view[:3, 3] = [0.5, -1.0, 30.0] - view[:3, :3] @ PLACE
    pinhole = renderer.PinholeCamera.from_matrix(view, INTRINSICS, SIZE)
    right, up, _ = renderer.OrthographicCamera(60.0, 30.0, 20.0).axes() @ PLACE
    parallel = renderer.OrthographicCamera(60.0, 30.0, 20.0, -right, -up, clip_range=500.0)
    perspective = renderer.PerspectiveCamera(
        60.0, 30.0, 25.0, -right, -up, distance=300.0, clip_range=290.0
    )
    return [pinhole, parallel, perspective]


def test_a_scene_shows_a_mesh_in_its_world_as_a_render_does():
    """Vertices are rounded to float32 in the scene, which moves few samples at outlines."""
    light = renderer.load_light("grace")
    mesh = placed()
    scene = placed_scene(3, light=light, samples=4)
    [item] = scene.objects
    vertices = np.array(item.center) + item.extent * item.mesh.vertices
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-5)
    expected = renderer.render(
        mesh, cameras(), light, SIZE, samples=4, encoding=scene.settings.encoding
    )
    found = images_of(scene)
    for view in range(3):
        assert (expected[view] != 0.5).any(0).float().mean() > 0.1
        difference = (found[view] - expected[view]).abs()
        assert difference.mean() < 1e-3
        assert difference.max() < 0.1


def placed_scene(count: int = 1, **options) -> augment.Scene:
    return augment.build_scene(
        [(placed(), "cup")], SIZE, cameras=cameras()[:count], normalize=False, **options
    )


def test_given_cameras_replace_the_circle():
    cup = [("solid:cup", "cup")]
    given = augment.build_scene(cup, SIZE, cameras=renderer.orbit_cameras(3, 2.0))
    assert torch.equal(images_of(given), images_of(augment.build_scene(cup, SIZE, 3)))


def test_a_pose_attack_turns_cameras_about_the_object():
    """The object's center only comes nearer to the principal point, by the larger distance."""
    [camera] = placed_scene().cameras[0]
    turns = [torch.tensor(value, dtype=torch.float64) for value in (10.0, -20.0, 0.1)]
    turned = camera.moved(*turns).fixed()
    origin = np.zeros((1, 3))
    principal_point = np.array([camera.principal_right, camera.principal_up])
    before = camera.project(origin)[0, :2] - principal_point
    after = turned.project(origin)[0, :2] - principal_point
    np.testing.assert_allclose(after * np.exp(0.1), before, rtol=1e-9)
    assert np.linalg.norm(turned.eye() - camera.eye()) > 0.1


def test_an_attack_and_its_files_keep_pinhole_cameras(tmp_path):
    classifier = augment.Classifier(bright_or_dark, size=SIZE, classes=["cup", "other"])
    scene = placed_scene(silhouettes=True, samples=2)
    pose = augment.PoseSettings(radius=1.0)
    light = augment.StepSettings(step_size=0.5)
    settings = augment.AttackSettings(pose=pose, lighting=light, max_steps=1, allow_negative=True)
    result = augment.attack(classifier, scene, settings=settings, force=True)
    augment.save(result, tmp_path)
    adversary = augment.reload(tmp_path / "example_000")
    assert isinstance(adversary.cameras[0], renderer.PinholeCamera)
    assert (adversary.render() - result.images[0]).abs().max() < 1e-4


def test_variations_keep_pinhole_cameras():
    scene = placed_scene()
    settings = VariationSettings(shift=0.1, scale=[0.8, 1.2], azimuth=20.0, fov=[20.0, 40.0])
    [camera] = vary(scene, settings, torch.Generator().manual_seed(0)).cameras[0]
    assert isinstance(camera, renderer.PinholeCamera)
    assert camera.roll == scene.cameras[0][0].roll
    assert 20 <= camera.angle <= 40
