import json

import numpy as np
import pytest
import torch
from PIL import Image
from torchvision.ops import masks_to_boxes

import norm_balls as nb
from renderer.errors import InputError
from tests.helpers import BORDER

CLASSES = ["cat", "dog", "cow"]


def _find_white(images):
    """Detect the white rectangle of each image as a dog, and a cow in the upper left corner."""
    outputs = []
    for image in images:
        is_white = image.amin(0) > 0.8
        boxes, labels, scores = torch.tensor([[0.0, 0, 4, 4]]), [2], [0.5]
        if is_white.any():
            boxes = torch.cat([boxes, masks_to_boxes(is_white[None]) + BORDER])
            labels, scores = [2, 1], [0.5, float(image.max()) - 0.1]
        output = {"boxes": boxes, "labels": torch.tensor(labels)}
        outputs.append(output | {"scores": torch.tensor(scores)})
    return outputs


@pytest.fixture
def photographs(tmp_path):
    """Write two photographs in light, one of which is wide, and one in the dark."""
    folder = tmp_path / "photographs"
    images, annotations = [], []
    sizes = {"light/a.png": (40, 80), "light/b.png": (60, 60), "dark/c.png": (60, 60)}
    for key, (name, shape) in enumerate(sizes.items()):
        pixels = np.zeros((*shape, 3), np.uint8)
        pixels[10:30, 20:50] = 255 if name.startswith("light") else 90
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / name)
        images.append({"id": key, "file_name": name, "width": shape[1], "height": shape[0]})
        annotations.append({"image_id": key, "category_id": 18, "bbox": [20, 10, 30, 20]})
    categories = [{"id": 18, "name": "dog"}, {"id": 21, "name": "Cow"}, {"id": 99, "name": "yak"}]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (folder / "annotations.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("fit", ["letterbox", "stretch"])
def test_recall_and_false_detections_are_the_counted_ones_and_written(photographs, tmp_path, fit):
    out = tmp_path / "out"
    scores = nb.evaluate(_find_white, photographs, classes=CLASSES, size=120, fit=fit, out=out)
    assert scores.photograph_count == 3
    assert scores.by_label["dog"].n == 3
    assert scores.by_label["dog"].recall.value == pytest.approx(2 / 3)
    assert scores.by_label["dog"].false_per_image.value == 0
    assert scores.by_label["Cow"].recall.value is None
    assert scores.by_label["Cow"].false_per_image.value == pytest.approx(1)
    assert scores.overall.recall == scores.by_label["dog"].recall
    assert scores.overall.ap50 == scores.by_label["dog"].ap50
    recalls = {name: metrics["dog"].recall.value for name, metrics in scores.by_source.items()}
    assert recalls == {"dark": 0, "light": 1}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["by_label"]["dog"]["recall"]["value"] == pytest.approx(2 / 3)
    found = json.loads((out / "detections.json").read_text())
    dogs = {item["file_name"]: item["bbox"] for item in found if item["category"] == "dog"}
    # The box is in pixels of the photograph.
    assert dogs["light/a.png"] == pytest.approx([20, 10, 30, 20], abs=1)
    assert (out / "contact_sheet.png").is_file()


@pytest.mark.parametrize("threshold", [0.1, 0.3, 0.7, 0.9])
def test_a_score_at_the_threshold_counts(photographs, threshold):
    def find(images):
        found = _find_white(images)
        return [item | {"scores": torch.full_like(item["scores"], threshold)} for item in found]

    task = nb.Detection(threshold=threshold)
    scores = nb.evaluate(find, photographs, classes=CLASSES, size=120, task=task)
    assert scores.by_label["dog"].recall.value == pytest.approx(2 / 3)


def test_the_order_of_images_in_the_file_does_not_matter(photographs):
    """Only the first photograph shows a dog, and all detections of dogs have equal scores."""
    file = photographs / "annotations.json"
    content = json.loads(file.read_text())
    content["annotations"] = content["annotations"][:1]
    precision = []
    for images in (content["images"], content["images"][::-1]):
        file.write_text(json.dumps(content | {"images": images}))
        scores = nb.evaluate(_find_white, photographs, "dog", classes=CLASSES, size=120)
        precision.append(scores.overall.ap50.value)
    # pycocotools sorts images by their id.
    assert precision == [1, 1]


@pytest.mark.parametrize("label", [None, "dog", "Dog"])
def test_names_that_differ_in_their_case_are_one_class(photographs, label):
    file = photographs / "annotations.json"
    expected = nb.evaluate(_find_white, photographs, "dog", classes=CLASSES, size=120).overall
    content = json.loads(file.read_text())
    content["categories"][1:] = [{"id": 19, "name": "Dog"}]
    content["annotations"][0]["category_id"] = 19
    file.write_text(json.dumps(content))
    scores = nb.evaluate(_find_white, photographs, label, classes=CLASSES, size=120)
    assert scores.labels == [label or "dog"]
    assert scores.by_label == {label or "dog": expected}
    assert scores.overall == expected


def test_a_class_that_the_network_lacks_is_not_scored(photographs):
    scores = nb.evaluate(_find_white, photographs, classes=CLASSES, size=120)
    assert scores.labels == ["dog", "Cow"]
    only = nb.evaluate(_find_white, photographs, "dog", classes=CLASSES, size=120)
    assert only.labels == ["dog"]
    for label in ("cow", 2):
        assert nb.evaluate(_find_white, photographs, label, classes=CLASSES).labels == ["Cow"]
    with pytest.raises(InputError, match="no classes of the network"):
        nb.evaluate(_find_white, photographs, "yak", classes=CLASSES, size=120)
    with pytest.raises(InputError, match="marks no cat"):
        nb.evaluate(_find_white, photographs, "cat", classes=CLASSES, size=120)


def test_photographs_of_which_none_can_be_read_are_refused(photographs):
    for name in ("light/a.png", "light/b.png", "dark/c.png"):
        (photographs / name).write_bytes(b"no image")
    with pytest.raises(InputError, match="no photograph that can be read"):
        nb.evaluate(_find_white, photographs, classes=CLASSES, size=120, skip_unreadable=True)


@pytest.mark.parametrize("photos", ["", "annotations.json"])
@pytest.mark.parametrize("source", ["run=pretrained/detector", "network=run:pretrained/detector"])
def test_a_run_is_scored_with_the_threshold_and_the_overlap_that_are_given(
    call, photographs, tmp_path, source, photos
):
    labeled = (photographs / "annotations.json").read_text().replace("dog", "orange")
    (photographs / "annotations.json").write_text(labeled)
    words = f"photos={photographs / photos}", "threshold=0.9", "iou=0.75", "out=out"
    assert call("evaluate", source, *words) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["threshold"], summary["iou"]) == (0.9, 0.75)


def test_no_scores_are_written_among_the_photographs_that_a_yaml_file_names(tmp_path):
    Image.new("RGB", (60, 60)).save(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("1 0.5 0.5 0.2 0.2\n")
    file = tmp_path / "data.yaml"
    file.write_text("names: [cat, dog]\ntrain: train.txt\n")
    with pytest.raises(InputError, match="lies inside"):
        nb.evaluate(_find_white, file, classes=CLASSES, size=120, out=tmp_path / "scores")
