import csv
import json
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.special import softmax
from scipy.stats import binomtest

from renderer.errors import InputError
from train.contact_sheet import CELL, FRAME, PICTURE, Section, Tile, draw_contact_sheet
from train.photographs import (
    Photograph,
    evaluate_photographs,
    find_photographs,
    format_summary,
    load_photographs,
)

CLASSES = ["apple", "fig", "lime", "orange", "pear", "plum"]
DATA = Path(__file__).parents[2].parent / "shared" / "data"


def save(path: Path, pixels: np.ndarray | Image.Image, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    image.save(path, **options)
    return path


def plain(colour=(255, 128, 0), size=(32, 32)) -> Image.Image:
    return Image.new("RGB", size, colour)


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def load_one(path: Path, size: int = 32) -> np.ndarray:
    """The picture as (size, size, 3) integers."""
    photograph = Photograph(PurePosixPath(path.name), "orange", None)
    _, images, _ = load_photographs(path.parent, [photograph], size)
    return images[0].permute(1, 2, 0).numpy().astype(int)


# ---------------------------------------------------------------------------------------- finding


def test_class_folders_give_the_class_at_any_depth_in_sorted_order(tmp_path):
    touch(tmp_path, "pear/b.PNG", "orange/2026/may/c.jpeg", "orange/a.webp", "other_tomato__none/d.TIF")
    found = find_photographs(tmp_path, CLASSES, "orange")
    assert [(str(photograph.path), photograph.label) for photograph in found] == [
        ("orange/2026/may/c.jpeg", "orange"),
        ("orange/a.webp", "orange"),
        ("other_tomato__none/d.TIF", "other_tomato__none"),
        ("pear/b.PNG", "pear"),
    ]
    assert {photograph.source for photograph in found} == {None}


def test_pictures_without_class_folders_are_all_of_the_given_class(tmp_path):
    touch(tmp_path, "b.jpg", "a.gif")
    assert find_photographs(tmp_path, CLASSES, "pear") == [
        Photograph(PurePosixPath("a.gif"), "pear", None),
        Photograph(PurePosixPath("b.jpg"), "pear", None),
    ]


def test_hidden_files_and_other_kinds_of_file_are_passed_over(tmp_path):
    touch(tmp_path, "orange/a.jpg", "orange/._a.jpg", "orange/.cache/b.jpg", ".git/c.jpg", "orange/notes.txt")
    (tmp_path / "orange" / "folder.jpg").mkdir()
    assert [str(photograph.path) for photograph in find_photographs(tmp_path, CLASSES, "orange")] == ["orange/a.jpg"]


def test_sources_come_from_photos_csv_whatever_its_other_columns_and_rows(tmp_path):
    touch(tmp_path, "orange/a.jpg", "orange/b.jpg", "pear/c.jpg")
    rows = "class,source_tag,path\norange,web,orange/a.jpg\norange,,orange/b.jpg\nfig,web,fig/gone.jpg\n\n"
    (tmp_path / "photos.csv").write_text("\ufeff" + rows, encoding="utf-8")
    found = find_photographs(tmp_path, CLASSES, "orange")
    assert [photograph.source for photograph in found] == ["web", None, None]


@pytest.mark.parametrize("table", [b"", b"path,source\na.jpg,web\n", b"path,source_tag\n\xff.jpg,web\n"])
def test_a_photos_csv_without_its_columns_is_refused_by_name(tmp_path, table):
    touch(tmp_path, "a.jpg")
    (tmp_path / "photos.csv").write_bytes(table)
    with pytest.raises(InputError, match=r"photos\.csv .* columns path and source_tag"):
        find_photographs(tmp_path, CLASSES, "orange")


@pytest.mark.parametrize(
    ("files", "folder", "label", "message"),
    [
        ((), "gone", "orange", "gone does not exist"),
        (("a.jpg",), "a.jpg", "orange", r"a\.jpg is not a folder"),
        ((), ".", "orange", "holds no photographs"),
        (("orange/notes.txt",), ".", "orange", "holds no photographs"),
        (("Oranges/a.jpg",), ".", "orange", "Oranges is not .* 'orange'.* other_Oranges"),
        (("orange /a.jpg",), ".", "orange", "orange  is not .* 'orange'"),
        (("orange/a.jpg", "b.jpg"), ".", "orange", r"b\.jpg lies beside class folders"),
        (("a.jpg",), ".", "PAER", "'PAER' is not a class .* 'pear'"),
        (("other_lemon/a.jpg",), ".", "other_lemon", "'other_lemon' is not a class"),
    ],
)
def test_what_cannot_be_labelled_is_refused_in_one_sentence(tmp_path, files, folder, label, message):
    touch(tmp_path, *files)
    with pytest.raises(InputError, match=message) as caught:
        find_photographs(tmp_path / folder, CLASSES, label)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------------------------- loading


# EXIF 2.3, tag 274: which sides of the upright picture the stored first row and first column are.
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


@pytest.mark.parametrize("axis", [0, 1])
def test_only_the_central_square_is_kept(tmp_path, axis):
    thirds = [np.broadcast_to(np.uint8(colour), (32, 32, 3)) for colour in ((255, 0, 0), (0, 200, 0), (0, 0, 255))]
    path = save(tmp_path / "a.png", np.concatenate(thirds, axis=axis))
    np.testing.assert_array_equal(load_one(path), thirds[1])


def test_the_square_is_exactly_central_so_that_a_turned_picture_loads_turned(tmp_path):
    pixels = np.random.default_rng(0).integers(64, 192, (67, 90, 3), dtype=np.uint8)  # no clipping
    loaded = load_one(save(tmp_path / "a.png", pixels))
    turned = load_one(save(tmp_path / "b.png", np.ascontiguousarray(np.rot90(pixels))))
    # Pillow filters along rows first and rounds to 8 bits in between.
    assert np.abs(turned - np.rot90(loaded)).max() <= 1


@pytest.mark.parametrize("side", [64, 100, 333])
def test_detail_too_fine_to_show_reduces_to_grey(tmp_path, side):
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
    # Halving an odd side rounds it up, which moves the centre by 1/100 of a final pixel.
    assert difference.max() <= 8 and difference.mean() <= 1


def with_alpha(mode: str, colour: tuple[int, ...]) -> Image.Image:
    return Image.new(mode, (40, 40), colour)


def palette() -> Image.Image:
    image = Image.new("P", (40, 40), 1)
    image.putpalette([0, 0, 0, 10, 200, 30])
    return image


@pytest.mark.parametrize(
    ("name", "image", "options", "expected"),
    [
        ("grey.png", Image.new("L", (40, 40), 100), {}, (100, 100, 100)),
        ("black-and-white.png", Image.new("1", (40, 40), 1), {}, (255, 255, 255)),
        ("palette.png", palette(), {}, (10, 200, 30)),
        ("palette.gif", palette(), {}, (10, 200, 30)),
        ("clear-palette.png", palette(), {"transparency": 1}, (255, 255, 255)),
        ("half-clear-palette.png", palette(), {"transparency": bytes([255, 51])}, (206, 244, 210)),
        ("colour-key.png", plain((10, 20, 30)), {"transparency": (10, 20, 30)}, (255, 255, 255)),
        ("alpha.png", Image.new("RGBA", (40, 40), (255, 0, 0, 51)), {}, (255, 204, 204)),
        ("grey-alpha.png", Image.new("LA", (40, 40), (0, 51)), {}, (204, 204, 204)),
        ("alpha.webp", Image.new("RGBA", (40, 40), (255, 0, 0, 0)), {"lossless": True}, (255, 255, 255)),
        ("cmyk.tif", Image.new("CMYK", (40, 40), (0, 255, 255, 0)), {}, (255, 0, 0)),
        ("cmyk.jpg", Image.new("CMYK", (40, 40), (0, 255, 255, 0)), {"quality": 100}, (255, 0, 0)),
        ("sixteen.png", Image.fromarray(np.full((40, 40), 0x80C0, np.uint16)), {}, (128, 128, 128)),
        ("sixteen.tif", Image.fromarray(np.full((40, 40), 0xFFFF, np.uint16)), {}, (255, 255, 255)),
        ("thirty-two.tif", Image.fromarray(np.full((40, 40), 0x40FF, np.int32)), {}, (64, 64, 64)),
        ("plain.bmp", plain((1, 2, 3)), {}, (1, 2, 3)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_any_mode_becomes_rgb_over_white(tmp_path, name, image, options, expected):
    loaded = load_one(save(tmp_path / name, image, **options))
    assert np.abs(loaded - expected).max() <= (2 if name.endswith("jpg") else 0)


def test_pictures_come_as_bytes_in_the_order_asked_for(tmp_path):
    colours = {"c.png": (255, 0, 0), "a.png": (0, 255, 0), "b.png": (0, 0, 255)}
    for name, colour in colours.items():
        save(tmp_path / name, plain(colour, (50, 40)))
    photographs = [Photograph(PurePosixPath(name), "orange", None) for name in colours]
    kept, images, unreadable = load_photographs(tmp_path, photographs, size=8)
    assert (kept, unreadable) == (photographs, [])
    assert images.dtype == torch.uint8 and images.shape == (3, 3, 8, 8) and images.is_contiguous()
    assert [tuple(image[:, 4, 4].tolist()) for image in images] == list(colours.values())


def truncated(path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    save(path, noise)
    path.write_bytes(path.read_bytes()[:2000])


BROKEN = {
    "truncated.jpg": truncated,
    "truncated.png": truncated,
    "empty.jpg": Path.touch,
    "text.png": lambda path: path.write_text("not a picture"),
    "huge.png": lambda path: save(path, plain(size=(100, 100))),
    "float.tif": lambda path: save(path, np.ones((40, 40), np.float32)),
}


@pytest.fixture
def small_bomb_limit(monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 4096)  # Pillow refuses what has over twice as many


@pytest.mark.parametrize(("name", "break_picture"), BROKEN.items())
def test_an_unreadable_picture_is_named_or_skipped(tmp_path, small_bomb_limit, name, break_picture):
    break_picture(tmp_path / name)
    save(tmp_path / "good.png", plain())
    found = find_photographs(tmp_path, CLASSES, "orange")
    with pytest.raises(InputError, match=rf"1 of 2 .*{name} .*evaluate\.skip_unreadable=true"):
        load_photographs(tmp_path, found)
    kept, images, unreadable = load_photographs(tmp_path, found, skip_unreadable=True)
    assert [str(photograph.path) for photograph in kept] == ["good.png"]
    assert images.shape == (1, 3, 32, 32) and unreadable == [name]


def test_many_unreadable_pictures_are_counted_and_the_first_is_named(tmp_path, small_bomb_limit):
    for name, break_picture in BROKEN.items():
        break_picture(tmp_path / name)
    found = find_photographs(tmp_path, CLASSES, "orange")
    for skip_unreadable in (False, True):  # there is nothing to go on with
        with pytest.raises(InputError, match=r"6 of 6 .*empty\.jpg .*replace them$"):
            load_photographs(tmp_path, found, skip_unreadable=skip_unreadable)


# ---------------------------------------------------------------------------------------- scoring


class Oracle(torch.nn.Module):
    """Answers row i of a table of logits for a picture whose red is i."""

    def __init__(self, table):
        super().__init__()
        self.table = torch.as_tensor(table, dtype=torch.float32)

    def forward(self, images):
        assert images.dtype == torch.float32 and images.ndim == 4 and images.shape[1] == 3
        return self.table[(images[:, 0].mean(dim=(1, 2)) * 255).round().long()]


def save_for_oracle(folder: Path, names: list[str]) -> None:
    for index, name in enumerate(names):
        save(folder / name, plain((index, 0, 0)))


# Photograph, source, and the model's classes from best to worst.
STORY = [
    ("orange/a.png", "lab", "orange pear plum fig lime apple"),
    ("orange/b.png", "lab", "pear orange plum fig lime apple"),
    ("orange/c.png", "street", "apple pear plum fig lime orange"),
    ("orange/d.png", "", "plum pear apple fig orange lime"),
    ("orange/e.png", "street", "pear orange plum fig lime apple"),
    ("other_lemon/f.png", "street", "orange pear plum fig lime apple"),
    ("other_lemon/g.png", "street", "lime pear plum fig orange apple"),
    ("pear/h.png", "shop", "pear orange plum fig lime apple"),
    ("pear/i.png", "shop", "orange apple plum fig lime pear"),
    ("pear/j.png", "", "apple orange plum fig pear lime"),
]


@pytest.fixture
def story(tmp_path):
    """A folder of photographs and a model whose every answer is known."""
    folder = tmp_path / "photos"
    save_for_oracle(folder, [name for name, _, _ in STORY])
    lines = [f"{name},{source}" for name, source, _ in STORY]
    (folder / "photos.csv").write_text("\n".join(["path,source_tag", *lines]))
    return folder, Oracle([[-order.split().index(name) for name in CLASSES] for _, _, order in STORY])


def share(hits: int, n: int) -> dict:
    interval = binomtest(hits, n).proportion_ci(method="wilson")
    return {"value": hits / n, "low": interval.low, "high": interval.high, "hits": hits, "n": n}


NOTHING = {"value": None, "low": None, "high": None, "hits": 0, "n": 0}

STORY_SUMMARY = {
    "label": "orange",
    "n": {"photographs": 10, "label": 5, "others": 5, "unreadable": 0},
    "recall": share(1, 5),
    "top5": share(4, 5),
    "false_alarms": share(2, 5),
    "most_common_wrong": {"pear": 2, "apple": 1, "plum": 1},
    "by_source": {
        "lab": {"n": 2, "recall": share(1, 2), "top5": share(2, 2), "false_alarms": NOTHING},
        "shop": {"n": 2, "recall": NOTHING, "top5": NOTHING, "false_alarms": share(1, 2)},
        "street": {"n": 4, "recall": share(0, 2), "top5": share(1, 2), "false_alarms": share(1, 2)},
    },
    "by_class": {
        "orange": {
            "n": 5,
            "recall": share(1, 5),
            "top5": share(4, 5),
            "called_label": share(1, 5),
            "most_common_wrong": {"pear": 2, "apple": 1, "plum": 1},
        },
        "other_lemon": {
            "n": 2,
            "recall": NOTHING,
            "top5": NOTHING,
            "called_label": share(1, 2),
            "most_common_wrong": {"lime": 1, "orange": 1},
        },
        "pear": {
            "n": 3,
            "recall": share(1, 3),
            "top5": share(2, 3),
            "called_label": share(1, 3),
            "most_common_wrong": {"apple": 1, "orange": 1},
        },
    },
    "unreadable": [],
}


def rounded(tree):
    """The same tree with its floats to 12 digits, below which the order of the operations shows."""
    if isinstance(tree, dict):
        return {key: rounded(value) for key, value in tree.items()}
    return round(tree, 12) if isinstance(tree, float) else tree


@pytest.mark.parametrize("batch_size", [1, 3, 256])
def test_every_figure_of_a_known_model_is_right(story, tmp_path, batch_size):
    folder, model = story
    summary = evaluate_photographs(model, CLASSES, folder, "orange", tmp_path / "out", batch_size=batch_size)
    assert rounded(summary) == rounded(STORY_SUMMARY)
    ordered = summary["by_class"]["orange"]["most_common_wrong"]
    assert list(ordered.items()) == [("pear", 2), ("apple", 1), ("plum", 1)]


def test_the_summary_written_is_the_summary_returned_in_strict_json(story, tmp_path):
    folder, model = story
    summary = evaluate_photographs(model, CLASSES, folder, "orange", tmp_path / "new" / "out")
    text = (tmp_path / "new" / "out" / "summary.json").read_text(encoding="utf-8")

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    assert json.loads(text, parse_constant=refuse) == summary


@pytest.mark.parametrize("hits, n", [(0, 1), (1, 1), (0, 40), (40, 40), (1, 527), (263, 527), (527, 527)])
def test_intervals_are_wilson_score_intervals(tmp_path, hits, n):
    """Also at the ends, where the normal approximation leaves [0, 1]."""
    folder = tmp_path / "photos"
    shared = save(tmp_path / "hit.png", plain((1, 0, 0))), save(tmp_path / "miss.png", plain((0, 0, 0)))
    folder.mkdir()
    for index in range(n):
        (folder / f"{index}.png").hardlink_to(shared[0] if index < hits else shared[1])
    recall = evaluate_photographs(Oracle(np.eye(2)), ["pear", "orange"], folder, "orange", tmp_path)["recall"]
    assert 0 <= recall["low"] <= recall["value"] <= recall["high"] <= 1
    assert rounded(recall) == rounded(share(hits, n))


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_csv_gives_each_photograph_its_probabilities_and_brute_force_ranks(tmp_path):
    names = [f"{label}/{index}.png" for label in ("orange", "other_x", "plum") for index in range(4)]
    save_for_oracle(tmp_path / "photos", names)
    logits = np.random.default_rng(0).normal(0, 3, (len(names), len(CLASSES))).astype(np.float32)
    evaluate_photographs(Oracle(logits), CLASSES, tmp_path / "photos", "orange", tmp_path)
    rows = read_csv(tmp_path / "photographs.csv")
    assert [row["path"] for row in rows] == names
    for row, scores in zip(rows, logits.astype(float), strict=True):
        probabilities = dict(zip(CLASSES, softmax(scores), strict=True))
        ranking = sorted(CLASSES, key=probabilities.get, reverse=True)
        label = row["path"].split("/")[0]
        assert (row["label"], row["source"], row["prediction"]) == (label, "", ranking[0])
        assert float(row["probability"]) == pytest.approx(probabilities[ranking[0]], rel=1e-12)
        assert float(row["orange_probability"]) == pytest.approx(probabilities["orange"], rel=1e-12)
        assert int(row["orange_rank"]) == ranking.index("orange") + 1
        if label == "other_x":
            assert (row["true_probability"], row["true_rank"]) == ("", "")
        else:
            assert float(row["true_probability"]) == pytest.approx(probabilities[label], rel=1e-12)
            assert int(row["true_rank"]) == ranking.index(label) + 1


def test_ranks_hold_where_probabilities_round_to_zero(tmp_path):
    save_for_oracle(tmp_path / "photos", ["a.png"])
    evaluate_photographs(Oracle([[0, -5000, -4000]]), ["a", "b", "c"], tmp_path / "photos", "c", tmp_path)
    (row,) = read_csv(tmp_path / "photographs.csv")
    assert (float(row["c_probability"]), row["c_rank"]) == (0, "2")


@pytest.mark.parametrize("label", CLASSES)
def test_a_tie_of_all_classes_goes_to_the_first_alone(tmp_path, label):
    save_for_oracle(tmp_path / "photos", ["a.png"])
    summary = evaluate_photographs(Oracle(np.zeros((1, 6))), CLASSES, tmp_path / "photos", label, tmp_path)
    assert summary["recall"]["value"] == (label == CLASSES[0])
    assert summary["top5"]["value"] == (label != CLASSES[5])


def test_a_model_that_calls_everything_orange_has_recall_1_and_false_alarms_1(story, tmp_path):
    folder, _ = story
    orange = torch.nn.functional.one_hot(torch.tensor(CLASSES.index("orange")), len(CLASSES)).float()
    summary = evaluate_photographs(lambda x: orange.expand(len(x), -1), CLASSES, folder, "orange", tmp_path)
    assert summary["recall"]["value"] == summary["false_alarms"]["value"] == 1
    assert summary["most_common_wrong"] == {}
    assert all(figures["called_label"]["value"] == 1 for figures in summary["by_class"].values())


def test_a_class_without_photographs_has_no_recall_rather_than_a_wrong_one(story, tmp_path):
    folder, model = story
    summary = evaluate_photographs(model, CLASSES, folder, "fig", tmp_path)
    assert summary["recall"] == summary["top5"] == NOTHING
    assert rounded(summary["false_alarms"]) == rounded(share(0, 10))


def test_skipped_photographs_are_counted_and_named_but_not_scored(story, tmp_path):
    folder, model = story
    touch(folder, "orange/broken.jpg")
    with pytest.raises(InputError, match="1 of 11 "):
        evaluate_photographs(model, CLASSES, folder, "orange", tmp_path)
    summary = evaluate_photographs(model, CLASSES, folder, "orange", tmp_path, skip_unreadable=True)
    assert summary["unreadable"] == ["orange/broken.jpg"]
    assert summary["n"] == {"photographs": 10, "label": 5, "others": 5, "unreadable": 1}
    assert format_summary(summary).endswith("1 unreadable: orange/broken.jpg")


@pytest.mark.parametrize("fails", [False, True])
def test_the_model_is_asked_in_eval_mode_without_gradients_and_left_as_it_was(story, tmp_path, fails):
    folder, oracle = story

    class Spy(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.live, self.frozen = torch.nn.BatchNorm2d(3), torch.nn.BatchNorm2d(3).eval()

        def forward(self, images):
            assert not any(module.training for module in self.modules())
            assert not self.live(images).requires_grad
            if fails:
                raise RuntimeError("out of memory")
            return oracle(images)

    model = Spy()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    try:
        evaluate_photographs(model, CLASSES, folder, "orange", tmp_path)
    except RuntimeError:
        assert fails
    assert (model.training, model.live.training, model.frozen.training) == (True, True, False)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("answer", "message"),
    [(torch.zeros(10), r"shape \(10, 10\), not \(10, 6\)"), (torch.full((6,), torch.nan), "not finite")],
)
def test_a_model_that_does_not_fit_is_refused(story, tmp_path, answer, message):
    folder, _ = story
    with pytest.raises(InputError, match=message):
        evaluate_photographs(lambda x: answer.expand(len(x), -1), CLASSES, folder, "orange", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------------- showing


def test_the_terminal_table_is_aligned_and_complete():
    assert (
        format_summary(STORY_SUMMARY)
        == """\
5 photographs of orange, 5 of other things

                             recall                       top-5                false alarms
overall  1/5 = 0.200 [0.036, 0.624]  4/5 = 0.800 [0.376, 0.964]  2/5 = 0.400 [0.118, 0.769]
lab      1/2 = 0.500 [0.095, 0.905]  2/2 = 1.000 [0.342, 1.000]                           -
shop                              -                           -  1/2 = 0.500 [0.095, 0.905]
street   0/2 = 0.000 [0.000, 0.658]  1/2 = 0.500 [0.095, 0.905]  1/2 = 0.500 [0.095, 0.905]

class        n  recall  top-5  called orange  most common wrong answers
orange       5   0.200  0.800          0.200  pear 2, apple 1, plum 1
other_lemon  2       -      -          0.500  lime 1, orange 1
pear         3   0.333  0.667          0.333  apple 1, orange 1"""
    )


FRAMES = {"hits": (46, 158, 91), "misses": (208, 59, 59), "false alarms": (232, 163, 23)}


def count_tiles(sheet: Image.Image) -> dict[str, int]:
    pixels = np.asarray(sheet)
    areas = {name: int((pixels == colour).all(axis=2).sum()) for name, colour in FRAMES.items()}
    counts = {name: divmod(area, CELL**2 - PICTURE**2) for name, area in areas.items()}
    assert all(rest == 0 for _, rest in counts.values())
    return {name: count for name, (count, _) in counts.items()}


def test_the_contact_sheet_frames_each_hit_miss_and_false_alarm(story, tmp_path):
    folder, model = story
    evaluate_photographs(model, CLASSES, folder, "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == {"hits": 1, "misses": 4, "false alarms": 2}


def test_the_contact_sheet_stays_bounded_and_keeps_the_surest_and_the_least_sure(tmp_path):
    """Of 101 hits 40 are drawn, picture 100 being the surest and picture 0 the least."""
    save_for_oracle(tmp_path / "photos", [f"{index:03}.png" for index in range(101)])
    table = np.stack([np.arange(1, 102), np.zeros(101)], axis=1) / 20
    evaluate_photographs(Oracle(table), ["orange", "pear"], tmp_path / "photos", "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == {"hits": 40, "misses": 0, "false alarms": 0}
        red, green, blue = np.moveaxis(np.asarray(sheet), 2, 0)
    areas = np.bincount(red[(green == 0) & (blue == 0)])
    shown = np.flatnonzero(areas >= PICTURE**2)
    assert len(shown) == 40 and shown[0] == 0 and shown[-1] == 100
    assert set(np.diff(shown)) == {2, 3}


def test_pictures_on_the_contact_sheet_keep_their_pixels():
    picture = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    tiles = [Tile(picture, ("a caption that is far too long to fit under its tile", "second line"))] * 11
    sheet = np.asarray(draw_contact_sheet([Section("empty", "red", []), Section("title", "#123456", tiles)]))
    enlarged = picture.repeat(3, axis=0).repeat(3, axis=1)
    framed = (sheet == (0x12, 0x34, 0x56)).all(axis=2)
    corners = [
        (y, x)
        for y, x in np.argwhere(framed)
        if framed[y : y + CELL, x].sum() == CELL and framed[y, x : x + CELL].sum() == CELL
    ]
    assert len(corners) == 11 and len({y for y, _ in corners}) == 2
    for y, x in corners:
        inside = sheet[y + FRAME : y + FRAME + PICTURE, x + FRAME : x + FRAME + PICTURE]
        np.testing.assert_array_equal(inside, enlarged)


# -------------------------------------------------------------------------------------- real data


@pytest.mark.realdata
@pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data")
def test_the_shared_photographs_are_found_labelled_and_loaded():
    with np.load(DATA / "cifar100.npz") as archive:
        classes = archive["classes"].tolist()
    found = find_photographs(DATA / "photos", classes, "orange")
    oranges = [photograph for photograph in found if photograph.label == "orange"]
    assert (len(oranges), len(found) - len(oranges)) == (527, 920)
    sources = {photograph.source for photograph in oranges}
    assert sources == {"tiny", "web1", "web2", "web3", "turntable"}
    kept, images, unreadable = load_photographs(DATA / "photos", found[::10])
    assert (kept, unreadable) == (found[::10], [])
    assert images.shape == (145, 3, 32, 32)
    of_oranges = images[[photograph.label == "orange" for photograph in kept]].float().mean(dim=(0, 2, 3))
    assert of_oranges[0] > of_oranges[1] > of_oranges[2]  # red above green above blue
