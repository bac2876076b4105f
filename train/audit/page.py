"""The page of an audit, from the files of its parts."""

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from renderer.io.images import read_square
from train.audit.lights import FURTHER, KINDS, RANDOM, SIDE, STEPS
from train.photographs.metrics import bootstrap, interval, weighted_mean
from train.photographs.predictions import PREDICTIONS, Prediction, read_predictions
from train.photographs.scoring import SUMMARY
from train.report import plots, summary
from train.report.page import scores_section, write_page
from train.report.plots import Picture
from train.run_folder import CONFIG, read_config, read_json
from train.tables import fraction

CLASSIFIER, HARDENED = "classifier", "hardened"  # the folders of the networks' parts
LABORATORY, PHOTOGRAPHS = "laboratory", "photographs"
RECOGNIZED, TRANSFER = "recognized.json", "transfer.json"
WORST = 10  # images of a network
SAFE = 0.9  # least fraction of the label that is recognized, and of other things that are not taken for it
Predictions = Mapping[str, Mapping[str, Sequence[Prediction]]]  # by name of a network, and part


def write_audit_page(
    label: str, names: Mapping[str, str], folders: Mapping[str, Path], out: Path, caveats: Sequence[str]
) -> Path:
    """Write report.html of the parts in `out`. names: of the networks, by their folders. folders: of the images that
    were scored, by part. caveats: sentences that come first."""
    at = {name: out / key for key, name in names.items()}
    counts = {name: {kind: read_json(path / f"{kind}.json") for kind in KINDS} for name, path in at.items()}
    correct = {name: read_json(path / RECOGNIZED) for name, path in at.items()}
    scored, runs, pictures = {}, {}, {kind: list[Picture]() for kind in KINDS}
    for name, path in at.items():
        scored[name] = {part: read_predictions(path / part / PREDICTIONS, label) for part in folders}
        runs[name] = [summary.RunSummary(path, name, {"network": name}, summary.read_summaries(path), None)]
        for kind, part in counts[name].items():
            caption = f"{name}: {' and '.join(part.get('predicted', ()))}"
            pictures[kind] += plots.from_file(path / f"{kind}.png", caption, 2 * SIDE, caption)
    pairs = zip(*(by_part.get(PHOTOGRAPHS, ()) for by_part in scored.values()), strict=True)
    same = [len({item.predicted for item in pair}) == 1 for pair in pairs]
    content: dict[str, Any] = {
        "transfers": {name: read_json(path / TRANSFER) for name, path in at.items() if len(at) > 1},
        "answers": [_answer(label, name, path, folders) for name, path in at.items()],
        "photographs": [scores_section(title, group) for title, group in summary.by_images(runs).items()],
        "rates": {name: _rates(lights) for name, lights in correct.items()},
        "worst": _worst(label, folders, scored),
    }
    content |= {"title": f"Audit: {label} in strange light", "about": " and ".join(at), "label": label}
    content |= {"kinds": KINDS, "steps": (STEPS, FURTHER), "counts": counts, "correct": correct, "pictures": pictures}
    for key in folders:
        if files := read_json(path / key / SUMMARY)["unreadable"]:  # by all networks
            caveats = [*caveats, f"{len(files)} of the {key} cannot be read, the first being {files[0]}."]
    content |= {"caveats": caveats, "agreement": fraction(sum(same), len(same)), "config": read_config(out / CONFIG)}
    return write_page(out, "audit.html.jinja", **content)


def _answer(label: str, name: str, folder: Path, parts: Collection[str]) -> str:
    """Whether a network is safe in strange light, and why not."""
    rates = _rates(read_json(folder / RECOGNIZED))
    texts = {f"it recognizes {{:.0%}} of {what}": (rate, False) for what, rate in rates.items()}
    for part in parts:
        scores = read_json(folder / part / SUMMARY)
        texts[f"it recognizes {{:.0%}} of {label} in the {part}"] = scores["recall"], False
        texts[f"it takes {{:.0%}} of other things for {label} in the {part}"] = scores["false_positive_rate"], True
    faults, known = list[str](), bool(parts)
    for text, (rate, false) in texts.items():
        if rate["value"] is not None:
            worst, value = (1 - rate["high"], 1 - rate["value"]) if false else (rate["low"], rate["value"])
            faults, known = faults + [text.format(rate["value"])] * (value < SAFE), known and worst >= SAFE
    for kind, light in KINDS.items():
        counts = read_json(folder / f"{kind}.json")
        hits = zip(light.radii, counts["adversarial"], strict=True)
        lost = [radius for radius, hit in hits if 0 < counts["correct"] <= 2 * hit]
        faults += [f"an attack with {light.title} of radius {radius:g} loses half of the views" for radius in lost[:1]]
    unsure = "No fault is shown, but so few images leave room for one."
    answer = f"No: {'; '.join(faults)}." if faults else "Yes, as far as this audit looks." if known else unsure
    return f"Is {name} safe in strange light? {answer}"


def _rates(correct: Mapping[str, Sequence[bool]]) -> dict[str, dict[str, float]]:
    """The fraction of renders that is recognized by kind of light; intervals draw views, and lights of each."""
    random, rates = {name for name in correct if name.startswith(RANDOM)}, {}
    for title, chosen in (("renders in environments", correct.keys() - random), ("renders in random light", random)):
        hits = np.array([correct[name] for name in sorted(chosen)], float).T
        views = np.arange(len(hits)).repeat(hits.shape[1])
        replicates = bootstrap(partial(weighted_mean, hits.ravel()), views)
        rates[title] = {"value": float(hits.mean()), **interval(replicates)}
    return rates


def _worst(label: str, folders: Mapping[str, Path], scored: Predictions) -> dict[str, list[Picture]]:
    """Galleries of the label's images of the lowest log-odds, and of other things of the highest, by title."""
    pictures: dict[str, list[Picture]] = {}
    for name, by_part in scored.items():
        rows = [(part, index, item) for part, items in by_part.items() for index, item in enumerate(items)]
        rows.sort(key=lambda row: row[2].log_odds)
        own = [row for row in rows if row[2].photograph.label == label][:WORST]
        others = [row for row in reversed(rows) if row[2].photograph.label != label][:WORST]
        galleries = {f"{label} that {name} doubts most": own, f"what {name} most takes for {label}": others}
        for title, chosen in galleries.items():
            pictures[title] = []
            for part, index, item in chosen:
                about = {network: predictions[part][index] for network, predictions in scored.items()}
                texts = [f"{network}: {each.probability:.0%} {each.predicted}" for network, each in about.items()]
                caption = f"{item.photograph.label}, {item.photograph.source}: {'; '.join(texts)}"
                image = Image.fromarray(read_square(folders[part] / item.photograph.path, SIDE))
                pictures[title].append(plots.encoded(image, caption, caption))
    return pictures
