"""The first screen of a report page about the hardening of a network.

It says whether hardening helped, and shows metrics and pictures before and after it.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from renderer.errors import InputError
from train.data.photo import DESCRIPTION
from train.results import compare, tables
from train.results.compare import Difference
from train.results.metrics import CLASS_RATE, Pool
from train.results.pictures import Picture, read_square
from train.results.predictions import Predictions
from train.results.store import RunSummary
from train.results.tables import Estimate, Table
from train.run_folder import read_json
from train.settings import KEPT_ASIDE, PHOTOGRAPHS, in_words

# Metric "recall at a false-positive rate of 10%". At an equal rate, the recall of two
# networks can be compared.
EQUAL_RATE = "recall_at/0.10"
# Words for the network before and after hardening, in the middle of a sentence.
NETWORKS = ("the original network", "the hardened network")
# Largest number of pictures in a row.
PICTURES = 6
# Largest number of pixels per side of a picture.
SIDE = 200


@dataclass(frozen=True)
class ShownMetric:
    """A metric on the first screen, before and after hardening.

    Attributes:
        title: The metric in words.
        note: Words that say which values are good, such as "higher is better".
        before: Value for the original network. None if only one network is shown.
        after: Value for the hardened network, or for the only network.
        form: Format of its numbers: in percent, or with two decimals.
        interval: What the ends of the interval are.
    """

    title: str
    note: str
    before: Estimate | None
    after: Estimate
    form: str = ".0%"
    interval: str = "95% interval"

    def text(self, value: float) -> str:
        """Write a value of the metric."""
        return f"{value:{self.form}}"


class ShownPrediction(NamedTuple):
    """Class that a network predicts for an image, as a page shows it.

    Attributes:
        text: Predicted class and its probability, such as "orange 81%".
        verdict: "right" if the image is of the predicted class. "wrong" if the
            network misses an object of the positive class, or takes another
            object for the positive class. Empty for any other wrong prediction,
            which does not count in the metrics.
    """

    text: str
    verdict: str


class ComparedImage(NamedTuple):
    """An image, what it shows in words, and what the original and the hardened network predict.

    An attack has two pictures of the image: before and after it.
    """

    pictures: Sequence[Picture]
    subject: str
    before: ShownPrediction
    after: ShownPrediction


@dataclass(frozen=True)
class FirstScreen:
    """Content of the first screen of a page: an answer, metrics and pictures.

    Attributes:
        answer: Short sentence that says whether hardening helped or, for a
            single network, whether it is safe.
        sentences: Sentences with the reasons of the answer.
        numbers: Metrics of the networks.
        names: Names of both networks, or of the only network.
        images: Sentence that says how many images and objects were scored.
        rows: Rows of pictures, by the title of the row.
        note: Sentences that say how the pictures were chosen.
    """

    answer: str
    sentences: Sequence[str]
    numbers: Sequence[ShownMetric]
    names: Sequence[str]
    images: str = ""
    rows: Mapping[str, Sequence[ComparedImage]] = field(default_factory=dict)
    note: str = ""

    def __str__(self) -> str:
        """Return the answer, its reasons and the table of the metrics as text."""
        rows = []
        for metric in self.numbers:
            shown = filter(None, (metric.before, metric.after))
            cells = [tables.format_interval(estimate, form=metric.form) for estimate in shown]
            rows.append([metric.title, *cells])
        table = Table("", ["", *self.names], rows)
        return f"{' '.join([self.answer, *self.sentences])}\n\n{table}"


def describe_place(folder: Path | None, name: str) -> str:
    """Write the start of a sentence that says where images are from."""
    if folder is None or not (folder / DESCRIPTION).is_file():
        return f"In the images of “{name}”" if name else "In the scored images"
    settings = read_json(folder / DESCRIPTION)
    patterns = settings.get("patterns", [])
    if not patterns or settings.get("environments"):
        return "Under unusual lighting"
    return f"Under projected patterns ({tables.join_words(patterns, 'and')})"


def compare_networks(
    before: Sequence[compare.Evaluation],
    after: Sequence[compare.Evaluation],
    names: tuple[str, str],
    folder: Path | None = None,
    name: str = PHOTOGRAPHS,
    is_hardening: bool = True,
) -> FirstScreen | None:
    """Make the first screen, which says whether hardening helped, and at what price.

    Both networks were scored on the images `name` in `folder`. If unknown, `name` is "" and
    `folder` is None. Without `is_hardening`, the networks are two trained ones, which sentences
    call by their names. The result is None if recall, false-positive rate or AUC is unknown.
    """
    subjects, change = NETWORKS, "hardening"
    if not is_hardening:
        subjects = f"the network “{names[0]}”", f"the network “{names[1]}”"
        change = f"“{names[1]}”"
    # All seeds have the same images, so the first one gives their numbers and labels.
    pool = after[0].pooled
    labels = pool.predictions.labels
    label = tables.join_words([in_words(item) for item in labels], "or")
    each, rate = "", "false_positive_rate"
    if len(labels) > 1:
        each, rate = ", mean over these classes", CLASS_RATE
    metrics = {
        "recall": (f"Images of {label} recognized", "higher is better"),
        rate: (f"Other objects called {label}{each}", "lower is better"),
        "auc": ("Ranking quality (AUC)", "higher is better; 0.5 is chance"),
    }
    reasons = {EQUAL_RATE: "At an equal rate of 10% false positives, recall"}
    if each:
        metrics["class_top1"] = ("Top-1 among all classes, mean over classes", "higher is better")
        reasons["class_top1"] = "Among all classes of the network, top-1 (the mean over classes)"
    # Difference after minus before of each metric. None if it is unknown.
    gains = {
        metric: compare.difference(after, before, compare.ALL, metric)
        for metric in (*metrics, EQUAL_RATE)
    }
    recall, mistaken, auc = gains["recall"], gains[rate], gains["auc"]
    if recall is None or mistaken is None or auc is None:
        return None
    numbers = []
    for metric, (title, note) in metrics.items():
        was, is_now = (compare.mean_metric(item, compare.ALL, metric) for item in (before, after))
        if was is not None and is_now is not None:
            has_one_seed = len(before) == len(after) == 1
            interval = tables.describe_intervals([is_now]) if has_one_seed else is_now.over
            form = ".2f" if metric == "auc" else ".0%"
            numbers.append(ShownMetric(title, note, was, is_now, form, interval))

    original, hardened = subjects
    sentences = [
        f"{describe_place(folder, name)}, {original} recognizes {recall.before:.0%} of the images "
        f"of {label}; {hardened}, {recall.after:.0%}.",
        f"{'The price: of' if mistaken.direction > 0 else 'Of'} the images of other objects, "
        f"{original} calls {mistaken.before:.0%} “{label}”; {hardened}, "
        f"{mistaken.after:.0%}{each}.",
    ]
    known = {text: gains[metric] for metric, text in reasons.items()}
    sentences += [gain_sentence(text, gain) for text, gain in known.items() if gain is not None]

    images = f"{_describe_images(pool, labels)} The gains have {tables.describe_intervals([auc])}."
    if trained := _classes_with_trained_objects(after[0].run, labels, folder):
        trained_labels = tables.join_words(trained, "and")
        images += f" The images of {trained_labels} show the objects of the training in new light."
    note = f"For other objects, any answer but {label} counts as right. Shown are the images on "
    order = "first one for each kind of object and light, then more"
    note += f"which the networks differ most: {order}."
    rows = {}
    if folder is not None:
        # The pictures are from the first seed.
        one, other = (item[0].pooled.predictions for item in (before, after))
        rows = choose_disagreements(one, other, folder, subjects)
    answer = _answer(change, recall, mistaken, auc)
    return FirstScreen(answer, sentences, numbers, names, images, rows, note)


def _describe_images(pool: Pool, labels: Sequence[str]) -> str:
    """Tell on how many images and objects of the positive classes and of others scores are."""
    shown = pool.negatives.photograph
    # Object of each image without a positive class. A photograph has one prediction for each label.
    others = {item.path: item.mesh for item in shown if item.label not in labels}
    scored = pool.metrics.auc
    label = tables.join_words([in_words(item) for item in labels], "or")
    # Without the names of the objects, the interval is over images.
    counts = (scored.positive_objects, len({*others.values()} - {None}) or len(others))
    objects = ["" if scored.over == tables.IMAGES else f" ({count:,} objects)" for count in counts]
    negatives = f"{len(others):,} of other objects{objects[1]}"
    text = f"Scored on {scored.positives:,} images of {label}{objects[0]} and {negatives}."
    if len(labels) > 1:
        text += " For each class, the images of the other classes count as other objects, too."
    return text


def _classes_with_trained_objects(
    run: RunSummary, labels: Sequence[str], images: Path | None
) -> list[str]:
    """List the positive classes whose rendered test images show objects of the training."""
    if images is None or images != run.folder / KEPT_ASIDE:
        return []
    trained = {item["mesh"] if isinstance(item, Mapping) else item for item in run.config.meshes}
    shown = read_json(images / DESCRIPTION)["meshes"]
    repeated = {item["label"] for item in shown if item["mesh"] in trained}
    return [in_words(label) for label in labels if label in repeated]


def _answer(change: str, recall: Difference, false_positives: Difference, auc: Difference) -> str:
    """Write a short sentence that says whether a change of a network helped.

    A proven change of the AUC decides. Recall and false positives decide what the sentence says in
    addition. Differences are after minus before.
    """
    subject = change[0].upper() + change[1:]
    ends = f"{_rounded(auc.low, 2)}, {_rounded(auc.high, 2)}"
    gain = f"AUC {_rounded(auc.value, 2, '+')} [{ends}] over {auc.over}"
    # A direction is the sign of a difference that is proven, and otherwise 0.
    if auc.direction > 0:
        price = ", at a price" if false_positives.direction > 0 else ""
        return f"{subject} improved the ranking ({gain}){price}."
    if auc.direction < 0:
        return f"{subject} made the ranking worse ({gain})."
    if recall.direction > 0 and false_positives.direction > 0:
        return f"{subject} finds more, and mistakes more; a better ranking is not proven ({gain})."
    return f"It is not proven that {change} improved the ranking ({gain})."


def gain_sentence(subject: str, change: Difference) -> str:
    """Write a sentence that compares a metric of two networks."""
    verdict = {1: "a gain", -1: "a loss", 0: "a difference is not proven"}[change.direction]
    # Percentage points, such as "+3", "−0.4" or "0".
    low, high = (_rounded(100 * end, 0, "+") for end in (change.low, change.high))
    values = f"{change.after:.0%} instead of {change.before:.0%}"
    interval = f"95% interval over {change.over}: {low} to {high} points"
    return f"{subject} is {values}; {verdict} ({interval})."


def _rounded(value: float, decimals: int, sign: str = "") -> str:
    """Write a number with a fixed number of decimals.

    A number that would be rounded to 0 keeps one significant digit, so that its sign is visible.
    With "+" as `sign`, positive numbers have a plus sign.
    """
    text = f"{value:{sign}.{decimals}f}"
    if float(text) == 0:
        # A number below 1e-4 is taken as 0 with a rounding error.
        text = "0" if abs(value) < 1e-4 else f"{value:{sign}.1g}"
    # The text gets a typographic minus sign instead of a hyphen.
    return text.replace("-", "−")


def choose_disagreements(
    before: Predictions, after: Predictions, images: Path, subjects: tuple[str, str] = NETWORKS
) -> dict[str, list[ComparedImage]]:
    """Choose images that only one of two networks classifies correctly.

    An image of a positive class is classified correctly if this class is predicted. Any other image
    is classified correctly if no positive class is predicted. The first row has the images that
    only the hardened network gets right, the second those that only the original does, at most
    PICTURES each.
    """
    labels = after.labels
    # One row for each image, about its own class or else about the first one.
    is_positive = np.isin(before.shown, labels)
    is_chosen = before.label == np.where(is_positive, before.shown, labels[0])
    before, after, is_positive = before[is_chosen], after[is_chosen], is_positive[is_chosen]
    was_right, is_right = (
        np.where(is_positive, item.predicted == item.shown, ~np.isin(item.predicted, labels))
        for item in (before, after)
    )
    original, hardened = subjects
    rows = {}
    for subject, is_shown in ((hardened, is_right & ~was_right), (original, was_right & ~is_right)):
        title = f"Only {subject} is right ({is_shown.sum()} of {len(before)} images)"
        rows[title] = _draw_images(before[is_shown], after[is_shown], images)
    return rows


def _draw_images(before: Predictions, after: Predictions, images: Path) -> list[ComparedImage]:
    """Draw at most PICTURES images, first those on whose log-odds both networks differ most."""
    ordered = np.argsort(-np.abs(after.log_odds - before.log_odds), kind="stable").tolist()
    first_of_group: dict[tuple[str, str | None], int] = {}
    for row in ordered:
        photograph = before.photograph[row]
        # One image of each class and source comes first, so that the images differ.
        first_of_group.setdefault((photograph.label, photograph.source), row)
    drawn = []
    for row in [*dict.fromkeys([*first_of_group.values(), *ordered])][:PICTURES]:
        photograph = before.photograph[row]
        subject = ", ".join(map(in_words, filter(None, (photograph.label, photograph.source))))
        original, hardened = (describe_prediction(item, row) for item in (before, after))
        alt = f"{subject}; original network: {original.text}; hardened network: {hardened.text}"
        # A photograph may be gone since it was scored.
        with suppress(InputError):
            picture = read_square(images / photograph.path, SIDE, alt)
            drawn.append(ComparedImage([picture], subject, original, hardened))
    return drawn


def describe_prediction(predictions: Predictions, row: int) -> ShownPrediction:
    """Describe the class that a network predicts for the image in a row.

    It is right if the image shows it, also if the network has no such class, and wrong if it
    misses the positive class or names it falsely. Otherwise, the verdict is empty.
    """
    predicted = predictions.predicted[row]
    verdict = ""
    if predicted == predictions.shown[row]:
        verdict = "right"
    elif predictions.positive[row] or predicted == predictions.label[row]:
        verdict = "wrong"
    return ShownPrediction(f"{in_words(predicted)} {predictions.probability[row]:.0%}", verdict)
