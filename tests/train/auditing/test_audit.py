"""The audit agrees with a scan of radii and closed forms, and continues if it was stopped."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import augment
from augment.scene import patterns
from augment.scene.objects import Conditions, load_object
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.light.files import load_light
from tests.helpers import darker_than, save_plain
from tests.train.helpers import attack_shortly
from train.auditing import lights
from train.auditing.network import NEXT_HARDENING, NEXT_TRAINING, RECOGNIZED, AuditedNetwork
from train.command_settings import AuditSettings
from train.commands import audit
from train.commands.audit import run_audit
from train.results.tables import fraction
from train.run_config import write_config
from train.settings import LABORATORY

CLASSES = ("orange", "other")


def guessing() -> augment.Classifier:
    return augment.Classifier(lambda images: 0 * images[:, :2, 0, 0], 8, CLASSES, "guessing")


@pytest.fixture(autouse=True)
def few_small_frames(monkeypatch) -> None:
    for name, number in {"FRAME_COUNT": 3, "BALL_SIDE": 8, "SIDE": 8}.items():
        monkeypatch.setattr(lights, name, number)


@pytest.fixture(scope="module")
def views() -> lights.Views:
    orange = load_object(ObjectSettings("solid:orange:0", label="orange"))
    return lights.Views([orange], 4, 0, torch.device("cpu"))


def mean_values(views: lights.Views, power: float | None = None) -> torch.Tensor:
    """Render the views in their light, or with all lamps at a power, and average each image."""
    if power is None:
        scene = views.scene(8)
        light = (load_light(views.light) * views.exposure).expand(len(scene), -1, -1)
    else:
        scene = views.scene(8, "lamps")
        ((rows, _),) = [part for part in scene.basis.lights if part[1].name == "lamps"]
        light = scene.basis.project_nonnegative(scene.lights)
        light[:, rows] = power
    images = scene.render(Conditions(light), torch.arange(len(scene)))
    return images.mean((1, 2, 3, 4))


def test_a_map_makes_no_dark_rings_on_gloss(tmp_path):
    path = tmp_path / "lamp.npy"
    np.save(path, np.float32(np.arange(16 * 32) == 144).reshape(16, 32, 1).repeat(3, axis=2))
    glossy = load_object(ObjectSettings("solid:orange:0", label="orange", gloss=[0.4]))
    views = lights.Views([glossy], 1, 0, torch.device("cpu"))
    shown = lights.environment_lights(views, [str(path)], 1)["lamp"]
    torch.testing.assert_close(shown, load_light(path, roughness=0.4))


def test_attacks_within_a_radius_succeed_where_the_brightest_lamps_do(views, tmp_path, monkeypatch):
    """Each lamp adds light, so no light within a radius is brighter than all lamps at it."""
    # Steps of a quarter of the radius reach a corner of the norm-ball in four.
    monkeypatch.setattr(lights, "STEPS", 5)
    monkeypatch.setitem(lights.KINDS, "lamps", lights.KINDS["lamps"]._replace(radii=(1.0, 10.0)))
    middle_two = mean_values(views, 2.0).sort().values[1:3]
    limit = float(middle_two.mean())
    is_correct = mean_values(views, 0.0) < limit
    expected = []
    for radius in lights.KINDS["lamps"].radii:
        is_wrong = mean_values(views, radius) > limit
        expected.append(int((is_correct & is_wrong).sum()))
    assert 0 < expected[0] < expected[1]

    steps = lights.success_by_light(darker_than(limit), views, "lamps", tmp_path)

    # The first counts are of the largest radius alone.
    assert next(steps)["adversarial"] == expected[-1:]
    counts = next(steps)
    assert counts["correct"] == int(is_correct.sum())
    assert counts["adversarial"] == expected
    for random, hits in zip(counts["random"], expected, strict=True):
        assert random <= hits


def test_views_are_attacked_at_an_exposure_at_which_they_are_recognized(views):
    limit = float(mean_values(views).min()) - 1e-3
    plain = lights.find_plain_views(darker_than(limit), views)
    assert plain.recognized_as_given == 0
    assert plain.recognized >= 3
    found = replace(views, light=plain.light, exposure=plain.exposure, size=plain.size)
    assert plain.recognized == int((mean_values(found) < limit).sum())

    plain = lights.find_plain_views(darker_than(1.0), views)
    assert plain.recognized == plain.recognized_as_given == views.count
    assert (plain.light, plain.exposure, plain.size) == (views.light, views.exposure, views.size)


@pytest.fixture
def lamps_alone(monkeypatch) -> None:
    attack_shortly(monkeypatch, "lamps", steps=3, additional=5)
    monkeypatch.setitem(lights.KINDS, "lamps", lights.KINDS["lamps"]._replace(radii=(10.0,)))


def test_the_slider_goes_from_the_natural_to_the_adversarial_prediction(views, lamps_alone):
    middle_two = mean_values(views, 2.0).sort().values[1:3]
    result = lights.adversaries(darker_than(float(middle_two.mean())), views, "lamps")
    example = int((result.clean_correct & result.success).nonzero()[0])
    slider = lights.frames_of(result, example)
    ends = [slider["frames"][index]["probabilities"] for index in (0, -1)]
    expected = [result.logits_before[example], result.logits[example]]
    assert slider["classes"] == ["orange", "other"]
    assert [slider["frames"][index]["predicted"] for index in (0, -1)] == slider["classes"]
    for probabilities, logits in zip(ends, expected, strict=True):
        np.testing.assert_allclose(probabilities, logits.softmax(0), atol=1e-4)


def test_views_that_fool_a_network_are_counted_if_the_other_recognizes_them(views, lamps_alone):
    """The other network errs in less light. No light is bright enough for the last attack."""
    views = replace(views, count=2)
    counts = lights.transfer_success(darker_than(0.5), darker_than(0.515, size=12), views)
    assert counts == {"lamps": [2, 2, 2]}
    assert lights.transfer_success(darker_than(2), darker_than(0.5), views) == {"lamps": [0, 0, 0]}


def test_classifiers_of_all_sizes_get_the_same_views_unlike_those_of_another_seed(views):
    small = views.scene(8)
    large = views.scene(12, "projector")
    assert small.examples == large.examples
    assert small.examples != replace(views, seed=1).scene(8).examples
    for one, other in zip(small.objects, large.objects, strict=True):
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)


CLASSIFIERS = {"dark": darker_than(0.5), "guessing": guessing(), "large": darker_than(0.5, 16)}


@pytest.fixture
def given(monkeypatch, tmp_path) -> dict[str, Any]:
    attack_shortly(monkeypatch, "lighting")
    monkeypatch.setattr(audit, "PATTERNS", ("solid", "rings"))
    counts = {"VIEW_COUNT": 2, "ATTACKED_COUNT": 2, "RANDOM_LIGHT_COUNT": 1}
    for name, count in {"SPP": 1, "SETUPS": 1, **counts}.items():
        monkeypatch.setattr(audit, name, count)
    monkeypatch.setattr(patterns, "LAB_RESOLUTION", 32)
    monkeypatch.setattr(audit, "load_network", lambda name, **_: CLASSIFIERS[name])
    monkeypatch.setattr(audit, "load_chosen", lambda settings: CLASSIFIERS[settings.network])
    negatives = ["solid:lemon:0", {"mesh": "solid:pear:0", "label": "other"}]
    settings = {"network": "dark", "environments": [], "meshes": ["solid:orange:0"]}
    return settings | {"hard_negatives": negatives, "out": str(tmp_path / "audit")}


def results_of(folder: Path) -> dict[str, bytes]:
    of_scores = ("*/*/summary.json", "*/*/predictions.csv", "renders/*/*.png")
    names = ("report.html", "*/*.json", *of_scores)
    paths = [path for name in names for path in folder.glob(name)]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def modification_times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.glob("*/*.json")}


def stop(*arguments) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:classifier guessing scores black and white")
class TestAWholeAudit:
    @pytest.fixture
    def folder(self, given, tmp_path) -> Path:
        pytest.importorskip("mitsuba")
        run_audit(AuditSettings(**given, hardened="guessing"))
        return tmp_path / "audit"

    def test_scores_a_classifier_that_guesses_at_chance(self, folder):
        summary = json.loads((folder / "hardened/laboratory/summary.json").read_text())
        assert summary["auc"]["value"] == 0.5
        assert summary["n"]["positives"] == summary["n"]["negatives"] == 2

    @pytest.mark.parametrize(
        ("module", "stopped"),
        [(lights, "success_by_light"), (lights, "success_by_radius"), (audit, "_write_renders")],
    )
    def test_continues_if_it_was_stopped_and_writes_the_same(
        self, folder, given, monkeypatch, tmp_path, module, stopped
    ):
        expected = results_of(folder)
        assert len(expected) > 15
        folder.rename(tmp_path / "uninterrupted")
        with monkeypatch.context() as patch:
            patch.setattr(module, stopped, stop)
            with pytest.raises(KeyboardInterrupt):
                run_audit(AuditSettings(**given))
        # A page with first results is there before what takes longest.
        if stopped != "success_by_light":
            assert "still recognizes" in (folder / "report.html").read_text()
        first = [*folder.glob("*/*_first.json")]
        times = {path: at for path, at in modification_times(folder).items() if path not in first}
        assert folder / "classifier" / RECOGNIZED in times

        run_audit(AuditSettings(**given, hardened="guessing"))  # A hardened network may be added.

        assert results_of(folder) == expected
        assert times.items() <= modification_times(folder).items()

    def test_refuses_to_continue_with_another_seed(self, folder, given):
        with pytest.raises(InputError, match="seed=0, not 1"):
            run_audit(AuditSettings(**given, hardened="guessing", seed=1))


def test_an_audit_killed_as_it_removes_results_leaves_no_part_of_them(tmp_path, given, monkeypatch):
    out = tmp_path / "audit"
    for name in ("classifier/laboratory/summary.json", "renders/lab.json"):
        (out / name).parent.mkdir(parents=True)
        (out / name).touch()
    settings = AuditSettings(**given, overwrite=True)
    with monkeypatch.context() as patch:
        patch.setattr(audit.shutil, "rmtree", lambda folder, **_: folder.exists() and stop())
        with pytest.raises(KeyboardInterrupt):
            audit._prepare_folder(settings, out, out / "renders", {})
    assert not (out / "classifier").exists()
    audit._prepare_folder(settings, out, out / "renders", {})
    assert [path.name for path in out.iterdir()] == ["config.yaml"]


def test_an_audit_does_not_go_on_with_other_weights(given, tmp_path):
    linear = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * 8**2, 2))
    networks = {audit.CLASSIFIER: augment.Classifier(linear, 8, CLASSES)}
    prepared = AuditSettings(**given), tmp_path / "audit", tmp_path / "audit/renders"
    audit._prepare_folder(*prepared, networks)
    audit._prepare_folder(*prepared, networks | {audit.HARDENED: guessing()})
    linear[1].bias.data[0] += 1e-3
    with pytest.raises(InputError, match="other weights"):
        audit._prepare_folder(*prepared, networks)


@pytest.fixture
def no_success_without_mitsuba(monkeypatch) -> dict[str, Any]:
    """Return the counts of each attack, of which none succeeds."""
    counts = {"n": 2, "correct": 2}
    for method in ("adversarial", "random"):
        counts |= {method: [0, 0, 0, 0], f"{method}_without_noise": [0, 0, 0, 0]}
    monkeypatch.setattr(audit, "mitsuba", Mock(side_effect=InputError("Mitsuba is missing")))
    monkeypatch.setattr(lights, "success_by_light", lambda *_: iter([counts, counts]))
    return counts


@pytest.mark.usefixtures("no_success_without_mitsuba")
def test_an_audit_without_mitsuba_says_that_it_has_no_laboratory(given, tmp_path, monkeypatch):
    recognized = {"uniform": [True], "random 1": [True]}
    monkeypatch.setattr(lights, "recognize_in_environments", lambda *_: recognized)
    report = run_audit(AuditSettings(**given)).path
    assert "The laboratory is left out, and hard_negatives with it" in report.read_text()
    assert not (tmp_path / "audit/renders").exists()
    assert not (tmp_path / "audit/classifier/laboratory").exists()


@pytest.mark.parametrize("has_images", [False, True])
def test_a_network_that_knows_no_view_is_to_be_trained_first(
    given, tmp_path, no_success_without_mitsuba, has_images
):
    no_success_without_mitsuba["correct"] = 0
    for label in CLASSES if has_images else ():
        save_plain(tmp_path / "renders" / label / "1.png", 0)
        given |= {"laboratory": str(tmp_path / "renders"), "hard_negatives": [], "label": "orange"}
    audited = run_audit(AuditSettings(**given), {audit.CLASSIFIER: darker_than(-1)})
    assert (audited.recommendation is not None) == has_images
    assert audited.screen.sentences[-1] == NEXT_TRAINING
    assert NEXT_HARDENING not in audited.path.read_text()
    for number in audited.screen.numbers:
        assert number.interval.endswith(f"over {number.after.over}")


ORANGE_PEAR = {"mesh": "solid:pear", "label": "orange"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"label": "pear"}, "'pear' is not a class of the model"),
        ({"meshes": []}, "meshes"),
        ({"hard_negatives": [ORANGE_PEAR]}, r"hard_negatives\[0\] is solid:pear"),
        ({"hard_negatives": ["pear.glb"]}, "pear.glb"),
        ({"photos": "nowhere"}, "nowhere is not a folder"),
        ({"meshes": [{"msh": "a.glb"}]}, "msh"),
        ({"environments": ["nowhere.hdr"]}, "nowhere.hdr"),
        ({"laboratory": "nowhere"}, "laboratory=nowhere"),
        # Results are kept by the name of a light, and one of two with the same name would be lost.
        ({"environments": ["map.npy", "other/map.npy"]}, "different names"),
        ({"environments": ["grace", "grace"]}, "different names"),
        ({"environments": ["uniform.npy"]}, "different names"),
        ({"environments": ["random 1.npy"]}, "different names"),
        ({"environments": ["rings.npy"]}, "different names"),
    ],
)
def test_what_cannot_be_audited_is_refused_and_nothing_written(
    given, tmp_path, monkeypatch, changes, message
):
    monkeypatch.chdir(tmp_path)
    Path("other").mkdir()
    for name in ("map", "other/map", "uniform", "random 1", "rings"):
        np.save(f"{name}.npy", np.ones((8, 16, 3), np.float32))
    with pytest.raises(InputError, match=message):
        run_audit(AuditSettings(**given | changes))
    assert not (tmp_path / "audit").exists()


@pytest.mark.parametrize("rest", [{"laboratory": "renders"}, {"environments": ["uniform"]}])
def test_lights_are_audited_whose_names_no_other_light_has(given, tmp_path, monkeypatch, rest):
    """No patterns are rendered with a given laboratory, and uniform light is there in any case."""
    monkeypatch.chdir(tmp_path)
    np.save("rings.npy", np.ones((8, 16, 3), np.float32))
    save_plain(Path("renders/orange/1.png"), 0)
    changes = {"environments": ["rings.npy"], "hard_negatives": [], "label": "orange", **rest}
    settings = AuditSettings(**given | changes)
    plan = audit._Plan(settings, {audit.CLASSIFIER: CLASSIFIERS["dark"]}, torch.device("cpu"))
    assert {*plan.environments} == {"uniform", *settings.environments}


def test_test_images_of_another_size_than_a_later_network_needs_are_refused(given, tmp_path):
    out = tmp_path / "audit"
    (out / "renders").mkdir(parents=True)
    (out / "renders" / "lab.json").write_text(json.dumps({"size": 8}))
    write_config(out, audit.complete(AuditSettings(**given), CLASSES))
    with pytest.raises(InputError, match=r"hardened.*16.* 8") as raised:
        run_audit(AuditSettings(**given, hardened="large"))
    assert raised.value.argument == "hardened"
    assert not (out / "classifier").exists()


def test_an_audit_of_meshes_ends_with_its_page_if_photographs_show_nothing(
    given, monkeypatch, tmp_path
):
    found = []
    photographs = tmp_path / "photographs"
    save_plain(photographs / "gray.png", 128)
    error = InputError("dark has no detections in 1 photographs: give others")
    monkeypatch.setattr(audit, "_attack_photographs", Mock(side_effect=error))
    monkeypatch.setattr(audit._Plan, "measure", lambda *_: [])
    monkeypatch.setattr(audit.page, "write_audit_page", lambda *given: found.append(given[-1]))
    run_audit(AuditSettings(**given, unlabeled=str(photographs)))
    assert "no detections" in found[0][-1]


def write_parts(folder: Path, hits: int, n: int, adversarial: list[int], correct: int = 4) -> None:
    is_recognized = [True] * hits + [False] * (n - hits)
    recognized = {"uniform": is_recognized, "random 1": is_recognized}
    (folder / RECOGNIZED).write_text(json.dumps(recognized))
    for kind in lights.KINDS:
        (folder / f"{kind}.json").write_text(
            json.dumps({"correct": correct, "adversarial": adversarial})
        )
    rates = {"recall": fraction(hits, n), "false_positive_rate": fraction(0, n)}
    scores = {"label": "orange"} | {name: asdict(rate) for name, rate in rates.items()}
    (folder / LABORATORY).mkdir()
    (folder / LABORATORY / "summary.json").write_text(json.dumps(scores))


@pytest.mark.parametrize(
    ("hits", "n", "adversarial", "answer"),
    [
        # A classifier is called safe only if the intervals lie above the limit.
        (400, 400, [0, 0, 1, 1], "Yes"),
        (9, 9, [0, 0, 1, 1], "No fault is shown, but"),
        (200, 400, [0, 0, 1, 1], "No: it recognizes 50%"),
        # Four attacked views, of which all are lost, do not decide alone.
        (9, 9, [0, 0, 4, 4], "Perhaps not: an attack"),
        (200, 400, [0, 0, 4, 4], "No: it recognizes"),
        # Four views are recognized, but in plain light alone.
        (0, 400, [0, 0, 0, 0], "No: it recognizes 0%"),
        # Without a view that is recognized in plain light, nothing is known.
        (0, 400, None, "Unknown: "),
    ],
)
def test_the_answer_of_an_audit(tmp_path, hits, n, adversarial, answer):
    write_parts(tmp_path, hits, n, adversarial or [0, 0, 0, 0], correct=4 if adversarial else 0)
    network = AuditedNetwork("orange", "dark", tmp_path)
    assert network.answer.startswith(f"Is dark safe under unusual lighting? {answer}")
    # No interval has zero width, even if all views are recognized or none.
    assert all(rate.low < rate.high for rate in network.rates.values())


def test_a_light_is_a_fault_from_the_radius_on_that_loses_half_of_the_views(tmp_path):
    write_parts(tmp_path, 400, 400, adversarial=[0, 1, 2, 4])
    text = AuditedNetwork("orange", "dark", tmp_path).answer
    for light in lights.KINDS.values():
        assert f"{light.title} of radius {light.radii[2]:g} loses 2 of 4 views" in text


def test_each_lighting_of_the_laboratory_has_the_same_number_of_setups(monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr(audit, "write_laboratory", made.append)
    environments = ["a.npy", "b.npy", "c.npy"]
    settings = AuditSettings(
        network="any", label="orange", meshes=["solid:orange"], environments=environments
    )
    items = [ObjectSettings("solid:orange:1", label="orange")]
    audit._write_renders(SimpleNamespace(settings=settings, items=items), 8, tmp_path)
    assert made[0].setups == 6 * (len(made[0].patterns) + 3)
