import json
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from augment.attacks.figure import Panel, save_figure
from renderer.errors import InputError
from train.report.attacks import read_attack, sections
from train.report.blocks import Gallery
from train.report.tables import Table

LINE = {
    "example": 0, "label": ["orange", "orange"], "predicted_before": ["orange", "plum"],
    "confidence_before": [0.875, 0.5],
    "predicted": ["plum", "plum"], "confidence": [0.75, 0.625], "success": True, "success_before": False, "steps": 7,
}  # fmt: skip


def write(folder: Path, *lines: dict) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "attack.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def panel(views: int, caption: tuple[str, ...]) -> Panel:
    return Panel(torch.full((views, 3, 8, 8), 0.5), [caption] * views, torch.ones(views, 3, 8, 8))


def galleries(folder: Path) -> list[Gallery]:
    (section,) = sections([read_attack(folder)])
    return [block for block in section.blocks if isinstance(block, Gallery)]


def test_before_after_difference_and_lights_are_shown_with_the_answers_as_text(tmp_path):
    write(tmp_path, LINE)
    save_figure(panel(1, ("87.5% orange",)), panel(1, ("75.0% plum", "2.0% orange")), tmp_path / "example_000.png")
    (gallery,) = galleries(tmp_path)
    captions = [
        "initial: 87.5% orange", "adversarial: 75.0% plum / 2.0% orange",
        "difference: largest 0.000 / shown 255 times", "initial light", "adversarial light",
    ]  # fmt: skip
    assert gallery.title == "Example 0, orange: fooled in 7 steps"
    assert [image.caption for image in gallery.images] == captions
    assert [image.alt for image in gallery.images] == [f"{gallery.title}: {caption}" for caption in captions]


def test_of_many_views_the_first_and_the_last_are_shown(tmp_path):
    write(tmp_path, LINE)
    save_figure(panel(5, ()), panel(5, ()), tmp_path / "example_000.png")
    assert [gallery.title[-11:] for gallery in galleries(tmp_path)] == ["view 1 of 5", "view 5 of 5"]


def test_of_an_older_version_the_image_is_shown_as_it_is(tmp_path):
    write(tmp_path, {key: LINE[key] for key in ("example", "label", "predicted", "confidence", "success", "steps")})
    Image.new("RGB", (1300, 20)).save(tmp_path / "example_000.png")
    (gallery,) = galleries(tmp_path)
    assert [image.width for image in gallery.images] == [1100] and "called 75.0% plum" in gallery.images[0].alt


def test_the_table_has_the_answers_before_and_after(tmp_path):
    write(tmp_path, LINE, {**LINE, "example": 1, "success_before": True})
    attack = read_attack(tmp_path)
    assert (attack.success, attack.success_before) == (1, 1)
    (table,) = [block for block in next(sections([attack])).blocks if isinstance(block, Table)]
    answers = ["orange", "87.5% orange, 50.0% plum", "75.0% plum, 62.5% plum"]
    assert table.rows == [[0, *answers, "fooled in 7 steps"], [1, *answers, "wrong before any step"]]


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=3), lambda inner: st.lists(inner, max_size=3)
)


@given(st.sampled_from([*LINE]), ANYTHING)
def test_a_line_that_no_attack_wrote_is_read_or_refused_in_one_sentence(tmp_path_factory, key, value):
    folder = tmp_path_factory.mktemp("attack")
    write(folder, LINE | {key: value})
    try:
        [*sections([read_attack(folder)])]
    except InputError as error:
        assert str(error).startswith(f"{folder / 'attack.jsonl'} is damaged or no file of an attack (")


@pytest.mark.parametrize("text", ["", "1\n", "[]\n", '{"checks": 3}\n', '{"example": 0}\n', "[" * 100_000 + "\n"])
def test_a_file_that_no_attack_wrote_is_read_or_refused(tmp_path, text):
    (tmp_path / "attack.jsonl").write_text(text)
    if text in ("", "[]\n"):
        assert not read_attack(tmp_path).examples
    else:
        with pytest.raises(InputError, match="no file of an attack"):
            read_attack(tmp_path)
