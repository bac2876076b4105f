import numpy as np
import pytest
import torch

from augment.phases import Phases
from augment.scene import ObjectSettings, Scene, SceneObject, build_objects, count_views
from augment.service import AugmentationService, AugmentationSettings, LightAttackSettings
from renderer.cache import OperatorCache
from renderer.camera import ring
from renderer.errors import InputError
from renderer.harmonics import live_coefficients
from renderer.image import ENCODINGS, PictureSettings, develop
from renderer.lights import ambient, probe
from renderer.mesh import normalise
from renderer.shapes import solid
from renderer.transfer import Operator, build_operators
from renderer.visibility import choose

EPS32 = torch.finfo(torch.float32).eps
BACKEND = choose("software")
SETTINGS = PictureSettings(size=8, samples=2)
SIZE = 5
GREYS = [0.0, 0.25, 1.0]
LIVE = live_coefficients(6)
DEAD = torch.ones(49, dtype=torch.bool).index_fill(0, LIVE, False)


def random_operator(seed: int, count: int) -> Operator:
    """Covers `count` random pixels of a picture of SIZE², dark enough that clamping is the exception."""
    draws = torch.Generator().manual_seed(seed)
    coverage = 0.1 + 0.9 * torch.rand(count, generator=draws)
    return Operator(
        transfer=0.2 * torch.rand(3, 31, count, generator=draws) * coverage,
        albedo=torch.ones(3, count),
        coverage=coverage,
        pixels=torch.randperm(SIZE**2, generator=draws)[:count].sort().values,
        settings=PictureSettings(size=SIZE),
    )


@pytest.fixture(params=ENCODINGS)
def scene(request) -> Scene:
    """Two meshes of 2 views over 3 backgrounds; one view covers nothing."""
    objects = [
        SceneObject("orange", [random_operator(0, 6), random_operator(1, 4)]),
        SceneObject("pear", [random_operator(2, 9), random_operator(3, 0)]),
    ]
    return Scene(objects, GREYS, PictureSettings(size=SIZE, encoding=request.param))


def random_lights(count: int, seed: int = 0) -> torch.Tensor:
    return 0.3 * torch.randn(count, 49, 3, generator=torch.Generator().manual_seed(seed)) + ambient(
        torch.full((3,), 0.3)
    )


def composed(scene: Scene, lights: torch.Tensor) -> torch.Tensor:
    """Every example by itself: (E, 3, SIZE, SIZE)."""
    operators = [random_operator(seed, count) for seed, count in enumerate([6, 4, 9, 0])]
    pictures = []
    for light, (operator, grey) in zip(lights, [(o, g) for o in operators for g in GREYS], strict=True):
        canvas = torch.full((3, SIZE**2), grey)
        radiance = torch.einsum("kc,ckp->cp", light[LIVE], operator.transfer)
        behind = torch.full((1, 1), grey)
        canvas[:, operator.pixels] = develop(radiance, operator.coverage[None], behind, scene.settings.encoding)
        pictures.append(canvas.view(3, SIZE, SIZE))
    return torch.stack(pictures)


# A product of 31 terms below 1 in another order, and the slope of 12.92 of the sRGB curve near black.
TOLERANCE = {"rtol": 0, "atol": 13 * 8 * EPS32}


def test_renders_are_the_examples_composed_one_by_one(scene):
    lights = random_lights(12)
    pictures = scene.render(lights)
    assert pictures.shape == (12, 3, SIZE, SIZE) and len(scene) == 12
    assert pictures.min() >= 0 and pictures.max() <= 1
    torch.testing.assert_close(pictures, composed(scene, lights), **TOLERANCE)


@pytest.mark.parametrize("examples", [[0], [11], [1, 2], [0, 4, 5, 9], [3, 6, 7, 8, 10], list(range(12))])
def test_some_examples_are_rendered_as_all_are(scene, examples):
    lights, chosen = random_lights(12), torch.tensor(examples)
    torch.testing.assert_close(scene.render(lights[chosen], chosen), composed(scene, lights)[chosen], **TOLERANCE)


def test_examples_are_meshes_by_views_by_backgrounds(scene):
    assert scene.labels == ["orange"] * 6 + ["pear"] * 6
    free = sorted(set(range(SIZE**2)) - set(scene.pixels.tolist()))
    assert free
    corner = scene.render(random_lights(12)).flatten(2)[:, :, free[0]]
    torch.testing.assert_close(corner, torch.tensor(GREYS * 4)[:, None].expand(12, 3), rtol=0, atol=0)


def test_uncovered_pixels_and_dead_coefficients_have_gradients_of_exactly_zero(scene):
    lights = random_lights(12).requires_grad_(True)
    pictures = scene.render(lights)
    (gradient,) = torch.autograd.grad(pictures.sum(), lights, retain_graph=True)
    assert (gradient[:9, LIVE] != 0).any(dim=2).all()
    assert not gradient[:, DEAD].any() and DEAD.sum() == 18
    uncovered = torch.ones(12, SIZE**2)
    for view, (seed, count) in enumerate(enumerate([6, 4, 9, 0])):
        uncovered[3 * view : 3 * view + 3, random_operator(seed, count).pixels] = 0
    (gradient,) = torch.autograd.grad(pictures, lights, uncovered.view(12, 1, SIZE, SIZE).expand_as(pictures))
    assert not gradient.any()


def test_the_gradient_is_the_transfer_where_nothing_clamps():
    """Under the linear encoding and whatever the background."""
    operator = random_operator(4, 7)
    scene = Scene([SceneObject("orange", [operator])], [0.5], PictureSettings(size=SIZE))
    lights = ambient(torch.full((3,), 0.1)).expand(1, -1, -1).clone().requires_grad_(True)
    weights = torch.randn(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad(scene.render(lights), lights, weights)
    expected = torch.einsum("ckp,cp->kc", operator.transfer, weights.view(3, -1)[:, operator.pixels])
    torch.testing.assert_close(gradient[0, LIVE], expected, rtol=0, atol=16 * EPS32)


def test_the_clamped_share_counts_covered_values_alone():
    """Radiance ±L₀₀ at three pixels of coverage 1, 1/2 and 1; a second view covers a fourth pixel, always in range."""
    unit, settings = torch.zeros(3, 31, 3), PictureSettings(size=2)
    unit[:, 0] = torch.tensor([1.0, 0.5, -1.0])
    views = [
        Operator(unit, torch.ones(3, 3), torch.tensor([1.0, 0.5, 1.0]), torch.tensor([0, 1, 2]), settings),
        Operator(torch.zeros(3, 31, 1), torch.ones(3, 1), torch.ones(1), torch.tensor([3]), settings),
    ]
    scene = Scene([SceneObject("orange", views)], [0.0, 1.0], settings)
    lights = torch.zeros(4, 49, 3)
    lights[:, 0] = torch.tensor([0.9, 1.6, 2.4])
    # Over black: 0.9, 1.6, 2.4; 0.45, 0.8, 1.2; all negative: 2 + 1 + 3 clamped. Over white, half of it at the second
    # pixel: 0.95, 1.3, 1.7, so 2 + 2 + 3.
    torch.testing.assert_close(scene.clamped_share(lights), torch.tensor([6 / 9, 7 / 9, 0, 0]))


def test_a_scene_that_nothing_covers_is_its_backgrounds():
    scene = Scene([SceneObject("orange", [random_operator(0, 0)])], GREYS, PictureSettings(size=SIZE))
    pictures = scene.render(random_lights(3))
    torch.testing.assert_close(pictures, torch.tensor(GREYS).view(3, 1, 1, 1).expand_as(pictures), rtol=0, atol=0)
    assert scene.clamped_share(random_lights(3)).tolist() == [0, 0, 0]


@pytest.mark.parametrize("grey", [-0.1, 1.01, 255, float("nan")])
def test_backgrounds_that_no_picture_has_are_refused(grey):
    with pytest.raises(InputError, match=r"scene\.backgrounds"):
        Scene([SceneObject("orange", [random_operator(0, 1)])], [0.5, grey], PictureSettings(size=SIZE))


@pytest.mark.parametrize(
    ("examples", "objects", "backgrounds", "views", "expected"),
    [(100, 2, 5, None, 10), (100, 2, 5, 10, 10), (5, 1, 5, None, 1), (6, 3, 1, None, 2)],
)
def test_views_make_the_product_of_meshes_and_backgrounds_the_examples(examples, objects, backgrounds, views, expected):
    assert count_views(examples, objects, backgrounds, views) == expected


@pytest.mark.parametrize(
    ("examples", "objects", "backgrounds", "views", "message"),
    [
        (100, 3, 5, None, r"augment\.examples=100 is not a multiple of 3 meshes × 5 backgrounds: .* multiple of 15"),
        (4, 2, 5, None, "set it to a multiple of 10"),
        (100, 2, 5, 9, r"2 meshes × 9 views × 5 backgrounds = 90: .*scene\.views=null"),
        (100, 2, 5, 0, r"scene\.views=null"),
        (100, 0, 5, None, r"scene\.meshes and scene\.backgrounds must not be empty"),
        (100, 2, 0, None, r"scene\.meshes and scene\.backgrounds must not be empty"),
    ],
)
def test_numbers_that_make_no_product_are_refused(examples, objects, backgrounds, views, message):
    with pytest.raises(InputError, match=message):
        count_views(examples, objects, backgrounds, views)


def same(a: Operator, b: Operator) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("transfer", "coverage", "pixels"))


@pytest.mark.parametrize(("spec", "name", "seed"), [("solid:plate", "plate", 0), ("solid:table:3", "table", 3)])
def test_a_solid_is_normalised_and_seen_from_a_ring(spec, name, seed):
    (built,) = build_objects([ObjectSettings(spec, "thing")], 2, 2.2, SETTINGS, BACKEND)
    expected = build_operators(normalise(solid(name, seed)), ring(2, 2.2), SETTINGS, BACKEND)
    assert built.label == "thing" and len(built.operators) == 2
    assert all(same(*pair) for pair in zip(built.operators, expected, strict=True))


def test_a_file_is_turned_upright_and_its_gain_multiplies(tmp_path):
    """A wall in the file's xy plane, 2 wide and 1 high: seen from π/3, it is upright only when y is up."""
    path = tmp_path / "wall.obj"
    path.write_text("v -1 0 0\nv 1 0 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n")
    level, upright, bright = build_objects(
        [
            ObjectSettings(str(path), "wall"),
            ObjectSettings(str(path), "wall", up="y"),
            ObjectSettings(str(path), "wall", up="y", gain=2.0),
        ],
        4,
        4.0,
        PictureSettings(size=32, samples=4),
        BACKEND,
    )
    # From azimuth π/2: as wide as it was and sin π/3 high standing, cos π/3 high lying; half a sample's width of 1/64
    # off along the outline of 6 at the most.
    for built, foreshortening in ((upright, np.sqrt(3) / 2), (level, 0.5)):
        area = float(built.operators[1].coverage.sum()) / 64
        assert area == pytest.approx(2 * foreshortening, abs=6 / 64)
    torch.testing.assert_close(bright.operators[1].albedo, 2 * upright.operators[1].albedo, rtol=0, atol=0)
    torch.testing.assert_close(bright.operators[1].transfer, upright.operators[1].transfer, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("solid:orangutan", "orange"),
        ("solid", "No solid is called ''"),
        ("solid:orange:red", r"scene\.meshes: the seed in 'solid:orange:red' must be a whole number"),
        ("solid:orange:-1", "must be a whole number"),
        ("solid:orange:1:2", "must be a whole number"),
        ("no/such.glb", "no/such.glb does not exist"),
    ],
)
def test_a_mesh_that_is_not_there_is_refused(spec, message):
    with pytest.raises(InputError, match=message):
        build_objects([ObjectSettings(spec, "orange")], 1, 2.0, SETTINGS, BACKEND)


@pytest.mark.parametrize("gain", [0.0, -1.0, float("nan")])
def test_a_gain_that_leaves_nothing_is_refused(gain):
    with pytest.raises(InputError, match="gain="):
        ObjectSettings("solid:orange", "orange", gain=gain)


def test_a_lighting_attack_rasterises_nothing(rasterised):
    """Each mesh is rasterised once, in all views; 30 steps on 24 examples that are never fooled add nothing."""
    items = [ObjectSettings(f"solid:{name}", name) for name in ("plate", "cup")]
    objects = build_objects(items, 4, 2, SETTINGS, BACKEND)
    assert rasterised == [4, 4]
    scene = Scene(objects, GREYS, SETTINGS)
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * 64, 3))
    torch.nn.init.constant_(network[1].bias[0], 1000)
    settings = AugmentationSettings(attack=LightAttackSettings(max_steps=30))
    service = AugmentationService(settings, scene, torch.zeros(24, dtype=torch.int64), probe("grace"), 0, Phases())
    assert service.regenerate(network, epoch=0).diagnostics["steps"] == 30 and rasterised == [4, 4]


def test_a_scene_stores_no_background_pixel_and_no_backgrounds_or_dead_bands_of_a_view():
    objects = build_objects([ObjectSettings("solid:bottle", "bottle")], 4, 2, SETTINGS, BACKEND)
    scene = Scene(objects, GREYS, SETTINGS)
    covered = set(np.concatenate([operator.pixels for operator in objects[0].operators]).tolist())
    assert len(scene) == 12 and 0 < len(covered) < 64 / 2
    # 31 live coefficients of 49, and the row of zeros that makes the product fast
    assert scene.transfer.shape == (4, 3, 32, len(covered)) and not scene.transfer[:, :, 31].any()
    assert scene.coverage.shape == (4, 1, len(covered)) and scene.pixels.tolist() == sorted(covered)


def test_a_second_scene_from_the_same_folder_builds_nothing(tmp_path, rasterised):
    items = [ObjectSettings("solid:plate", "plate"), ObjectSettings("solid:plate:1", "plate", gain=2.0)]
    pictures = []
    for calls in ([3, 3], [3, 3]):
        cache = OperatorCache(tmp_path)
        scene = Scene(build_objects(items, 3, 2, SETTINGS, BACKEND, cache), GREYS, SETTINGS)
        pictures.append(scene.render(random_lights(18)))
        assert rasterised == calls
    assert (cache.tally.loaded, cache.tally.built) == (6, 0)
    assert torch.equal(*pictures)


def test_under_grace_a_plate_is_brighter_from_above_than_from_below():
    """The whole way from a spec to a picture."""
    (plate,) = build_objects([ObjectSettings("solid:plate", "plate")], 1, 2.0, SETTINGS, BACKEND)
    scene = Scene([plate], [0.0], SETTINGS)
    light = probe("grace")[None]
    upside_down = light.clone()
    upside_down[:, 2] *= -1
    assert scene.render(light).mean() > 1.2 * scene.render(upside_down).mean()
