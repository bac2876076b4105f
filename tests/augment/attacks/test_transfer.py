import math
from dataclasses import replace

import pytest
import torch

import augment
from augment.attacks.attack import AttackResult
from augment.attacks.norm_ball import StepSettings
from renderer.errors import InputError

CLASSES, SIZE = ("orange", "lime", "sky"), 12
LIGHT = StepSettings(step_size=0.2)


def network(classes: tuple[str, ...] = CLASSES, size: int = SIZE) -> augment.Classifier:
    """The brightest channel of the mean color, whatever the order of the classes."""
    order = [CLASSES.index(name) for name in classes]
    return augment.Classifier(lambda images: 30 * images.mean((2, 3))[:, order], size, classes, f"{classes[0]}{size}")


def attacked(criterion=None, **kinds: StepSettings) -> AttackResult:
    """Of two views, each an example, before gray."""
    scene = augment.build_scene(
        [("solid:orange", "orange")], SIZE, 2, backgrounds=[0.4], light="st_peters", exposure=0.5
    )
    settings = augment.AttackSettings(**kinds, allow_negative=True, margin=0.0, rounded=False, max_steps=20)
    found = augment.attack(network(), scene, criterion, settings)
    assert found.success.all()
    return found


KINDS = {
    "lighting": LIGHT,
    "geometry": StepSettings("linf", 0.05, "sign", 0.01),
    "albedo": StepSettings("linf", 0.5, "sign", 0.1),
    "pixels": StepSettings("linf", 0.3, "sign", 0.05),
}


@pytest.mark.parametrize("kinds", [["lighting"], ["geometry", "albedo", "lighting"], ["pixels"]])
def test_where_nothing_is_another_the_answers_are_the_same(kinds):
    done = attacked(**{kind: KINDS[kind] for kind in kinds})
    (found,) = augment.transfer(done, [network()])
    torch.testing.assert_close(found.before, done.logits_before, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.after, done.logits, rtol=0, atol=1e-4)
    assert found.clean_correct.all() and found.success.all() and found.kind == "network"


def test_another_network_sees_a_render_at_its_size_and_has_its_own_order_of_classes():
    done = attacked(criterion=augment.Targeted("sky"), lighting=LIGHT)
    (found,) = augment.transfer(done, [network(("sky", "orange", "lime"), size=3 * SIZE)])
    assert (found.after.argmax(2) == 0).all() and found.clean_correct.all() and found.success.all()
    finer = augment.build_scene([("solid:orange", "orange")], 3 * SIZE, 2, backgrounds=[0.4])
    images = finer.render(done.conditions, torch.arange(2))
    torch.testing.assert_close(found.after, network(found.classes, 3 * SIZE)(images[:, 0])[:, None], rtol=0, atol=1e-4)
    with pytest.raises(InputError, match="'sky' is not a class of the model"):
        augment.transfer(done, [network(("orange", "lime"))])


def test_other_sides_and_other_meshes_are_those_of_a_scene_with_them():
    done = attacked(lighting=LIGHT)
    apple = augment.build_scene([("solid:apple", "lime")], SIZE, 2, backgrounds=[0.4])
    turned, other = augment.transfer(done, azimuths=[-30.0], objects=apple.objects)
    assert (turned.kind, turned.name, other.kind) == ("azimuth", "-30°", "mesh")
    scene = done.problem.scene
    cameras = [replace(row.cameras[0], azimuth=row.cameras[0].azimuth - math.pi / 6) for row in scene.examples]
    rows = [replace(row, cameras=(camera,)) for row, camera in zip(scene.examples, cameras, strict=True)]
    for found, shown in ((turned, replace(scene, examples=rows)), (other, apple)):
        logits = network()(shown.render(done.conditions, torch.arange(2))[:, 0])[:, None]
        torch.testing.assert_close(found.after, logits, rtol=0, atol=1e-4)
    assert not other.clean_correct.any()  # a lime by its label, and none by its color


def test_only_what_was_recognized_and_then_fooled_is_shown():
    done = attacked(lighting=LIGHT)
    before = done.logits_before.clone()
    before[0] = -before[0]  # as if the first had been taken for something else
    (found,) = augment.transfer(replace(done, logits_before=before), [network()])
    torch.testing.assert_close(found.after, done.logits[1:], rtol=0, atol=1e-4)
    (none,) = augment.transfer(replace(done, logits_before=-done.logits_before), [network()])
    assert none.after.shape == (0, 1, 3) and not len(none.success)
