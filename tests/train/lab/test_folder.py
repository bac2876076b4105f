import csv
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from renderer.errors import InputError
from renderer.shapes import HARD_NEGATIVES, SOLIDS
from train.lab.folder import LabSettings, read_subject, write_laboratory
from train.photographs.folder import find_photographs, load_photographs

pytest.importorskip("mitsuba")

MESHES = ["solid:orange:7", {"mesh": "solid:orange:8", "albedo_scale": 0.5}, "solid:lemon:7", "solid:pear:7"]


def settings(out: Path, **changes) -> LabSettings:
    small = {"setups": 4, "patterns": ["stripes", "half"], "size": 8, "spp": 4, "bounces": 2}
    return LabSettings(**{"out": str(out), "meshes": MESHES, **small, **changes})


def rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "photos.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("laboratory") / "lab"
    assert write_laboratory(settings(folder)) == 8
    return folder


def test_a_laboratory_is_a_folder_of_photographs_with_the_pattern_as_the_source_and_its_settings(laboratory):
    photographs = find_photographs(laboratory, sorted(SOLIDS), "orange")
    assert Counter((item.label, item.source) for item in photographs) == {
        (label, pattern): count
        for label, count in {"orange": 2, "other_lemon": 1, "pear": 1}.items()
        for pattern in ("stripes", "half")
    }
    _, images, _ = load_photographs(laboratory, photographs, 8)
    assert len(images.unique(dim=0)) == 8
    described = json.loads((laboratory / "lab.json").read_text())
    assert described["meshes"] == MESHES and described["setups"] == 4 and described["seed"] == 0


def test_a_setup_shows_one_object_of_the_label_and_one_other_under_the_same_light(laboratory):
    by_setup = {}
    for row in rows(laboratory):
        by_setup.setdefault(int(row["setup"]), []).append((row["mesh"], row["source_tag"], row["brightness"]))
    pairs = [("solid:orange:7", "solid:lemon:7"), ("solid:orange:8", "solid:pear:7")] * 2
    for setup, (pair, source) in enumerate(zip(pairs, ["stripes"] * 2 + ["half"] * 2, strict=True)):
        meshes, sources, brightness = zip(*sorted(by_setup[setup]), strict=True)
        assert set(meshes) == set(pair) and set(sources) == {source} and len(set(brightness)) == 1
        assert 0.2 <= float(brightness[0]) <= 2.5
    assert len(by_setup) == 4


def test_the_same_settings_write_the_same_bytes_and_another_seed_writes_others(laboratory, tmp_path):
    for seed, same in [(0, True), (1, False)]:
        write_laboratory(settings(tmp_path / str(seed), seed=seed))
        for row in rows(laboratory):
            first, again = ((folder / row["path"]).read_bytes() for folder in (laboratory, tmp_path / str(seed)))
            assert (first == again) is same
    assert (tmp_path / "0" / "photos.csv").read_bytes() == (laboratory / "photos.csv").read_bytes()


def test_only_the_object_distinguishes_the_label_from_a_hard_negative(tmp_path):
    """One and the same mesh under both labels: the photographs of a setup are the same, byte for byte."""
    meshes = ["solid:orange:7", {"mesh": "solid:orange:7", "label": "other_orange"}]
    write_laboratory(settings(tmp_path, meshes=meshes))
    for path in (tmp_path / "orange").iterdir():
        assert path.read_bytes() == (tmp_path / "other_orange" / path.name).read_bytes()


def test_exposure_brightens(laboratory, tmp_path):
    write_laboratory(settings(tmp_path, exposure=4.0))
    for row in rows(laboratory):
        plain, exposed = (sum(Image.open(folder / row["path"]).tobytes()) for folder in (laboratory, tmp_path))
        assert exposed > plain


@pytest.mark.parametrize("name", [*SOLIDS, *HARD_NEGATIVES])
def test_a_solid_without_a_label_has_its_own_name_as_a_class_or_as_something_else(name):
    expected = name if name in SOLIDS else f"other_{name}"
    assert read_subject(f"solid:{name}:1", 0).label == expected
    assert read_subject({"mesh": f"solid:{name}", "label": "pear"}, 0).label == "pear"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meshes": ["solid:orange"]}, "meshes: name at least one of label=orange and one of another class"),
        ({"meshes": [{"mesh": "solid:orange", "label": "other_../../x"}]}, r"meshes\[0\]: the label '.*x' names the"),
        ({"meshes": ["solid:orange", "fruit.glb"]}, r"meshes\[1\]: fruit.glb has no label: give {mesh: fruit.glb, "),
        ({"setups": 5}, "setups=5 must be a positive multiple of the 2 patterns"),
        ({"patterns": ["stripe"]}, "patterns=stripe: choose one of solid, gradient, stripes"),
        ({"brightness": [2.0, 1.0]}, r"brightness=\[2.0, 1.0\]: give \[least, most\]"),
    ],
)
def test_what_cannot_be_photographed_is_refused_before_anything_is_written(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        write_laboratory(settings(tmp_path / "lab", **changes))
    assert not (tmp_path / "lab").exists()


def test_a_folder_that_holds_something_is_left_alone(laboratory):
    before = {path: path.stat().st_mtime_ns for path in laboratory.rglob("*")}
    with pytest.raises(InputError, match=r"out=.*lab is not an empty folder: name another, or delete it"):
        write_laboratory(settings(laboratory))
    assert before == {path: path.stat().st_mtime_ns for path in laboratory.rglob("*")}


def test_environments_stand_beside_patterns_and_name_the_source(tmp_path):
    noon = tmp_path / "noon.npy"
    for value, name in ((0.0, "dark"), (1.0, "lit")):
        np.save(noon, np.full((8, 16, 3), value, np.float32))
        lab = settings(tmp_path / name, patterns=["solid"], environments=[str(noon)], setups=2)
        if value == 0:
            with pytest.raises(InputError, match=r"noon\.npy is negative somewhere or dark above"):
                write_laboratory(lab)
        else:
            write_laboratory(lab)
    assert sorted({row["source_tag"] for row in rows(tmp_path / "lit")}) == ["noon", "solid"]
