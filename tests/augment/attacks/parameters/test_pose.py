import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import augment
from augment.attack_settings import PoseSettings
from augment.attacks.parameters.pose import Pose
from augment.attacks.problem import SceneProblem
from augment.scene.scene import Scene
from renderer.errors import InputError

ONLY = dict.fromkeys(PoseSettings.parts, 0.0)  # Add the parts that may change.
FIRST = torch.zeros(1, dtype=torch.int64)  # index of the only example
GRAY = [0.5, 0.5, 0.5]


def scene_of(size: int = 24, **options) -> Scene:
    choices = {"samples": 2, "silhouettes": True, "width": 2.6, "fov": 40.0, "rasterizer": "numpy"}
    scene = augment.build_scene([("solid:pear:0", "pear")], size, **choices | options)
    return scene.changed(lights=0.4 * scene.lights.double())


def problem_of(scene: Scene, **units) -> SceneProblem:
    settings = augment.PoseSettings(radius=1.0, **units)
    return SceneProblem(scene, [Pose(scene, settings)])


@pytest.mark.parametrize("ground", [None, GRAY])
def test_values_are_a_rotation_vector_a_shift_and_a_scale(ground):
    """An object on the ground stays on it."""
    scene = scene_of(ground=ground)
    pose = [1.0, -0.5, 2.0, 0.3, -0.2, 0.7, 0.0, 0.0, 0.0]
    values = torch.tensor([pose], dtype=torch.float64)
    moved = problem_of(scene).conditions(values, FIRST).vertices[0].numpy()

    before = scene.objects[0].mesh.vertices
    is_own = scene.objects[0].own_vertices
    turn = Rotation.from_rotvec([10.0, -5.0, 20.0], degrees=True)
    expected = 1.1**0.7 * turn.apply(before) + [0.03, -0.02, 0]
    if ground:
        # The lowest vertex is as high as before.
        expected[:, 2] += before[is_own, 2].min() - expected[is_own, 2].min()
    np.testing.assert_allclose(moved[is_own], expected[is_own], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(moved[~is_own], before[~is_own])


@pytest.mark.parametrize("fov", [None, 40.0])
def test_the_camera_moves_to_the_place_of_another_scenes_camera(fov):
    scene = scene_of(fov=fov, polar=60.0, azimuth=20.0)
    values = torch.tensor([[0.0] * 6 + [0.5, -1.5, 2.0]], dtype=torch.float64)
    other = scene_of(fov=fov, polar=65.0, azimuth=5.0, width=2.6 * 1.15**2)
    conditions = replace(other.conditions(FIRST), vertices=other.vertices)
    expected = other.render(conditions, FIRST)
    rendered = problem_of(scene, distance=0.15).render(values, FIRST)
    torch.testing.assert_close(rendered, expected, rtol=0, atol=1e-9)
    # Conditions of the camera alone show the same, although the object is unchanged.
    cameras = torch.tensor([[5.0, -15.0, 2 * math.log(1.15)]], dtype=torch.float64)
    alone = scene.render(replace(scene.conditions(FIRST), cameras=cameras), FIRST)
    torch.testing.assert_close(alone, expected, rtol=0, atol=1e-9)


def test_an_object_that_grows_and_a_camera_that_comes_closer_do_not_meet():
    scene = scene_of(fov=85.0, width=2.0)
    pose = Pose(scene, augment.PoseSettings())
    problem = SceneProblem(scene, [pose])
    too_close = torch.tensor([[0.0] * 5 + [9, 0, 0, -9]], dtype=torch.float64)
    with pytest.raises(InputError, match="reaches the camera"):
        problem.render(too_close, FIRST)
    problem.render(pose.project_feasible(too_close), FIRST)


@pytest.mark.parametrize("ground", [None, pytest.param(GRAY, marks=pytest.mark.slow)])
def test_gradients_by_the_pose_are_differences_of_new_images(ground):
    """Three weighted sums of the image are compared, and the differences have more samples."""
    problem, finer = (
        problem_of(scene_of(32, samples=samples, ground=ground, rasterizer="auto"))
        for samples in (8, 16)
    )
    ramp = torch.linspace(-1, 1, 32, dtype=torch.float64)
    y, x = torch.meshgrid(ramp, ramp, indexing="ij")
    weights = torch.stack([torch.ones_like(x), torch.sin(2 * x + y), torch.cos(3 * y - x)])

    def sums(values: torch.Tensor) -> torch.Tensor:
        return torch.einsum("kyx,yx->k", weights, problem.render(values, FIRST)[0, 0].sum(0))

    found = torch.autograd.functional.jacobian(sums, problem.start)[:, 0]

    slopes = []
    for step in 0.2 * torch.eye(9, dtype=torch.float64)[:, None]:
        change = finer.render(step, FIRST) - finer.render(-step, FIRST)
        slopes.append(change[0, 0].sum(0) / 0.4)
    expected = torch.einsum("kyx,dyx->kd", weights, torch.stack(slopes))
    assert (found - expected).norm() < 0.03 * expected.norm()


@pytest.fixture(scope="module")
def result(attacked) -> augment.AttackResult:
    only_views = ONLY | {"view": 10.0, "shift": 0.1}
    steps = augment.PoseSettings("linf", 3.0, "sign", 0.5, **only_views)
    lit = {"silhouettes": True, "samples": 4, "normals": "smooth"}
    return attacked({"pose": steps}, scene=lit, max_steps=20, backtracking=True, margin=1000.0)


def test_descent_finds_a_view_as_good_as_those_of_a_grid_and_at_random(result, by_color):
    """Descent reaches at least 95% of the gain of 5 × 5 views and of ten draws."""
    steps = torch.linspace(-3, 3, 5)
    grid = torch.zeros(25, 9)
    grid[:, 6:8] = torch.cartesian_prod(steps, steps)
    draws = [torch.Generator().manual_seed(seed) for seed in range(10)]
    others = torch.cat([grid, *map(result.problem.sample, draws)])
    rows = torch.zeros(len(others), dtype=torch.int64)
    logits = by_color(result.problem.render(others, rows)[:, 0])
    lowest = float(logits.log_softmax(1)[:, result.criterion.source[0, 0]].min())
    before = float(result.minimum.cost_before[0])
    reached = float(result.minimum.cost[0])
    assert 0 < 0.95 * (before - lowest) < before - reached


def test_an_adversarial_pose_is_read_back_to_its_image_and_camera(result, tmp_path):
    [line] = augment.save(result, tmp_path)
    assert line["versions"]["reload"]["largest_difference"] < 1e-4
    camera = augment.reload(tmp_path / "example_000").cameras[0]
    assert isinstance(camera.polar, float)
    assert camera.polar != result.problem.scene.cameras[0][0].polar


def test_a_pose_without_outlines_is_refused():
    with pytest.raises(InputError, match="silhouettes=True"):
        problem_of(scene_of(silhouettes=False))
