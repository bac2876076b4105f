import json
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import pytest
import torch

import augment
from tests.helpers import darker_than, save_plain
from tests.train.helpers import evaluation_of, ranked
from train.auditing import page
from train.auditing.lights import KINDS, PlainViews
from train.auditing.network import (
    BOTH,
    CLASSIFIER,
    HARDENED,
    HARDENING,
    LIGHT_ALONE,
    ORIGINAL,
    PLAIN,
    RECOGNIZED,
    AuditedNetwork,
    name_remedies,
    normalizing,
    recommend,
)
from train.command_settings import AuditSettings
from train.commands import audit
from train.results.compare import Evaluation

COUNT = 60


def evaluation(found: Sequence[int], labels: Sequence[str] = ("orange",)) -> Evaluation:
    """Score found images of COUNT of each label above all negatives, and other ones below."""
    shown = np.repeat([*labels, "other_ball"], COUNT)
    classes = ["other", *labels]
    logits = torch.zeros(len(shown), len(classes))
    for row, label in enumerate(shown):
        if label in labels:
            logits[row, classes.index(label)] = 2 if row % COUNT in found else -2
    return evaluation_of(ranked(shown, logits, classes, labels))


FEW = range(10)
MORE = range(30)
MOST = range(50)


@pytest.mark.parametrize(
    ("light_alone", "hardening", "both", "expected"),
    [
        (FEW, FEW, FEW, None),
        (MORE, FEW, FEW, LIGHT_ALONE),
        (MORE, MORE, MORE, LIGHT_ALONE),
        (FEW, MORE, MORE, HARDENING),
        (MORE, MOST, MOST, HARDENING),
        (FEW, FEW, MORE, BOTH),
        (MORE, range(32), MOST, BOTH),
        ((), range(11), range(11), None),
    ],
)
def test_the_cheapest_best_remedy_is_recommended(light_alone, hardening, both, expected):
    labels = ["orange", "lemon"]
    found = {ORIGINAL: FEW, LIGHT_ALONE: light_alone, HARDENING: hardening, BOTH: both}
    evaluations = {name: [evaluation(shown, labels)] for name, shown in found.items()}
    recommendation = recommend(evaluations)
    assert recommendation.remedy == expected
    values = [float(row[1].partition(" ")[0]) for row in recommendation.table.rows]
    np.testing.assert_allclose(values, [len(shown) / COUNT for shown in found.values()], atol=1e-3)


def test_a_remedy_is_unknown_without_negatives():
    without = evaluation_of(evaluation(FEW).pooled.positives)
    assert recommend({ORIGINAL: [without], LIGHT_ALONE: [without]}) is None


def network(normalize_light: bool) -> augment.Classifier:
    classes = ["red", "green", "blue"]
    return augment.Classifier(lambda x: x.mean((2, 3)), 8, classes, normalize_light=normalize_light)


def test_a_network_that_normalizes_light_itself_gets_no_second_normalization():
    networks = {"classifier": network(False), "hardened": network(True)}
    assert [*normalizing(networks)] == ["classifier_normalized_light"]
    names = {ORIGINAL: "classifier", LIGHT_ALONE: "classifier_normalized_light"}
    assert name_remedies(networks) == names | {BOTH: "hardened"}


@pytest.mark.parametrize("shown", [(), ("orange",), ("orange", "other_apple")])
def test_an_audit_of_a_hardened_network_warns_without_photographs_of_others(tmp_path, shown):
    for name in shown:
        save_plain(tmp_path / name / "1.png", 0)
    given = {audit.CLASSIFIER: darker_than(0.5), audit.HARDENED: darker_than(0.5)}
    photos = str(tmp_path) if shown else None
    settings = AuditSettings(network="x", label="orange", meshes=["solid:orange"], photos=photos)
    plan = audit._Plan(settings, given, torch.device("cpu"))
    assert (audit.NO_PHOTOGRAPHS in audit._caveats(settings, given, plan)) == (len(shown) < 2)


def test_without_scored_images_the_first_screen_shows_both_networks_in_one_light(tmp_path):
    """The first network fails under lamps, and the second in a projector."""
    networks = []
    for name, correct, kind, lost in ((CLASSIFIER, 2, "lamps", 2), (HARDENED, 4, "projector", 1)):
        folder = tmp_path / name
        folder.mkdir()
        for each in KINDS:
            hits = [0] * 3 + [lost if each == kind else 0]
            counts = {"n": 5, "correct": correct, "adversarial": hits, "random": hits}
            (folder / f"{each}.json").write_text(json.dumps(counts))
        views = {"eucalyptus": [True] * correct, "random 1": [True] * correct}
        (folder / RECOGNIZED).write_text(json.dumps(views))
        networks.append(AuditedNetwork("orange", name, folder))
    plain = PlainViews("grace", 1.0, 1.0, recognized=2, n=5, recognized_as_given=2)
    (tmp_path / CLASSIFIER / PLAIN).write_text(json.dumps(asdict(plain)))
    screen = page._first_screen(networks, {})
    assert screen.names == [CLASSIFIER, HARDENED]
    found = [(shown.before.value, shown.after.value) for shown in screen.numbers]
    assert found == [(2 / 5, 4 / 5), (0 / 2, 4 / 4)]


@pytest.mark.parametrize("source", [None, "my_desk"])
def test_a_photograph_is_described_by_its_class_and_its_source_if_that_is_known(tmp_path, source):
    save_plain(tmp_path / "other_ball" / "000.png", 0)
    predictions = ranked(["other_ball"], [[2.0, 0.0]], ["orange", "lemon"], sources=[source])
    subject = page._draw(predictions, 0, tmp_path).alt.partition(":")[0]
    assert subject == ("ball, my desk" if source else "ball")
