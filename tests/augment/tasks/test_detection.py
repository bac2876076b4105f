from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torchvision.ops import batched_nms, box_iou

import norm_balls as nb
from augment.attack_settings import PoseSettings
from augment.classifier import as_network
from augment.scene.truth import Truth
from tests.detectors import small_detector

SIZE = 16
TRUE_BOX = torch.tensor([2.0, 3.0, 10.0, 12.0])
CLASSES = ["ball", "cup", "lamp"]


def criterion(source: int = 0, target: int | None = None, box: Tensor = TRUE_BOX, **options):
    masks = torch.zeros(1, 1, 1, SIZE, SIZE, dtype=torch.bool)
    truth = Truth(torch.tensor([[[source]]]), box.view(1, 1, 1, 4), masks, torch.ones(1, 1, 1))
    task = nb.Detection(**options)
    found = task.criterion(torch.tensor([[source]]), lambda: truth, len(CLASSES))
    if target is not None:
        found = replace(found, target=torch.tensor([[target]]))
    return found.map(lambda rows: rows.flatten(0, 1))


def drawn_boxes(seed: int) -> dict[str, Tensor]:
    draws = torch.Generator().manual_seed(seed)
    boxes = TRUE_BOX + 3 * torch.randn(8, 4, generator=draws)
    boxes = torch.cat([boxes[:, :2].minimum(boxes[:, 2:]), boxes[:, :2].maximum(boxes[:, 2:])], 1)
    labels = torch.randint(3, (8,), generator=draws)
    return {"boxes": boxes, "labels": labels, "scores": torch.rand(8, generator=draws)}


@pytest.mark.parametrize("goal", ["hide", "mislabel"])
def test_a_success_is_that_of_the_definition(goal):
    outcomes = set()
    for seed in range(200):
        item = drawn_boxes(seed)
        counts = (item["scores"] >= 0.4) & (box_iou(item["boxes"], TRUE_BOX[None])[:, 0] >= 0.5)
        own = item["scores"][counts & (item["labels"] == 0)]
        other = item["scores"][counts & (item["labels"] != 0)]
        expected = not len(own)
        if goal == "mislabel":
            expected = len(other) > 0 and (not len(own) or bool(other.max() > own.max()))
        rule = criterion(goal=goal)
        evidence = rule.evidence([item])
        reached = bool(rule.reached_in_views(rule.predicted(evidence)))
        assert reached == expected
        assert bool(rule.gap(evidence) > 0) == expected
        was_found = len(own) > 0 and (goal == "hide" or not expected)
        assert bool(rule.predicted(evidence) == 0) == was_found
        outcomes.add(expected)
    assert outcomes == {True, False}


def test_a_score_at_the_threshold_counts_and_one_below_does_not():
    item = {"boxes": TRUE_BOX[None], "labels": torch.tensor([0]), "scores": torch.tensor([0.4])}
    rule = criterion()
    assert rule.predicted(rule.evidence([item])) == 0
    below = item | {"scores": torch.tensor([0.4]).nextafter(torch.tensor(0.0))}
    assert rule.predicted(rule.evidence([below])) == len(CLASSES)


def test_a_target_is_reached_by_its_own_box_alone():
    item = {"boxes": TRUE_BOX.expand(2, 4), "labels": torch.tensor([1, 0])}
    item["scores"] = torch.tensor([0.9, 0.5])
    for target, expected in ((1, True), (2, False)):
        rule = criterion(target=target, goal="mislabel")
        evidence = rule.evidence([item])
        assert bool(rule.reached_in_views(rule.predicted(evidence))) == expected
        assert bool(rule.gap(evidence) > 0) == expected


def test_an_object_that_leaves_the_view_is_no_success():
    rule = criterion(box=TRUE_BOX)
    gone = Truth(torch.zeros(1, 1), torch.zeros(1, 1, 4), torch.zeros(1, 1, 1, 1), torch.ones(1, 1))
    rule = rule.at(gone)
    empty = {"boxes": torch.zeros(0, 4), "labels": torch.zeros(0).long(), "scores": torch.zeros(0)}
    assert rule.predicted(rule.evidence([empty])) == 0


def test_the_cost_is_the_log_sum_of_the_odds_of_candidates_near_the_object():
    item = drawn_boxes(1)
    is_near = box_iou(item["boxes"], TRUE_BOX[None])[:, 0] >= 0.25
    odds = (item["scores"] / (1 - item["scores"]))[is_near & (item["labels"] == 0)]
    assert len(odds) > 1
    torch.testing.assert_close(criterion().cost([item])[0], odds.sum().log(), rtol=0, atol=2e-5)


def test_decoded_boxes_pass_class_wise_suppression():
    draws = torch.Generator().manual_seed(2)
    corners = 8 * torch.rand(30, 2, generator=draws)
    boxes = torch.cat([corners, corners + 6], dim=1)
    scores = torch.rand(30, 3, generator=draws)
    task = nb.Detection(decode=lambda outputs: [{"boxes": boxes, "scores": outputs}])
    [found] = task.reader("network", 3)(scores, torch.zeros(1, 3, SIZE, SIZE))
    kept = batched_nms(boxes, scores.amax(1), scores.argmax(1), 0.5)
    assert torch.equal(found["boxes"], boxes[kept])
    assert torch.equal(found["labels"], scores.argmax(1)[kept])
    assert torch.equal(found["candidate_scores"], scores)


def ball_scene(size: int = SIZE, **options) -> nb.Scene:
    return nb.build_scene([("solid:ball", "ball")], size=size, width=2.5, **options)


def brightness_detector(images: Tensor) -> list[dict[str, Tensor]]:
    """Return the box of the ball, with the brightness inside of it as the score."""
    box = torch.tensor([1.0, 1.0, 15.0, 15.0])
    scores = images[:, :, 4:12, 4:12].mean((1, 2, 3))
    label = torch.tensor([0])
    return [{"boxes": box[None], "labels": label, "scores": score[None]} for score in scores]


SETTINGS = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.2), max_steps=40, margin=0.1)


def test_a_list_of_boxes_is_recognized_and_said(caplog):
    adapted = as_network(brightness_detector, SIZE, CLASSES, name="boxes of one")
    assert adapted.task == nb.Detection()
    assert "boxes of one: its outputs are of detection" in caplog.text


@pytest.mark.parametrize("goal", ["hide", "mislabel"])
def test_an_object_that_is_not_found_before_is_reported_and_no_success(goal):
    # To mislabel, the attack makes the ball so bright that it is detected as a lamp.
    classes = CLASSES if goal == "hide" else CLASSES[::-1]
    scene, task = ball_scene(), nb.Detection(threshold=0.8, goal=goal)
    options = {"task": task, "settings": SETTINGS, "classes": classes}
    with pytest.raises(nb.InputError, match="not found"):
        nb.attack(brightness_detector, scene, **options)
    result = nb.attack(brightness_detector, scene, **options, force=True)
    assert result.success_in_views.all()
    assert not result.clean_correct.any() and not result.success.any()


def test_noise_is_tested_where_an_attack_has_moved_the_object():
    """The box stays, and its score falls slowly: IoU decides, after half of the shift."""
    scene = ball_scene(silhouettes=True, light="uniform", backgrounds=[0.0])
    box = scene.truth(lambda label: 0).boxes[0, 0, :1]

    def stays(images: Tensor) -> list[dict[str, Tensor]]:
        scores = images[:, :, 2:14, 2:14].mean((1, 2, 3), keepdim=True).flatten(1)
        return [{"boxes": box, "labels": torch.tensor([0]), "scores": score} for score in scores]

    unmoved = dict.fromkeys(["rotation", "view", "distance", "scale"], 0.0)
    pose = PoseSettings(**unmoved, shift=0.8, step_size=0.1, step="sign")
    settings = nb.AttackSettings(pose=pose, max_steps=30, margin=0.0, noise_margin=1.0)
    found = nb.attack(stays, scene, task=nb.Detection(0.2), settings=settings, classes=CLASSES)
    assert found.success.all() and found.minimum.steps < 15
    # No noise is tested before a restart if the first start has no success.
    weak = replace(settings, pose=replace(pose, radius=0.01), max_steps=1, restarts=1)
    found = nb.attack(stays, scene, task=nb.Detection(0.2), settings=weak, classes=CLASSES)
    assert not found.success.any() and found.minimum.steps == 2


def test_a_task_with_another_goal_replaces_that_of_a_loaded_network():
    loaded = as_network(brightness_detector, SIZE, CLASSES)
    task = nb.Detection(threshold=0.3, goal="mislabel")
    assert as_network(loaded, task=task).task == task
    with pytest.raises(nb.InputError, match="leave the task out"):
        as_network(loaded, task=nb.Segmentation())


BOX = {"boxes": [[2.0, 3.0, 10.0, 12.0]], "labels": [0], "scores": [0.9]}
CANDIDATE = {"candidate_boxes": [[0.0, 0.0, 8.0, 8.0]]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scores": [float("nan")]}, "NaN"),
        ({"boxes": [[2.0, 3.0, float("inf"), 12.0]]}, "NaN or infinite"),
        ({"scores": [3.0]}, "from 0 to 1"),
        ({"labels": [3]}, "from 0 to 2"),
        ({"boxes": [[10.0, 12.0, 2.0, 3.0]]}, "not width and height"),
        ({"boxes": [[20.0, 3.0, 30.0, 12.0]]}, "outside of the image"),
        ({"boxes": [[0.1, 0.2, 0.6, 0.7]]}, "fractions of the image"),
        ({"boxes": [[1.0, 2.0, 3.0]]}, r"boxes \(n, 4\)"),
        ({"labels": [0.5]}, "fractions"),
        ({"candidate_boxes": [[0.0, 0.0, 8.0, 8.0]]}, r"candidate_scores \(\)"),
        (CANDIDATE | {"candidate_scores": [[0.1] * 5]}, "candidate_scores"),
        (CANDIDATE | {"candidate_scores": [[0.1, float("nan"), 0.1]]}, "NaN"),
        (CANDIDATE | {"candidate_scores": [[0.1, 3.0, 0.1]]}, "from 0 to 1"),
        (CANDIDATE | {"candidate_scores": [0.1], "candidate_labels": [9]}, "from 0 to 2"),
    ],
)
def test_impossible_boxes_are_refused(change, message):
    item = {name: torch.tensor(value) for name, value in (BOX | change).items()}
    with pytest.raises(nb.InputError, match=message):
        nb.Detection().reader("network", 3)([item], torch.zeros(1, 3, SIZE, SIZE))


@pytest.mark.parametrize(
    ("boxes", "rest", "message"),
    [
        (torch.rand(1, 2, 4), torch.rand(1, 2, 3), "list of a dictionary"),
        (9 * torch.ones(1, 20, 8), [], r"nb\.Detection\(decode"),  # Layout of YOLOv5.
    ],
)
def test_a_pair_that_is_not_of_ultralytics_is_refused(boxes, rest, message):
    with pytest.raises(nb.InputError, match=message):
        nb.Detection().reader("network")((boxes, rest), torch.zeros(1, 3, SIZE, SIZE))


@pytest.mark.parametrize("box", [[16.0, 3.0, 16.0, 9.0], [3.0, 0.0, 9.0, 0.0]])
def test_boxes_that_were_clipped_at_the_border_are_possible(box):
    item = {name: torch.tensor(value) for name, value in (BOX | {"boxes": [box]}).items()}
    found = nb.Detection().reader("network", 3)([item], torch.zeros(1, 3, SIZE, SIZE))
    assert found[0]["boxes"].tolist() == [box]


@pytest.mark.parametrize(
    ("decode", "message"),
    [
        (lambda outputs: outputs, "must return a list"),
        (lambda outputs: [], "must return a list"),
        (lambda outputs: [{"boxes": torch.zeros(5, 4), "scores": torch.zeros(5, 2)}], "scores"),
        (lambda outputs: outputs["boxes"], "fails on"),
    ],
)
def test_a_decode_function_of_other_shapes_is_refused(decode, message):
    reader = nb.Detection(decode=decode).reader("network", 3)
    with pytest.raises(nb.InputError, match=message):
        reader(torch.zeros(1, 7, 4, 4), torch.zeros(1, 3, SIZE, SIZE))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"classes": None}, "classes is None"),
        ({"classes": ["cup"]}, "'ball'"),
        ({"target": "cup", "force": True}, "mislabel"),
        ({"settings": replace(SETTINGS, eot=nb.EOTSettings(draws=1))}, "eot"),
        ({"task": nb.Classification()}, "returned list"),
        ({"task": nb.Detection(goal="mislabel"), "classes": ["ball"]}, "second class"),
        ({"task": "detection"}, "task is 'detection'"),
    ],
)
def test_an_attack_that_fits_no_detector_is_refused(options, message):
    given = {"classes": CLASSES, "settings": SETTINGS}
    with pytest.raises(nb.InputError, match=message):
        nb.attack(brightness_detector, ball_scene(), **given | options)


def test_a_detector_of_torchvision_names_the_classes_of_coco_itself():
    adapted = as_network(small_detector(91, 64), 64)
    assert isinstance(adapted.task, nb.Detection)
    assert [adapted.label(name) for name in ("banana", "apple", "orange")] == [52, 53, 55]
    assert len(set(adapted.classes)) == 91


def test_boxes_of_a_background_are_no_detections_in_photographs():
    """Raw networks such as SSD have scores of a background, which is the best class of most."""
    boxes = torch.tensor([[0.0, 0.0, 4.0, 4.0], [4.0, 4.0, 8.0, 8.0]])

    def decode(means: Tensor) -> list[dict[str, Tensor]]:
        scores = torch.tensor([[0.0, 0.1], [0.9, 0.0]])
        return [{"boxes": boxes, "scores": scores + mean * torch.eye(2)[1]} for mean in means]

    photographs = torch.full((2, 3, 8, 8), 200, dtype=torch.uint8)
    options = {
        "task": nb.Detection(threshold=0.3, decode=decode),
        "classes": ["_Background", "cup"],
    }
    found = nb.attack_photographs(lambda images: images.mean((1, 2, 3)), photographs, **options)
    assert found.index.tolist() == [0, 1]
    assert found.criterion.source.flatten().tolist() == [1, 1]
