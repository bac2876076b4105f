import math

import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import ConcatDataset, DataLoader

from augment.attacks.norm_ball import StepSettings
from augment.backgrounds import load_backgrounds
from augment.losses import complementary_label
from augment.objects import ObjectSettings, load_object
from augment.scene import Conditions, Scene
from augment.service import AugmentationService, AugmentationSettings, RandomLightSettings, TrainingAttackSettings
from augment.utils import Phases
from augment.variation import VariationSettings
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.image import ImageSettings
from renderer.light.presets import probe
from renderer.rasterizer import choose
from renderer.shapes import solid

EPS32 = torch.finfo(torch.float32).eps
LIGHT = probe("grace")
CLASSES = {"plate": 0, "table": 2}
SHORT = TrainingAttackSettings(max_steps=5)
FRACTIONS = {"attack_success_before", "attack_success", "used_all_steps", "zero_gradient"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The paper's 2 meshes × 10 views × 5 backgrounds, small."""
    settings = ImageSettings(size=8, samples=2)
    objects = [load_object(ObjectSettings(f"solid:{name}", name)) for name in CLASSES]
    behind = load_backgrounds([0, 0.25, 0.5, 0.75, 1], settings.size)
    return Scene.grid(objects, orbit_cameras(10, 2.0), behind, LIGHT, settings, choose("numpy"))


def render(scene: Scene, lights: Tensor) -> Tensor:
    return scene.render(Conditions(lights), torch.arange(len(scene)))[:, 0]


@pytest.fixture(scope="module")
def labels(scene) -> Tensor:
    return torch.tensor([CLASSES[label] for label in scene.labels])


@pytest.fixture(scope="module")
def model(scene, labels) -> nn.Module:
    """A small network that has learned the two solids in the initial light, so that an attack can succeed."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Sequential(
            nn.Conv2d(3, 16, 3, padding=1),
            nn.BatchNorm2d(16),
            nn.ReLU(),
            nn.Dropout(0.1),
            nn.Flatten(),
            nn.Linear(1024, 3),
        )
        optimizer = torch.optim.Adam(network.parameters(), lr=0.003)
        images = render(scene, LIGHT.expand(100, -1, -1))
        for _ in range(60):
            optimizer.zero_grad()
            nn.functional.cross_entropy(network(images), labels).backward()
            optimizer.step()
    return network


@pytest.fixture
def serve(scene, labels):
    def service(seed: int = 0, phases: Phases | None = None, **settings) -> AugmentationService:
        choices = AugmentationSettings(**{"attack": SHORT, **settings})
        return AugmentationService(choices, scene, labels, seed, phases or Phases())

    return service


@pytest.mark.parametrize("settings", [{"arm": "none"}, {"arm": "random", "examples": 0}, {"examples": 0}])
def test_without_an_arm_or_examples_the_batch_is_empty(serve, model, settings):
    renders = serve(**settings).regenerate(model, 0)
    assert len(renders.images) == len(renders.labels) == 0 and renders.diagnostics == {}
    choices = AugmentationSettings(**settings)
    assert not choices.renders
    service = AugmentationService(choices, None, torch.zeros(0, dtype=torch.int64), 0, Phases())
    assert len(service.regenerate(model, 0).labels) == 0


@pytest.mark.parametrize("arm", ["random", "adversarial"])
def test_renders_come_with_labels_and_finite_diagnostics(serve, model, scene, arm):
    phases = Phases()
    renders = serve(arm=arm, phases=phases).regenerate(model, 0)
    assert renders.images.shape == (100, 3, 8, 8) and not renders.images.requires_grad
    assert renders.images.min() >= 0 and renders.images.max() <= 1
    assert [CLASSES[name] for name in scene.labels] == renders.labels.tolist()
    assert renders.labels.dtype == torch.int64
    assert all(type(value) is float and math.isfinite(value) for value in renders.diagnostics.values())
    assert all(0 <= renders.diagnostics[name] <= 1 for name in FRACTIONS & renders.diagnostics.keys())
    assert renders.diagnostics["light_change"] > 0
    assert phases.take().keys() == {"attack_classifier"}


@pytest.mark.parametrize("settings", [{"arm": "random"}, {"arm": "adversarial", "init": "random"}])
def test_the_seed_and_the_epoch_decide_the_draw(serve, model, settings):
    images = serve(seed=1, **settings).regenerate(model, 3).images
    resumed = serve(seed=1, **settings)
    resumed.regenerate(model, 2)
    torch.rand(5)
    torch.testing.assert_close(resumed.regenerate(model, 3).images, images, rtol=0, atol=0)
    assert (resumed.regenerate(model, 4).images != images).any()
    assert (serve(seed=2, **settings).regenerate(model, 3).images != images).any()


def test_random_light_has_its_norm_and_diagnostics_of_its_images(serve, model):
    renders = serve(arm="random").regenerate(model, 0)
    model.eval()
    with torch.no_grad():
        logits = model(renders.images)
    model.train()
    assert renders.diagnostics["attack_success"] == pytest.approx((logits.argmax(1) != renders.labels).double().mean())
    loss = nn.functional.cross_entropy(logits.double(), renders.labels)
    assert renders.diagnostics["loss"] == pytest.approx(float(loss), rel=100 * EPS32)
    # ±0.5 on 147 coefficients: a norm of 3.5, with a standard deviation of 0.13 that 100 examples bring to 0.013.
    assert renders.diagnostics["light_change"] == pytest.approx(math.sqrt(147 / 12), abs=5 * 0.013)
    renders = serve(arm="random", random_light=RandomLightSettings(radius=1.5)).regenerate(model, 0)
    assert renders.diagnostics["light_change"] == pytest.approx(1.5, rel=8 * EPS32)


def attacked_by_hand(model: nn.Module, scene: Scene, labels: Tensor, step: str, steps: int) -> dict[str, Tensor]:
    """The paper's loop spelt out, with every example looked at in every step."""
    lights, steps_taken, was_training = LIGHT.repeat(len(scene), 1, 1), torch.zeros_like(labels), model.training
    model.eval()
    for index in range(steps + 1):
        lights.requires_grad_(True)
        images = render(scene, lights)
        logits = model(images)
        losses, success = nn.functional.cross_entropy(logits, labels, reduction="none"), logits.argmax(1) != labels
        if index == 0:
            before = {"attack_success_before": success, "loss_before": losses.detach()}
        if index == steps:
            break
        (uphill,) = torch.autograd.grad(losses.sum(), lights)
        move = uphill.sign() if step == "sign" else uphill / uphill.flatten(1).norm(dim=1)[:, None, None]
        lights = torch.where(success[:, None, None], lights, lights + 0.05 * move).detach()
        steps_taken += ~success
    model.train(was_training)
    after = {
        "attack_success": success,
        "loss": losses.detach(),
        "steps": steps_taken,
        "used_all_steps": steps_taken == steps,
    }
    return (
        before | after | {"images": images.detach(), "light_change": (lights - LIGHT).detach().flatten(1).norm(dim=1)}
    )


@pytest.mark.parametrize("step", ["unit", "sign"])
def test_adversarial_images_are_those_of_the_papers_loop(serve, model, scene, labels, step):
    renders = serve(attack=TrainingAttackSettings(step=step, max_steps=10, batch_size=32)).regenerate(model, 0)
    expected = attacked_by_hand(model, scene, labels, step, steps=10)
    # Ten steps of products in float32 in another order, through a network that amplifies their rounding.
    torch.testing.assert_close(renders.images, expected.pop("images"), rtol=0, atol=10 * 64 * EPS32)
    for name, values in expected.items():
        assert renders.diagnostics[name] == pytest.approx(float(values.double().mean()), rel=1e-4), name
    assert 0 < renders.diagnostics["attack_success"] < 1 and renders.diagnostics["zero_gradient"] == 0


@pytest.mark.parametrize("init", ["scene", "random"])
def test_a_warm_start_continues_the_last_attack_also_after_a_resume(serve, model, init):
    service = serve(warm_start=True, init=init)
    first = service.regenerate(model, 0)
    state = {name: value.clone() for name, value in service.state_dict().items()}
    second = service.regenerate(model, 1)
    assert second.diagnostics["loss_before"] == pytest.approx(first.diagnostics["loss"], rel=8 * EPS32)
    assert second.diagnostics["attack_success_before"] == first.diagnostics["attack_success"]
    assert second.diagnostics["loss"] > first.diagnostics["loss"]

    resumed = serve(warm_start=True, init=init)
    resumed.load_state_dict(state)
    torch.testing.assert_close(resumed.regenerate(model, 1).images, second.images, rtol=0, atol=0)


def test_a_checkpoint_of_another_number_of_examples_is_refused(serve):
    with pytest.raises(InputError, match=r"the checkpoint continues 3 examples and the scene has"):
        serve(warm_start=True).load_state_dict({"values": torch.zeros(3, 147)})


@pytest.mark.parametrize("arm", ["random", "adversarial"])
def test_a_label_beyond_the_classes_of_the_network_is_refused(model, arm):
    settings = AugmentationSettings(arm)
    service = AugmentationService.from_meshes([("solid:plate", 53)], 8, settings, views=1, backgrounds=[0.5])
    with pytest.raises(InputError, match=r"label=53 must be at least 0 and at most \d"):
        service.regenerate(model, 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AugmentationSettings(arm="both"), "arm=both: choose one of none, random, adversarial"),
        (lambda: AugmentationSettings(init="dark"), "init=dark: choose one of scene, random"),
        (lambda: AugmentationSettings(examples=-1), "examples=-1"),
        (
            lambda: AugmentationSettings(warm_start=True, vary=VariationSettings(instances=True)),
            "warm_start=True keeps",
        ),
        (
            lambda: AugmentationSettings("random", attack=TrainingAttackSettings(geometry=StepSettings())),
            "geometry.radius is None",
        ),
        (lambda: RandomLightSettings(amplitude=math.nan), "amplitude=nan"),
        (lambda: RandomLightSettings(radius=0.0), "radius=0.0"),
        (lambda: AugmentationService(AugmentationSettings(), None, torch.zeros(0), 0, Phases()), "give a scene"),
    ],
)
def test_settings_that_are_out_of_range_or_contradict_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


SHAPE_AND_ALBEDO = {
    "geometry": StepSettings("linf", 0.02, "sign", 0.01),
    "albedo": StepSettings("linf", 0.1, "sign", 0.05),
}


@pytest.fixture(scope="module")
def few() -> tuple[Scene, Tensor]:
    """Both meshes from one view over one gray, since shapes are rasterized in every step."""
    settings = ImageSettings(size=8, samples=2)
    objects = [load_object(ObjectSettings(f"solid:{name}", name)) for name in CLASSES]
    scene = Scene.grid(objects, orbit_cameras(1, 2.0), load_backgrounds([0.5], 8), LIGHT, settings, choose("numpy"))
    return scene, torch.tensor(list(CLASSES.values()))


@pytest.mark.parametrize("arm", ["random", "adversarial"])
def test_both_arms_change_shape_and_albedo_within_their_norm_balls(few, model, arm):
    """The random arm draws from the same balls."""
    settings = AugmentationSettings(
        arm=arm, examples=2, attack=TrainingAttackSettings(**SHAPE_AND_ALBEDO, max_steps=2, shorten=True)
    )
    service = AugmentationService(settings, *few, 0, Phases())
    first, again = (service.regenerate(model, 0) for _ in range(2))
    assert first.images.shape == (2, 3, 8, 8) and torch.equal(first.images, again.images)
    found, values = first.diagnostics, 3 * max(len(item.mesh.vertices) for item in few[0].objects)
    assert 0 < found["vertices_change"] <= 0.02 * values**0.5 and found["albedo_change"] > 0
    assert found["light_change"] == 0
    if arm == "adversarial":
        assert found["loss"] > found["loss_before"]


def test_a_service_works_in_any_loop_and_its_renders_are_a_data_set(model, monkeypatch, tmp_path):
    """Built from meshes, label indices and a size; its renders equal those of a service around the same scene."""
    monkeypatch.chdir(tmp_path)
    meshes = [("solid:plate", 0), (solid("table"), 2)]
    attack = TrainingAttackSettings(max_steps=2)
    settings = AugmentationSettings(warm_start=True, attack=attack)
    choices = dict(views=2, backgrounds=[0.25, 0.75], samples=2, rasterizer="numpy")
    service = AugmentationService.from_meshes(meshes, 8, settings, **choices)
    renders = service.regenerate(model, 0)
    assert renders.labels.tolist() == [0] * 4 + [2] * 4 and len(service) == len(renders) == 8

    objects = [load_object(ObjectSettings(f"solid:{name}", name)) for name in ("plate", "table")]
    image, behind = ImageSettings(size=8, samples=2), load_backgrounds([0.25, 0.75], 8)
    scene = Scene.grid(objects, orbit_cameras(2, 2.0), behind, LIGHT, image, choose("numpy"))
    same = AugmentationService(AugmentationSettings(examples=8, attack=attack), scene, renders.labels, 0, Phases())
    assert torch.equal(same.regenerate(model, 0).images, renders.images)

    data = ConcatDataset([[(torch.zeros(3, 8, 8), 0)] * 5, renders])
    images, labels = next(iter(DataLoader(data, batch_size=13)))
    assert torch.equal(images[5:], renders.images) and labels.tolist() == [0] * 5 + renders.labels.tolist()

    resumed = AugmentationService.from_meshes(meshes, 8, settings, **choices)
    resumed.load_state_dict(service.state_dict())
    assert torch.equal(resumed.regenerate(model, 1).images, service.regenerate(model, 1).images)
    assert list(tmp_path.iterdir()) == []


def test_hard_negatives_are_attacked_towards_the_label_and_the_label_away_from_it(serve, scene, model, labels):
    """Tables are complementary to a plate: there every step raises the plate's probability."""
    other = torch.where(labels == 0, labels, complementary_label(0))
    service = AugmentationService(AugmentationSettings(attack=SHORT), scene, other, 0, Phases(), label=0)
    renders = service.regenerate(model, 0)
    model.eval()
    with torch.no_grad():
        before, after = (
            model(images).softmax(1)[:, 0] for images in (render(scene, LIGHT.expand(100, -1, -1)), renders.images)
        )
    model.train()
    rises = torch.where(labels == 0, before - after, after - before)
    assert (rises >= -1e-5).all() and (rises[labels == 0] > 0).any() and (rises[labels != 0] > 0).any()
    assert torch.equal(renders.labels, other)


def test_an_attack_on_a_hard_negative_with_a_class_succeeds_only_as_the_label(scene, labels, model):
    service = AugmentationService(AugmentationSettings(attack=SHORT), scene, labels, 0, Phases(), label=0)
    result = service.regenerate(model, 0)
    model.eval()
    with torch.no_grad():
        predicted = model(result.images).argmax(1)
    model.train()
    success = torch.where(labels == 0, predicted != 0, predicted == 0)
    assert result.diagnostics["attack_success"] == pytest.approx(success.double().mean())


def test_attack_examples_are_new_successes_before_and_after(scene, labels, model):
    service = AugmentationService(
        AugmentationSettings(attack=TrainingAttackSettings(max_steps=30, step_size=0.5)), scene, labels, 0, Phases()
    )
    renders = service.regenerate(model, 0)
    found = renders.attack_examples
    assert renders.diagnostics["attack_success"] > renders.diagnostics["attack_success_before"] and 0 < len(found) <= 4
    assert (found.predictions_before.argmax(1) == found.labels).all() and (
        found.predictions.argmax(1) != found.labels
    ).all()
    assert torch.equal(found.lights_before, LIGHT.expand(len(found), -1, -1))
    for images, lights, predictions in [
        (found.images_before, found.lights_before, found.predictions_before),
        (found.images, found.lights, found.predictions),
    ]:
        everything = [render(scene, light.expand(len(scene), -1, -1)) for light in lights]
        gaps = [(image - shown).flatten(1).abs().amax(1).min() for image, shown in zip(images, everything, strict=True)]
        assert max(gaps) < 100 * EPS32
        with torch.no_grad():
            torch.testing.assert_close(predictions, model.eval()(images).softmax(1))
