import json
from typing import Any

import numpy as np
import pytest
import torch

import norm_balls as nb
from augment.classifier import as_network
from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from renderer.io.images import write_image
from tests.helpers import find_red
from train.auditing import lights as engine
from train.auditing import page
from train.auditing.lights import KINDS, Views, recognize_in_environments, render_in
from train.auditing.relit import RELIT_FOLDER, read_relit
from train.command_settings import AuditSettings
from train.commands import audit
from train.commands.audit import run_audit

SIZE = 32


@pytest.fixture
def no_attacks(monkeypatch) -> None:
    monkeypatch.setattr(engine, "KINDS", {})


def views_of(name: str, count: int, **changes: Any) -> Views:
    """Show a solid, by default as an orange."""
    item = load_object(ObjectSettings(f"solid:{name}:0", label="orange"))
    return Views([item], count, 0, torch.device("cpu"), **changes)


@pytest.mark.usefixtures("no_attacks")
def test_recall_on_renders_is_the_part_of_views_in_which_the_object_is_found(tmp_path):
    network = as_network(find_red, SIZE, ["orange", "apple"])
    views, negatives = (views_of(name, 3, exposure=0.7) for name in ("orange", "lemon"))
    lights = ["uniform", "eucalyptus"]
    unusual = engine.environment_lights(views, lights, 2)
    content = engine.find_in_lights(network, views, views, negatives, unusual, tmp_path)
    metrics = content["metrics"]
    recognized = recognize_in_environments(network, views, unusual)
    expected = np.mean([recognized[name] for name in lights])
    assert metrics["environments"]["n"] == 6
    assert metrics["environments"]["recall"]["value"] == pytest.approx(expected)
    expected = np.mean([recognized["random 1"], recognized["random 2"]])
    assert metrics["random light"]["recall"]["value"] == pytest.approx(expected)
    # At the lowest threshold, each lemon is a detection.
    assert content["curve"][-1][0] == pytest.approx(0.5)
    recalls = [recall for _, recall in content["curve"]]
    assert recalls == sorted(recalls)


def test_the_slider_shows_what_a_detector_predicts_at_its_threshold(monkeypatch):
    """The only detection keeps the largest score, but this falls below the threshold."""
    monkeypatch.setattr(engine, "FRAME_COUNT", 3)
    monkeypatch.setattr(engine, "STEPS", 5)
    network = as_network(find_red, 16, ["orange", "apple"], task=nb.Detection(threshold=0.9))
    result = engine.adversaries(network, views_of("orange", 1, exposure=0.7), "lamps")
    frames = engine.frames_of(result, 0)["frames"]
    for frame in frames:
        assert frame["predicted"] == ("orange" if frame["probabilities"][0] >= 0.9 else "nothing")
    assert (frames[0]["predicted"], frames[-1]["predicted"]) == ("orange", "nothing")


@pytest.mark.usefixtures("no_attacks")
def test_metrics_of_a_detector_that_finds_nothing_are_zero_and_explained(tmp_path):
    def find_nothing(images):
        empty = {"boxes": torch.zeros(0, 4), "labels": torch.zeros(0).long()}
        return [{**empty, "scores": torch.zeros(0)} for _ in images]

    network = as_network(find_nothing, SIZE, ["orange", "apple"], task=nb.Detection())
    views = views_of("orange", 2)
    unusual = engine.environment_lights(views, ["uniform"], 1)
    content = engine.find_in_lights(network, views, views, views, unusual, tmp_path)
    plain = content["metrics"]["plain light"]
    assert plain["recall"]["value"] == plain["false_per_image"]["value"] == 0
    (tmp_path / engine.DETECTED).write_text(json.dumps(content))
    [section] = page.detection_sections({"nothing": tmp_path}, "orange")
    assert section["about"] == page.ABOUT.format("orange")


def test_an_audit_without_meshes_relights_what_a_detector_finds_in_photographs(tmp_path):
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for index in range(3):
        pixels = np.full((SIZE, SIZE, 3), 128, np.uint8)
        # The last photograph shows nothing.
        pixels[8:20, 8 + index : 24] = (150, 110, 90) if index < 2 else 128
        write_image(photographs / f"{index}.png", pixels)
    network = as_network(find_red, SIZE, ["orange", "apple"])
    out = tmp_path / "out"
    settings = AuditSettings(network="red", unlabeled=str(photographs), out=str(out))
    page = run_audit(settings, {"classifier": network}).path.read_text()
    scores = read_relit(out / "classifier" / RELIT_FOLDER)
    assert [item.path for item in scores.photographs] == ["0.png", "1.png"]
    assert {item.predicted for item in scores.photographs} == {"orange"}
    assert f"Of 2 detections in 2 photographs, {network.name} still detects" in page


@pytest.mark.slow
def test_an_audit_of_a_detector_has_a_section_about_detections(tmp_path):
    options = {"classes": ["orange", "apple"], "size": SIZE, "environments": ["eucalyptus"]}
    negatives = ["solid:lemon:0"]
    report = nb.audit(
        find_red, ["solid:orange:0"], hard_negatives=negatives, budget=0.1, out=tmp_path, **options
    )
    assert "<h2>Objects in other light" in report.page
    assert "has no gradients" not in report.page
    stored = json.loads((tmp_path / "classifier" / engine.DETECTED).read_text())
    assert {f"attacked: {light.title}" for light in KINDS.values()} <= stored["metrics"].keys()
    assert report.network.attacks["lighting"].correct == 1


@pytest.mark.usefixtures("no_attacks")
def test_the_miou_on_renders_is_that_of_the_pixels_of_the_class(tmp_path):
    def find_gray(images):
        is_gray = (images - 0.5).abs().amax(1) < 0.05
        return torch.stack([is_gray.float(), 0.5 + 0 * images[:, 0]], dim=1)

    network = as_network(find_gray, SIZE, ["background", "orange"])
    views, negatives = (views_of(name, 3) for name in ("orange", "lemon"))
    unusual = engine.environment_lights(views, ["uniform"], 1)
    content = engine.find_in_lights(network, views, views, negatives, unusual, tmp_path)
    scenes = [shown.scene(SIZE) for shown in (views, negatives)]
    shown = [find_gray(render_in(scene, scene.lights[0])[:, 0]).argmax(1) for scene in scenes]
    guess = torch.cat(shown).bool()
    mask = torch.zeros_like(guess)
    mask[:3] = scenes[0].truth(network.label).masks[:, 0, 0]
    expected = []
    for one, other in ((guess, mask), (~guess, ~mask)):
        expected.append(float((one & other).sum() / (one | other).sum()))
    miou = content["metrics"]["plain light"]["miou"]
    assert miou["value"] == pytest.approx(np.mean(expected))
    assert miou["low"] < miou["value"] < miou["high"]
    assert content["metrics"]["random light"]["n"] == 6


def test_the_threshold_holds_for_the_hardened_network_too(monkeypatch, tmp_path):
    found = []

    def stop(_, networks, __):
        found.extend(network.task for network in networks.values())
        raise KeyboardInterrupt

    monkeypatch.setattr(audit, "_caveats", stop)
    detector = "run:pretrained/detector"
    given = {"network": detector, "hardened": detector, "meshes": ["solid:orange:0"]}
    settings = AuditSettings(**given, threshold=0.9, iou=0.7, out=str(tmp_path / "out"))
    with pytest.raises(KeyboardInterrupt):
        run_audit(settings)
    assert found == [nb.Detection(threshold=0.9, iou=0.7)] * 2
