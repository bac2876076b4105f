from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from oracles import draw
from torch import Tensor

import norm_balls as nb
from augment.scene.truth import Truth, boxes_of

SIZE = 12
MASK = torch.zeros(SIZE, SIZE, dtype=torch.bool)
MASK[2:9, 3:8] = True
MASK[2, 3] = False


def criterion(iou: float = 0.5):
    masks = MASK.view(1, 1, 1, SIZE, SIZE)
    truth = Truth(torch.ones(1, 1, 1).long(), boxes_of(masks), masks, torch.ones(1, 1, 1))
    rule = nb.Segmentation(iou).criterion(torch.tensor([[1]]), lambda: truth, 3)
    return rule.map(lambda rows: rows.flatten(0, 1))


def test_a_success_is_an_iou_within_the_box_below_the_limit():
    outcomes = set()
    for seed in range(100):
        draws = torch.Generator().manual_seed(seed)
        logits = torch.randn(1, 3, SIZE, SIZE, generator=draws)
        # The class of the object reaches beyond the box, too, which does not count.
        logits[:, 1] += 4 * torch.rand((), generator=draws)
        is_class = (logits.argmax(1)[0] == 1)[2:9, 3:8]
        mask = MASK[2:9, 3:8]
        ratio = float((is_class & mask).sum() / (is_class | mask).sum())
        rule = criterion()
        evidence = rule.evidence(logits)
        assert float(rule.task.confidences(evidence)[0, 1]) == pytest.approx(ratio, abs=1e-5)
        reached = bool(rule.reached_in_views(rule.predicted(evidence)))
        assert reached == (ratio < 0.5)
        outcomes.add(reached)
    assert outcomes == {True, False}


def test_an_object_that_leaves_the_view_is_no_success():
    empty = torch.zeros(1, 1, 1, SIZE, SIZE, dtype=torch.bool)
    gone = Truth(torch.zeros(1, 1), torch.zeros(1, 1, 4), empty[0], torch.ones(1, 1))
    rule = criterion().at(gone)
    for label in range(3):
        logits = 9 * F.one_hot(torch.full((1, SIZE, SIZE), label), 3).movedim(-1, 1).double()
        assert not rule.reached_in_views(rule.predicted(rule.evidence(logits)))


def test_the_gradient_of_the_cost_is_that_of_finite_differences():
    logits = draw(1, 3, SIZE, SIZE).requires_grad_()
    assert torch.autograd.gradcheck(criterion().cost, logits)


def bright(images: Tensor) -> Tensor:
    mean = images.mean(1)
    return torch.stack([0 * mean + 0.15, mean], dim=1)


@pytest.mark.parametrize("wrap", [lambda logits: logits, lambda logits: {"out": logits}])
def test_an_attack_darkens_an_object_until_its_segment_is_lost(wrap):
    scene = nb.build_scene([("solid:ball", "ball")], size=SIZE, backgrounds=[0.0])
    light = nb.StepSettings(step_size=0.3)
    options = {"settings": nb.AttackSettings(lighting=light, max_steps=60, margin=0.1)}
    options["classes"] = ["dark", "ball"]
    result = nb.attack(lambda images: wrap(bright(images)), scene, **options)
    mask = scene.truth(lambda label: 1).masks[0, 0, 0]
    kept = (result.images[0].mean(0) > 0.15) & mask
    assert result.clean_correct.all() and result.success.all()
    assert kept.sum() < 0.5 * mask.sum()
    nothing = replace(result, evidence_in_views_before=-result.evidence_in_views_before)
    assert nb.transfer(nothing, [result.classifier])[0]["success"] == []


def test_an_attack_on_different_numbers_of_objects_transfers_to_its_own_network():
    alone, beside = (nb.ObjectSettings("solid:ball", "ball", at=at) for at in (None, [0.0, 2.1]))
    scene = nb.build_scene([[alone, beside], alone], SIZE, backgrounds=[0.0], width=3.0)
    light = nb.StepSettings(step_size=0.3)
    options = {"settings": nb.AttackSettings(lighting=light, max_steps=60, margin=0.1)}
    result = nb.attack(bright, scene, **options, classes=["dark", "ball"])
    [row] = nb.transfer(result, [result.classifier])
    assert row["success"] == result.success.tolist() == [True, True]


@pytest.mark.parametrize("shape", [(1, 2, SIZE, SIZE), (2, 3, SIZE, SIZE), (1, 3, 6, 12), (1, 3)])
def test_logits_of_another_size_are_refused(shape):
    reader = nb.Segmentation().reader("network", 3)
    with pytest.raises(nb.InputError, match=r"must return logits \(1, 3, 12, 12\)"):
        reader(torch.zeros(shape), torch.zeros(1, 3, SIZE, SIZE))


def test_a_single_logit_is_refused_because_its_class_would_be_everywhere():
    with pytest.raises(nb.InputError, match=r"must return logits \(1, 2, 12, 12\)"):
        nb.Segmentation().reader("network")(torch.zeros(1, 1, 12, 12), torch.zeros(1, 3, 12, 12))


def test_the_probabilities_of_queries_are_enlarged_and_not_their_logarithms():
    masks = 60 * torch.arange(60.0).view(1, 5, 3, 4).sin()
    classes = torch.arange(20.0).view(1, 5, 4).sin()
    outputs = SimpleNamespace(masks_queries_logits=masks, class_queries_logits=classes)
    read = nb.Segmentation().reader("network")(outputs, torch.zeros(1, 3, SIZE, SIZE))
    scores = classes.softmax(2)[0, :, :3].T @ masks.sigmoid()[0].flatten(1)
    expected = F.interpolate(scores.view(1, 3, 3, 4), (SIZE, SIZE), mode="bilinear")
    torch.testing.assert_close(read.exp(), expected)
