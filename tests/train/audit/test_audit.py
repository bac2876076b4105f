"""The audit: a brute-force scan of radii, closed forms, and audits that were stopped."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import augment
from augment.scene.conditions import Conditions
from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.light.basis import parts_of
from train.audit import audit, lights
from train.audit import audit_page as page
from train.audit.audit import run_audit
from train.audit.lights import KINDS, Views, adversaries, success_by_light, transfers
from train.command_settings import AuditSettings
from train.evaluation.laboratory import lab_patterns as patterns

CLASSES = ("orange", "other")


def brightness(limit: float, size: int = 8) -> augment.Classifier:
    """Orange is what is darker than a limit on average."""

    def logits(images: torch.Tensor) -> torch.Tensor:
        excess = 100 * (images.mean((1, 2, 3)) - limit)
        return torch.stack([-excess, excess], dim=1)

    return augment.Classifier(logits, size, CLASSES, f"darker than {limit}")


def chance() -> augment.Classifier:
    return augment.Classifier(lambda images: 0 * images[:, :2, 0, 0], 8, CLASSES, "chance")


@pytest.fixture(scope="module")
def views() -> Views:
    return Views([load_object(ObjectSettings("solid:orange:0", label="orange"))], 4, 0, torch.device("cpu"))


def test_the_smallest_radius_is_that_of_a_scan_of_all_radii(views, tmp_path):
    """Each lamp adds light: within a radius, no light is brighter than that of all lamps at the radius."""
    scene, rows = views.scene(8, "lamps"), torch.arange(4)
    ((where, _),) = [part for part in parts_of(scene.basis) if part[1].name == "lamps"]

    def means(power: float) -> torch.Tensor:
        light = scene.basis.project_nonnegative(scene.lights)
        light[:, where] = power
        return scene.render(Conditions(light), rows).mean((1, 2, 3, 4))

    limit = float(means(2.0).sort().values[1:3].mean())
    counts = success_by_light(brightness(limit), views, "lamps", tmp_path)
    correct = means(0.0) < limit
    expected = [int((correct & (means(radius) > limit)).sum()) for radius in KINDS["lamps"].radii]
    assert counts["correct"] == int(correct.sum()) and 0 < expected[1] < expected[-1]
    assert counts["adversarial"] == expected
    assert all(random <= hits for random, hits in zip(counts["random"], expected, strict=True))


def test_adversaries_that_were_kept_transfer_as_the_attack_itself_finds(views, tmp_path, monkeypatch):
    monkeypatch.setattr(lights, "STEPS", 3)
    monkeypatch.setattr(lights, "FURTHER", 5)
    for kind in ("skylight", "projector", "lighting"):
        monkeypatch.delitem(KINDS, kind)
    monkeypatch.setitem(KINDS, "lamps", KINDS["lamps"]._replace(radii=(10.0,)))
    views, attacked, other = replace(views, count=2), brightness(0.5), brightness(0.515, size=12)
    success_by_light(attacked, views, "lamps", tmp_path)
    counts = transfers(attacked, other, views, tmp_path)["lamps"]
    for name, further in (("first", False), ("further", True)):
        (row,) = augment.transfer(adversaries(attacked, views, "lamps", further), [other])
        pairs = [*zip(row["clean_correct"], row["success"], strict=True)]
        pairs_without_noise = [*zip(row["clean_correct"], row["success_without_noise"], strict=True)]
        lost = [part.count((True, True)) for part in (pairs, pairs_without_noise)]
        assert counts[name] == [lost[0], sum(row["clean_correct"]), lost[1]]
    assert (counts["first"], counts["further"]) == ([1, 2, 1], [2, 2, 2])


def test_classifiers_of_all_sizes_get_the_same_views_which_the_seed_decides(views):
    small, large = views.scene(8), views.scene(12, "projector")
    assert small.examples == large.examples
    for one, other in zip(small.objects, large.objects, strict=True):
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
    assert small.examples != Views(views.objects, 4, 1, views.device).scene(8).examples


@pytest.fixture
def given(monkeypatch, tmp_path) -> dict:
    """Settings of an audit of seconds, of two classifiers."""
    monkeypatch.setattr(lights, "FURTHER", 2)
    monkeypatch.setattr(lights, "STEPS", 2)
    for kind in ("skylight", "projector", "lamps"):
        monkeypatch.delitem(KINDS, kind)
    for name, value in {
        "PATTERNS": ("solid", "rings"),
        "SPP": 1,
        "VIEWS": 2,
        "ATTACKED": 2,
        "SETUPS": 1,
        "LIGHTS": 1,
    }.items():
        monkeypatch.setattr(audit, name, value)
    monkeypatch.setattr(patterns, "RESOLUTION", 32)
    monkeypatch.setattr(audit, "load_network", lambda name, weights=None: {"a": brightness(0.5), "b": chance()}[name])
    meshes = {
        "meshes": ["solid:orange:0"],
        "look_alikes": ["solid:lemon:0", {"mesh": "solid:pear:0", "label": "other"}],
    }
    return {"classifier": "a", "environments": [], **meshes, "out": str(tmp_path / "audit")}


def files(folder: Path) -> dict[str, bytes]:
    names = ("report.html", "*/*.json", "*/*/summary.json", "*/*/predictions.csv", "renders/*/*.png")
    return {str(path.relative_to(folder)): path.read_bytes() for name in names for path in folder.glob(name)}


@pytest.mark.slow
def test_an_audit_that_was_stopped_goes_on_and_writes_the_same_report(given, monkeypatch, tmp_path):
    pytest.importorskip("mitsuba")
    run_audit(AuditSettings(**given, hardened="b"))
    whole, folder = files(tmp_path / "audit"), tmp_path / "audit"
    assert len(whole) > 15
    summary = json.loads((folder / "hardened/laboratory/summary.json").read_text())
    assert summary["auc"]["value"] == 0.5 and summary["n"]["positives"] == summary["n"]["negatives"] == 2
    folder.rename(tmp_path / "before")

    def stop(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(audit, "success_by_light", stop)
        with pytest.raises(KeyboardInterrupt):
            run_audit(AuditSettings(**given))
    made = {path: path.stat().st_mtime_ns for path in folder.glob("*/*.json")}
    assert folder / "classifier" / page.RECOGNIZED in made
    run_audit(AuditSettings(**given, hardened="b"))  # which may be added
    assert files(folder) == whole
    assert made == {path: path.stat().st_mtime_ns for path in made}
    with pytest.raises(
        InputError, match="audit was made with seed=0, not 1: give its setting, or another folder with out="
    ):
        run_audit(AuditSettings(**given, hardened="b", seed=1))


def test_without_mitsuba_all_but_the_laboratory_is_audited_or_a_folder_of_renders_serves(given, monkeypatch, tmp_path):
    def missing():
        raise InputError("Mitsuba is not installed")

    counts = {"n": 2, "correct": 2, "adversarial": [0, 0, 0, 0], "random": [0, 0, 0, 0]}
    counts |= {f"{method}_without_noise": counts[method] for method in ("adversarial", "random")}
    monkeypatch.setattr(audit, "mitsuba", missing)
    monkeypatch.setattr(audit, "recognized", lambda *arguments: {"uniform": [True], "random 1": [True]})
    monkeypatch.setattr(audit, "success_by_light", lambda *arguments: counts)
    report = run_audit(AuditSettings(**given))
    text = "The laboratory is left out, and look_alikes with it (Mitsuba is not installed)."
    assert text in report.read_text() and not (tmp_path / "audit/renders").exists()
    assert not (tmp_path / "audit/classifier/laboratory").exists()
    for label in CLASSES:
        (tmp_path / "lab" / label).mkdir(parents=True)
        Image.new("RGB", (8, 8), "black" if label == "orange" else "white").save(tmp_path / "lab" / label / "a.png")
    folders = {"look_alikes": [], "laboratory": str(tmp_path / "lab"), "out": str(tmp_path / "ready")}
    monkeypatch.setattr(audit, "load_network", lambda name, weights=None: brightness(0.5, {"a": 8, "larger": 12}[name]))
    monkeypatch.setattr(
        audit, "transfers", lambda *arguments: {kind: {"first": [0, 0, 0], "further": [0, 0, 0]} for kind in KINDS}
    )
    report = run_audit(AuditSettings(**given | folders, hardened="larger")).read_text()
    assert text not in report and "The networks take images of 8 and 12 pixels" in report
    summary = json.loads((tmp_path / "ready/classifier/laboratory/summary.json").read_text())
    assert summary["recall"]["value"] == 1 and summary["false_positive_rate"]["value"] == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"label": "pear"}, "'pear' is not a class of the model"),
        ({"meshes": []}, "meshes is empty: name one mesh"),
        (
            {"look_alikes": [{"mesh": "solid:pear", "label": "orange"}]},
            "look_alikes: solid:pear is of the class orange",
        ),
        ({"look_alikes": ["pear.glb"]}, "pear.glb"),
        ({"photos": "nowhere"}, "nowhere is not a folder"),
        ({"environments": ["nowhere.hdr"]}, "nowhere.hdr"),
        ({"laboratory": "nowhere"}, "look_alikes are rendered instead of laboratory=nowhere"),
    ],
)
def test_what_cannot_be_audited_is_refused_before_anything_is_written(given, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        run_audit(AuditSettings(**given | changes))
    assert not (tmp_path / "audit").exists()


@pytest.mark.parametrize(
    ("hits", "answer"), [(400, "Yes"), (9, "No fault is shown, but"), (200, "No: it recognizes 50%")]
)
def test_the_answer_is_yes_only_where_intervals_lie_above_what_is_called_safe(monkeypatch, hits, answer):
    n = 400 if hits > 9 else 9
    rate, none = page.fraction(hits, n), page.fraction(0, n)
    views = [True] * hits + [False] * (n - hits)
    parts = {page.RECOGNIZED: {"uniform": views, "random 1": views}}
    parts |= {f"{kind}.json": {"correct": 4, "adversarial": [0, 0, 1, 1]} for kind in KINDS}
    parts["summary.json"] = {"recall": asdict(rate), "false_positive_rate": asdict(none)}
    monkeypatch.setattr(page, "read_json", lambda path: parts[path.name])
    assert page._answer("orange", "a", Path(), ["laboratory"]).startswith(f"Is a safe in strange light? {answer}")


def test_a_light_is_a_fault_from_the_radius_on_that_loses_half_of_the_views(monkeypatch):
    rate, views = page.fraction(400, 400), [True] * 400
    parts = {page.RECOGNIZED: {"uniform": views, "random 1": views}}
    parts |= {f"{kind}.json": {"correct": 4, "adversarial": [0, 1, 2, 4]} for kind in KINDS}
    parts["summary.json"] = {"recall": asdict(rate), "false_positive_rate": asdict(page.fraction(0, 400))}
    monkeypatch.setattr(page, "read_json", lambda path: parts[path.name])
    answer = page._answer("orange", "a", Path(), ["laboratory"])
    for light in KINDS.values():
        assert f"{light.title} of radius {light.radii[2]:g} " in answer
