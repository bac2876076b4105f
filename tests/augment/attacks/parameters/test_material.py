import colorsys
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gltf_files import read_tree
from oracles import draw, textured

import augment
from augment.attacks.adversary import Adversary, final_images, reload, write_adversary
from augment.attacks.files import render_again
from augment.attacks.parameters.material import Material
from augment.attacks.problem import SceneProblem
from augment.scene.objects import SceneObject, add_table
from augment.scene.scene import Scene
from renderer.mesh import Mesh
from renderer.settings import MIN_ROUGHNESS
from renderer.solids import sphere
from renderer.surface.albedo import changed_albedo
from renderer.surface.gloss import Gloss

FIRST = torch.zeros(1, dtype=torch.int64)  # index of the only example
TABLE = [0.5, 0.4, 0.3]
# Change of each parameter by an attacked value of 1.
UNITS = {"roughness": 0.3, "metallic": 0.2, "specular_factor": 0.5, "hue": 40.0}

# The scenes keep to light of degree 6, which takes less time.
pytestmark = pytest.mark.filterwarnings("ignore:.*takes light of degree")


def egg(gloss: Gloss | None) -> Mesh:
    vertices, faces = sphere(1)
    mesh = Mesh.plain(vertices * [1.0, 0.7, 0.8], faces, (0.8, 0.5, 0.3))
    return mesh if gloss is None else gloss.on(mesh)


def textured_egg(gloss: Gloss) -> Mesh:
    draws = np.random.default_rng(0)
    plain = egg(None)
    uvs = draws.random((len(plain.faces), 3, 2), dtype=np.float32)
    colors = draws.integers(60, 200, (8, 8, 3), dtype=np.uint8)
    gloss_texels = draws.integers(150, 255, (1, 1, 2), dtype=np.uint8)
    mesh = textured(Mesh.plain(plain.vertices, plain.faces), uvs, colors)
    return replace(gloss.on(mesh), gloss_textures=(gloss_texels,))


def scene_of(*meshes: Mesh, ground: list[float] | None = None, **options) -> Scene:
    choices = {"samples": 1, "width": 2.6, "rasterizer": "numpy", "degree": 6} | options
    scene = augment.build_scene([(meshes[0], "egg")], 16, **choices)
    objects = [add_table(SceneObject("egg", mesh), ground) for mesh in meshes]
    examples = [replace(scene.examples[0], object=index) for index in range(len(objects))]
    lights = 0.4 * scene.lights[0].double()
    return scene.changed(objects=objects, examples=examples, lights=lights)


def problem_of(scene: Scene, **settings) -> SceneProblem:
    chosen = augment.MaterialSettings(**UNITS | settings)
    return SceneProblem(scene, [Material(scene, chosen)])


@pytest.mark.parametrize(
    ("mesh", "options"),
    [
        (egg(Gloss(0.5, 0.3, 0.6)), {"ground": TABLE}),
        (textured_egg(Gloss(0.5, 0.3, 0.6)), {"lamps": augment.LampsSettings()}),
    ],
    ids=["on a table", "textured under lamps"],
)
def test_gradients_are_central_differences(mesh, options):
    scene = scene_of(mesh, **options)
    problem = problem_of(scene.changed(lights=scene.lights + 0.05))
    weights = draw(3, 16, 16)

    def weighted_sum(values: torch.Tensor) -> torch.Tensor:
        return (problem.render(values, FIRST) * weights).sum()

    values = problem.start + torch.tensor([[0.2, 0.3, -0.4, 0.5]]).double()
    values.requires_grad_()
    (gradient,) = torch.autograd.grad(weighted_sum(values), values)
    assert gradient.abs().min() > 1e-3
    assert torch.autograd.gradcheck(weighted_sum, values, eps=1e-4, rtol=1e-6, atol=1e-7)


@pytest.fixture
def varied() -> Mesh:
    plain = egg(None)
    roughness = torch.linspace(0.3, 0.7, len(plain.faces))
    return Gloss(roughness, 0.2, 0.5).on(plain)


@pytest.fixture
def three_eggs(varied) -> Scene:
    return scene_of(egg(None), egg(Gloss(0.4)), varied, ground=TABLE)


def test_a_material_starts_as_the_scene_shows_it_and_a_matte_object_is_varnished(three_eggs):
    """Values are roughness, metallic, strength and hue in their units."""
    problem = problem_of(three_eggs)
    rows = torch.arange(3)
    varnished_egg = add_table(SceneObject("egg", Gloss().on(egg(None))), TABLE)
    varnished = three_eggs.changed(objects=[varnished_egg, *three_eggs.objects[1:]])
    expected = varnished.render(three_eggs.conditions(rows), rows)
    rendered = problem.render(problem.start, rows)
    torch.testing.assert_close(rendered, expected, rtol=0, atol=2e-6)
    units = torch.tensor([0.3, 0.2, 0.5, math.radians(40.0)], dtype=torch.float64)
    expected = torch.tensor([[0.5, 0, 1, 0], [0.4, 0, 1, 0], [0.5, 0.2, 0.5, 0]]).double()
    torch.testing.assert_close(problem.start * units, expected, rtol=0, atol=2e-6)


def test_all_faces_of_the_object_change_alike_and_the_table_stays(three_eggs, varied):
    gloss_before = three_eggs.objects[1].mesh.gloss.copy()
    problem = problem_of(three_eggs)
    gloss = problem.conditions(problem.start + 0.5, torch.arange(3)).gloss
    own = gloss[:, : len(varied.faces)]
    table = gloss[:, len(varied.faces) :]
    change = own[2] - torch.from_numpy(varied.gloss)
    expected = torch.tensor([0.15, 0.1, 0.25]).to(change).expand_as(change)
    torch.testing.assert_close(change, expected, rtol=0, atol=2e-6)
    assert (own[:2, :, 1] == 0).all()  # What is no metal becomes none.
    assert (table == torch.tensor([1, 0, 0])).all()
    np.testing.assert_array_equal(three_eggs.objects[1].mesh.gloss, gloss_before)


@pytest.mark.parametrize(("norm", "radius"), [("linf", 0.5), ("l2", 4.0), ("linf", None)])
def test_a_material_stays_in_its_norm_ball_and_physical(norm, radius):
    scene = scene_of(egg(Gloss(0.1, 0.0, 0.5)), egg(Gloss(0.9, 1.0, 0.0)))
    problem = problem_of(scene, norm=norm, radius=radius)
    draws = torch.Generator().manual_seed(0)
    rows = torch.arange(2)
    candidates = []
    for _ in range(5):
        far = problem.start + 5 * torch.randn(2, 4, generator=draws)
        candidates.append(problem.project(far, rows))
        if radius is not None:
            candidates.append(problem.sample(draws))
    for values in candidates:
        offset = (values - problem.start).abs()
        distance = offset.norm(dim=1) if norm == "l2" else offset.amax(1)
        assert radius is None or distance.max() <= radius * (1 + 1e-9)
        gloss = problem.conditions(values, rows).gloss
        assert gloss[..., 0].min() >= MIN_ROUGHNESS
        assert 0 <= gloss.min() <= gloss.max() <= 1
        assert gloss[0, 0, 1] == 0  # What is no metal becomes none.


@pytest.mark.parametrize("angle", range(-180, 181, 60))
def test_the_hue_turns_by_the_angle_and_keeps_the_mean(angle):
    """HSV's hue runs along a hexagon, which is off by at most 1.3° at both ends."""
    orange = torch.tensor([0.5, 0.4, 0.35], dtype=torch.float64)
    turned = changed_albedo(orange, torch.zeros(3), torch.tensor(float(angle)).double())
    assert turned.mean() == pytest.approx(float(orange.mean()))
    before = 360 * colorsys.rgb_to_hsv(*orange.tolist())[0]
    after = 360 * colorsys.rgb_to_hsv(*turned.tolist())[0]
    assert abs(math.remainder(after - before - angle, 360)) < 2.6


def write(problem: SceneProblem, values: torch.Tensor, folder: Path) -> Adversary:
    before, after = (
        final_images(problem, each, FIRST, problem.images(each))[0]
        for each in (problem.start, values)
    )
    conditions = problem.conditions(values, FIRST)
    adversary = Adversary.of(problem.scene, 0, conditions, before, after)
    write_adversary(adversary, folder)
    return adversary


@pytest.mark.parametrize(
    ("make_mesh", "rounding"), [(egg, 1e-5), (textured_egg, 1 / 255)], ids=["plain", "textured"]
)
def test_a_material_is_read_back_to_its_image_and_written_as_gltfs_factors(
    make_mesh, rounding, tmp_path
):
    problem = problem_of(scene_of(make_mesh(Gloss(0.5, 0.3, 0.4)), ground=TABLE, shadows=True))
    values = problem.start + torch.tensor([[-0.5, 0.6, 0.8, 0.7]])
    adversary = write(problem, values, tmp_path)
    assert (adversary.images - adversary.images_before).abs().max() > 0.03
    image = reload(tmp_path).render()
    torch.testing.assert_close(image.double(), adversary.images.double(), rtol=0, atol=rounding)
    material = read_tree(tmp_path / "mesh.glb")["materials"][0]
    surface = material["pbrMetallicRoughness"]
    assert surface["roughnessFactor"] == pytest.approx(0.35, abs=1e-5)
    assert surface["metallicFactor"] == pytest.approx(0.42, abs=1e-5)
    strength = material["extensions"]["KHR_materials_specular"]["specularFactor"]
    assert strength == pytest.approx(0.8, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("change", [(-0.5, 0.6, 0.8, 0.7), (-0.5, -1.5, 1.2, -0.7)])
def test_mitsuba_shows_the_material_that_an_attack_leaves(tmp_path, change):
    """Mitsuba's varnish has Disney's diffuse part, which differs by 3% (rms) over a ball."""
    options = {"ground": TABLE, "shadows": True, "samples": 8, "polar": 40.0}
    scene = scene_of(egg(Gloss(0.5, 0.3, 0.4)), **options)
    scene = scene.changed(lights=scene.basis.project_nonnegative(scene.lights))
    problem = problem_of(scene)
    values = problem.project(problem.start + torch.tensor([change]), FIRST)
    adversary = write(problem, values, tmp_path)
    before, after = adversary.images_before, adversary.images
    expected = render_again(tmp_path, ["mitsuba"], scene.rasterizer)["mitsuba"].double()

    def relative_error(image: torch.Tensor) -> float:
        return float((image - expected).square().mean().sqrt() / expected.mean())

    assert relative_error(after) < 0.03
    assert relative_error(before) > 0.06
    assert abs((after - expected).mean()) < 0.01 * expected.mean()
