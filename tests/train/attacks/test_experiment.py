import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import augment
from augment.attacks import attack
from augment.attacks.attack import AttackResult
from augment.attacks.descent import descend
from augment.attacks.evaluate import Checks
from augment.attacks.parameters import PARAMETERS
from augment.classifiers import Classifier
from augment.losses import adversarial_cost
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.light.presets import probe
from train.attacks.experiment import attack_mesh
from train.attacks.settings import AttackExperimentSettings
from train.attacks.text import format_attack
from train.settings import compose, read_object, read_settings

CPU = torch.device("cpu")
CLASSES = ("orange", "lime", "sky", "night")
SIZE = 8


def mean_color(images: Tensor) -> Tensor:
    """Orange is red, lime is green, sky is blue, night is dark."""
    means = 30 * images.mean((2, 3))
    return torch.cat([means, 12 - means.sum(1, keepdim=True)], dim=1)


def sky_in_the_dark(images: Tensor) -> Tensor:
    return 30 * images.mean((2, 3)) + 30 * (images[:, :1, 0, 0] < 0.1) * torch.tensor([0, 0, 1])


def by_color(classes: Sequence[str] = CLASSES) -> Classifier:
    return Classifier(mean_color, SIZE, classes, "by_color")


def configured(*overrides: str) -> AttackExperimentSettings:
    """The real configuration; arguments are further overrides."""
    small = ["renderer.rasterizer=numpy", "renderer.cache=null", "attack.checks=false", "attack.max_steps=8"]
    small += ["attack.margin=0", "attack.rounded=false"]
    return read_settings(AttackExperimentSettings, compose("attack", [*small, *overrides]))


STANDING = {  # the light of a kind that is placed in the scene, a little of it from the start
    "projector": "scene.projector={pixels: 4, pattern: 0.2}",
    "lamps": "scene.lamps={positions: [[2, 2, 2], [-2, 2, 2]], start: 0.5}",
}


def standing(kinds: str) -> list[str]:
    """What the scene needs for the kinds."""
    return [STANDING[kind] for kind in kinds.split(",") if kind in STANDING]


def attacked(*overrides: str, classifier: Classifier | None = None, device: torch.device = CPU) -> AttackResult:
    settings = configured(*overrides)
    (mesh,) = settings.scene.meshes
    return attack_mesh(read_object(mesh, settings.label, 0), settings, classifier or by_color(), device)


# ---------------------------------------------------------------------------------------- what is attacked


@pytest.mark.parametrize("kinds", [*PARAMETERS, "lighting,geometry,pixels"])
def test_every_kind_alone_and_with_others_lowers_the_cost_of_its_own_images(kinds):
    """The numbers are those of the images: the cost and the answers follow from the logits."""
    more = ["attack.max_steps=3", "scene.backgrounds=[0.4,0.5]", "renderer.shadows=false", *standing(kinds)]
    done = attacked(f"attack=[{kinds}]", *more)
    assert [kind.name for kind in done.problem.parameters] == kinds.split(",")
    assert done.images.shape == (2, 1, 3, SIZE, SIZE)
    assert (done.descent.cost < done.descent.cost_before).all() and (done.descent.steps > 0).all()
    for images, logits, cost in [
        (done.images_before, done.logits_before, done.descent.cost_before),
        (done.images, done.logits, done.descent.cost),
    ]:
        assert torch.equal(logits[:, 0], mean_color(images[:, 0]))
        # Sums of 64 pixels in another order differ by rounding.
        torch.testing.assert_close(cost, adversarial_cost(logits[:, 0], done.goal.source[:, 0]), rtol=0, atol=1e-4)
    assert torch.equal(done.logits.argmax(2) != 0, done.descent.success[:, None])
    everything = torch.arange(2)
    again = done.problem.render(done.descent.values, everything)
    torch.testing.assert_close(again.detach(), done.images, rtol=0, atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("kinds", [*PARAMETERS, "lighting,geometry,albedo,pixels"])
def test_a_gpu_attacks_as_a_cpu_does_to_rounding(kinds):
    """After one step; a gradient's sign may differ where it is nearly zero, hence not every pixel is compared."""
    overrides = (f"attack=[{kinds}]", "attack.max_steps=1", "scene.views=2", *standing(kinds))
    expected, found = (attacked(*overrides, device=device).descent for device in (CPU, torch.device("cuda")))
    torch.testing.assert_close(found.cost_before.cpu(), expected.cost_before, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.cost.cpu(), expected.cost, rtol=1e-2, atol=1e-2)
    assert torch.equal(found.success.cpu(), expected.success)


def test_examples_are_each_view_before_all_backgrounds_at_equal_azimuths():
    overrides = "scene.views=3", "scene.backgrounds=[0.2,0.6]", "scene.polar=90", "attack.allow_negative=true"
    done = attacked(*overrides, "attack.max_steps=0")
    cameras = orbit_cameras(3, 2.0, math.pi / 2)
    assert done.problem.scene.cameras == [(camera,) for camera in cameras for _ in range(2)]
    assert done.images_before[:, 0, :, 0, 0].tolist() == [[pytest.approx(gray)] * 3 for gray in [0.2, 0.6] * 3]
    assert torch.equal(done.problem.scene.lights, probe("grace").expand(6, -1, -1))


def test_shared_views_are_one_example_with_one_light():
    done = attacked("scene.views=3", "attack.shared=true")
    assert (len(done.problem.scene), done.problem.scene.views) == (1, 3)
    assert done.descent.values.shape == (1, 147)
    each = adversarial_cost(done.logits_before[0], done.goal.source[0])
    assert done.descent.cost_before.item() == pytest.approx(each.sum().item(), abs=1e-4)


def test_exposure_multiplies_the_light_and_gain_the_surface():
    brighter = attacked("attack.max_steps=0", "scene.exposure=1.5", "attack.force=true")
    item = "scene.meshes=[{mesh: 'solid:orange:0', albedo_scale: 1.5}]"
    whiter = attacked("attack.max_steps=0", item, "attack.force=true")
    torch.testing.assert_close(brighter.images_before, whiter.images_before, rtol=0, atol=1e-6)
    assert not torch.equal(brighter.images_before, attacked("attack.max_steps=0").images_before)


def test_subdivision_gives_more_vertices_than_asked_for():
    before = len(attacked("attack.max_steps=0").problem.scene.mesh(0).vertices)
    after = len(attacked("attack.max_steps=0", f"scene.vertices={before}").problem.scene.mesh(0).vertices)
    assert after > before


@pytest.mark.parametrize("kinds", ["lighting", "geometry"])
def test_the_same_seed_gives_the_same_result(kinds):
    """Nothing reaches `sky`, so that a restart is drawn."""
    overrides = [f"attack=[{kinds}]", "target=sky", "attack.restarts=1", f"attack.{kinds}.radius=0.02"]
    first, second = (attacked(*overrides, "attack.max_steps=2") for _ in range(2))
    for name, value in vars(first.descent).items():
        assert torch.equal(value, getattr(second.descent, name)), name
    assert first.descent.steps.item() == 4 and not first.descent.success.any()


def test_restarts_are_within_the_ball_and_follow_from_the_seed(monkeypatch):
    def starts(seed: int) -> Tensor:
        drawn = []

        def recorded(*arguments, starts, **others):
            drawn.extend(starts)
            return descend(*arguments, starts=drawn, **others)

        monkeypatch.setattr(attack, "descend", recorded)
        done = attacked(f"seed={seed}", "attack.restarts=2", "attack.lighting.radius=0.02", "attack.max_steps=0")
        return torch.stack(drawn) - done.problem.start

    offsets = starts(0)
    assert offsets.shape == (2, 1, 147) and 0.01 < offsets.abs().max() <= 0.02 + 1e-6  # float32 around a light of 1
    assert torch.equal(starts(0), offsets) and not torch.equal(offsets[0], offsets[1])
    assert not torch.equal(starts(1), offsets)


# ---------------------------------------------------------------------------------------- targets


def test_least_likely_is_each_views_own_least_confidence():
    done = attacked("target=least_likely", "scene.views=2", "attack.shared=true")
    assert torch.equal(done.goal.target, done.logits_before.argmin(2))


@pytest.mark.parametrize(
    ("target", "wanted"), [("null", None), ("lime", [1, 1]), ("[sky,lime]", [2, 1]), ("[night,night]", [3, 3])]
)
def test_targets_are_one_for_all_views_or_one_each(target, wanted):
    done = attacked(
        f"target={target}", "scene.views=2", "attack.shared=true", "attack.max_steps=1", "scene.backgrounds=[0.4,0.5]"
    )
    found = done.goal.target
    assert found is None if wanted is None else found.tolist() == [wanted] * 2
    assert done.goal.source.tolist() == [[0, 0]] * 2


def test_a_target_is_reached():
    done = attacked("target=lime", "attack.max_steps=30")
    assert done.descent.success.all() and done.logits.argmax(2).item() == CLASSES.index("lime")


def test_a_class_whose_name_is_a_number_is_a_target():
    done = attacked("target=7", "attack.max_steps=1", classifier=by_color(("orange", "7", "8", "9")))
    assert done.goal.target.tolist() == [[1]]


# ---------------------------------------------------------------------------------------- bad input


REFUSED = [
    (["attack=[lighting,skylight]"], r"lighting and skylight both set the light: choose one of them"),
    (["attack.lighting.radius=-1"], r"radius=-1.0 must be at least 0"),
    (["attack.lighting.norm=l3"], r"norm=l3: choose one of linf, l2"),
    (["attack.lighting.step=long"], r"step=long: choose one of unit, raw, sign"),
    (["attack.lighting.step_size=0"], r"step_size=0.0 must be at least"),
    (["attack.restarts=2"], r"restarts draws from the norm-balls: set the radius of every parameter, or restarts=0"),
    (["attack.restarts=-1"], r"restarts=-1 must be at least 0"),
    (["attack.max_steps=-1"], r"max_steps=-1 must be at least 0"),
    (["attack.batch_size=0"], r"batch_size=0 must be at least 1"),
    (["scene.views=0"], r"views=0 must be at least 1"),
    (["scene.polar=1e30"], r"polar=1e\+30 must be at least 0 and at most 180"),
    (["scene.azimuth=inf"], r"azimuth=inf must be at least -360 and at most 360"),
    (["scene.exposure=-1"], r"exposure=-1.0 must be at least 0 and at most 100000"),
    (["scene.exposure=inf"], r"exposure=inf must be at least"),
    (["scene.exposure=1e30"], r"exposure=1e[+]30 must be at least"),
    (["scene.vertices=1000000000000"], r"vertices=1000000000000 must be at least 0 and at most"),
    (["scene.meshes=[]"], r"meshes and backgrounds must not be empty"),
    (["scene.backgrounds=[]"], r"meshes and backgrounds must not be empty"),
    (["seed=-1"], r"seed=-1 must be at least 0"),
    (["attack.max_steps=many"], r"attack.max_steps: Value 'many' of type 'str' could not be converted to Integer"),
    (["label=mango"], r"classifier=by_color: 'mango' is not a class of the model: choose one, such as "),
    (["target=mango"], r"classifier=by_color: 'mango' is not a class of the model: choose one, such as "),
    (["target=[lime,sky]"], r"target=\['lime', 'sky'\] names 2 classes for 1 views .*: give one class per view, and"),
    (["target=[lime,sky]", "scene.views=2"], r"names 2 classes for 1 views"),
    (["target=[lime]", "scene.views=2", "attack.shared=true"], r"names 1 classes for 2 views"),
    (["target=[lime,mango]", "scene.views=2", "attack.shared=true"], r"'mango' is not a class of the model"),
    (["renderer.normals=round"], r"normals=round: choose one of flat, smooth"),
    (["scene.meshes=[{mesh: 'solid:orange:0', wight: 2}]"], r"scene.meshes\[0\]"),
    (["scene.meshes=[absent.glb]"], r"absent.glb"),
    (["scene.light=moon"], r"light 'moon' is not known"),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED, ids=[" ".join(row[0]) for row in REFUSED])
def test_bad_input_is_refused_in_one_sentence(overrides, message):
    with pytest.raises(InputError, match=message) as refused:
        attacked(*overrides)
    assert "\n" not in str(refused.value)


def test_an_attack_on_nothing_is_refused():
    with pytest.raises(InputError, match="attack: name what to change, such as attack=lighting; there are lighting, "):
        configured("attack=[]").attack.require_parameters()


def test_a_mesh_may_name_its_own_class():
    item = read_object({"mesh": "solid:orange:0", "label": "lime", "albedo_scale": 2.0}, "orange", 0)
    assert (item.mesh, item.label, item.albedo_scale) == ("solid:orange:0", "lime", 2.0)
    assert read_object("solid:orange:0", "sky", 0).label == "sky"


@pytest.mark.parametrize("item", [{"label": "orange"}, {"mesh": "solid:orange", "wight": 1}, None, ["a"]])
def test_a_mesh_that_is_none_is_refused_by_its_place(item):
    with pytest.raises(InputError, match=r"scene\.meshes\[3\]"):
        read_object(item, "orange", 3)


BESIDE = [
    ([{"mesh": "solid:cup"}], r"scene.meshes\[3\].props\[0\].at is not set: give scene.meshes\[3\].props\[0\].at="),
    ([{"mesh": "solid:cup", "at": [1]}], r"meshes\[3\].props\[0\].at: at=\[1.0\] must be x and y"),
    ([{"mesh": "solid:cup", "at": [0, float("nan")]}], r"at=\[0.0, nan\] must be x and y from -10 to 10"),
    ([{"mesh": "solid:cup", "at": [0, 1], "scale": 0}], "scale=0.0 must be at least 0.1"),
    ([{"mesh": "solid:cup", "at": [0, 1], "albedo_scale": 2}], r"meshes\[3\].props: Key 'albedo_scale' not in"),
    (["solid:cup"], r"meshes\[3\].props: Invalid type"),
    (None, r"meshes\[3\].props: field 'props' is not Optional"),
]


@pytest.mark.parametrize(("props", "message"), BESIDE)
def test_what_cannot_stand_beside_a_mesh_is_refused(props, message):
    with pytest.raises(InputError, match=message):
        read_object({"mesh": "solid:apple", "props": props}, "orange", 3)


def test_a_mesh_that_is_not_recognized_is_refused_with_the_best_answers_unless_forced():
    """Of six classes the five best are told, best first, with their shares."""
    bias = torch.tensor([0.0, 5, 4, 3, 2, 1])
    deaf = Classifier(lambda images: images.sum() * 0 + bias.expand(len(images), -1), SIZE, ("orange", *"abcde"))
    shares = bias.softmax(0)
    best = ", ".join(f"{name} {share:.1%}" for name, share in zip("abcde", shares[1:].tolist(), strict=True))
    with pytest.raises(InputError) as refused:
        attacked("scene.views=2", classifier=deaf)
    assert str(refused.value) == (
        f"2 of 2 images of solid:orange:0 are not recognized as 'orange' before any attack (the first: {best}): "
        "change the scene, or set force=true"
    )
    done = attacked("scene.views=2", "attack.force=true", "attack.max_steps=1", classifier=deaf)
    assert done.descent.success_before.all() and not done.descent.steps.any()
    assert done.descent.zero_gradient.all()
    assert format_attack("mesh", done, None).startswith("mesh: lighting against callable: none of 2 examples was")
    found = augment.check(done)
    assert (found.success, found.random_search, set(found.success_by_steps.values())) == (0, 0, {0})


def test_success_is_counted_among_what_was_recognized_before():
    """Before the dark background the image is not recognized; wrong as it is, it is nothing that the attack did."""
    dark = Classifier(sky_in_the_dark, SIZE, CLASSES[:3])
    done = attacked("scene.backgrounds=[0.5,0.0]", "attack.force=true", "attack.max_steps=30", classifier=dark)
    assert done.clean_correct.tolist() == [True, False] and done.success.tolist() == [True, True]
    assert "success on 1 of 1 [21%, 100%] examples; 1 wrong before, which do not count" in format_attack(
        "mesh", done, None
    )


def test_views_that_share_a_light_are_counted_one_by_one_too():
    """No light makes the image before it both green and blue, so that of two views with a target each one remains."""
    done = attacked("target=[lime,sky]", "scene.views=2", "attack.shared=true", "attack.max_steps=30")
    assert done.success_in_views.shape == (1, 2)
    views = int(done.success_in_views.sum())
    assert f"{int(done.success)} of 1 [" in (text := format_attack("mesh", done, None))
    assert f", {views} of 2 views" in text


def test_the_ring_of_views_begins_at_the_azimuth():
    done = attacked("scene.views=2", "scene.azimuth=30", "attack.max_steps=0")
    assert [camera.azimuth for (camera,) in done.problem.scene.cameras] == pytest.approx([math.pi / 6, 7 * math.pi / 6])


@pytest.mark.parametrize("kind", ["projector", "lamps"])
def test_what_is_attacked_stands_in_the_scene_without_being_named(kind):
    alone, bare = attacked(f"attack={kind}"), attacked("attack=lighting")
    assert len(alone.problem.scene.lights[0]) > len(bare.problem.scene.lights[0])
    assert torch.equal(alone.images, attacked(f"attack={kind}", f"scene.{kind}={{}}").images)


# ---------------------------------------------------------------------------------------- checks


def test_checks_see_that_the_cost_falls_and_that_more_steps_fool_more():
    done = attacked("attack.max_steps=3", "scene.backgrounds=[0.3,0.5,0.7]", "attack.lighting.step_size=0.1")
    found = augment.check(done)
    assert found.cost_before == pytest.approx(float(done.descent.cost_before.mean()))
    assert found.cost == pytest.approx(float(done.descent.cost.mean())) and found.cost < found.cost_before
    assert found.cost_fell == 1 and found.zero_gradient == 0 and 0 <= found.random_search <= 1
    shares = list(found.success_by_steps.values())
    assert list(found.success_by_steps) == [3, 9, 30]
    # A longer descent repeats the shorter one: nothing here is drawn.
    assert shares == sorted(shares) and shares[0] == found.success < shares[-1] == 1
    assert found == augment.check(done)


def test_checks_count_what_fools_within_the_steps_also_where_a_margin_sends_it_on():
    done = attacked(
        "attack.max_steps=3", "attack.margin=100", "attack.allow_negative=true", "attack.lighting.step_size=0.2"
    )
    found = augment.check(done)
    assert found.success == 1 and found.success_by_steps == {3: 1, 9: 1, 30: 1}


def test_random_search_that_does_as_well_is_a_warning():
    """Any change fools a classifier that knows no image but one of almost exactly this brightness."""
    brightness, width = attacked("attack.max_steps=0").images_before.mean(), 1e-4

    def narrow(images: Tensor) -> Tensor:
        margin = width - (images.mean((1, 2, 3)) - brightness - width / 2).abs()
        return torch.stack([margin, 0 * margin], dim=1)

    network = Classifier(narrow, SIZE, CLASSES[:2])
    done = attacked("attack.lighting.radius=0.1", "attack.max_steps=8", classifier=network)
    found = augment.check(done)
    assert not done.descent.success_before.any() and found.success == found.random_search == 1
    assert found.warnings == ["random search does as well or better"]


NOTHING_TO_SAY = Checks(2.0, -1.0, 1.0, 0.0, 0.8, 0.5, {3: 0.8, 9: 0.9, 30: 1.0})


@pytest.mark.parametrize(
    ("changes", "warning"),
    [
        ({}, None),
        ({"random_search": 0.8}, "random search does as well or better"),
        ({"random_search": 0.9}, "random search does as well or better"),
        ({"random_search": 0.0, "success": 0.0}, None),
        ({"cost_fell": 0.9}, "the cost rose in some examples"),
        ({"zero_gradient": 0.1}, "some first gradients are exactly zero"),
    ],
)
def test_warnings_follow_from_the_numbers_and_are_printed(changes, warning):
    found = replace(NOTHING_TO_SAY, **changes)
    assert found.warnings == ([warning] if warning else [])
    done = attacked("attack.max_steps=1")
    text = format_attack("mesh", done, found)
    assert [line for line in text.splitlines() if "warning" in line] == ([f"warning: {warning}"] if warning else [])
    assert "80% in 3, 90% in 9, 100% in 30 steps" in text
    assert len(format_attack("mesh", done, None).splitlines()) == 1
