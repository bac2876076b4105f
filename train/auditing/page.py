"""Write the report of an audit from the files with its results.

The folder of the audit has a subfolder of results for each network. A folder of
test images is either "laboratory", with path-traced renders, or "photographs".
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from renderer.io.images import read_square
from train.auditing.lights import ADDITIONAL_STEPS, KINDS, RANDOM, SIDE, STEPS, PlainViews
from train.auditing.relit import relit_sections
from train.auditing.remedies import (
    CLASSIFIER,
    HARDENING,
    NEXT_HARDENING,
    NORMALIZED,
    Recommendation,
    recommend,
)
from train.auditing.screen import (
    attack_pictures,
    charts,
    plain_sentence,
    screen_of_one,
    withstood_sentence,
)
from train.results import compare, store
from train.results.first_screen import (
    NETWORKS,
    Compared,
    FirstScreen,
    choose_disagreements,
    compare_networks,
    describe_place,
    describe_prediction,
)
from train.results.intervals import Units, leave_out, weighted_means
from train.results.metrics import Metrics
from train.results.page import scores_section, write_page
from train.results.pictures import Picture, encode_picture
from train.results.predictions import PREDICTIONS, SUMMARY, Prediction, read_predictions
from train.results.tables import Estimate, Proportion, fraction
from train.run_config import CONFIG, read_config
from train.run_folder import read_json
from train.settings import in_words

# Headline of the report, by the answer to the question whether the network is safe.
VERDICTS = {
    "No": "It is not safe under unusual lighting.",
    "Perhaps not": "It may not be safe under unusual lighting; so few views show little.",
    "Unknown": "It is unknown whether it is safe.",
}
# Names of the two folders of test images, and of the subfolders with their scores.
LABORATORY = "laboratory"
PHOTOGRAPHS = "photographs"
# The images in these folders, in words.
IN_WORDS = {LABORATORY: "path-traced test images", PHOTOGRAPHS: "photographs"}
# Result file: in which environment lights a network recognizes each view.
RECOGNIZED = "recognized.json"
# Result file: the ordinary light in which the audited network recognizes most views.
PLAIN = "plain_light.json"
# Result file: how often attacks on a network also fool the other network.
TRANSFER = "transfer.json"
# JavaScript of the slider that moves a light from natural to attacked.
SLIDER_SCRIPT = (Path(__file__).parent / "slider.js").read_text(encoding="utf-8")
# With fewer views that an attack could lose, attacks and renders alone decide nothing.
MIN_VIEWS = 6
# Number of images in a gallery of the worst predictions.
WORST = 10
# A network is called safe only if it classifies at least this fraction of the images
# correctly, both of the tested class and of other objects.
PASS_THRESHOLD = 0.9
# Predictions in the order of the images, by the name of the network and by the name of
# the folder of test images.
Predictions = Mapping[str, Mapping[str, Sequence[Prediction]]]


class Audited(NamedTuple):
    """Report of an audit.

    Attributes:
        path: Path of report.html.
        screen: Top of the report: its headline, main numbers and sentences.
        label: Class whose objects were tested.
        names: Name of each network, by the name of the subfolder with its
            results.
        recommendation: Recommended remedy. None if it is unknown.
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
    """Write report.html from the results in the folder of an audit.

    Keys of `names` and values of `remedies` are subfolders of `out` with results.
    """
    results = {name: out / key for key, name in names.items()}
    scored = {}
    for name, folder in results.items():
        predictions = {}
        for images in folders:
            predictions[images] = read_predictions(folder / images / PREDICTIONS, label)
        scored[name] = predictions
    correct = {name: read_json(folder / RECOGNIZED) for name, folder in results.items()}
    counts = {}
    for name, folder in results.items():
        counts[name] = {kind: read_json(folder / f"{kind}.json") for kind in KINDS}
    first_name = names[CLASSIFIER]
    plain = PlainViews(**read_json(out / CLASSIFIER / PLAIN))
    transfers = {}
    if len(results) > 1:
        transfers = {name: read_json(folder / TRANSFER) for name, folder in results.items()}
    screen = _first_screen(label, results, folders, counts, plain)
    recommendation = _recommendation(remedies, folders, out)
    if recommendation is not None:
        sentence = recommendation.sentence
        if recommendation.remedy == HARDENING:
            # The top of the report shows the gain by hardening already.
            sentence = recommendation.advice
        screen = replace(screen, sentences=[*screen.sentences, sentence])
    elif screen.answer in (VERDICTS["No"], VERDICTS["Perhaps not"]):
        screen = replace(screen, sentences=[*screen.sentences, NEXT_HARDENING])
    last_folder = list(results.values())[-1]
    path = write_page(
        out,
        "audit.html.jinja",
        title=f"Audit: {in_words(label)} under unusual lighting",
        about=" and ".join(results),
        label=in_words(label),
        kinds=KINDS,
        steps=(STEPS, ADDITIONAL_STEPS),
        counts=counts,
        correct=correct,
        plain_sentence=plain_sentence(label, first_name, plain),
        pictures={name: attack_pictures(path, counts[name]) for name, path in results.items()},
        withstood={name: withstood_sentence(name, counts[name]) for name in results},
        charts=charts(counts),
        slider=_slider(counts),
        script=SLIDER_SCRIPT if _slider(counts) else "",
        transfers=transfers,
        answers=[write_answer(label, name, path, folders) for name, path in results.items()],
        photographs=_score_sections(_with_remedies(results, remedies, out)),
        recommendation=recommendation,
        rates={name: _rates(lights) for name, lights in correct.items()},
        worst=_worst(label, folders, scored),
        screen=screen,
        caveats=[*caveats, *_unreadable_caveats(folders, last_folder)],
        agreement=_agreement(scored),
        relit=relit_sections(results),
        config=read_config(out / CONFIG),
    )
    return Audited(path, screen, label, names, recommendation)


def _recommendation(
    remedies: Mapping[str, str], folders: Mapping[str, Path], out: Path
) -> Recommendation | None:
    """Recommend a remedy by the scores on the first folder of test images.

    `remedies` begins with the original network. None without test images, or without a remedy.
    """
    images = next(iter(folders), None)
    if images is None or len(remedies) == 1:
        return None
    return recommend(_evaluations({name: out / key / images for name, key in remedies.items()}))


def _with_remedies(
    results: Mapping[str, Path], remedies: Mapping[str, str], out: Path
) -> dict[str, Path]:
    """Add the networks with the remedy "normalized light" to the networks of an audit.

    This remedy normalizes the colors of an image before the network classifies it. New names are
    such as "resnet50, normalized light".
    """
    name_of_folder = {folder.name: name for name, folder in results.items()}
    added = {}
    for key in remedies.values():
        if key.endswith(NORMALIZED):
            name = name_of_folder[key.removesuffix(NORMALIZED)]
            added[f"{name}, normalized light"] = out / key
    return {**results, **added}


def _slider(counts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """Choose the attack that the slider of the report shows, the first that succeeds.

    "network" and "light" of the result are titles. None if no attack succeeds.
    """
    for name, counts_of_network in counts.items():
        for kind, attack_counts in counts_of_network.items():
            if "slider" in attack_counts:
                slider = attack_counts["slider"]
                classes = [in_words(label) for label in slider["classes"]]
                named = {"network": name, "light": KINDS[kind].title, "classes": classes}
                return {**slider, **named}
    return None


def _first_screen(
    label: str,
    results: Mapping[str, Path],
    folders: Mapping[str, Path],
    counts: Mapping[str, Mapping[str, Any]],
    plain: PlainViews,
) -> FirstScreen:
    """Make the top of the report: its headline, main numbers and sentences.

    With two networks and test images, it compares the scores of the networks.
    Otherwise it describes the first network.
    """
    (name, folder), *others = results.items()
    images = next(iter(folders), None)
    if others and images is not None:
        other_name, other_folder = others[0]
        screen = _compare(
            label,
            (name, folder / images),
            (other_name, other_folder / images),
            folders[images],
        )
        if screen is not None:
            return screen
    pool = None
    if images is not None:
        (evaluation,) = _evaluations({name: folder / images})[name]
        pool = evaluation.pooled.all
    _, _, answer = write_answer(label, name, folder, folders).partition("? ")
    # "No: it recognizes 20% of orange" becomes "No".
    short_answer = answer.partition(":")[0]
    verdict = VERDICTS.get(short_answer, short_answer)
    return screen_of_one(label, name, verdict, plain, counts[name], pool)


def _compare(
    label: str,
    original: tuple[str, Path],
    hardened: tuple[str, Path],
    images: Path,
) -> FirstScreen | None:
    """Make the top of a report that compares a network with its hardened version."""
    evaluations = _evaluations(dict([original, hardened]))
    compared = Compared(
        label=in_words(label),
        before=evaluations[original[0]],
        after=evaluations[hardened[0]],
        names=(f"before: {original[0]}", f"after: {hardened[0]}"),
        subjects=NETWORKS,
        place=describe_place(images, images.name),
    )
    before, after = (item.pooled.predictions for (item,) in evaluations.values())
    return compare_networks(compared, choose_disagreements(before, after, images, [label]))


def _evaluations(score_folders: Mapping[str, Path]) -> compare.Evaluations:
    """Read the predictions of several networks for the same images."""
    runs = {}
    for name, folder in score_folders.items():
        scores = {folder.name: store.StoredScores.read(read_json(folder / SUMMARY))}
        runs[name] = [store.RunSummary(folder.parent, name, {"network": name}, scores, None)]
    # All networks were scored on the same images, so there is a single group.
    (group,) = store.group_by_images(runs).values()
    return compare.read_evaluations(group)


def _score_sections(results: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Collect the plots, tables and pictures of the scores on each folder of test images."""
    runs = {}
    for name, folder in results.items():
        scores = store.read_summaries(folder)
        runs[name] = [store.RunSummary(folder, name, {"network": name}, scores, None)]
    return [scores_section(title, group) for title, group in store.group_by_images(runs).items()]


def _unreadable_caveats(images: Collection[str], folder: Path) -> Iterator[str]:
    """Yield a sentence about each folder of test images with files that cannot be read."""
    for name in images:
        files = read_json(folder / name / SUMMARY)["unreadable"]
        if files:
            images_in_words = IN_WORDS[name]
            yield f"{len(files)} of the {images_in_words} cannot be read, such as {files[0]}."


def _agreement(scored: Predictions) -> Proportion:
    """Compute the fraction of photographs for which all networks predict the same class."""
    by_network = [by_images.get(PHOTOGRAPHS, ()) for by_images in scored.values()]
    is_same = []
    for predictions in zip(*by_network, strict=True):
        is_same.append(len({item.predicted for item in predictions}) == 1)
    return fraction(sum(is_same), len(is_same))


class Finding(NamedTuple):
    """Fraction of images that a network classifies correctly, in words and as numbers.

    Attributes:
        text: Clause for the report, such as "it recognizes 60% of orange".
        right: Fraction of images that the network classifies correctly.
        least: Low end of the 95% interval of this fraction.
    """

    text: str
    right: float
    least: float


def write_answer(label: str, name: str, folder: Path, images: Collection[str]) -> str:
    """Write whether a network is safe in unusual lighting, and why it is not."""
    if not any(any(views) for views in read_json(folder / RECOGNIZED).values()):
        question = f"Is {name} safe under unusual lighting?"
        return f"{question} Unknown: it does not recognize {label} in plain light, either."
    of_renders, of_images = _find_rates(label, folder, images)
    findings = [*of_renders, *of_images]
    faults = [finding.text for finding in findings if finding.right < PASS_THRESHOLD]
    faults += _attack_faults(folder)
    view_count = max(read_json(folder / f"{kind}.json")["correct"] for kind in KINDS)
    rests_on_images = any(finding.right < PASS_THRESHOLD for finding in of_images)
    if faults and not rests_on_images and view_count < MIN_VIEWS:
        answer = f"Perhaps not: {'; '.join(faults)}. Only {view_count} views were attacked."
    elif faults:
        answer = f"No: {'; '.join(faults)}."
    elif images and all(finding.least >= PASS_THRESHOLD for finding in findings):
        answer = "Yes, as far as this audit looks."
    else:
        answer = "No fault is shown, but so few images leave room for one."
    return f"Is {name} safe under unusual lighting? {answer}"


def _find_rates(
    label: str, folder: Path, images: Collection[str]
) -> tuple[list[Finding], list[Finding]]:
    """Find what fraction of the renders and test images a network classifies correctly.

    The first list is about renders in environments and random light, the second about recall and
    false positives on test images.
    """
    rates = _rates(read_json(folder / RECOGNIZED))
    of_renders = [_recognized(subject, rate) for subject, rate in rates.items()]
    findings = []
    for name in images:
        metrics = Metrics.read(read_json(folder / name / SUMMARY))
        findings.append(_recognized(f"{label} in the {IN_WORDS[name]}", metrics.recall))
        subject = f"other objects for {label} in the {IN_WORDS[name]}"
        findings.append(_not_mistaken(subject, metrics.false_positive_rate))
    return _known(of_renders), _known(findings)


def _known(findings: Sequence[Finding | None]) -> list[Finding]:
    """Return the findings that are known."""
    return [finding for finding in findings if finding is not None]


def _recognized(subject: str, recall: Estimate | None) -> Finding | None:
    """Describe what fraction of the images of an object a network recognizes."""
    if recall is None or recall.value is None or recall.low is None:
        return None
    text = f"it recognizes {recall.value:.0%} of {subject}"
    return Finding(text, right=recall.value, least=recall.low)


def _not_mistaken(subject: str, error_rate: Estimate | None) -> Finding | None:
    """Describe what fraction of the images of other objects a network mistakes for a class.

    `error_rate` is the fraction that is mistaken, the finding has the fraction that is not.
    """
    if error_rate is None or error_rate.value is None or error_rate.high is None:
        return None
    text = f"it takes {error_rate.value:.0%} of {subject}"
    return Finding(text, right=1 - error_rate.value, least=1 - error_rate.high)


def _attack_faults(folder: Path) -> list[str]:
    """Describe the attacks after which a network misclassifies half of the views.

    Each clause has the smallest radius at which that is so, among the views that were correct
    before.
    """
    faults = []
    for kind, light in KINDS.items():
        counts = read_json(folder / f"{kind}.json")
        for radius, fooled_count in zip(light.radii, counts["adversarial"], strict=True):
            if 0 < counts["correct"] <= 2 * fooled_count:
                attack = f"an attack with {light.title} of radius {radius:g}"
                faults.append(f"{attack} loses {fooled_count} of {counts['correct']} views")
                break
    return faults


def _rates(correct: Mapping[str, Sequence[bool]]) -> dict[str, Estimate]:
    """Compute what fraction of renders in environment lights and random lights is recognized.

    The intervals are over views. Names of random lights start with "random ".
    """
    random_names = {name for name in correct if name.startswith(RANDOM)}
    names_of_title = {
        "renders in environments": correct.keys() - random_names,
        "renders in random light": random_names,
    }
    rates: dict[str, Estimate] = {}
    for title, names in names_of_title.items():
        # `hits` has one row for each view and one column for each light.
        hits = np.array([correct[name] for name in sorted(names)], float).T
        # Index of the view in each entry of `hits.ravel()`.
        view_of_render = np.arange(len(hits)).repeat(hits.shape[1])
        units = Units([view_of_render], "views")
        (rate,) = leave_out(partial(weighted_means, hits.reshape(1, -1)), units)
        rates[title] = rate.estimate
    return rates


class _ScoredImage(NamedTuple):
    """Test image with the prediction of one network.

    Attributes:
        images: Name of the folder of test images, "laboratory" or
            "photographs".
        image_index: Index of the image in the folder.
        prediction: Prediction of the network for the image.
    """

    images: str
    image_index: int
    prediction: Prediction


def _worst(
    label: str,
    folders: Mapping[str, Path],
    scored: Predictions,
) -> dict[str, list[Picture]]:
    """Make two galleries of the worst predictions of each network.

    The first gallery has the images of the tested class with the lowest log-odds of this class. The
    second gallery has the images of other objects with the highest log-odds. Each gallery has at
    most WORST pictures, by its title.
    """
    galleries: dict[str, list[Picture]] = {}
    for name, by_images in scored.items():
        items = [
            _ScoredImage(images, index, prediction)
            for images, predictions in by_images.items()
            for index, prediction in enumerate(predictions)
        ]
        items.sort(key=lambda item: item.prediction.log_odds)
        positives = [item for item in items if item.prediction.photograph.label == label]
        negatives = [item for item in reversed(items) if item.prediction.photograph.label != label]
        draw = partial(_draw_image, folders, scored)
        label_in_words = in_words(label)
        galleries[f"{label_in_words} that {name} doubts most"] = [
            draw(item) for item in positives[:WORST]
        ]
        galleries[f"what {name} most takes for {label_in_words}"] = [
            draw(item) for item in negatives[:WORST]
        ]
    return galleries


def _draw_image(folders: Mapping[str, Path], scored: Predictions, item: _ScoredImage) -> Picture:
    """Draw a test image with the predictions of all networks in its caption."""
    photograph = item.prediction.photograph
    texts = []
    for network, by_images in scored.items():
        prediction = by_images[item.images][item.image_index]
        texts.append(f"{network}: {describe_prediction(prediction).text}")
    caption = f"{in_words(photograph.label)}, {photograph.source}: {'; '.join(texts)}"
    image = Image.fromarray(read_square(folders[item.images] / photograph.path, SIDE))
    return encode_picture(image, caption, caption)
