"""An audit of a detector: recall and AP50 in plain light, in other light and after attacks."""

import json

import numpy as np
import pytest
import torch

import norm_balls as nb
from augment.classifier import as_network
from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from train.auditing import found
from train.auditing.lights import KINDS, Views, recognize_in_environments

SIZE = 32


def _find_red(images):
    """Detect what differs from the gray background. Its score is the fraction of red light."""
    outputs = []
    for image in images:
        is_object = ((image - 0.5).abs() > 0.05).any(0)
        rows, columns = torch.nonzero(is_object, as_tuple=True)
        if not len(rows):
            empty = image.new_zeros(0)
            none = {"boxes": image.new_zeros(0, 4), "labels": empty.long(), "scores": empty}
            outputs.append(none)
            continue
        sides = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        red, green, _ = image[:, is_object].mean(1)
        outputs.append(
            {
                "boxes": torch.stack(sides).float()[None],
                "labels": torch.tensor([0]),
                "scores": (12 * (red - green) - 1).sigmoid()[None],
            }
        )
    return outputs


def test_recall_on_renders_is_the_fraction_of_views_in_which_the_object_is_found(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(found, "KINDS", {})
    network = as_network(_find_red, SIZE, ["orange", "apple"])
    solids = {
        name: load_object(ObjectSettings(f"solid:{name}:0", label=name))
        for name in ("orange", "lemon")
    }
    views, negatives = (
        Views([item], 3, 0, torch.device("cpu"), exposure=0.7) for item in solids.values()
    )
    lights = ["uniform", "eucalyptus"]
    content = found.detect_in_lights(network, views, views, negatives, lights, 2, tmp_path)
    metrics = content["metrics"]
    recognized = recognize_in_environments(network, views, lights, 2)
    expected = np.mean([recognized[name] for name in lights])
    assert metrics["environments"]["n"] == 6
    assert metrics["environments"]["recall"]["value"] == pytest.approx(expected)
    expected = np.mean([recognized["random 1"], recognized["random 2"]])
    assert metrics["random light"]["recall"]["value"] == pytest.approx(expected)
    # At the lowest threshold, each lemon is a detection.
    assert content["curve"][-1][0] == pytest.approx(0.5)
    recalls = [recall for _, recall in content["curve"]]
    assert recalls == sorted(recalls)


@pytest.mark.slow
def test_an_audit_of_a_detector_has_a_section_about_detections(tmp_path):
    options = {"classes": ["orange", "apple"], "size": SIZE, "environments": ["eucalyptus"]}
    negatives = ["solid:lemon:0"]
    report = nb.audit(
        _find_red, ["solid:orange:0"], hard_negatives=negatives, budget=0.1, out=tmp_path, **options
    )
    assert "<h2>Detections" in report.page
    stored = json.loads((tmp_path / "classifier" / found.DETECTED).read_text())
    assert {f"attacked: {light.title}" for light in KINDS.values()} <= stored["metrics"].keys()
    assert report.network.attacks["lighting"].correct == 1
