import contextlib
import io

import numpy as np
import pytest
from scipy.stats import chi2

from train.results import detections
from train.results.detections import Found, Marked

BOX = np.array([[10.0, 10, 30, 30]])


def _found(boxes, labels, scores):
    return Found(np.reshape(boxes, (-1, 4)).astype(float), np.array(labels, int), np.array(scores))


def _marked(boxes, labels, is_crowd=None):
    is_crowd = np.zeros(len(labels), bool) if is_crowd is None else np.array(is_crowd)
    return Marked(np.reshape(boxes, (-1, 4)).astype(float), np.array(labels, int), is_crowd)


def _match(found, marked):
    return detections.join([*map(detections.match_image, found, marked)])


def _random_image(rng, class_count=3):
    """Draw objects, some of them crowds, and detections near and far from them."""
    count = rng.integers(0, 5)
    low = rng.uniform(0, 60, (count, 2))
    boxes = np.hstack([low, low + rng.uniform(5, 40, (count, 2))])
    labels = rng.integers(0, class_count, count)
    near = np.repeat(boxes, 3, axis=0) + rng.normal(0, 3, (3 * count, 4))
    low = rng.uniform(0, 60, (4, 2))
    far = np.hstack([low, low + rng.uniform(5, 40, (4, 2))])
    near[:, 2:] = np.maximum(near[:, 2:], near[:, :2] + 1)
    guesses = np.concatenate([np.repeat(labels, 3), rng.integers(0, class_count, 4)])
    scores = rng.uniform(0, 1, len(guesses)).round(2)
    found = _found(np.vstack([near, far]), guesses, scores)
    return found, _marked(boxes, labels, rng.random(count) < 0.2)


@pytest.mark.ecosystem
@pytest.mark.parametrize("seed", range(5))
def test_recall_and_average_precision_are_those_of_coco(seed):
    pytest.importorskip("pycocotools")
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    rng = np.random.default_rng(seed)
    pairs = [_random_image(rng) for _ in range(12)]
    annotations, results = [], []
    for image, (found, marked) in enumerate(pairs):
        for box, label, crowd in zip(marked.boxes, marked.labels, marked.is_crowd, strict=True):
            size = box[2:] - box[:2]
            entry = {"id": len(annotations) + 1, "image_id": image, "category_id": int(label)}
            entry |= {"bbox": [*box[:2], *size], "area": size.prod(), "iscrowd": int(crowd)}
            annotations.append(entry)
        for box, label, score in zip(found.boxes, found.labels, found.scores, strict=True):
            entry = {"image_id": image, "category_id": int(label), "score": score}
            results.append(entry | {"bbox": [*box[:2], *(box[2:] - box[:2])]})
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO()
        coco.dataset = {
            "images": [{"id": image} for image in range(len(pairs))],
            "categories": [{"id": label, "name": str(label)} for label in range(3)],
            "annotations": annotations,
        }
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes(results), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
    matches = _match(*zip(*pairs, strict=True))
    every = np.ones((1, len(pairs)))
    for label in range(3):
        precision = evaluation.eval["precision"][0, :, label, 0, 2].mean()
        recall = evaluation.eval["recall"][0, label, 0, 2]
        of_label = matches.of([label])
        assert of_label.average_precision(every[0]) == pytest.approx(precision, abs=1e-12)
        assert of_label.recall(0.0, every) == pytest.approx(recall, abs=1e-12)


def test_average_precision_of_three_detections_is_that_of_the_definition():
    # Ranks: right, false, right. Of two objects: precision 1 up to recall 0.5, then 2 / 3.
    boxes = [BOX[0], BOX[0] + 100, BOX[0] + 200]
    found = _found(boxes, [0, 0, 0], [0.9, 0.8, 0.7])
    matches = _match([found], [_marked([boxes[0], boxes[2]], [0, 0])])
    expected = (51 * 1 + 50 * 2 / 3) / 101
    assert matches.average_precision(np.ones(1)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("boxes", "labels", "scores", "expected"),
    [
        ([BOX, BOX], [0, 0], [0.5, 0.9], [detections.NO_OBJECT, 0]),
        ([BOX], [1], [0.9], [detections.NO_OBJECT]),
        ([[10, 10, 30, 50]], [0], [0.9], [0]),
        ([[10, 10, 30, 50.1]], [0], [0.9], [detections.NO_OBJECT]),
        ([BOX + 100, BOX + 100], [0, 0], [0.9, 0.8], [detections.CROWD, detections.CROWD]),
    ],
    ids=["a second one", "another class", "IoU of one half", "less", "crowd"],
)
def test_an_object_has_at_most_one_detection_of_its_class(boxes, labels, scores, expected):
    marked = _marked([BOX, [[90, 90, 150, 150]]], [0, 0], [False, True])
    assert detections.match(_found(boxes, labels, scores), marked, 0.5).tolist() == expected


@pytest.mark.parametrize("threshold", [0.1, 0.3, 0.7, 0.9])
def test_a_score_of_32_bits_at_the_threshold_counts_as_right_and_as_false(threshold):
    scores = np.float32([threshold, threshold])
    found = _found([BOX, BOX + 50], [0, 0], scores)
    metrics = detections.score(_match([found], [_marked(BOX, [0])]), [0], threshold)
    assert (metrics.recall.value, metrics.false_per_image.value) == (1, 1)


def test_ap50_is_at_an_iou_of_one_half_whatever_that_of_the_recall():
    # The IoU is 20 · 20 / (20 · 33), which is 0.606.
    found, marked = _found([[10, 10, 30, 43]], [0], [0.9]), _marked(BOX, [0])
    strict, at_half = (
        detections.join([detections.match_image(found, marked, iou)]) for iou in (0.75, 0.5)
    )
    metrics = detections.score(strict, [0], 0.4, at_half)
    assert (metrics.recall.value, metrics.ap50.value) == (0, 1)


def test_objects_of_the_same_photograph_add_nothing_to_its_interval():
    def recall(copies):
        shifts = 50 * np.arange(copies)[:, None]
        image = [_found(BOX + shifts, [0] * copies, [0.9] * copies), _found([], [], [])]
        matches = _match(image * 9, [_marked(BOX + shifts, [0] * copies)] * 18)
        return detections.score(matches, [0], 0.4).recall

    assert recall(4) == recall(1)
    assert recall(1).low == pytest.approx(1 - recall(1).high)
    assert 0.2 < recall(1).low < 0.35


@pytest.mark.parametrize("is_found", [True, False])
def test_photographs_without_objects_do_not_change_the_interval_of_the_recall(is_found):
    """It is Wilson's for the photographs with objects."""

    def metrics(empty):
        found = [_found(*(BOX, [0], [0.9]) if is_found else ([], [], []))] * 50
        marked = [_marked(BOX, [0])] * 50 + [_marked([], [])] * empty
        matches = _match(found + [_found([], [], [])] * empty, marked)
        return detections.score(matches, [0], 0.4)

    alone = metrics(0)
    assert alone.recall.high - alone.recall.low < 0.08
    for empty in (1, 2, 3, 40):
        for name in ("recall", "ap50"):
            found, expected = (getattr(each, name) for each in (metrics(empty), alone))
            ends = [found.value, found.low, found.high]
            assert ends == pytest.approx([expected.value, expected.low, expected.high], abs=2e-3)


@pytest.mark.parametrize("count", [2, 3])
def test_fewer_than_three_photographs_have_no_interval(count):
    """With two, the t distribution has one degree of freedom, and intervals reach everywhere."""
    far = _found([[60, 60, 80, 80]], [0], [0.9])
    found = [_found([], [], []), *[far] * (count - 1)]
    metrics = detections.score(_match(found, [_marked(BOX, [0])] * count), [0], 0.4)
    assert metrics.false_per_image.value == pytest.approx((count - 1) / count)
    for metric in (metrics.recall, metrics.ap50, metrics.false_per_image):
        assert (metric.low is None) == (metric.high is None) == (count < 3)


@pytest.mark.parametrize("number", [1, 200])
def test_an_equal_number_of_false_detections_in_all_photographs_has_the_interval_of_poisson(number):
    far = _found([[60, 60, 80, 80]] * number, [0] * number, [0.9] * number)
    found = detections.score(_match([far] * 20, [_marked(BOX, [0])] * 20), [0], 0.4).false_per_image
    # Garwood 1936, by quantiles of χ².
    low, high = chi2.ppf([0.025, 0.975], [40 * number, 40 * number + 2]) / 40
    assert (found.value, found.low, found.high) == pytest.approx((number, low, high))


def test_no_false_detection_has_an_upper_limit_like_the_rule_of_three():
    matches = _match([_found([], [], [])] * 100, [_marked([], [])] * 100)
    metrics = detections.score(matches, [0], 0.4)
    assert metrics.false_per_image.value == 0
    assert 0.03 < metrics.false_per_image.high < 0.05
    assert metrics.recall.value is None


def test_mean_iou_is_that_of_the_confusion_matrix():
    masks, predicted = np.random.default_rng(0).integers(0, 3, (2, 4, 5, 6))
    masks[0, 0] = detections.NO_CLASS_PIXEL
    mean, by_class = detections.mean_iou(zip(predicted, masks, strict=True), 4)
    is_scored = masks != detections.NO_CLASS_PIXEL
    confusion = np.zeros((4, 4))
    np.add.at(confusion, (masks[is_scored], predicted[is_scored]), 1)
    shared = np.diag(confusion)[:3]
    expected = shared / (confusion.sum(0) + confusion.sum(1) - np.diag(confusion))[:3]
    assert by_class[:3] == pytest.approx(expected)
    assert np.isnan(by_class[3])
    assert mean.value == pytest.approx(expected.mean())
    assert mean.low < mean.value < mean.high
