"""Where else an attack's adversaries are shown, and what became of them there, as lines of a file and as a table."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attacks.evaluate import Transfer
from augment.classifiers import Classifier
from augment.objects import load_object, on_ground
from renderer.errors import InputError
from train.attacks.settings import AttackExperimentSettings
from train.networks import load_classifier
from train.settings import read_object
from train.tables import aligned, format_fraction, fraction

FILE = "transfer.jsonl"


def load_others(settings: AttackExperimentSettings, attacked: Classifier, device: torch.device) -> dict[str, Any]:
    """The arguments of `augment.transfer`; none where nothing is asked for. InputError: as the loaders, and where
    a classifier lacks a class."""
    asked, scene = settings.transfer, settings.scene
    named = [item if isinstance(item, dict) else {"classifier": item} for item in asked.classifiers]
    if unknown := next((key for item in named for key in item if key not in ("classifier", "weights")), None):
        raise InputError(f"transfer.classifiers: {unknown} is not known: give names, or {{classifier, weights}}")
    classifiers = [load_classifier(str(item.get("classifier")), item.get("weights")).to(device) for item in named]
    for classifier in classifiers:
        classifier.label(settings.label)  # before anything is attacked
    items = [read_object(item, settings.label, index, "transfer.meshes") for index, item in enumerate(asked.meshes)]
    for item in items:
        attacked.label(item.label)
    objects = [on_ground(load_object(item, scene.vertices), scene.ground) for item in items]
    others = {"classifiers": classifiers, "azimuths": asked.azimuths, "objects": objects}
    return {name: each for name, each in others.items() if each}


def write_transfers(found: Sequence[Transfer], folder: Path) -> None:
    """transfer.jsonl: a line for each place, with the success rate and every adversary's predictions by view."""
    lines = [
        {
            each.kind: each.name,
            **_fraction(each),
            "clean_correct": each.clean_correct.tolist(),
            "success": each.success.tolist(),
            **{f"{name}_before": values for name, values in _predictions(each.before, each.classes).items()},
            **_predictions(each.after, each.classes),
        }
        for each in found
    ]
    (folder / FILE).write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


def format_transfers(found: Sequence[Transfer]) -> str:
    """The fractions as a table."""
    rows = []
    for each in found:
        result = _fraction(each)
        rows.append(
            [f"{each.kind} {each.name}", f"{result['n']} of {len(each.clean_correct)}", format_fraction(result)]
        )
    return aligned(["adversaries shown to", "correct before", "success"], rows)


def _fraction(found: Transfer) -> dict[str, Any]:
    return fraction(int(found.success[found.clean_correct].sum()), int(found.clean_correct.sum()))


def _predictions(logits: Tensor, classes: Sequence[str]) -> dict[str, Any]:
    best = logits.softmax(2).max(2)
    return {
        "predicted": [[classes[index] for index in views] for views in best.indices.tolist()],
        "confidence": best.values.tolist(),
    }
