"""Attacks on the material of an object: roughness, metallic, strength, and the hue of its albedo."""

import colorsys
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import augment
from augment.attacks.adversary import Adversary, reload, write_adversary
from augment.attacks.attack import final_images
from augment.attacks.attack_files import render_again
from augment.attacks.parameters.material import Material
from augment.attacks.problem import AttackProblem
from augment.parameter_settings import MATERIAL
from augment.scene.objects import SceneObject, on_ground
from augment.scene.scene import Scene
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.shapes import sphere
from renderer.settings import MIN_ROUGHNESS
from renderer.shading.gloss import Gloss
from renderer.surface.albedo import changed_albedo

ONE = torch.zeros(1, dtype=torch.int64)
UNITS = torch.tensor([0.3, 0.2, 0.5, np.deg2rad(40)])


# The scenes keep to light of degree 6, which takes less time.
pytestmark = pytest.mark.filterwarnings("ignore:.*takes light of degree")


def egg(gloss: Gloss | None, textured: bool = False) -> Mesh:
    vertices, faces = sphere(1)
    mesh, draws = Mesh.plain(vertices * [1.0, 0.7, 0.8], faces, (0.8, 0.5, 0.3)), np.random.default_rng(0)
    if textured:
        uvs, ids = draws.random((len(mesh.faces), 3, 2), dtype=np.float32), np.zeros(len(mesh.faces), dtype=np.int32)
        images = draws.integers(60, 200, (8, 8, 3), dtype=np.uint8), draws.integers(150, 255, (1, 1, 2), dtype=np.uint8)
        mesh = replace(Mesh.plain(mesh.vertices, mesh.faces), corner_uvs=uvs, texture_ids=ids, textures=images[:1])
    mesh = mesh if gloss is None else gloss.on(mesh)
    return replace(mesh, gloss_textures=images[1:]) if textured else mesh


def scene_of(*meshes: Mesh, ground: list[float] | None = None, **options) -> Scene:
    choices = {"samples": 1, "width": 2.6, "rasterizer": "numpy", "degree": 6} | options
    scene = augment.build_scene([(meshes[0], "egg")], 16, **choices)
    items = [on_ground(SceneObject("egg", mesh), ground) for mesh in meshes]
    rows = [replace(scene.examples[0], object=index) for index in range(len(items))]
    return scene.changed(objects=items, examples=rows, lights=0.4 * scene.lights[0].double())


def problem_of(scene: Scene, **settings) -> AttackProblem:
    units = dict(zip(MATERIAL, [*UNITS[:3].tolist(), 40.0], strict=True))
    return AttackProblem(scene, [Material(scene, augment.MaterialSettings(**units | settings))])


@pytest.mark.parametrize(
    "options", [{}, {"ground": [0.5, 0.4, 0.3]}, {"textured": True, "lamps": augment.LampsSettings()}]
)
def test_gradients_are_central_differences(options):
    scene = scene_of(egg(Gloss(0.5, 0.3, 0.6), options.pop("textured", False)), **options)
    problem, draws = problem_of(scene.changed(lights=scene.lights + 0.05)), torch.Generator().manual_seed(0)
    weights = torch.randn(3, 16, 16, generator=draws, dtype=torch.float64)

    def weighed(values: torch.Tensor) -> torch.Tensor:
        return (problem.render(values, ONE) * weights).sum()

    at = problem.start + torch.tensor([[0.2, 0.3, -0.4, 0.5]]).double()
    (gradient,) = torch.autograd.grad(weighed(at.requires_grad_()), at)
    steps = 1e-4 * torch.eye(4, dtype=torch.float64)[:, None]
    expected = torch.stack([(weighed(at + step) - weighed(at - step)) / 2e-4 for step in steps]).detach()
    assert expected.abs().min() > 1e-3
    torch.testing.assert_close(gradient[0], expected, rtol=1e-6, atol=1e-7)


def test_a_material_starts_as_the_scene_shows_it_and_changes_the_object_alone():
    """Also where faces differ in gloss, which the attack moves by the same. A matte object is shown varnished."""
    varied = Gloss(torch.linspace(0.3, 0.7, len(egg(None).faces)), 0.2, 0.5).on(egg(None))
    scene = scene_of(egg(None), egg(Gloss(0.4)), varied, ground=[0.5, 0.4, 0.3])
    problem, rows = problem_of(scene), torch.arange(3)
    egg_on_ground = on_ground(SceneObject("egg", Gloss().on(egg(None))), [0.5, 0.4, 0.3])
    varnished = scene.changed(objects=[egg_on_ground, *scene.objects[1:]])
    shown = varnished.render(scene.conditions(rows), rows)
    before = scene.objects[1].mesh.gloss.copy()
    torch.testing.assert_close(problem.render(problem.start, rows), shown, rtol=0, atol=2e-6)
    assert (problem.start * UNITS).tolist() == pytest.approx(
        np.array([[0.5, 0, 1, 0], [0.4, 0, 1, 0], [0.5, 0.2, 0.5, 0]]), abs=2e-6
    )
    gloss = problem.conditions(problem.start + 0.5, rows).gloss
    faces = len(varied.faces)
    assert (gloss[2, :faces] - torch.from_numpy(varied.gloss)).tolist() == pytest.approx(
        np.tile([0.15, 0.1, 0.25], (faces, 1)), abs=2e-6
    )
    assert (gloss[:2, :faces, 1] == 0).all() and (gloss[:, faces:] == torch.tensor([1, 0, 0])).all()
    assert (scene.objects[1].mesh.gloss == before).all()


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("radius", [0.5, 4.0, None])
def test_a_material_stays_within_its_norm_ball_and_what_exists(norm, radius):
    scene = scene_of(egg(Gloss(0.1, 0.0, 0.5)), egg(Gloss(0.9, 1.0, 0.0)))
    problem, draws = problem_of(scene, norm=norm, radius=radius), torch.Generator().manual_seed(0)
    for _ in range(20):
        far = problem.start + 5 * torch.randn(2, 4, generator=draws)
        for values in [problem.project(far, torch.arange(2)), *([] if radius is None else [problem.sample(draws)])]:
            offset = (values - problem.start).abs()
            reach = offset.norm(dim=1) if norm == "l2" else offset.amax(1)
            assert radius is None or reach.max() <= radius * (1 + 1e-9)
            gloss = problem.conditions(values, torch.arange(2)).gloss
            assert gloss.amin((0, 1))[0] >= MIN_ROUGHNESS and gloss.min() >= 0 and gloss.max() <= 1
            assert gloss[0, 0, 1] == 0  # what is no metal becomes none


def test_the_hue_turns_by_the_angle_and_keeps_the_mean():
    """Of colors on a circle about gray, whose hue by HSV is the angle to within 1.3° of a hexagon's."""
    orange = torch.tensor([0.5, 0.4, 0.35], dtype=torch.float64)
    for angle in torch.linspace(-180, 180, 13).double():
        turned = changed_albedo(orange, angle, torch.zeros(3))
        assert turned.mean() == pytest.approx(float(orange.mean()))
        before, after = (360 * colorsys.rgb_to_hsv(*color.tolist())[0] for color in (orange, turned))
        off = (after - before - float(angle) + 180) % 360 - 180
        assert abs(off) < 2.6


@pytest.mark.parametrize("textured", [False, True])
def test_a_material_is_written_to_files_that_show_it_again(tmp_path, textured):
    """As glTF's factors; beside a table that casts highlights' shadows, as the final images show them."""
    scene = scene_of(egg(Gloss(0.5, 0.3, 0.4), textured), ground=[0.5, 0.4, 0.3], shadows=True)
    problem = problem_of(scene)
    values = problem.start + torch.tensor([[-0.5, 0.6, 0.8, 0.7]])
    image = final_images(problem, values, ONE, problem.images(values))[0]
    adversary = Adversary.of(scene, 0, problem.conditions(values, ONE), problem.images(problem.start)[0], image)
    write_adversary(adversary, tmp_path)
    assert (adversary.images - adversary.images_before).abs().max() > 0.03
    torch.testing.assert_close(reload(tmp_path).render().double(), image, rtol=0, atol=1 / 255 if textured else 1e-5)
    glb = (tmp_path / "mesh.glb").read_bytes()
    tree = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    factors = tree["materials"][0]["pbrMetallicRoughness"]
    strength = tree["materials"][0]["extensions"]["KHR_materials_specular"]["specularFactor"]
    assert [factors["roughnessFactor"], factors["metallicFactor"], strength] == pytest.approx(
        [0.35, 0.42, 0.8], abs=1e-5
    )


def test_descent_finds_a_material_as_good_as_those_of_a_grid(attacked, by_color):
    """Of 5² of roughness and strength in the ball, under lamps whose highlights are narrow; to 2 % of the gain."""
    lit = {"normals": "smooth", "lamps": augment.LampsSettings([[1.5, 0.5, 2.0], [-1.0, 2.0, 1.5]], start=6.0)}
    steps = augment.MaterialSettings("linf", 1.0, "sign", 0.2, roughness=0.3, strength=1.0)
    result = attacked({"material": steps}, scene=lit, max_steps=10, shorten=True, margin=1000.0)
    problem, label = result.problem, result.goal.source[0, 0]
    sides = torch.linspace(0.2001, 0.8, 5) / 0.3, torch.linspace(0, 1 - 1e-6, 5)
    grid = torch.nn.functional.pad(torch.cartesian_prod(*sides), (0, 2))[:, [0, 2, 1, 3]]
    logits = by_color(problem.render(grid, torch.zeros(25, dtype=torch.int64))[:, 0])
    costs = -torch.nn.functional.cross_entropy(logits, label.expand(25), reduction="none")
    best, before, reached = float(costs.min()), float(result.descent.cost_before[0]), float(result.descent.cost[0])
    assert 0 < 0.98 * (before - best) < before - reached


def test_a_material_without_parts_is_refused_in_one_sentence():
    with pytest.raises(InputError, match="are all 0"):
        augment.MaterialSettings(**dict.fromkeys(MATERIAL, 0.0))
    with pytest.raises(InputError, match="hue=200 must be"):
        augment.MaterialSettings(hue=200)


@pytest.mark.slow
@pytest.mark.parametrize(("change", "limit"), [((-0.5, 0.6, 0.8, 0.7), 0.02), ((-0.5, -1.5, 1.2, -0.7), 0.03)])
def test_mitsuba_shows_the_material_that_an_attack_leaves(tmp_path, change, limit):
    """A metal's, and a varnish whose diffuse part is Disney's there; beside a table, which stays diffuse."""
    pytest.importorskip("mitsuba")
    scene = scene_of(egg(Gloss(0.5, 0.3, 0.4)), ground=[0.5, 0.4, 0.3], shadows=True, samples=8, polar=40.0)
    scene = scene.changed(lights=scene.basis.project_nonnegative(scene.lights))
    problem = problem_of(scene)
    values = problem.project(problem.start + torch.tensor([change]), ONE)
    images = [final_images(problem, at, ONE, problem.images(at))[0] for at in (problem.start, values)]
    write_adversary(Adversary.of(scene, 0, problem.conditions(values, ONE), *images), tmp_path)
    theirs = render_again(tmp_path, ["mitsuba"], scene.rasterizer)["mitsuba"].double()
    before, after = ((image - theirs).square().mean().sqrt() / theirs.mean() for image in images)
    assert after < limit and before > 2 * limit
    assert abs((images[1] - theirs).mean()) < 0.01 * theirs.mean()
