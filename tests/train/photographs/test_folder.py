import logging
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch
from PIL import Image

from renderer.errors import InputError
from train.photographs.folder import Photograph, find_photographs, left_out, load_photographs

CLASSES = ["apple", "fig", "lime", "orange", "pear", "plum"]
DATA = Path(__file__).parents[4] / "shared" / "data"


def save(path: Path, pixels: np.ndarray | Image.Image, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    image.save(path, **options)
    return path


def plain(color=(255, 128, 0), size=(32, 32)) -> Image.Image:
    return Image.new("RGB", size, color)


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def load_one(path: Path, size: int = 32) -> np.ndarray:
    """The image as (size, size, 3) integers."""
    photograph = Photograph(PurePosixPath(path.name), "orange", None)
    _, images, _ = load_photographs(path.parent, [photograph], size)
    return images[0].permute(1, 2, 0).numpy().astype(int)


# ---------------------------------------------------------------------------------------- finding


def find(folder: Path, label: str = "orange") -> list[tuple[str, str]]:
    found = find_photographs(folder, CLASSES, label)
    assert {photograph.source for photograph in found} == {None}
    return [(str(photograph.path), photograph.label) for photograph in found]


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        pytest.param(
            ("pear/b.PNG", "orange/2026/may/c.jpeg", "orange/a.webp", "other_tomato__none/d.TIF"),
            [
                ("orange/2026/may/c.jpeg", "orange"),
                ("orange/a.webp", "orange"),
                ("other_tomato__none/d.TIF", "other_tomato__none"),
                ("pear/b.PNG", "pear"),
            ],
            id="class folders at any depth",
        ),
        pytest.param(("b.jpg", "a.gif"), [("a.gif", "orange"), ("b.jpg", "orange")], id="flat"),
        pytest.param(
            ("orange/a.JFIF", "orange/._a.jpg", "orange/.cache/b.jpg", ".git/c.jpg", "__MACOSX/a.jpg", "x.txt"),
            [("orange/a.JFIF", "orange")],
            id="hidden files",
        ),
    ],
)
def test_images_are_found_with_their_class_in_sorted_order(tmp_path, files, expected):
    assert find(touch(tmp_path, *files)) == expected


def test_links_to_folders_and_files_are_followed_but_not_in_circles(tmp_path):
    touch(tmp_path, "elsewhere/deep/a.jpg", "elsewhere/b.jpg", "photos/pear/c.jpg")
    photos = tmp_path / "photos"
    (photos / "orange").symlink_to(tmp_path / "elsewhere")
    (photos / "pear" / "d.jpg").symlink_to(tmp_path / "elsewhere" / "b.jpg")
    for circle, target in [("pear/all", photos), ("pear/self", photos / "pear"), ("pear/root", tmp_path)]:
        (photos / circle).symlink_to(target)
    assert [path for path, _ in find(photos)] == ["orange/b.jpg", "orange/deep/a.jpg", "pear/c.jpg", "pear/d.jpg"]


def test_files_of_other_kinds_are_left_out_and_listed(tmp_path):
    touch(tmp_path, "orange/a.jpg", "orange/b.HEIC", "orange/c.avif", "orange/.d.heic", "notes.txt", "lab.json")
    (tmp_path / "orange" / "folder.jpg").mkdir()
    (tmp_path / "photos.csv").write_text("path,source_tag\n")
    assert find(tmp_path) == [("orange/a.jpg", "orange")]
    assert [*map(str, left_out(tmp_path))] == ["notes.txt", "orange/b.HEIC", "orange/c.avif"]


@pytest.mark.parametrize(
    ("files", "folder", "label", "message"),
    [
        (("a.jpg",), "a.jpg", "orange", r"a\.jpg is not a folder"),
        (("orange/notes.txt",), ".", "orange", "holds no photographs"),
        (("Oranges/a.jpg",), ".", "orange", "Oranges is not .*such as orange, .* other_Oranges"),
        (("orange/a.jpg", "b.jpg"), ".", "orange", r"b\.jpg lies beside class folders"),
        (("other_lemon/a.jpg",), ".", "other_lemon", "'other_lemon' is not a class"),
    ],
)
def test_a_folder_of_another_layout_is_refused(tmp_path, files, folder, label, message):
    touch(tmp_path, *files)
    with pytest.raises(InputError, match=message):
        find_photographs(tmp_path / folder, CLASSES, label)


# ---------------------------------------------------------------------------------------- photos.csv


def test_sources_and_hard_negatives_come_from_photos_csv_in_any_order_of_columns(tmp_path, caplog):
    touch(tmp_path, "orange/a.jpg", "orange/b.jpg", "other_lemon/c.jpg", "pear/d.jpg")
    rows = [
        "class,hard_negatives,path,source_tag", "orange,lab; web,orange/a.jpg,sun", "orange,,orange/b.jpg,web",
        "lemon,;,other_lemon\\c.jpg,lab", "pear,,pear/d.jpg,", "fig,,fig/gone.jpg,web", "",
    ]  # fmt: skip
    (tmp_path / "photos.csv").write_text("\ufeff" + "\n".join(rows), encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        found = find_photographs(tmp_path, CLASSES, "orange")
    assert [photograph.source for photograph in found] == ["sun", "web", "lab", None]
    assert [photograph.hard_negatives for photograph in found] == [("lab", "web"), (), (), ()]
    assert "photos.csv has 1 of 5 rows for no file of the folder, like fig/gone.jpg" in caplog.text


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (b"path;source_tag\na.jpg;web\n", "make it UTF-8 with the columns path and source_tag, separated by commas"),
        (b"path,source_tag\nb/a.jpg,web\n", "1 of 1 rows for no file of the folder, .*; give paths such as a.jpg$"),
        (b"path,source_tag\na.jpg,web\na.jpg,web\n./a.jpg,lab\n", "two different rows for a.jpg"),
        (
            b"path,source_tag,hard_negatives\na.jpg,web,lib\n",
            "names hard_negatives of source 'lib', which has no image$",
        ),
    ],
)
def test_a_photos_csv_that_cannot_be_used_is_refused_by_name(tmp_path, table, message):
    (touch(tmp_path, "a.jpg") / "photos.csv").write_bytes(table)
    with pytest.raises(InputError, match=rf"photos\.csv .*{message}"):
        find(tmp_path)


# ---------------------------------------------------------------------------------------- loading


# EXIF 2.3, tag 274: which sides of the upright image the stored first row and first column are.
ORIENTATIONS = {
    1: ("top", "left"),
    2: ("top", "right"),
    3: ("bottom", "right"),
    4: ("bottom", "left"),
    5: ("left", "top"),
    6: ("right", "top"),
    7: ("right", "bottom"),
    8: ("left", "bottom"),
}


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize(("orientation", "sides"), ORIENTATIONS.items())
def test_every_exif_orientation_is_undone(tmp_path, orientation, sides, suffix):
    blocks = np.random.default_rng(orientation).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    upright = blocks.repeat(8, axis=0).repeat(8, axis=1)
    stored = upright if sides[0] in ("top", "bottom") else upright.transpose(1, 0, 2)
    stored = stored[::-1] if sides[0] in ("bottom", "right") else stored
    stored = stored[:, ::-1] if sides[1] in ("bottom", "right") else stored
    exif = Image.Exif()
    exif[274] = orientation
    options = {"quality": 100, "subsampling": 0} if suffix == "jpg" else {}
    path = save(tmp_path / f"a.{suffix}", np.ascontiguousarray(stored), exif=exif, **options)
    tolerance = 3 if suffix == "jpg" else 0  # JPEG rounds YCbCr and cosine coefficients to integers
    assert np.abs(load_one(path) - upright).max() <= tolerance


def test_only_the_central_square_is_used_whichever_way_the_image_is_turned(tmp_path):
    thirds = [np.broadcast_to(np.uint8(color), (32, 32, 3)) for color in ((255, 0, 0), (0, 200, 0), (0, 0, 255))]
    for axis in (0, 1):
        path = save(tmp_path / "thirds.png", np.concatenate(thirds, axis=axis))
        np.testing.assert_array_equal(load_one(path), thirds[1])
    pixels = np.random.default_rng(0).integers(64, 192, (67, 90, 3), dtype=np.uint8)  # no clipping
    loaded = load_one(save(tmp_path / "a.png", pixels))
    turned = load_one(save(tmp_path / "b.png", np.ascontiguousarray(np.rot90(pixels))))
    # Pillow filters along rows first and rounds to 8 bits in between.
    assert np.abs(turned - np.rot90(loaded)).max() <= 1


@pytest.mark.parametrize("side", [64, 100, 333])
def test_detail_too_fine_to_show_reduces_to_gray(tmp_path, side):
    checkerboard = (np.indices((side, side)).sum(axis=0) % 2 * 255).astype(np.uint8)
    loaded = load_one(save(tmp_path / "a.png", checkerboard))
    assert np.abs(loaded - 127.5)[3:-3, 3:-3].max() <= 1.5  # rounded to 8 bits twice
    assert np.abs(loaded - 127.5).max() <= 4  # at the rim the filter is cut off


def test_a_large_jpeg_decoded_small_equals_one_decoded_in_full(tmp_path):
    rng = np.random.default_rng(0)
    coarse = Image.fromarray(rng.integers(0, 256, (24, 32, 3), dtype=np.uint8))
    path = save(tmp_path / "a.jpg", coarse.resize((2333, 1801), Image.Resampling.BICUBIC), quality=90)
    with Image.open(path) as image:
        whole = save(tmp_path / "a.bmp", image.convert("RGB"))
    difference = np.abs(load_one(path) - load_one(whole))
    # Halving an odd side rounds it up, which moves the center by 1/100 of a final pixel.
    assert difference.max() <= 8 and difference.mean() <= 1


def palette() -> Image.Image:
    image = Image.new("P", (40, 40), 1)
    image.putpalette([0, 0, 0, 10, 200, 30])
    return image


@pytest.mark.parametrize(
    ("name", "image", "options", "expected"),
    [
        ("gray.png", Image.new("L", (40, 40), 100), {}, (100, 100, 100)),
        ("palette.gif", palette(), {}, (10, 200, 30)),
        ("half-clear-palette.png", palette(), {"transparency": bytes([255, 51])}, (206, 244, 210)),
        ("color-key.png", plain((10, 20, 30)), {"transparency": (10, 20, 30)}, (255, 255, 255)),
        ("alpha.png", Image.new("RGBA", (40, 40), (255, 0, 0, 51)), {}, (255, 204, 204)),
        ("gray-alpha.png", Image.new("LA", (40, 40), (0, 51)), {}, (204, 204, 204)),
        ("cmyk.jpg", Image.new("CMYK", (40, 40), (0, 255, 255, 0)), {"quality": 100}, (255, 0, 0)),
        ("sixteen.png", Image.fromarray(np.full((40, 40), 0x80C0, np.uint16)), {}, (128, 128, 128)),
        ("thirty-two.tif", Image.fromarray(np.full((40, 40), 0x40FF, np.int32)), {}, (64, 64, 64)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_any_mode_becomes_rgb_over_white(tmp_path, name, image, options, expected):
    loaded = load_one(save(tmp_path / name, image, **options))
    assert np.abs(loaded - expected).max() <= (2 if name.endswith("jpg") else 0)


def test_images_come_as_bytes_in_the_order_asked_for(tmp_path):
    colors = {"c.png": (255, 0, 0), "a.png": (0, 255, 0), "b.png": (0, 0, 255)}
    for name, color in colors.items():
        save(tmp_path / name, plain(color, (50, 40)))
    photographs = [Photograph(PurePosixPath(name), "orange", None) for name in colors]
    loaded, images, unreadable = load_photographs(tmp_path, photographs, size=8)
    assert (loaded, unreadable) == (photographs, [])
    assert images.dtype == torch.uint8 and images.shape == (3, 3, 8, 8) and images.is_contiguous()
    assert [tuple(image[:, 4, 4].tolist()) for image in images] == list(colors.values())


def test_unreadable_images_are_named_or_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 4096)  # Pillow refuses what has over twice as many
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    for name in ("cut.jpg", "cut.png"):
        cut = save(tmp_path / name, noise)
        cut.write_bytes(cut.read_bytes()[:2000])
    save(tmp_path / "float.tif", np.ones((40, 40), np.float32))
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nowhere.jpg")
    save(tmp_path / "huge.png", plain(size=(100, 100)))
    (tmp_path / "text.png").write_text("not an image")
    broken = sorted(path.name for path in tmp_path.iterdir())
    found = find_photographs(tmp_path, CLASSES, "orange")
    for skip_unreadable in (False, True):  # nothing is left when all of them are skipped
        with pytest.raises(InputError, match=r"6 of 6 .*cut\.jpg .*replace them$"):
            load_photographs(tmp_path, found, skip_unreadable=skip_unreadable)

    save(tmp_path / "good.png", plain())
    found = find_photographs(tmp_path, CLASSES, "orange")
    with pytest.raises(InputError, match=r"6 of 7 .*cut\.jpg .* set skip_unreadable=true"):
        load_photographs(tmp_path, found)
    loaded, images, unreadable = load_photographs(tmp_path, found, skip_unreadable=True)
    assert [str(photograph.path) for photograph in loaded] == ["good.png"]
    assert images.shape == (1, 3, 32, 32) and unreadable == broken


# -------------------------------------------------------------------------------------- real data


@pytest.mark.realdata
@pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data")
def test_the_shared_photographs_are_found_labeled_and_loaded():
    with np.load(DATA / "cifar100.npz") as archive:
        classes = archive["classes"].tolist()
    found = find_photographs(DATA / "photos", classes, "orange")
    oranges = [photograph for photograph in found if photograph.label == "orange"]
    assert (len(oranges), len(found) - len(oranges)) == (527, 920)
    sources = {photograph.source for photograph in oranges}
    assert sources == {"tiny", "web1", "web2", "web3", "turntable"}
    loaded, images, unreadable = load_photographs(DATA / "photos", found[::10])
    assert (loaded, unreadable) == (found[::10], [])
    assert images.shape == (145, 3, 32, 32)
    of_oranges = images[[photograph.label == "orange" for photograph in loaded]].float().mean(dim=(0, 2, 3))
    assert of_oranges[0] > of_oranges[1] > of_oranges[2]  # red above green above blue
