import csv
import math
import re
from pathlib import PurePosixPath
from unicodedata import normalize

import numpy as np
import pytest
import torch
from scipy.stats import binomtest

from augment.network import say_once
from benchmarks import real_light
from tests.helpers import darker_than, save_plain
from tests.train.helpers import ranked
from train.data.photo import Photograph


@pytest.fixture
def folder(tmp_path):
    """Write oranges that are dark, and others that are bright, in two lights, as two crops each.

    In plain light, the network that tells dark from bright is right. In low light, one of four
    photographs of other objects is as dark as the oranges.
    """
    for number in range(4):
        for crop in (1, 2):
            name = f"p{number}_{crop}.png"
            for light in ("plain", "low_light"):
                save_plain(tmp_path / f"orange/{light}__{name}", 40)
                is_dark = light == "low_light" and number == 0
                save_plain(tmp_path / f"other_ball/{light}__{name}", 20 if is_dark else 200)
    return tmp_path


def score(folder, monkeypatch, *words):
    networks = {"half": darker_than(0.5), "never": darker_than(-1.0)}
    monkeypatch.setattr(real_light, "load", networks.__getitem__)
    out = folder.parent / "scores.csv"
    real_light.main(["score", str(folder), *words, "--label", "orange", "--out", str(out)])
    with out.open() as file:
        return {(row["network"], row["light"]): row for row in csv.DictReader(file)}


def test_each_light_has_its_scores(folder, monkeypatch):
    rows = score(folder, monkeypatch, "half", "never", "--crops")
    values = {
        key: [row[name].split()[0] for name in real_light.METRICS[1:]] for key, row in rows.items()
    }
    # One quarter of the others is darker than each orange. So three quarters of the pairs are
    # ranked correctly. At 5% FPR, no negative of eight may exceed the threshold.
    assert values["half", "plain"] == ["1.000", "1.000", "0.000", "1.000"]
    assert values["half", "low_light"] == ["1.000", "0.000", "0.250", "0.750"]
    assert values["never", "plain"][0] == "0.000"


def test_scores_are_the_counted_ones():
    # At 5% FPR, two pears of 40 exceed the threshold of -0.5. At 10% FPR, it would be -2.5.
    scores = [-2, -1, -0.25, 3, *(number - 37.5 for number in range(40))]
    names = np.repeat(["orange", "pear"], [4, 40])
    predictions = ranked(names, [[score, 0.0] for score in scores], ["orange", "pear"])
    found = real_light.measure(predictions, names, np.ones((1, 44), int), np.arange(44))
    top1 = (1 / 4 + 38 / 40) / 2
    auc = (36 + 37 + 38 + 40) / 160
    assert found[:, 0] == pytest.approx([top1, 1 / 4, 2 / 4, 2 / 40, auc])


def test_simulated_light_keeps_photographs_that_share_a_name(tmp_path):
    names = ("a/b_1.png", "a_b/1.png", "a_b_1.png", "a_b_1.jpg", "dim__1.png")
    for name in names:
        save_plain(tmp_path / "given/orange" / name, 40)
        save_plain(tmp_path / "flat" / name.replace("/", "+"), 40)
    for given in ("given", "flat"):
        words = ["simulate", str(tmp_path / given), str(tmp_path / f"of_{given}")]
        real_light.main([*words, "--classes", "orange", "--lights", "low_light"])
        found = real_light.find_photographs(tmp_path / f"of_{given}", ["orange"], "orange")
        lights = [*map(real_light.light_of, found)]
        assert lights.count("plain") == lights.count("low_light") == len(names)


def test_photographs_of_an_excluded_source_are_not_simulated(tmp_path):
    for name in "ab":
        save_plain(tmp_path / f"given/orange/{name}.png", 40)
    table = "path,source_tag\norange/a.png,web\norange/b.png,lab\n"
    (tmp_path / "given/photos.csv").write_text(table)
    words = ["simulate", str(tmp_path / "given"), str(tmp_path / "out"), "--classes", "orange"]
    real_light.main([*words, "--lights", "low_light", "--exclude", "web", "--size", "8"])
    found = sorted(path.name for path in (tmp_path / "out/orange").iterdir())
    assert [name[-5:] for name in found] == ["b.png", "b.png"]


@pytest.mark.parametrize(
    "words",
    [
        "simulate given out --classes orange --lights lowlight",
        "simulate given out --classes orange --lights low_light --size 0",
        "simulate given given --classes orange --lights low_light",
        "score given pretrained/none --label orange --lights dim",
        "score given pretrained/none --label orange --lights x=plain x=lamp",
        "score given pretrained/none --label orange --out missing/a.csv",
        "rank a=missing.csv --label orange",
        "rank a=given.csv --label orange",
        "rank given.csv --label orange",
        "rank a=one.csv a=other.csv --label orange",
        "simulate given out --classes pear --lights low_light",
        "simulate given out --classes orange ornge --lights low_light",
        "dim missing",
        "dim broken",
    ],
)
def test_a_mistake_of_the_user_is_one_sentence(tmp_path, capsys, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    save_plain(tmp_path / "given/orange/1.png", 40)
    save_plain(tmp_path / "given/orange/lamp__1.png", 40)
    for name, value in {"one": 0.5, "other": 0.6}.items():
        rows = f"label,network,light,recall at 5% FPR\norange,n,dim,{value}\n"
        (tmp_path / f"{name}.csv").write_text(rows)
    (tmp_path / "given.csv").write_text("a,b\n1,2\n")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/1.png").write_bytes(b"no image")
    with pytest.raises(SystemExit, match="2"):
        real_light.main(words.split())
    assert "error: " in capsys.readouterr().err.splitlines()[-1]


def test_a_run_is_loaded_as_network_spells_it():
    one, other = (real_light.load(f"{prefix}pretrained/none") for prefix in ("", "run:"))
    assert all(map(torch.equal, one.state_dict().values(), other.state_dict().values()))


def test_crops_of_a_photograph_are_drawn_together(folder):
    found = real_light.find_photographs(folder, ["orange", "ball"], "orange")
    counts = real_light.Folder(folder, found, has_crops=True).draw("orange")
    names = [item.path.stem.partition("__")[2][:2] for item in found]
    for name in {*names}:
        columns = counts[:, np.array(names) == name]
        assert (columns == columns[:, :1]).all()
    # Four photographs in both lights are drawn, with two crops each of two classes.
    assert (counts.sum(1) == len(found)).all()
    draws = counts[1:, 0]
    assert draws.var() == pytest.approx(3 / 4, abs=0.1)  # Multinomial: n p (1 - p).


def test_seeds_are_averaged_and_drawn():
    seeds = [np.full((5, 1 + real_light.DRAWS), value) for value in (0.0, 1.0)]
    mean = real_light.over_seeds(seeds)
    assert (mean[:, 0] == 0.5).all()
    # The mean of two draws of 0 or 1 has the variance 1 / 8.
    assert mean[0, 1:].var() == pytest.approx(1 / 8, abs=0.01)


def write_scores(path, metric, values):
    """Write the values of networks in dim light, and that of a network which has none."""
    cells = {name: f"{value:.4f} [0, 1]" for name, value in values.items()} | {"unknown": "-"}
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["label", *real_light.HEADER], restval="")
        writer.writeheader()
        for name, cell in cells.items():
            writer.writerow({"label": "orange", "network": name, "light": "dim", metric: cell})


def test_networks_that_two_lights_rank_alike_have_a_rank_correlation_of_one(tmp_path):
    values = {"a": 0.2, "b": 0.3, "c": 0.7, "d": 0.9, "e": 0.95}
    for title, power in (("real", 1), ("alike", 3), ("other", -1)):
        write_scores(tmp_path / title, "AUC", {name: x**power for name, x in values.items()})
    words = [f"{title}={tmp_path / title}" for title in ("real", "alike", "other")]
    scores = real_light.read_scores(words, "orange", "AUC")
    real, alike, other = (scores[f"{title}: dim"] for title in ("real", "alike", "other"))
    assert real == values
    assert real_light.rank_correlation(real, alike).value == pytest.approx(1)
    assert real_light.rank_correlation(real, other).value == pytest.approx(-1)


@pytest.mark.parametrize(("metric", "best"), [("FPR", "low"), ("AUC", "high")])
def test_the_best_network_is_ranked_first(tmp_path, capsys, metric, best):
    write_scores(tmp_path / "scores.csv", metric, {"middle": 0.5, "low": 0.1, "high": 0.9})
    words = [f"scores={tmp_path / 'scores.csv'}", "--label", "orange", "--metric", metric]
    real_light.main(["rank", *words])
    found = re.findall("middle|low|high", capsys.readouterr().out)
    assert found[0] == best


def test_the_interval_of_a_rank_correlation_is_that_of_bonett_and_wright():
    first = dict(zip("abcdef", (1, 2, 3, 4, 5, 6), strict=True))
    second = dict(zip("abcdef", (2, 1, 4, 3, 6, 5), strict=True))
    # The ranks differ by 1 six times: 1 − 6 · 6 / (6 · 35).
    expected = 1 - 36 / 210
    half = 1.959964 * math.sqrt((1 + expected**2 / 2) / 3)
    estimate = real_light.rank_correlation(first, second)
    assert estimate.value == pytest.approx(expected)
    assert estimate.low == pytest.approx(math.tanh(math.atanh(expected) - half), abs=1e-6)
    assert estimate.high == pytest.approx(math.tanh(math.atanh(expected) + half), abs=1e-6)


def test_the_interval_of_a_rank_correlation_holds_the_true_one_also_if_all_ranks_agree():
    draw, correlation = np.random.default_rng(0), 0.95
    # Pearson (1907): ρ of Spearman for normal values.
    true = 6 / math.pi * math.asin(correlation / 2)
    covariance = [[1, correlation], [correlation, 1]]
    hits = []
    for _ in range(300):
        pair = draw.multivariate_normal([0, 0], covariance, 6).T
        found = real_light.rank_correlation(*(dict(enumerate(values)) for values in pair))
        hits.append(found.low <= true <= found.high)
    # The standard error of a fraction of 0.95 is 0.013.
    assert np.mean(hits) > 0.95 - 2 * 0.013


def test_a_rank_correlation_of_few_networks_has_no_interval():
    found = real_light.rank_correlation(*[dict(zip("abcde", range(5), strict=True))] * 2)
    assert (found.value, found.low, found.high) == (pytest.approx(1), None, None)


SIDES = ("orange", "other_ball")


def folder_of(*rows):
    """Return a folder of photographs, each with a path and an object."""
    shown = [
        Photograph(path=PurePosixPath(path), label=path.split("/")[0], source=None, mesh=mesh)
        for path, mesh in rows
    ]
    return real_light.Folder(None, shown)


# Two photographs of each of five oranges and five balls, which have the same names.
NAMED = [(f"{side}/{n}_{k}.png", n) for side in SIDES for n in "12345" for k in "ab"]
DIM_BALLS = [(f"other_ball/dim__{n}_a.png", n) for n in "12345"]


@pytest.mark.parametrize(
    ("rows", "unit_count"),
    [
        pytest.param(NAMED, 10, id="objects"),
        pytest.param(NAMED[2:], 18, id="four oranges"),
        pytest.param(NAMED[:-2], 18, id="four balls"),
        pytest.param([*NAMED, ("orange/6.png", None)], 21, id="an object without a name"),
        pytest.param([*NAMED, *DIM_BALLS], 10, id="a light without oranges"),
        pytest.param([*NAMED, *DIM_BALLS, ("orange/dim__1_a.png", "1")], 20, id="a single one"),
    ],
)
def test_units_are_objects_if_each_light_shows_five_of_each_kind(rows, unit_count):
    assert len({*folder_of(*rows).units("orange")}) == unit_count


def test_objects_of_a_class_count_one_by_one_only_if_all_have_a_name():
    rows = [("orange/1.png", "1"), ("orange/2.png", None), ("apple/1.png", "1")]
    assert folder_of(*rows).objects.tolist() == ["orange", "orange", "apple: 1"]


def test_an_object_with_one_photograph_is_drawn_with_others_of_its_class():
    folder = folder_of(*((f"{side}/{n}.png", n) for side in ("orange", "pear") for n in "1234"))
    counts = folder.draw("orange")
    assert (counts[:, :4].sum(1) == 4).all()
    assert counts[1:, 0].var() > 0


def test_intervals_do_not_depend_on_photographs_that_other_lights_lack():
    """25 photographs are drawn with replacement, whatever other lights show of them."""
    draw = np.random.default_rng(0)
    lights = ("dim", "lamp", "white", "stripes", "half")
    rows = [(f"orange/plain__{n}.png", None) for n in range(25)]
    rows += [
        (f"orange/{x}__{n}.png", None) for n in range(25) for x in lights if draw.random() < 0.5
    ]
    counts = folder_of(*rows).draw("orange")[1:, :25]
    hits = counts @ (np.arange(25) % 2 == 0) / counts.sum(1)
    # The variance of a fraction of 25: p (1 - p) / n.
    assert hits.var() == pytest.approx(13 / 25 * 12 / 25 / 25, rel=0.15)


def test_lights_without_common_photographs_keep_their_numbers():
    rows = [
        (f"orange/{light}__{light}{n}.png", None) for light in ("dim", "lamp") for n in range(4)
    ]
    counts = folder_of(*rows).draw("orange")
    assert (counts[:, :4].sum(1) == 4).all()
    assert (counts[:, 4:].sum(1) == 4).all()


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        pytest.param("ab", ["a/orange/1", "a/orange/1", "b/orange/1", "b/orange/1"], id="nested"),
        pytest.param(["{light}"], ["orange/1", "orange/1"], id="folders of lights"),
    ],
)
def test_the_name_of_a_photograph_has_its_folders_except_for_that_of_its_light(folders, names):
    paths = [
        f"orange/{folder.format(light=light)}/{light}__1.png"
        for folder in folders
        for light in ("plain", "dim")
    ]
    assert [*folder_of(*((path, None) for path in paths)).names] == names


def test_gains_in_top_1_are_those_on_the_classes_of_both_networks(capsys):
    """Both networks call everything an orange, and the first one has no class for the pears."""
    folder = folder_of(
        *((f"{name}/{n}.png", None) for name in ("orange", "other_pear") for n in "12")
    )
    known = {"first": ("orange", "fig"), "second": ("orange", "pear")}
    predictions = {}
    for title, classes in known.items():
        labels = ["orange"] * 2 + [classes[1].replace("fig", "other_pear")] * 2
        predictions[title] = [ranked(labels, [[1.0, 0.0]] * 4, classes)]
    rows = real_light.print_tables("orange", predictions, folder, {"plain": np.ones(4, bool)})
    assert [float(row[2].split()[0]) for row in rows] == [1, 0.5]
    gain = capsys.readouterr().out.partition("minus first")[2].partition("second")[2].split("|")[2]
    margin = binomtest(0, 2).proportion_ci(method="wilson").high
    assert gain.strip() == f"+0.000 [{-margin:+.3f}, {margin:+.3f}]"


def test_a_class_that_counts_although_its_folder_is_called_other_is_named(folder, caplog):
    found = real_light.find_photographs(folder, ["orange"], "orange")
    for name, is_named in (("ball", True), ("pear", False)):
        say_once.cache_clear()
        caplog.clear()
        network = darker_than(0.5)
        network.classes = ("orange", name)
        shown = real_light.predict(network, real_light.Folder(folder, found), ["orange"])
        is_other = np.array([item.label.startswith("other_") for item in found])
        assert np.isfinite(shown.true_rank[is_other]).all() == is_named
        assert ("other_ball" in caplog.text) == is_named


def printed_change(printed):
    """Return the cells of the change of the network from plain light, without intervals."""
    cells = printed.partition("minus plain")[2].partition("half")[2].split("|")
    return [float(cell.split()[0]) for cell in cells[2:4]]


# The gray levels of photographs by their names. Oranges of level 40 are recognized.
ORANGES = {f"orange/plain__s{number}": level for number, level in enumerate((40, 40, 200))}
IN_TEXT = {f"orange/text__s{number}": level for number, level in enumerate((40, 40, 200))}
APPLES = {"other_apple/plain__p_2": 200, "other_apple/low_light__p_2": 200}
TOGETHER = ["--lights", "plain", "both=text+stripes"]


def dim(*names):
    return {f"orange/low_light__{name}": 40 for name in names}


@pytest.mark.parametrize(
    ("levels", "words", "expected", "said"),
    [
        pytest.param(ORANGES | dim("s0", "s1"), [], 0, "", id="the same photographs"),
        pytest.param(ORANGES | dim("s0", "x1"), [], 0, "", id="one of the same photographs"),
        pytest.param(ORANGES | dim("x0", "x1"), [], 1 / 3, "", id="other photographs"),
        pytest.param(
            {"orange/plain__0": 40, "other/plain__0": 40} | dim("0"), [], 0, "other", id="objects"
        ),
        pytest.param(
            ORANGES | IN_TEXT | {"orange/stripes__s0": 40, "orange/stripes__s1": 40},
            *(TOGETHER, 0, "leaves out 2 images"),
            id="photographs in each of two lights",
        ),
        pytest.param(
            {"orange/plain__p_1": 200} | dim("q_1") | APPLES, ["--crops"], 1, "", id="crops"
        ),
    ],
)
def test_changes_between_lights_are_those_of_what_both_show(
    tmp_path, monkeypatch, capsys, levels, words, expected, said
):
    for name, level in levels.items():
        save_plain(tmp_path / f"{name}.png", level)
    score(tmp_path, monkeypatch, "half", *words)
    printed = capsys.readouterr().out
    assert printed_change(printed) == pytest.approx([expected] * 2, abs=1e-3)
    assert said in printed


def test_an_object_without_one_of_the_lights_that_are_scored_together_is_left_out(
    tmp_path, monkeypatch, capsys
):
    """All lights show the same images: each first photograph of an object is recognized."""
    shown = {"a": {"plain": 3, "text": 2}, "b": {"plain": 2, "text": 2, "stripes": 2}}
    rows = ["path,source_tag,mesh"]
    for name, lights in shown.items():
        for light, count in lights.items():
            for number in range(count):
                path = f"orange/{light}__{name}{number}.png"
                save_plain(tmp_path / path, 200 if number else 40)
                rows.append(f"{path},,{name}")
    (tmp_path / "photos.csv").write_text("\n".join(rows))
    score(tmp_path, monkeypatch, "half", *TOGETHER)
    printed = capsys.readouterr().out
    assert printed_change(printed) == [0, 0]
    assert "leaves out 5 images" in printed and "different photographs" not in printed


def test_names_of_lights_are_the_same_in_both_forms_of_unicode(tmp_path, monkeypatch, capsys):
    for form, light in (("NFD", "dämmrig"), ("NFC", "plain")):
        for name, level in {"grün": 40, "x": 200}.items():
            save_plain(tmp_path / "orange" / normalize(form, f"{light}__{name}.png"), level)
    save_plain(tmp_path / "orange/plain__y.png", 40)
    found = score(tmp_path, monkeypatch, "half", "--lights", "plain", "dämmrig")
    assert ("half", "dämmrig") in found
    assert "leaves out 1 images" in capsys.readouterr().out


def test_the_interval_of_hardly_varying_draws_is_that_of_the_units_that_decide():
    names = np.repeat(["orange", "other_ball"], [2, 40])
    predictions = ranked(names, torch.zeros(42, 2), ["orange", "pear"])
    units, rows = np.arange(42), np.arange(42) != 41
    # The class of the balls is unknown, so they do not count for top-1.
    assert real_light.count_units(predictions, units, rows) == [2, 2, 2, 39, 2]
    draws = np.full(2001, 0.5)
    draws[7] = 0.9
    found = real_light.estimate(draws, 2)
    expected = binomtest(1, 2).proportion_ci(method="wilson")
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize("low", [0.978, 0.1])
def test_the_interval_of_a_perfect_score_holds_those_of_wilson_and_of_the_bootstrap(low):
    draws = np.ones(2001)
    draws[1:200] = low
    found = real_light.estimate(draws, 15)
    expected = binomtest(15, 15).proportion_ci(method="wilson")
    assert found.low == pytest.approx(min(expected.low, low))
    assert real_light.estimate(1 - draws, 15).high == pytest.approx(1 - found.low)
