"""The page of an audit, from the files of its parts."""

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from renderer.io.images import read_square
from train.audit.lights import FURTHER, KINDS, RANDOM, SIDE, STEPS
from train.evaluation.scores.metrics import bootstrap, estimate, read_metric, weighted_mean
from train.evaluation.scores.predictions import PREDICTIONS, Prediction, read_predictions
from train.evaluation.scores.scoring import SUMMARY
from train.evaluation.tables import Estimate, fraction
from train.report import plots, summary
from train.report.plots import Picture
from train.report.report_page import scores_section, write_page
from train.runs.run_config import CONFIG, read_config, read_json

CLASSIFIER, HARDENED = "classifier", "hardened"  # the folders of the networks' parts
LABORATORY, PHOTOGRAPHS = "laboratory", "photographs"
RECOGNIZED, TRANSFER = "recognized.json", "transfer.json"
WORST = 10  # images of a network
SAFE = 0.9  # least fraction of the label that is recognized, and of other things that are not taken for it
Predictions = Mapping[str, Mapping[str, Sequence[Prediction]]]  # by name of a network, and part


def write_audit_page(
    label: str,
    names: Mapping[str, str],
    folders: Mapping[str, Path],
    out: Path,
    caveats: Sequence[str],
) -> Path:
    """Write report.html of the parts in `out`. names: of the networks, by their folders. folders: of the images that
    were scored, by part. caveats: sentences that come first."""
    at = {name: out / key for key, name in names.items()}
    counts = {
        name: {kind: read_json(path / f"{kind}.json") for kind in KINDS}
        for name, path in at.items()
    }
    correct = {name: read_json(path / RECOGNIZED) for name, path in at.items()}
    scored, runs, pictures = {}, {}, {kind: list[Picture]() for kind in KINDS}
    for name, path in at.items():
        scored[name] = {
            part: read_predictions(path / part / PREDICTIONS, label) for part in folders
        }
        runs[name] = [
            summary.RunSummary(path, name, {"network": name}, summary.read_summaries(path), None)
        ]
        for kind, part in counts[name].items():
            caption = f"{name}: {' and '.join(part.get('predicted', ()))}"
            pictures[kind] += plots.from_file(path / f"{kind}.png", caption, 2 * SIDE, caption)
    pairs = zip(*(by_part.get(PHOTOGRAPHS, ()) for by_part in scored.values()), strict=True)
    same = [len({item.predicted for item in pair}) == 1 for pair in pairs]
    content: dict[str, Any] = {
        "transfers": {name: read_json(path / TRANSFER) for name, path in at.items() if len(at) > 1},
        "answers": [_answer(label, name, path, folders) for name, path in at.items()],
        "photographs": [
            scores_section(title, group) for title, group in summary.by_images(runs).items()
        ],
        "rates": {name: _rates(lights) for name, lights in correct.items()},
        "worst": _worst(label, folders, scored),
    }
    content |= {
        "title": f"Audit: {label} in strange light",
        "about": " and ".join(at),
        "label": label,
    }
    content |= {
        "kinds": KINDS,
        "steps": (STEPS, FURTHER),
        "counts": counts,
        "correct": correct,
        "pictures": pictures,
    }
    for key in folders:
        if files := read_json(path / key / SUMMARY)["unreadable"]:  # by all networks
            caveats = [
                *caveats,
                f"{len(files)} of the {key} cannot be read, the first being {files[0]}.",
            ]
    content |= {
        "caveats": caveats,
        "agreement": fraction(sum(same), len(same)),
        "config": read_config(out / CONFIG),
    }
    return write_page(out, "audit.html.jinja", **content)


class Finding(NamedTuple):
    """How often a network is right, in words and as a number.

    Attributes:
        text: Sentence without a period.
        right: Fraction of images on which the network is right.
        least: Low end of the interval of this fraction.
    """

    text: str
    right: float
    least: float


def _answer(label: str, name: str, folder: Path, parts: Collection[str]) -> str:
    """Say whether a network is safe in strange light, and why not."""
    findings = _find_rates(label, folder, parts)
    faults = [finding.text for finding in findings if finding.right < SAFE]
    faults += _attack_faults(folder)
    if faults:
        answer = f"No: {'; '.join(faults)}."
    elif parts and all(finding.least >= SAFE for finding in findings):
        answer = "Yes, as far as this audit looks."
    else:
        answer = "No fault is shown, but so few images leave room for one."
    return f"Is {name} safe in strange light? {answer}"


def _find_rates(label: str, folder: Path, parts: Collection[str]) -> list[Finding]:
    """Find how often a network is right on renders and on photographs, where that is known."""
    rates = _rates(read_json(folder / RECOGNIZED))
    findings = [_recognized(what, rate) for what, rate in rates.items()]
    for part in parts:
        scores = read_json(folder / part / SUMMARY)
        recall = read_metric(scores, "recall")
        findings.append(_recognized(f"{label} in the {part}", recall))
        mistaken = read_metric(scores, "false_positive_rate")
        findings.append(_not_mistaken(f"other things for {label} in the {part}", mistaken))
    return [finding for finding in findings if finding is not None]


def _recognized(what: str, rate: Estimate | None) -> Finding | None:
    """Say how much of something a network recognizes; None if that is unknown."""
    if rate is None or rate.value is None or rate.low is None:
        return None
    return Finding(f"it recognizes {rate.value:.0%} of {what}", rate.value, rate.low)


def _not_mistaken(what: str, rate: Estimate | None) -> Finding | None:
    """Say how much a network takes for something else; None if that is unknown."""
    if rate is None or rate.value is None or rate.high is None:
        return None
    return Finding(f"it takes {rate.value:.0%} of {what}", 1 - rate.value, 1 - rate.high)


def _attack_faults(folder: Path) -> list[str]:
    """Say from which radius on an attack with each kind of light loses half of the views."""
    faults = []
    for kind, light in KINDS.items():
        counts = read_json(folder / f"{kind}.json")
        for radius, lost in zip(light.radii, counts["adversarial"], strict=True):
            if 0 < counts["correct"] <= 2 * lost:
                attack = f"an attack with {light.title} of radius {radius:g}"
                faults.append(f"{attack} loses half of the views")
                break
    return faults


def _rates(correct: Mapping[str, Sequence[bool]]) -> dict[str, Estimate]:
    """Compute the fraction of renders that is recognized in each kind of light.

    The intervals draw views, and lights of each.
    """
    random = {name for name in correct if name.startswith(RANDOM)}
    lights = {
        "renders in environments": correct.keys() - random,
        "renders in random light": random,
    }
    rates = {}
    for title, names in lights.items():
        # A row for each view, and a column for each light.
        hits = np.array([correct[name] for name in sorted(names)], float).T
        views = np.arange(len(hits)).repeat(hits.shape[1])
        replicates = bootstrap(partial(weighted_mean, hits.ravel()), views)
        rates[title] = estimate(float(hits.mean()), replicates)
    return rates


def _worst(
    label: str, folders: Mapping[str, Path], scored: Predictions
) -> dict[str, list[Picture]]:
    """Galleries of the label's images of the lowest log-odds, and of other things of the highest, by title."""
    pictures: dict[str, list[Picture]] = {}
    for name, by_part in scored.items():
        rows = [
            (part, index, item)
            for part, items in by_part.items()
            for index, item in enumerate(items)
        ]
        rows.sort(key=lambda row: row[2].log_odds)
        own = [row for row in rows if row[2].photograph.label == label][:WORST]
        others = [row for row in reversed(rows) if row[2].photograph.label != label][:WORST]
        galleries = {
            f"{label} that {name} doubts most": own,
            f"what {name} most takes for {label}": others,
        }
        for title, chosen in galleries.items():
            pictures[title] = []
            for part, index, item in chosen:
                about = {
                    network: predictions[part][index] for network, predictions in scored.items()
                }
                texts = [
                    f"{network}: {each.probability:.0%} {each.predicted}"
                    for network, each in about.items()
                ]
                caption = f"{item.photograph.label}, {item.photograph.source}: {'; '.join(texts)}"
                image = Image.fromarray(read_square(folders[part] / item.photograph.path, SIDE))
                pictures[title].append(plots.encoded(image, caption, caption))
    return pictures
