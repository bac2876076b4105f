import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image, ImageOps

from renderer.errors import InputError
from train.data.annotations import LETTERBOX, STRETCH, fit, fit_batches, read_annotations

# A white rectangle in a black image of 80 × 40 pixels: left, top, right and bottom.
BOX = (20, 8, 60, 24)


def _draw(path, size=(80, 40), box=BOX, orientation=1):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    pixels[box[1] : box[3], box[0] : box[2]] = 255
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


def _bounds(pixels):
    return list(Image.fromarray(pixels > 200).getbbox())


def _write_coco(file, names=("a.png",), size=(80, 40), box=BOX, **changes):
    file.parent.mkdir(parents=True, exist_ok=True)
    images = [{"id": 7 + index, "file_name": name} for index, name in enumerate(names)]
    if size:
        images = [image | {"width": size[0], "height": size[1]} for image in images]
    bbox = [box[0], box[1], box[2] - box[0], box[3] - box[1]]
    marked = {"category_id": 90, "bbox": bbox, "iscrowd": 0}
    annotations = [{"id": index, "image_id": 7 + index, **marked} for index in range(len(images))]
    categories = [{"id": 3, "name": "cat"}, {"id": 90, "name": "dog"}]
    content = {"images": images, "categories": categories, "annotations": annotations}
    file.write_text(json.dumps(content | changes))


@pytest.mark.parametrize(
    ("file", "image", "name"),
    [
        ("a.json", "plain/a.png", "plain/a.png"),
        ("a.json", "plain/a.png", "a.png"),
        ("annotations/a.json", "val/a.png", "a.png"),
        ("a.json", "images/a.png", "..\\elsewhere\\images\\a.png"),
        ("a.json", "a\u0308/a\u0308.png", "\u00e4/\u00e4.png"),
        ("a.json", "plain/\u00e4.png", "a\u0308.png"),
    ],
)
def test_images_of_coco_are_found_in_subfolders(tmp_path, file, image, name):
    _draw(tmp_path / image)
    _write_coco(tmp_path / file, [name])
    # A Mac writes such files on disks of other systems.
    (tmp_path / file).with_name("._a.json").write_bytes(b"\0\5\x16\7")
    read = read_annotations(tmp_path / file)
    (photograph,) = read.photographs
    assert photograph.path == read_annotations(tmp_path).photographs[0].path == tmp_path / image
    # The identifiers of the categories have gaps.
    assert (read.classes, photograph.labels.tolist()) == (("cat", "dog"), [1])


def test_classes_of_coco_are_in_the_order_of_their_ids(tmp_path):
    _draw(tmp_path / "a.png")
    descending = [{"id": 90, "name": "dog"}, {"id": 3, "name": "cat"}]
    _write_coco(tmp_path / "a.json", categories=descending)
    read = read_annotations(tmp_path)
    assert (read.classes, read.photographs[0].labels.tolist()) == (("cat", "dog"), [1])


@pytest.mark.parametrize(
    ("value", "expected"), [(0, False), ("0", False), (None, False), (1, True), ("1", True)]
)
def test_iscrowd_of_coco_may_be_text_or_absent(tmp_path, value, expected):
    _draw(tmp_path / "a.png")
    annotation = {"image_id": 7, "category_id": 3, "bbox": [0, 0, 1, 1], "iscrowd": value}
    _write_coco(tmp_path / "a.json", annotations=[annotation])
    assert read_annotations(tmp_path).photographs[0].is_crowd.tolist() == [expected]


def test_missing_images_of_coco_are_named_and_ambiguous_ones_refused(tmp_path):
    _draw(tmp_path / "a.png")
    _write_coco(tmp_path / "a.json", ["a.png", "b.png"])
    read = read_annotations(tmp_path / "a.json")
    assert [len(read.photographs), *read.missing] == [1, "b.png"]
    _draw(tmp_path / "one" / "b.png")
    _draw(tmp_path / "two" / "b.png")
    with pytest.raises(InputError, match=r"b\.png, which may be"):
        read_annotations(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("orientation", "is_stored"),
    [(3, False), (6, False), (5, True), (6, True), (7, True), (8, True)],
)
def test_boxes_fit_photographs_that_a_camera_has_turned(tmp_path, orientation, is_stored):
    _draw(tmp_path / "a.png", orientation=orientation)
    with Image.open(tmp_path / "a.png") as image:
        upright = np.array(ImageOps.exif_transpose(image))[..., 0]
    height, width = upright.shape
    if is_stored:
        _write_coco(tmp_path / "a.json")
    else:
        _write_coco(tmp_path / "a.json", size=(width, height), box=_bounds(upright))
    (photograph,) = read_annotations(tmp_path).photographs
    fitted = fit(photograph, (height, width), LETTERBOX)
    assert fitted.boxes[0].tolist() == _bounds(fitted.pixels[0]) == _bounds(upright)


@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_all_boxes_of_a_file_are_turned_if_one_photograph_on_its_side_shows_it(
    tmp_path, orientation
):
    """A program that ignores the orientation of one photograph ignores that of all."""
    _draw(tmp_path / "a.png", orientation=6)
    _draw(tmp_path / "b.png", orientation=orientation)
    _draw(tmp_path / "c.tif", orientation=6)
    _write_coco(tmp_path / "a.json", ["a.png", "b.png", "c.tif"])
    photographs = read_annotations(tmp_path).photographs
    for photograph, size in zip(photographs, [(80, 40), (40, 80), (80, 40)], strict=True):
        fitted = fit(photograph, size, STRETCH)
        assert fitted.boxes[0].tolist() == _bounds(fitted.pixels[0])


@pytest.mark.parametrize("how", [LETTERBOX, STRETCH])
@pytest.mark.parametrize(("size", "border"), [((80, 80), 1 / 2), ((40, 120), 1 / 3)])
def test_boxes_follow_the_pixels_to_the_size_of_the_network(tmp_path, how, size, border):
    _draw(tmp_path / "a.png")
    _write_coco(tmp_path / "a.json")
    fitted = fit(read_annotations(tmp_path).photographs[0], size, how)
    assert fitted.pixels.shape == (3, *size)
    shown = np.array([_bounds(fitted.pixels[0])], float)
    assert fitted.to_photograph(shown)[0] == pytest.approx(BOX, abs=1.1)
    gray = (fitted.pixels[0] == 114).mean()
    assert gray == pytest.approx(border if how == LETTERBOX else 0, abs=0.01)


def test_an_image_of_coco_stands_for_no_other_of_the_same_name_in_another_folder(tmp_path):
    names = ["cam1/1.png", "cam2/1.png", "cam3/2.png"]
    _write_coco(tmp_path / "a.json", names)
    _draw(tmp_path / "cam1" / "1.png")
    read = read_annotations(tmp_path)
    assert [item.name for item in read.photographs] == names[:1]
    assert read.missing == names[1:]
    # Folders that the file names tell images of one name apart, wherever they lie.
    for folder in ("images/cam2", "images/cam4"):
        _draw(tmp_path / folder / "1.png")
    _draw(tmp_path / "images/2.png")
    paths = [item.path.relative_to(tmp_path) for item in read_annotations(tmp_path).photographs]
    assert [*map(str, paths)] == ["cam1/1.png", "images/cam2/1.png", "images/2.png"]


@pytest.mark.parametrize("val", ["", "val: images\n", "val: list.txt\n"])
def test_labels_of_yolo_without_an_image_are_counted(tmp_path, val):
    for name in ("1", "2"):
        _draw(tmp_path / "images" / f"{name}.png")
    for name in ("1", "2", "3"):
        (tmp_path / "labels").mkdir(exist_ok=True)
        (tmp_path / "labels" / f"{name}.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    (tmp_path / "labels" / "classes.txt").write_text("cat\n")
    (tmp_path / "list.txt").write_text("images/1.png\n")
    (tmp_path / "data.yaml").write_text(f"names: [cat]\n{val}")
    (tmp_path / "another.yaml").write_text("names: [person]\n")
    read = read_annotations(tmp_path)
    assert (read.classes, len(read.photographs)) == (("cat",), 1 if "list" in val else 2)
    assert read.missing == [str(tmp_path / "labels" / "3.txt")]


def test_labels_beside_images_of_a_relative_folder_are_not_missing(tmp_path, monkeypatch):
    for name in ("1", "2"):
        _draw(tmp_path / "set" / f"{name}.png")
    for name in ("1", "2", "3"):
        (tmp_path / "set" / f"{name}.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    (tmp_path / "set" / "data.yaml").write_text("names: [cat]\n")
    monkeypatch.chdir(tmp_path)
    assert read_annotations(Path("set")).missing == [str(tmp_path / "set" / "3.txt")]


def test_a_line_of_yolo_that_stands_twice_is_one_object_which_is_said(tmp_path, caplog):
    _draw(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("1 0.5 0.4 0.5 0.4\n0 0.5 0.4 0.5 0.4\n1 0.50 0.4 0.5 0.4\n")
    (tmp_path / "classes.txt").write_text("cat\ndog\n")
    assert read_annotations(tmp_path).photographs[0].labels.tolist() == [1, 0]
    assert "1 lines" in caplog.text


@pytest.mark.parametrize("shape", [[2, 2], [2, 3]])
def test_a_pose_of_yolo_has_keypoints_after_its_box(tmp_path, shape):
    _draw(tmp_path / "a.png")
    keypoints = "0.1 0.2 2 0.3 0.4 1" if shape[1] == 3 else "0.1 0.2 0.3 0.4"
    (tmp_path / "a.txt").write_text(f"0 0.5 0.4 0.5 0.4 {keypoints}\n")
    (tmp_path / "data.yaml").write_text(f"names: [cat]\nkpt_shape: {shape}\n")
    (marked,) = read_annotations(tmp_path).photographs
    assert fit(marked, (40, 80), LETTERBOX).boxes == pytest.approx(np.array([BOX]))


@pytest.mark.parametrize(
    ("image", "label", "names"),
    [
        ("images/val/a.png", "labels/val/a.txt", "data.yaml"),
        ("a.png", "a.txt", "classes.txt"),
        ("images/a.png", "images/a.txt", "labels/classes.txt"),
        ("a.png", "labels/a.txt", "obj.names"),
    ],
)
def test_boxes_of_yolo_are_fractions_of_the_sides(tmp_path, image, label, names):
    _draw(tmp_path / image)
    _draw(tmp_path / image.replace("a.", "empty."))
    text = {"data.yaml": "names: {0: cat, 1: dog}\n"}.get(names, "cat\ndog\n")
    box = "1 0.5 0.4 0.5 0.4\n"
    polygon = "0 0.25 0.2 0.75 0.2 0.75 0.6 0.25 0.6\n"
    for path, content in ((names, text), (label, box + polygon)):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(content)
    read = read_annotations(tmp_path)
    assert read.classes == ("cat", "dog")
    marked, empty = read.photographs
    assert marked.labels.tolist() == [1, 0]
    assert fit(marked, (40, 80), LETTERBOX).boxes == pytest.approx(np.array([BOX, BOX]))
    assert len(empty.boxes) == 0


@pytest.mark.parametrize(
    ("names", "expected"),
    [("[cat, dog]", ("cat", "dog")), ("{'0': cat, 2: dog}", ("cat", "1", "dog"))],
)
def test_names_of_yolo_are_a_list_or_a_mapping_of_indices(tmp_path, names, expected):
    _draw(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("1 0.5 0.5 1.0000001 0.4\n")
    (tmp_path / "data.yaml").write_text(f"names: {names}\n")
    read = read_annotations(tmp_path)
    assert read.classes == expected
    assert read.photographs[0].labels.tolist() == [1]


@pytest.mark.parametrize(
    ("place", "entries"),
    [
        ("set", "val: images/val"),
        ("set", "val: ../images/val"),
        ("beside", "val: ../set/images/val"),
        (".", "{path: set, val: [images/val]}"),
        ("set", "{path: /elsewhere, val: list.txt}"),
    ],
)
def test_the_images_of_val_are_read_and_no_others(tmp_path, place, entries):
    folder = tmp_path / "set"
    for name in ("images/val/a", "images/train/b", "details/c"):
        _draw(folder / f"{name}.png")
    (folder / "data_set.json").write_text("{}")
    (folder / "notes.json").write_text("{}")
    place = tmp_path / place
    place.mkdir(exist_ok=True)
    content = yaml.safe_load(entries) | {"names": ["cat"]}
    (place / "mine.yaml").write_text(yaml.safe_dump(content))
    (folder / "list.txt").write_text("./images/val/a.png\n")
    (folder / "labels/val").mkdir(parents=True)
    (folder / "labels/val/a.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    for photos in (place, place / "mine.yaml"):
        read = read_annotations(photos)
        (photograph,) = read.photographs
        assert photograph.path.samefile(folder / "images/val/a.png")
        assert read.missing == []
        assert photograph.labels.tolist() == [0]
    (place / "another.yaml").write_text("names: [dog]")
    assert read_annotations(place / "mine.yaml").classes == ("cat",)


def test_missing_images_of_val_are_counted_and_a_val_without_images_is_refused(tmp_path):
    _draw(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    (tmp_path / "val.txt").write_text("a.png\nb.png\n")
    (tmp_path / "data.yaml").write_text("{names: [cat], val: val.txt}")
    read = read_annotations(tmp_path)
    assert [item.name for item in read.photographs] == ["a.png"]
    assert read.missing == [str(tmp_path / "b.png")]
    for place in ("elsewhere", "[elsewhere, val.txt]"):
        (tmp_path / "data.yaml").write_text(f"{{names: [cat], val: {place}}}")
        (tmp_path / "val.txt").write_text("b.png\n")
        with pytest.raises(InputError, match="has no image of its entry val"):
            read_annotations(tmp_path)


def test_names_of_labels_may_have_another_form_of_unicode(tmp_path):
    _draw(tmp_path / "a\u0308pfel.png")
    (tmp_path / "\u00e4pfel.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    (tmp_path / "classes.txt").write_text("apple\n")
    read = read_annotations(tmp_path)
    assert (len(read.photographs[0].boxes), read.missing) == (1, [])


def test_files_that_macos_adds_are_no_labels_and_no_names_of_classes(tmp_path):
    _draw(tmp_path / "images/a.png")
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels/a.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    (tmp_path / "fruit.yaml").write_text("names: [apple]")
    for name in ("labels/._a.txt", "._fruit.yaml"):
        (tmp_path / name).write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        \xb0")
    read = read_annotations(tmp_path)
    assert (read.classes, len(read.photographs[0].boxes), read.missing) == (("apple",), 1, [])


def test_a_choice_among_several_files_of_names_is_said(tmp_path, caplog):
    _draw(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    for name, stem in (("cat", "first"), ("dog", "second")):
        (tmp_path / f"{stem}.yaml").write_text(f"names: [{name}]")
    assert read_annotations(tmp_path).classes == ("cat",)
    assert "first.yaml" in caplog.text


WRONG_LINES = (
    b"2 .5 .5 .1 .1",
    b"0 40 20 10 10",
    b"0 .5 .5 .1",
    b"cat .5 .5 .1 .1",
    b"0 nan 0 0 0",
)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("data.yaml", b"names: {cat: 0}", "give names as a list"),
        ("data.yaml", b"{names: [cat], val: 5}", "has val: 5"),
        ("a.txt", b"\xff\xfe\x00", "no text"),
        ("classes.txt", b"\xfcber", "save it as UTF-8"),
        *(("a.txt", b"0 0.5 0.5 0.1 0.1\n" + line, r"line 2 of .*a\.txt") for line in WRONG_LINES),
    ],
)
def test_wrong_files_and_lines_of_yolo_are_refused(tmp_path, file, content, message):
    _draw(tmp_path / "a.png")
    if file != "classes.txt":
        (tmp_path / "data.yaml").write_text("names: [cat, dog]\n")
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_annotations(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"annotations": [{"image_id": 8, "category_id": 90, "bbox": [0, 0, 1, 1]}]}, "image_id 8"),
        ({"annotations": [{"image_id": 7, "category_id": 1, "bbox": [0, 0, 1, 1]}]}, "category_id"),
        ({"annotations": [{"image_id": 7, "category_id": 3, "bbox": [0, 0, -1, 1]}]}, "bbox"),
        ({"annotations": [{"image_id": 7, "category_id": 3}]}, "the entry 'bbox' is missing"),
        ({"images": 2 * [{"id": 7, "file_name": "a.png"}]}, "two of the images"),
        ({"images": [{"id": i, "file_name": "a.png"} for i in (7, 8)]}, "two of the images"),
        ({"categories": [{"id": 90, "name": name} for name in "ab"]}, "two of the categories"),
    ],
)
def test_a_wrong_coco_file_is_refused_in_one_sentence(tmp_path, changes, message):
    _draw(tmp_path / "a.png")
    _write_coco(tmp_path / "a.json", **changes)
    with pytest.raises(InputError, match=message):
        read_annotations(tmp_path / "a.json")


def test_boxes_of_an_image_with_another_aspect_ratio_are_refused(tmp_path):
    _draw(tmp_path / "a.png")
    _write_coco(tmp_path / "a.json", size=(80, 80))
    with pytest.raises(InputError, match="80 × 40 pixels, but its boxes are for 80 × 80"):
        [*fit_batches(read_annotations(tmp_path).photographs, (8, 8), LETTERBOX)]


def test_boxes_count_within_the_photograph_only(tmp_path):
    _draw(tmp_path / "a.png")
    _write_coco(tmp_path / "a.json", box=(60, 20, 100, 30))
    fitted = fit(read_annotations(tmp_path).photographs[0], (40, 80), STRETCH)
    assert fitted.boxes.tolist() == [[60, 20, 80, 30]]
    _write_coco(tmp_path / "a.json", box=(90, 20, 100, 30))
    outside = fit(read_annotations(tmp_path).photographs[0], (40, 80), STRETCH)
    assert (len(outside.boxes), outside.is_kept.tolist()) == (0, [False])


def test_an_unreadable_photograph_is_an_error_or_skipped(tmp_path):
    _draw(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(b"no image")
    _write_coco(tmp_path / "a.json", ["a.png", "b.png"])
    photographs = read_annotations(tmp_path).photographs
    with pytest.raises(InputError, match=r"b\.png cannot be read"):
        [*fit_batches(photographs, (8, 8), LETTERBOX)]
    ((pair,),) = fit_batches(photographs, (8, 8), LETTERBOX, skip_unreadable=True)
    assert pair[0].name == "a.png"
