"""The first screen of a report page about the hardening of a network.

It says whether hardening helped, and shows metrics and pictures before and after it.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from renderer.io.images import read_square
from train.data.photographs import DESCRIPTION
from train.results import compare
from train.results.pictures import Picture, encode_picture
from train.results.predictions import Prediction
from train.results.tables import Estimate, Table, describe_intervals, join_words
from train.settings import in_words

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
        is_percentage: Whether the metric is shown in percent.
        interval: What the ends of the interval are.
    """

    title: str
    note: str
    before: Estimate | None
    after: Estimate
    is_percentage: bool = True
    interval: str = "95% interval"

    def text(self, value: float) -> str:
        """Write a value of the metric in percent, or with two decimals if it is no percentage."""
        return f"{value:.0%}" if self.is_percentage else f"{value:.2f}"

    def cells(self) -> list[str]:
        """Write the cells of the row of this metric in a table."""
        cells = [self.title]
        for estimate in (self.before, self.after):
            if estimate is None or estimate.value is None:
                continue
            cell = self.text(estimate.value)
            if estimate.low is not None and estimate.high is not None:
                cell += f" [{self.text(estimate.low)}, {self.text(estimate.high)}]"
            cells.append(cell)
        return cells


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
    """An image with the predictions of two networks.

    Attributes:
        picture: The image.
        subject: Words that say what the image shows, and in which light if that
            is known.
        before: Prediction of the original network.
        after: Prediction of the hardened network.
    """

    picture: Picture
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
        rows: Rows of pictures, by the title of the row.
        names: Names of both networks, or of the only network.
        images: Sentence that says how many images and objects were scored.
        note: Sentences that say how the pictures were chosen.
    """

    answer: str
    sentences: Sequence[str]
    numbers: Sequence[ShownMetric]
    rows: dict[str, list[ComparedImage]]
    names: Sequence[str]
    images: str
    note: str = ""

    def __str__(self) -> str:
        """Return the answer, its reasons and the table of the metrics as text."""
        rows = [metric.cells() for metric in self.numbers]
        table = Table("", ["", *self.names], rows)
        return f"{' '.join([self.answer, *self.sentences])}\n\n{table}"


class Compared(NamedTuple):
    """Evaluations of two networks on the same images, with words for sentences about them.

    The first network is called the original one, and the second the hardened
    one.

    Attributes:
        label: Positive classes in words.
        before: Evaluations of the original network, one for each seed.
        after: Evaluations of the hardened network, one for each seed.
        names: Names of both networks in tables.
        subjects: Words for both networks as the subject of a sentence.
        place: Start of a sentence that says where the images are from, such as
            "Under projected patterns (rings and text)".
        change: What turned the first network into the second, such as
            "hardening".
        trained_objects: Classes whose images show the objects of the training.
    """

    label: str
    before: Sequence[compare.Evaluation]
    after: Sequence[compare.Evaluation]
    names: tuple[str, str]
    subjects: tuple[str, str]
    place: str
    change: str = "hardening"
    trained_objects: Sequence[str] = ()

    def difference(self, name: str) -> compare.Difference | None:
        """Compute the difference of a metric on all images: hardened minus original."""
        return compare.difference(self.after, self.before, compare.ALL, name)

    @property
    def has_several_classes(self) -> bool:
        """Whether there are several positive classes."""
        pool = self.after[0].pooled.all
        return len({prediction.label for prediction in pool.positives}) > 1

    def metric(self, title: str, note: str, name: str) -> ShownMetric | None:
        """Average a metric of both networks over their seeds; None if one of them lacks it."""
        before = compare.mean_metric(self.before, compare.ALL, name)
        after = compare.mean_metric(self.after, compare.ALL, name)
        if before is None or after is None:
            return None
        seed_count = max(len(self.before), len(self.after))
        has_one_seed = seed_count == 1
        interval = describe_intervals([after]) if has_one_seed else after.over
        return ShownMetric(title, note, before, after, name != "auc", interval)


def describe_place(folder: Path | None, name: str) -> str:
    """Write the start of a sentence that says where images are from."""
    if folder is None or not is_laboratory(folder):
        return f"In the images of “{name}”"
    settings = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    patterns = settings.get("patterns", [])
    is_only_patterns = patterns and not settings.get("environments")
    if not is_only_patterns:
        return "Under unusual lighting"
    return f"Under projected patterns ({join_words(patterns, 'and')})"


def is_laboratory(folder: Path) -> bool:
    """Return whether a folder has renders of pnb-lab instead of photographs."""
    # pnb-lab writes a description of the renders to their folder.
    return (folder / DESCRIPTION).is_file()


def compare_networks(
    compared: Compared, rows: dict[str, list[ComparedImage]]
) -> FirstScreen | None:
    """Make the first screen, which says whether hardening helped, and at what price.

    None if recall, false-positive rate or AUC is unknown.
    """
    label = compared.label
    false_positive_title = f"Other objects called {label}"
    if compared.has_several_classes:
        false_positive_title = (
            "Images called a class that they do not show, mean over these classes"
        )
    titles = [
        ("recall", f"Images of {label} recognized", "higher is better"),
        ("false_positive_rate", false_positive_title, "lower is better"),
        ("auc", "Ranking quality (AUC)", "higher is better; 0.5 is chance"),
    ]
    if compared.has_several_classes:
        title = "Top-1 among all classes, mean over classes"
        titles.append(("class_top1", title, "higher is better"))
    metrics = []
    for name, title, note in titles:
        metric = compared.metric(title, note, name)
        if metric is not None:
            metrics.append(metric)
    recall = compared.difference("recall")
    false_positives = compared.difference("false_positive_rate")
    auc = compared.difference("auc")
    if recall is None or false_positives is None or auc is None:
        return None
    return FirstScreen(
        answer=_answer(compared.change, recall, false_positives, auc),
        sentences=_sentences(compared, recall, false_positives),
        numbers=metrics,
        rows=rows,
        names=compared.names,
        images=_describe_images(compared),
        note=_describe_rows(label),
    )


def _describe_rows(label: str) -> str:
    """Say how the rows of pictures were chosen."""
    return (
        f"For other objects, any answer but {label} counts as right. Shown are the images on "
        "which the networks differ most: first one for each kind of object and light, then more."
    )


def _describe_images(compared: Compared) -> str:
    """Say how many images and objects were scored, and which objects the training has shown."""
    pool = compared.after[0].pooled.all
    auc = pool.metrics.auc
    positives = f"{auc.positives:,} images of {compared.label} ({auc.positive_objects:,} objects)"
    if compared.has_several_classes:
        labels = {prediction.label for prediction in pool.positives}
        photographs = {item.photograph.path: item.photograph for item in pool.negatives}
        others = [shown for shown in photographs.values() if shown.label not in labels]
        sentence = (
            f"Scored on {positives} and {len(others):,} of other objects. For each class, the "
            "images of the other classes count as other objects, too."
        )
    else:
        sentence = (
            f"Scored on {positives} and {auc.negatives:,} of other objects "
            f"({auc.negative_objects:,} objects)."
        )
    gain = compared.difference("auc")
    if gain is not None:
        sentence += f" The gains have {describe_intervals([gain])}."
    if compared.trained_objects:
        trained = join_words(compared.trained_objects, "and")
        sentence += f" The images of {trained} show the objects of the training in new light."
    return sentence


def _direction(change: compare.Difference) -> int:
    """Return the sign of a difference, or 0 if its 95% interval contains 0."""
    assert change.low is not None and change.high is not None
    return int(change.low > 0) - int(change.high < 0)


def _answer(
    change: str,
    recall: compare.Difference,
    false_positives: compare.Difference,
    auc: compare.Difference,
) -> str:
    """Write a short sentence that says whether a change of a network helped.

    A proven change of the AUC decides. Recall and false positives decide what the sentence says in
    addition. Differences are after minus before.
    """
    assert auc.value is not None and auc.low is not None and auc.high is not None
    subject = change[0].upper() + change[1:]
    gain = (
        f"AUC {_rounded(auc.value, 2, '+')} [{_rounded(auc.low, 2)}, {_rounded(auc.high, 2)}] "
        f"over {auc.over}"
    )
    match _direction(auc):
        case 1 if _direction(false_positives) > 0:
            return f"{subject} improved the ranking ({gain}), at a price."
        case 1:
            return f"{subject} improved the ranking ({gain})."
        case -1:
            return f"{subject} made the ranking worse ({gain})."
    if _direction(recall) > 0 and _direction(false_positives) > 0:
        return f"{subject} finds more, and mistakes more; a better ranking is not proven ({gain})."
    return f"It is not proven that {change} improved the ranking ({gain})."


def _sentences(
    compared: Compared,
    recall: compare.Difference,
    false_positives: compare.Difference,
) -> list[str]:
    """Write sentences that say how recall and false positives changed."""
    label = compared.label
    original, hardened = compared.subjects
    sentences = [
        f"{compared.place}, {original} recognizes {recall.before:.0%} of the images of {label}; "
        f"{hardened}, {recall.after:.0%}."
    ]
    sentences.append(_describe_false_positives(compared, false_positives))
    equal = compared.difference(EQUAL_RATE)
    if equal is not None:
        text = "At an equal rate of 10% false positives, recall"
        sentences.append(gain_sentence(text, equal))
    top1 = compared.difference("class_top1") if compared.has_several_classes else None
    if top1 is not None:
        text = "Among all classes of the network, top-1 (the mean over classes)"
        sentences.append(gain_sentence(text, top1))
    return sentences


def _describe_false_positives(compared: Compared, change: compare.Difference) -> str:
    """Say how the false-positive rate changed. A proven increase is called the price."""
    original, hardened = compared.subjects
    before, after = f"{change.before:.0%}", f"{change.after:.0%}"
    is_worse = _direction(change) > 0
    if compared.has_several_classes:
        mean = "(mean over these classes)"
        if is_worse:
            return (
                f"The price: of the images that do not show a class, {hardened} mistakes {after} "
                f"for it, instead of {before} {mean}."
            )
        return (
            f"Of the images that do not show a class, {original} mistakes {before} for it; "
            f"{hardened}, {after} {mean}."
        )
    if is_worse:
        return (
            f"The price: {hardened} calls {after} of the images of other objects "
            f"“{compared.label}”, instead of {before}."
        )
    return (
        f"Of the images of other objects, {original} calls {before} “{compared.label}”; "
        f"{hardened}, {after}."
    )


def gain_sentence(subject: str, change: compare.Difference) -> str:
    """Write a sentence that compares a metric of two networks."""
    assert change.low is not None and change.high is not None
    verdicts = {1: "a gain", -1: "a loss", 0: "a difference is not proven"}
    verdict = verdicts[_direction(change)]
    interval = f"95% interval over {change.over}: {_points(change.low)} to {_points(change.high)}"
    values = f"{change.after:.0%} instead of {change.before:.0%}"
    return f"{subject} is {values}; {verdict} ({interval} points)."


def _points(value: float) -> str:
    """Write a difference of fractions in percentage points, such as "+3", "−0.4" or "0"."""
    return _rounded(100 * value, 0, "+")


def _rounded(value: float, decimals: int, sign: str = "") -> str:
    """Write a number with a fixed number of decimals.

    A number that would be rounded to 0 keeps one significant digit, so that its sign is visible.
    "+" as `sign` writes positive numbers with a plus sign.
    """
    text = f"{value:{sign}.{decimals}f}"
    if float(text) == 0:
        # A number below 1e-4 is taken as 0 with a rounding error.
        is_zero = abs(value) < 1e-4
        text = "0" if is_zero else f"{value:{sign}.1g}"
    # The text gets a typographic minus sign instead of a hyphen.
    return text.replace("-", "−")


def choose_disagreements(
    before: Sequence[Prediction],
    after: Sequence[Prediction],
    images: Path,
    labels: Sequence[str],
    subjects: tuple[str, str] = NETWORKS,
) -> dict[str, list[ComparedImage]]:
    """Choose images that only one of two networks classifies correctly.

    An image of a positive class is classified correctly if this class is predicted. Any other image
    is classified correctly if no positive class is predicted. The first row has the images that
    only the hardened network gets right, the second those that only the original does, at most
    PICTURES each.
    """
    predictions_before = _one_for_each_image(before, labels)
    predictions_after = _one_for_each_image(after, labels)
    image_count = len(predictions_before)
    gained = []
    lost = []
    for pair in zip(predictions_before, predictions_after, strict=True):
        was_correct = _is_correct(pair[0], labels)
        is_correct = _is_correct(pair[1], labels)
        if is_correct and not was_correct:
            gained.append(pair)
        elif was_correct and not is_correct:
            lost.append(pair)
    original, hardened = subjects
    gained_title = f"Only {hardened} is right ({len(gained)} of {image_count} images)"
    lost_title = f"Only {original} is right ({len(lost)} of {image_count} images)"
    return {
        gained_title: _draw_images(gained, images),
        lost_title: _draw_images(lost, images),
    }


# Predictions of the original network and of the hardened network for an image.
Pair = tuple[Prediction, Prediction]


def _one_for_each_image(
    predictions: Sequence[Prediction], labels: Sequence[str]
) -> list[Prediction]:
    """Choose one prediction for each image, from those for each image and each positive class.

    An image of another class keeps the prediction for the first positive class.
    """
    chosen = []
    for prediction in predictions:
        shown = prediction.photograph.label
        if prediction.label == (shown if shown in labels else labels[0]):
            chosen.append(prediction)
    return chosen


def _is_correct(prediction: Prediction, labels: Sequence[str]) -> bool:
    """Return whether an image of a positive class gets this class, and another image gets none."""
    shown = prediction.photograph.label
    if shown in labels:
        return prediction.predicted == shown
    return prediction.predicted not in labels


def _draw_images(pairs: Iterable[Pair], images: Path) -> list[ComparedImage]:
    """Draw at most PICTURES images, first those on whose log-odds both networks differ most."""
    ordered = sorted(pairs, key=lambda pair: -abs(pair[1].log_odds - pair[0].log_odds))
    first_of_group: dict[tuple[str, str | None], Pair] = {}
    for pair in ordered:
        photograph = pair[0].photograph
        first_of_group.setdefault((photograph.label, photograph.source), pair)
    chosen = list(first_of_group.values())
    chosen += [pair for pair in ordered if pair not in chosen]
    return [_draw_image(pair, images) for pair in chosen[:PICTURES]]


def _draw_image(pair: Pair, images: Path) -> ComparedImage:
    """Draw an image, and describe the predictions of both networks for it."""
    photograph = pair[0].photograph
    subject = in_words(photograph.label)
    if photograph.source:
        subject += f", {in_words(photograph.source)}"
    original = describe_prediction(pair[0])
    hardened = describe_prediction(pair[1])
    alt = f"{subject}; original network: {original.text}; hardened network: {hardened.text}"
    pixels = Image.fromarray(read_square(images / photograph.path, SIDE))
    return ComparedImage(encode_picture(pixels, alt), subject, original, hardened)


def describe_prediction(prediction: Prediction) -> ShownPrediction:
    """Describe the class that a network predicts for an image."""
    has_positive_class = prediction.predicted == prediction.label
    verdict = ""
    if prediction.predicted == prediction.photograph.label:
        verdict = "right"
    elif prediction.positive or has_positive_class:
        verdict = "wrong"
    text = f"{in_words(prediction.predicted)} {prediction.probability:.0%}"
    return ShownPrediction(text, verdict)
