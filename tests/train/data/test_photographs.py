import logging
from pathlib import Path, PurePosixPath
from unicodedata import normalize

import numpy as np
import pytest
import torch
from PIL import Image

from augment.tasks.classification import class_index
from renderer.errors import InputError
from tests.helpers import save_plain
from train.class_names import classes_of_meshes
from train.data import photographs

CLASSES = ["apple", "fig", "lime", "orange", "pear", "plum"]


def save(path: Path, pixels: np.ndarray | Image.Image, **options) -> Path:
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    image.save(path, **options)
    return path


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def load_one(path: Path) -> np.ndarray:
    found = [photographs.Photograph(PurePosixPath(path.name), "orange", None)]
    _, images, _ = photographs.load_photographs(path.parent, found, 32, False)
    return images[0].permute(1, 2, 0).numpy().astype(int)


def find(folder: Path, label: str = "orange") -> list[tuple[str, str]]:
    found = photographs.find_photographs(folder, CLASSES, label)
    assert {photograph.source for photograph in found} == {None}
    return [(str(photograph.path), photograph.label) for photograph in found]


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (
            "pear/b.PNG orange/2026/may/c.jpeg other_tomato/d.TIF",
            "orange/2026/may/c.jpeg:orange other_tomato/d.TIF:other_tomato pear/b.PNG:pear",
        ),
        ("orange/a.jpg orange/@eaDir/a.jpg/THUMB_M.jpg $RECYCLE.BIN/R1.jpg", "orange/a.jpg:orange"),
        ("b.jpg a.gif", "a.gif:orange b.jpg:orange"),
        (
            "orange/a.JFIF orange/._a.jpg orange/.cache/b.jpg .git/c.jpg __MACOSX/a.jpg x.txt",
            "orange/a.JFIF:orange",
        ),
    ],
    ids=["class folders at any depth", "thumbnails and bins", "flat", "hidden files"],
)
def test_images_are_found_with_their_class_in_sorted_order(tmp_path, files, expected):
    assert " ".join(map(":".join, find(touch(tmp_path, *files.split())))) == expected


def test_a_folder_without_photographs_is_no_positive_class(tmp_path):
    touch(tmp_path, "orange/a.png", "pear/b.png", "apple/notes.txt")
    (tmp_path / "lemon").mkdir()
    assert photographs.choose_labels(tmp_path, [*CLASSES, "lemon"], None) == ["orange", "pear"]


def test_links_to_folders_and_files_are_followed_but_not_in_circles(tmp_path):
    touch(tmp_path, "elsewhere/deep/a.jpg", "elsewhere/b.jpg", "photos/pear/c.jpg")
    photos = tmp_path / "photos"
    (photos / "orange").symlink_to(tmp_path / "elsewhere")
    (photos / "pear" / "d.jpg").symlink_to(tmp_path / "elsewhere" / "b.jpg")
    for number, target in enumerate([photos, photos / "pear", tmp_path]):
        (photos / "pear" / str(number)).symlink_to(target)
    found = [path for path, _ in find(photos)]
    assert found == ["orange/b.jpg", "orange/deep/a.jpg", "pear/c.jpg", "pear/d.jpg"]


def test_folders_that_link_to_each_other_are_searched_once_on_each_way(tmp_path):
    for name, other in (("orange", "pear"), ("pear", "fig"), ("fig", "orange")):
        touch(tmp_path, f"{name}/{name}.jpg")
        (tmp_path / name / "next").symlink_to(tmp_path / other)
    found = [str(path) for path in photographs.visible_files(tmp_path / "orange")]
    assert sorted(found) == ["next/next/fig.jpg", "next/pear.jpg", "orange.jpg"]


def test_files_of_other_kinds_are_left_out_and_listed(tmp_path):
    others = ["notes.txt", "orange/b.HEIC", "orange/c.jxl"]
    touch(tmp_path, "orange/a.jpg", "orange/.d.heic", "lab.json", *others)
    (tmp_path / "orange" / "folder.jpg").mkdir()
    (tmp_path / "photos.csv").write_text("path,source_tag\n")
    assert find(tmp_path) == [("orange/a.jpg", "orange")]
    assert [*map(str, photographs.unsupported_files(tmp_path))] == others


def test_photographs_without_labels_of_types_that_are_not_read_are_named(tmp_path, caplog):
    touch(tmp_path, "a.jpg", "b.JPEG", "notes.txt", "c.HEIC", "deep/d.cr2")
    assert len(photographs.find_unlabeled(tmp_path)) == 2
    assert "2 photographs" in caplog.text and "c.HEIC" in caplog.text


@pytest.mark.parametrize(("of_classes", "of_files"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_with_accents_are_equal_in_both_forms_of_unicode(tmp_path, of_classes, of_files):
    """macOS writes the names of files in the form NFD. Equal letters then differ in bytes."""
    classes = [normalize(of_classes, name) for name in ("orange", "açaí", "crème brûlée")]
    of_others = of_classes
    folder = normalize(of_files, "crème brûlée")
    touch(tmp_path, f"{folder}/{normalize(of_files, 'é.png')}", "orange/b.png")
    lines = ["path,source_tag,hard_negatives", normalize(of_others, "crème brûlée/é.png,Zürich,")]
    lines.append(normalize(of_files, "orange/b.png,a,Zürich"))
    (tmp_path / "photos.csv").write_text("\n".join(lines), encoding="utf-8")
    found = photographs.find_photographs(tmp_path, classes, normalize(of_others, "crème brûlée"))
    first = next(photograph for photograph in found if photograph.label != "orange")
    assert first.label == normalize("NFC", "crème brûlée")
    assert first.source == normalize("NFC", "Zürich")
    assert (tmp_path / first.path).exists()
    assert photographs.choose_labels(tmp_path, classes, None) == sorted([classes[0], classes[2]])
    assert class_index(classes, normalize(of_others, "açaí"), "label") == 1
    mesh = normalize(of_others, "crème_brûlée.glb")
    assert classes_of_meshes([mesh], classes, "meshes") == [classes[2]]


@pytest.mark.parametrize(
    ("files", "label", "message"),
    [
        (("orange/notes.txt",), "orange", "holds no photographs"),
        (("pear/a.jpg", "blood_oranges/b.jpg"), "orange", "blood_oranges is not .* other_blood"),
        (("orange/a.jpg", "b.jpg"), "orange", r"b\.jpg lies beside the class folders"),
        (("other_lemon/a.jpg",), "other_lemon", "'other_lemon' is not a class"),
        (("a.jpg",), ["orange", "pear"], "has several labels, but no folders of classes"),
    ],
)
def test_a_folder_of_another_layout_is_refused(tmp_path, files, label, message):
    touch(tmp_path, *files)
    with pytest.raises(InputError, match=message):
        photographs.find_photographs(tmp_path, CLASSES, label)
    with pytest.raises(InputError, match="is not a folder"):
        photographs.find_photographs(tmp_path / files[0], CLASSES, "orange")


@pytest.mark.parametrize("label", ["tv", "TV"])
def test_a_folder_that_resembles_a_positive_class_is_refused_in_any_case(tmp_path, label):
    touch(tmp_path, "tv_set/a.jpg", "pear/b.jpg")
    with pytest.raises(InputError, match="tv_set is not a class"):
        photographs.find_photographs(tmp_path, ["pear", label], label)


def test_folders_of_no_class_of_the_model_count_as_other_things_and_are_named(tmp_path, caplog):
    found = find(touch(tmp_path, "orange/a.jpg", "lion/b.jpg", "other_bee/c.jpg"))
    assert [label for _, label in found] == ["lion", "orange", "other_bee"]
    assert "1 of 3 folders" in caplog.text
    assert "count as negatives: lion" in caplog.text


def test_sources_and_hard_negatives_come_from_photos_csv_in_any_order_of_columns(tmp_path, caplog):
    touch(tmp_path, "orange/a.jpg", "orange/b.jpg", "other_lemon/c.jpg", "pear/d.jpg")
    rows = [
        "class, Hard_Negatives,path, source_tag",
        "orange,lab; web,orange/a.jpg,sun",
        "orange,,orange/b.jpg,web",
        "lemon,;,other_lemon\\c.jpg,lab", "pear,,pear/d.jpg,", "fig,,fig/gone.jpg,web", "",
        ",,,", " , ,,",
    ]  # fmt: skip
    (tmp_path / "photos.csv").write_text("\ufeff" + "\n".join(rows), encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        found = photographs.find_photographs(tmp_path, CLASSES, "orange")
    assert [photograph.source for photograph in found] == ["sun", "web", "lab", None]
    assert [photograph.hard_negatives for photograph in found] == [("lab", "web"), (), (), ()]
    assert "photos.csv names a missing file in 1 of 5 rows, such as fig/gone.jpg" in caplog.text


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (b"path;source_tag\na.jpg;web\n", "UTF-8 text with the columns path and source_tag"),
        (b"path,source_tag\nb/a.jpg,web\n", "a missing file in 1 of 1 rows, .* a.jpg$"),
        (b"path,source_tag\na.jpg,web\na.jpg,web\n./a.jpg,lab\n", "two different rows for a.jpg"),
        (b"path,source_tag,mesh\na.jpg,lamp, left,pear\n", "more cells than columns"),
        (b"path,source_tag,mesh,Mesh\na.jpg,lamp,cup,\n", "two columns have the same name"),
        (
            b"path,source_tag,hard_negatives\na.jpg,web,lib\n",
            "names 'lib' in the column hard_negatives, but no image has this source",
        ),
    ],
)
def test_a_photos_csv_that_cannot_be_used_is_refused_by_name(tmp_path, table, message):
    (touch(tmp_path, "a.jpg") / "photos.csv").write_bytes(table)
    with pytest.raises(InputError, match=rf"photos\.csv .*{message}"):
        find(tmp_path)


def test_only_the_central_square_is_used_whichever_way_the_image_is_turned(tmp_path):
    colors = np.uint8([(255, 0, 0), (0, 200, 0), (0, 0, 255)])
    thirds = [np.broadcast_to(color, (32, 32, 3)) for color in colors]
    for axis in (0, 1):
        path = save(tmp_path / "thirds.png", np.concatenate(thirds, axis=axis))
        np.testing.assert_array_equal(load_one(path), thirds[1])


def test_a_large_jpeg_decoded_small_equals_one_decoded_in_full(tmp_path):
    coarse = Image.fromarray(np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8))
    large = coarse.resize((2333, 1801), Image.Resampling.BICUBIC)
    path = save(tmp_path / "a.jpg", large, quality=90)
    with Image.open(path) as image:
        whole = save(tmp_path / "a.bmp", image.convert("RGB"))
    difference = np.abs(load_one(path) - load_one(whole))
    # Halving an odd side rounds it up, which moves the center by 1/100 of a final pixel.
    assert difference.max() <= 8
    assert difference.mean() <= 1


@pytest.mark.parametrize(
    ("name", "image", "options", "expected"),
    [
        (
            "color-key.png",
            Image.new("RGB", (9, 9), (10, 20, 30)),
            {"transparency": (10, 20, 30)},
            (255, 255, 255),
        ),
        ("alpha.png", Image.new("RGBA", (40, 40), (255, 0, 0, 51)), {}, (255, 204, 204)),
        ("cmyk.jpg", Image.new("CMYK", (40, 40), (0, 255, 255, 0)), {"quality": 100}, (255, 0, 0)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_any_mode_becomes_rgb_over_white(tmp_path, name, image, options, expected):
    loaded = load_one(save(tmp_path / name, image, **options))
    assert np.abs(loaded - expected).max() <= (2 if name.endswith("jpg") else 0)


def test_unreadable_images_are_named_or_skipped(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    cut = save(tmp_path / "cut.jpg", noise)
    cut.write_bytes(cut.read_bytes()[:2000])
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nowhere.jpg")
    (tmp_path / "text.png").write_text("not an image")
    broken = sorted(path.name for path in tmp_path.iterdir())
    found = photographs.find_photographs(tmp_path, CLASSES, "orange")
    for skip_unreadable in (False, True):  # nothing is left when all of them are skipped
        with pytest.raises(InputError, match=r"3 of 3 .*cut\.jpg .*replace them$"):
            photographs.load_photographs(tmp_path, found, 32, skip_unreadable)

    save_plain(tmp_path / "good.png", (255, 128, 0), (32, 32))
    found = photographs.find_photographs(tmp_path, CLASSES, "orange")
    with pytest.raises(InputError, match=r"3 of 4 .*cut\.jpg .* set skip_unreadable=True"):
        photographs.load_photographs(tmp_path, found, 32, False)
    loaded, images, unreadable = photographs.load_photographs(tmp_path, found, 32, True)
    assert [str(photograph.path) for photograph in loaded] == ["good.png"]
    assert (images.permute(0, 2, 3, 1) == torch.tensor([255, 128, 0])).all()
    assert unreadable == broken
