"""Write the report of an audit from the files of its parts."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from renderer.io.images import read_square
from train.auditing.audit_screen import attack_pictures, charts, plain_sentence, screen_of_one
from train.auditing.lights import ADDITIONAL_STEPS, KINDS, RANDOM, SIDE, STEPS
from train.auditing.plain_light import PlainViews
from train.auditing.relit_audit import relit_sections
from train.auditing.remedies import (
    CLASSIFIER,
    HARDENING,
    NORMALIZED,
    Recommendation,
    recommend,
)
from train.evaluation.scores.metrics import bootstrap, estimate, read_metric, weighted_mean
from train.evaluation.scores.predictions import PREDICTIONS, Prediction, read_predictions
from train.evaluation.scores.scoring import SUMMARY
from train.evaluation.tables import Estimate, Proportion, fraction
from train.report import comparison as compare
from train.report import plots, summary
from train.report.first_screen import (
    NETWORKS,
    Compared,
    FirstScreen,
    choose_disagreements,
    compare_networks,
    describe_place,
    in_words,
)
from train.report.plots import Picture
from train.report.report_page import scores_section, write_page
from train.runs.run_config import CONFIG, read_config, read_json

# First words of a page, by the answer that `write_answer` gives.
VERDICTS = {
    "No": "It is not safe under unusual lighting.",
    "Unknown": "It is unknown whether it is safe.",
}
# Parts of a network that are scored on a folder of images.
LABORATORY = "laboratory"
PHOTOGRAPHS = "photographs"
# File of `train.auditing.lights.recognized` in the folder of a network.
RECOGNIZED = "recognized.json"
# File of `train.auditing.plain_light.find_plain_views` in the folder of the audited network.
PLAIN = "plain_light.json"
# File of `train.auditing.lights.transfers` in the folder of a network.
TRANSFER = "transfer.json"
# JavaScript of the slider.
SLIDER_SCRIPT = (Path(__file__).parent / "slider.js").read_text(encoding="utf-8")
# Number of images in a gallery of the worst images.
WORST = 10
# Minimum fraction of correctly classified images of a network that is called
# safe, both of the label and of other objects.
PASS_THRESHOLD = 0.9
# Predictions by the name of a network and by part, in the order of the images.
Predictions = Mapping[str, Mapping[str, Sequence[Prediction]]]


class Audited(NamedTuple):
    """The report of an audit.

    Attributes:
        path: Path of report.html.
        screen: First screen of the report.
        label: Class whose objects were tested.
        names: Names of the networks by the folders of their parts.
        recommendation: Which remedy is recommended. None if it is unknown.
    """

    path: Path
    screen: FirstScreen
    label: str
    names: Mapping[str, str]
    recommendation: Recommendation | None


def write_audit_page(
    label: str,
    names: Mapping[str, str],
    remedies: Mapping[str, str],
    folders: Mapping[str, Path],
    out: Path,
    caveats: Sequence[str],
) -> Audited:
    """Write report.html from the parts of an audit.

    Args:
        label: Class whose objects were tested.
        names: Names of the networks by the folders of their parts in `out`.
        remedies: Folders of the parts of the compared remedies by name, as
            `name_remedies` returns them.
        folders: Folders of the scored images by part.
        out: Folder of the audit.
        caveats: Sentences at the beginning of the report.

    Returns:
        The report.
    """
    paths = {name: out / key for key, name in names.items()}
    scored = {}
    for name, path in paths.items():
        predictions = {}
        for part in folders:
            predictions[part] = read_predictions(path / part / PREDICTIONS, label)
        scored[name] = predictions
    correct = {name: read_json(path / RECOGNIZED) for name, path in paths.items()}
    counts = {}
    for name, path in paths.items():
        counts[name] = {kind: read_json(path / f"{kind}.json") for kind in KINDS}
    first_name = names[CLASSIFIER]
    plain = PlainViews(**read_json(out / CLASSIFIER / PLAIN))
    transfers = {}
    if len(paths) > 1:
        transfers = {name: read_json(path / TRANSFER) for name, path in paths.items()}
    screen = _first_screen(label, paths, folders, counts, plain)
    recommendation = _recommendation(remedies, folders, out)
    if recommendation is not None:
        sentence = recommendation.sentence
        if recommendation.remedy == HARDENING:
            # The first screen has the gain by hardening already.
            sentence = f"Recommended: {HARDENING}."
        screen = replace(screen, sentences=[*screen.sentences, sentence])
    path = write_page(
        out,
        "audit.html.jinja",
        title=f"Audit: {label} under unusual lighting",
        about=" and ".join(paths),
        label=label,
        kinds=KINDS,
        steps=(STEPS, ADDITIONAL_STEPS),
        counts=counts,
        correct=correct,
        plain_sentence=plain_sentence(label, first_name, plain),
        pictures={name: attack_pictures(path, counts[name]) for name, path in paths.items()},
        charts=charts(counts),
        slider=_slider(counts),
        script=SLIDER_SCRIPT if _slider(counts) else "",
        transfers=transfers,
        answers=[write_answer(label, name, path, folders) for name, path in paths.items()],
        photographs=_score_sections(_with_remedies(paths, remedies, out)),
        recommendation=recommendation,
        rates={name: _rates(lights) for name, lights in correct.items()},
        worst=_worst(label, folders, scored),
        screen=screen,
        caveats=[*caveats, *_unreadable_caveats(folders, list(paths.values())[-1])],
        agreement=_agreement(scored),
        relit=relit_sections(paths),
        config=read_config(out / CONFIG),
    )
    return Audited(path, screen, label, names, recommendation)


def _recommendation(
    remedies: Mapping[str, str], folders: Mapping[str, Path], out: Path
) -> Recommendation | None:
    """Recommend a remedy by the scores on the first folder of images.

    Args:
        remedies: Folder of the parts of each remedy in `out`, by name. The
            original network comes first.
        folders: Folder of images by the name of the part with its scores.
        out: Folder of the audit.

    Returns:
        The recommendation. None without images, or without a remedy.
    """
    part = next(iter(folders), None)
    if part is None or len(remedies) == 1:
        return None
    return recommend(_evaluations({name: out / key / part for name, key in remedies.items()}))


def _with_remedies(
    paths: Mapping[str, Path], remedies: Mapping[str, str], out: Path
) -> dict[str, Path]:
    """Add the networks with normalized light to the networks of an audit.

    Args:
        paths: Folder of the parts of each network, by the name of the network.
        remedies: Names of the folders of the remedies in `out`, by remedy.
        out: Folder of the audit.

    Returns:
        `paths`, and the folders of the networks with normalized light under
        names such as "resnet50, normalized light".
    """
    names = {path.name: name for name, path in paths.items()}
    added = {}
    for key in remedies.values():
        if key.endswith(NORMALIZED):
            name = names[key.removesuffix(NORMALIZED)]
            added[f"{name}, normalized light"] = out / key
    return {**paths, **added}


def _slider(counts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """Find an attack whose lights the slider of the page shows.

    Args:
        counts: For each network and each kind of lighting, the content of the
            file of `success_by_light`. It has the key "slider" if the attack
            has a success.

    Returns:
        The result of `frames_of`, with the classes in words and the additional
        keys "network" and "light". None if no attack has a success.
    """
    for name, by_kind in counts.items():
        for kind, part in by_kind.items():
            if "slider" in part:
                slider = part["slider"]
                classes = [in_words(label) for label in slider["classes"]]
                named = {"network": name, "light": KINDS[kind].title, "classes": classes}
                return {**slider, **named}
    return None


def _first_screen(
    label: str,
    paths: Mapping[str, Path],
    folders: Mapping[str, Path],
    counts: Mapping[str, Mapping[str, Any]],
    plain: PlainViews,
) -> FirstScreen:
    """Make the first screen of the page.

    With two networks and a folder of images, it compares the networks on the
    images. Otherwise it describes the first network.

    Args:
        label: Class whose objects were tested.
        paths: Folder of the parts of each network, by the name of the network.
        folders: Folder of images by the name of the part with its scores.
        counts: Content of the files of attacks, by network and kind of lighting.
        plain: Views that the first network recognizes in plain light.
    """
    (name, path), *others = paths.items()
    part = next(iter(folders), None)
    if others and part is not None:
        other, other_path = others[0]
        screen = _compare(label, (name, path / part), (other, other_path / part), folders[part])
        if screen is not None:
            return screen
    scores = read_json(path / part / SUMMARY) if part is not None else None
    # The answer follows the question mark, and ends at a colon if reasons follow.
    answer = write_answer(label, name, path, folders).partition("? ")[2].partition(":")[0]
    verdict = VERDICTS.get(answer, answer)
    return screen_of_one(label, name, verdict, plain, counts[name], scores)


def _compare(
    label: str,
    original: tuple[str, Path],
    hardened: tuple[str, Path],
    images: Path,
) -> FirstScreen | None:
    """Compare the scores of two networks on the same images.

    Args:
        label: Class under study.
        original: Name of the original network, and folder of its scores.
        hardened: Name of the hardened network, and folder of its scores.
        images: Folder of the images.

    Returns:
        The first screen. None if a metric of it is unknown.
    """
    evaluations = _evaluations(dict([original, hardened]))
    compared = Compared(
        label=in_words(label),
        before=evaluations[original[0]],
        after=evaluations[hardened[0]],
        names=(f"before: {original[0]}", f"after: {hardened[0]}"),
        subjects=NETWORKS,
        place=describe_place(images, images.name),
    )
    return compare_networks(
        compared, choose_disagreements(original[1], hardened[1], images, [label])
    )


def _evaluations(paths: Mapping[str, Path]) -> compare.Evaluations:
    """Read the predictions of networks for the same images.

    Args:
        paths: Folder of the scores of each network, by the name of the network.

    Returns:
        One evaluation of each network, by name.
    """
    runs = {}
    for name, path in paths.items():
        scores = {path.name: summary.PhotographScores.read(read_json(path / SUMMARY))}
        runs[name] = [summary.RunSummary(path.parent, name, {"network": name}, scores, None)]
    # All networks were scored on the same images, so there is one group.
    (group,) = summary.group_by_images(runs).values()
    return compare.read_evaluations(group)


def _score_sections(paths: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Collect the plots, tables and images of each folder of images.

    Args:
        paths: Folder of the parts of each network, by the name of the network.

    Returns:
        For each folder of images, the values that `scores_section` returns.
    """
    runs = {}
    for name, path in paths.items():
        scores = summary.read_summaries(path)
        runs[name] = [summary.RunSummary(path, name, {"network": name}, scores, None)]
    return [scores_section(title, group) for title, group in summary.group_by_images(runs).items()]


def _unreadable_caveats(parts: Collection[str], path: Path) -> Iterator[str]:
    """Yield a sentence for each part in which images cannot be read.

    Args:
        parts: Names of the parts with scores on images.
        path: Folder of the parts of a network. All networks read the same
            images.
    """
    for part in parts:
        files = read_json(path / part / SUMMARY)["unreadable"]
        if files:
            yield f"{len(files)} of the {part} cannot be read, the first being {files[0]}."


def _agreement(scored: Predictions) -> Proportion:
    """Compute the fraction of photographs to which all networks give the same class."""
    by_network = [parts.get(PHOTOGRAPHS, ()) for parts in scored.values()]
    is_same = []
    for predictions in zip(*by_network, strict=True):
        is_same.append(len({item.predicted for item in predictions}) == 1)
    return fraction(sum(is_same), len(is_same))


class Finding(NamedTuple):
    """Fraction of images on which a network is right, in words and as numbers.

    Attributes:
        text: Sentence without a period.
        right: Fraction of images on which the network is right.
        least: Low end of the 95% interval of this fraction.
    """

    text: str
    right: float
    least: float


def write_answer(label: str, name: str, folder: Path, parts: Collection[str]) -> str:
    """Say whether a network is safe in unusual lighting, and why it is not.

    Args:
        label: Class whose objects were tested.
        name: Name of the network.
        folder: Folder of the parts of the network.
        parts: Names of the parts that are scored on images.

    Returns:
        A question and its answer.
    """
    if not any(any(views) for views in read_json(folder / RECOGNIZED).values()):
        question = f"Is {name} safe under unusual lighting?"
        return f"{question} Unknown: it does not recognize {label} in plain light, either."
    findings = _find_rates(label, folder, parts)
    faults = [finding.text for finding in findings if finding.right < PASS_THRESHOLD]
    faults += _attack_faults(folder)
    if faults:
        answer = f"No: {'; '.join(faults)}."
    elif parts and all(finding.least >= PASS_THRESHOLD for finding in findings):
        answer = "Yes, as far as this audit looks."
    else:
        answer = "No fault is shown, but so few images leave room for one."
    return f"Is {name} safe under unusual lighting? {answer}"


def _find_rates(label: str, folder: Path, parts: Collection[str]) -> list[Finding]:
    """Find how often a network is right on renders and on the images of each part.

    Args:
        label: Class whose objects were tested.
        folder: Folder of the parts of the network.
        parts: Names of the parts that are scored on images.

    Returns:
        Findings about renders in environments, renders in random light, and,
        for each part, recall and false positives. Unknown rates are left out.
    """
    rates = _rates(read_json(folder / RECOGNIZED))
    findings = [_recognized(subject, rate) for subject, rate in rates.items()]
    for part in parts:
        scores = read_json(folder / part / SUMMARY)
        recall = read_metric(scores, "recall")
        findings.append(_recognized(f"{label} in the {part}", recall))
        false_positive_rate = read_metric(scores, "false_positive_rate")
        subject = f"other objects for {label} in the {part}"
        findings.append(_not_mistaken(subject, false_positive_rate))
    return [finding for finding in findings if finding is not None]


def _recognized(subject: str, recall: Estimate | None) -> Finding | None:
    """Say what fraction of the images of a subject a network recognizes.

    Args:
        subject: What the images show, in words.
        recall: Fraction of recognized images with its interval.

    Returns:
        The finding. None if the recall is unknown.
    """
    if recall is None or recall.value is None or recall.low is None:
        return None
    text = f"it recognizes {recall.value:.0%} of {subject}"
    return Finding(text, right=recall.value, least=recall.low)


def _not_mistaken(subject: str, error_rate: Estimate | None) -> Finding | None:
    """Say what fraction of the images of a subject a network mistakes.

    Args:
        subject: What the images show and what they are mistaken for, such as
            "other objects for orange".
        error_rate: Fraction of mistaken images with its interval.

    Returns:
        The finding. None if the error rate is unknown.
    """
    if error_rate is None or error_rate.value is None or error_rate.high is None:
        return None
    text = f"it takes {error_rate.value:.0%} of {subject}"
    return Finding(text, right=1 - error_rate.value, least=1 - error_rate.high)


def _attack_faults(folder: Path) -> list[str]:
    """Name the kinds of lighting whose attacks fool half of the views.

    Args:
        folder: Folder of the parts of a network.

    Returns:
        For each such kind, a clause with the smallest radius at which an attack
        makes at least half of the correct views misclassified.
    """
    faults = []
    for kind, light in KINDS.items():
        counts = read_json(folder / f"{kind}.json")
        for radius, fooled_count in zip(light.radii, counts["adversarial"], strict=True):
            if 0 < counts["correct"] <= 2 * fooled_count:
                attack = f"an attack with {light.title} of radius {radius:g}"
                faults.append(f"{attack} loses half of the views")
                break
    return faults


def _rates(correct: Mapping[str, Sequence[bool]]) -> dict[str, Estimate]:
    """Compute the fraction of recognized renders in environments and in random lights.

    The bootstrap of the interval draws views, and then lights of each view.

    Args:
        correct: Whether each view is recognized, by the name of the lighting.
            Names of random lights start with RANDOM.

    Returns:
        Fraction with its 95% interval, by "renders in environments" and
        "renders in random light".
    """
    random = {name for name in correct if name.startswith(RANDOM)}
    lights = {
        "renders in environments": correct.keys() - random,
        "renders in random light": random,
    }
    rates: dict[str, Estimate] = {}
    for title, names in lights.items():
        # The array has a row for each view and a column for each light.
        hits = np.array([correct[name] for name in sorted(names)], float).T
        # The view of each render, in the order of `hits.ravel()`.
        views = np.arange(len(hits)).repeat(hits.shape[1])
        if hits.min() == hits.max():
            # All replicates are equal. The interval counts each view once.
            rates[title] = fraction(int(hits[:, 0].sum()), len(hits))
            continue
        replicates = bootstrap(partial(weighted_mean, hits.ravel()), views)
        rates[title] = estimate(float(hits.mean()), replicates)
    return rates


class _ScoredImage(NamedTuple):
    """Prediction of one network for an image.

    Attributes:
        part: Part whose folder has the image.
        image_index: Index of the image among the predictions of the part.
        prediction: Prediction of the network.
    """

    part: str
    image_index: int
    prediction: Prediction


def _worst(
    label: str,
    folders: Mapping[str, Path],
    scored: Predictions,
) -> dict[str, list[Picture]]:
    """Make two galleries of images for each network.

    The first gallery has the images of the label with the lowest log-odds. The
    second gallery has the images of other objects with the highest log-odds.

    Args:
        label: Class whose objects were tested.
        folders: Folder of images by part.
        scored: Predictions by network and by part.

    Returns:
        At most WORST images by the title of the gallery.
    """
    galleries: dict[str, list[Picture]] = {}
    for name, by_part in scored.items():
        rows = [
            _ScoredImage(part, index, prediction)
            for part, predictions in by_part.items()
            for index, prediction in enumerate(predictions)
        ]
        rows.sort(key=lambda row: row.prediction.log_odds)
        positives = [row for row in rows if row.prediction.photograph.label == label]
        negatives = [row for row in reversed(rows) if row.prediction.photograph.label != label]
        draw = partial(_draw_image, folders, scored)
        galleries[f"{label} that {name} doubts most"] = list(map(draw, positives[:WORST]))
        galleries[f"what {name} most takes for {label}"] = list(map(draw, negatives[:WORST]))
    return galleries


def _draw_image(folders: Mapping[str, Path], scored: Predictions, row: _ScoredImage) -> Picture:
    """Draw an image with the predictions of all networks as its caption.

    Args:
        folders: Folder of images by part.
        scored: Predictions by network and by part.
        row: Prediction of one network for the image, with its part and index.
    """
    photograph = row.prediction.photograph
    texts = []
    for network, by_part in scored.items():
        prediction = by_part[row.part][row.image_index]
        texts.append(f"{network}: {prediction.probability:.0%} {prediction.predicted}")
    caption = f"{photograph.label}, {photograph.source}: {'; '.join(texts)}"
    image = Image.fromarray(read_square(folders[row.part] / photograph.path, SIDE))
    return plots.encoded(image, caption, caption)
