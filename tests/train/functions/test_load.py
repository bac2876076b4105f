"""Published networks come with the results that their page tells."""

from pathlib import Path

import pytest

import norm_balls as nb

ROOT = Path(__file__).parents[3]


def rows_of_the_page() -> dict[str, list[str]]:
    """Read the first table of results in pretrained/README.md, by the name of the network."""
    lines = (ROOT / "pretrained" / "README.md").read_text().splitlines()
    header = next(line for line in lines if line.startswith("|network|CIFAR-100|"))
    rows: dict[str, list[str]] = {}
    for line in lines[lines.index(header) + 2 :]:
        if not line.startswith("|"):
            return rows
        name, *cells = line.strip("|").split("|")
        rows[name.strip("`")] = cells
    return rows


@pytest.mark.parametrize("name", ["none", "random", "adversarial", "best"])
def test_the_results_are_those_of_the_page(name):
    accuracy, *_, recall, false_positive_rate, auc, _ = rows_of_the_page()[name]
    results = nb.load(name).results
    assert results["test/accuracy"].value == float(accuracy)
    errors = results["photographs/false_positive_rate"]
    # The page has the scores of another precision of the arithmetic.
    assert errors.value == pytest.approx(float(false_positive_rate), abs=3e-3)
    assert results["photographs/recall"].value == pytest.approx(float(recall), abs=5e-3)
    assert results["photographs/auc"].value == pytest.approx(float(auc.split()[0]), abs=1e-3)


def test_the_network_is_that_of_its_folder():
    loaded = nb.load("best")
    expected = nb.load_run("pretrained/best")
    assert loaded.classes == expected.classes
    weights = expected.state_dict()
    assert all(value.equal(weights[name]) for name, value in loaded.state_dict().items())
    assert loaded.operating_points == expected.operating_points


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(nb.InputError, match="adversarial, best, none, random"):
        nb.load("bset")
