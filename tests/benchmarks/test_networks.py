import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import rankdata

from benchmarks import networks
from tests.helpers import darker_than, save_plain


def rows_in(path):
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == networks.HEADER
    return {tuple(row[:3]): [float(cell or "nan") for cell in row[3:6]] for row in rows}


@pytest.fixture
def add(tmp_path, monkeypatch):
    """Add networks to a copy of the published file, in few renders of few pixels."""
    kinds = {networks.LABEL: ["orange"], networks.OTHERS: ["apple", "pear"]}
    objects = {
        folder: [f"solid:{name}:{seed}" for name in names for seed in (1, 2)]
        for folder, names in kinds.items()
    }
    monkeypatch.setattr(networks, "OBJECTS", objects)
    monkeypatch.setattr(networks, "MAPS", ("grace", "st_peters"))
    monkeypatch.setattr(networks, "SIZE", 32)
    known = {"half": darker_than(0.5, size=16, scale=10)}
    monkeypatch.setattr(networks.real_light, "load", known.__getitem__)
    renders = tmp_path / "renders"

    def run(scores, out):
        words = [str(out), "--scores", str(scores), "--renders", str(renders)]
        networks.main(["add", "half", "--out", *words])
        return rows_in(out)

    return run


def test_ranks_are_those_of_scipy():
    values = np.array([0.5, 0.9, 0.5, 0.1, 0.9, 0.7])
    exact = networks.rank({name: (x, x, x) for name, x in enumerate(values)})
    lowest, highest = (rankdata(-values, method) for method in ("min", "max"))
    # Networks whose intervals are points may change their order only if they are equal.
    expected = np.stack([lowest, lowest, highest], axis=1)
    assert np.array_equal([*exact.values()], expected)
    unknown = networks.rank({name: (x, 0.0, 1.0) for name, x in enumerate(values)})
    assert {each[1:] for each in unknown.values()} == {(1, len(values))}


def test_a_network_that_is_added_again_has_the_same_scores(add, tmp_path):
    before = rows_in(networks.SCORES)
    once = add(networks.SCORES, tmp_path / "once.csv")
    shutil.rmtree(tmp_path / "renders")
    assert add(tmp_path / "once.csv", tmp_path / "again.csv") == once
    text = (tmp_path / "once.csv").read_text()
    (tmp_path / "once.csv").write_text(text.replace("half", "other"))
    kept = {key for key in rows_in(tmp_path / "once.csv") if key[0] == "other"}
    assert add(networks.SCORES, tmp_path / "once.csv").keys() == once.keys() | kept
    assert {key: once[key] for key in before} == before
    own = {key[1] for key in once.keys() - before.keys()}
    assert own == {light for light in networks.LIGHTS if not light.endswith("real")}


def test_an_attack_lowers_the_auc_of_the_attacked_network(add, tmp_path):
    scores = add(networks.SCORES, tmp_path / "scores.csv")
    natural, attacked = (scores["half", light, "AUC"][0] for light in ("natural", "adversarial"))
    assert attacked < natural


def test_the_page_shows_the_table_of_the_file(capsys):
    networks.main(["table"])
    page = networks.SCORES.with_suffix(".md").read_text()
    assert capsys.readouterr().out in page


@pytest.fixture
def real(tmp_path):
    """Return a function that writes photographs of two classes in projected light."""

    def write(light, other):
        for label, level in (("orange", 40), (other, 200)):
            save_plain(tmp_path / f"real/projector/{label}/{light}__1.png", level)
        return tmp_path / "real"

    return write


@pytest.mark.parametrize(
    ("light", "other", "top1"), [("stripes_coarse", "other", [1]), ("stripes_fine", "mug", [])]
)
def test_stripes_of_any_width_are_scored_by_networks_with_all_classes(
    real, capsys, light, other, top1
):
    folders = networks.real_folders(real(light, other))
    found = networks.score_real(darker_than(0.5), folders)
    assert [each[networks.TOP1].value for each in found.values()] == top1
    # A class that leaves the column out is named.
    assert (other in capsys.readouterr().out) == (not top1)


def test_photographs_that_cannot_be_scored_end_a_command_before_the_renders(
    add, real, tmp_path, capsys
):
    words = ["--real", str(real("dim", "other")), "--renders", str(tmp_path / "renders")]
    with pytest.raises(SystemExit, match="2"):
        networks.main(["add", "half", *words])
    assert "error: " in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "renders").exists()


@pytest.mark.slow
def test_a_published_network_that_is_added_again_has_its_published_scores(tmp_path):
    name, out = "pretrained/none", Path(tmp_path / "scores.csv")
    networks.main(["add", name, "--out", str(out)])
    published, measured = rows_in(networks.SCORES), rows_in(out)
    for key, (value, *_) in published.items():
        # One of 60 images of an orange is 0.017.
        if key[0] == name and key in measured:
            assert measured[key][0] == pytest.approx(value, abs=0.02), key
