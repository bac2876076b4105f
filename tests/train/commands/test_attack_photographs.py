import json

import numpy as np
import pytest
import torch
from PIL import Image

from renderer.errors import InputError
from scripts.attack import list_parameters
from scripts.attack import main as attack
from tests.helpers import bright_or_dark
from train.auditing.relit import PICTURE_COUNT, read_relit
from train.commands.attack import run
from train.results.predictions import RELIT


def load_bright_or_dark():
    return bright_or_dark, 16, ["bright", "dark"]


def settings_of(*words):
    name = "network=python:tests.train.commands.test_attack_photographs:load_bright_or_dark"
    return attack.read(list_parameters([name, *words]))


@pytest.fixture(scope="module")
def out(half_dark, tmp_path_factory):
    folder = tmp_path_factory.mktemp("attack") / "out"
    size = ["attack.relighting.passes=5", "attack.relighting.slides=2"]
    run(settings_of("attack=relighting", f"unlabeled={half_dark}", f"out={folder}", *size))
    return folder


def test_every_photograph_has_predictions_which_the_tables_count(out, half_dark):
    scores = read_relit(out)
    paths = {path.relative_to(half_dark).as_posix() for path in half_dark.rglob("*.png")}
    assert {item.path for item in scores.photographs} == paths
    for item in scores.photographs:
        for light in scores.lights:
            is_kept = sum(name == item.predicted for name in item.becomes[light])
            assert is_kept <= item.kept[light] <= scores.slides
        assert item.kept["adversarial"] <= item.kept["slide"]

    content = json.loads((out / RELIT).read_text())
    rows = {row[0]: row for row in scores.tables()[1].rows}
    for place, light in enumerate(scores.lights):
        kept = [item for item in content["photographs"] if item["kept"][light] == 2]
        assert scores.kept(light).hits == len(kept)
        for name in ("bright", "dark"):
            expected = sum(item["predicted"] == name for item in kept)
            assert name not in rows or rows[name][2 + place] == expected
    assert sum(row[1] for row in rows.values()) == 12


def test_pictures_show_the_photograph_and_its_lights(out):
    scores = read_relit(out)
    assert 0 < len(scores.pictures) <= PICTURE_COUNT
    for index, name in scores.pictures.items():
        with Image.open(out / name) as strip:
            pixels = torch.from_numpy(np.array(strip)).permute(2, 0, 1)
        assert pixels.shape == (3, 16, 16 * (1 + len(scores.lights)))
        predicted = bright_or_dark(pixels[None, :, :, :16] / 255).argmax()
        assert scores.photographs[index].predicted == ["bright", "dark"][predicted]


@pytest.mark.parametrize(
    ("word", "key"),
    [
        ("target=dark", "target"),
        ("meshes=[solid:cup]", "meshes"),
        ("scene.views=2", "scene.views"),
        ("attack.max_steps=5", "attack.max_steps"),
        ("attack.eot.draws=2", "attack.eot.draws"),
        ("attack.radius_scales=[1,2]", "attack.radius_scales"),
        ("attack=relighting+lighting", "attack"),
        ("unlabeled=null", ""),
    ],
)
def test_relighting_needs_photographs_alone_and_no_settings_that_it_does_not_use(word, key):
    words = ["attack=relighting", "unlabeled=folder"]
    used = ["seed=3", "attack.batch_size=4", "attack.sensor_noise=0", "attack.relighting.gain=2"]
    assert settings_of(*words, *used).attack.batch_size == 4
    with pytest.raises(InputError) as caught:
        settings_of(*words, word)
    assert caught.value.argument == key
    assert "relighting" in str(caught.value)


def test_no_results_are_written_among_the_photographs(half_dark):
    words = "attack=relighting", f"unlabeled={half_dark}", f"out={half_dark / 'out'}"
    with pytest.raises(InputError, match="lies inside"):
        run(settings_of(*words))
