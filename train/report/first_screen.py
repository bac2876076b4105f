"""The first screen of a page: the answer, three numbers, and pictures of both networks."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from renderer.io.images import read_square
from train.data.photographs import DESCRIPTION, OTHER_PREFIX
from train.evaluation.scores.predictions import PREDICTIONS, Prediction, read_predictions
from train.evaluation.tables import Estimate, Table, join_words
from train.report import comparison as compare
from train.report import plots
from train.report.plots import Picture

# False-positive rate at which the recall of both networks is compared.
EQUAL_RATE = "recall_at/0.10"
# Words for the network before and after hardening, in the middle of a sentence.
NETWORKS = ("the original network", "the hardened network")
# Number of pictures in a row.
PICTURES = 6
# Largest number of pixels per side of a picture.
SIDE = 200


@dataclass(frozen=True)
class Number:
    """A metric before and after hardening.

    Attributes:
        title: Metric in words.
        note: Which values are good.
        before: Metric of the original network. None if there is one network.
        after: Metric of the hardened network, or of the only network.
        is_percentage: Whether the metric is shown in percent.
    """

    title: str
    note: str
    before: Estimate | None
    after: Estimate
    is_percentage: bool = True

    def text(self, value: float) -> str:
        """Write a value of the metric in percent, or with two decimals."""
        return f"{value:.0%}" if self.is_percentage else f"{value:.2f}"

    def cells(self) -> list[str]:
        """Write the title and the value of each network, with its 95% interval."""
        cells = [self.title]
        for estimate in (self.before, self.after):
            if estimate is None or estimate.value is None:
                continue
            cell = self.text(estimate.value)
            if estimate.low is not None and estimate.high is not None:
                cell += f" [{self.text(estimate.low)}, {self.text(estimate.high)}]"
            cells.append(cell)
        return cells


class Answer(NamedTuple):
    """Class that a network gives an image, with its probability.

    Attributes:
        text: Class and probability.
        verdict: "right" if the class is that of the image. "wrong" if the image
            shows the class under study and the network misses it, or if the
            network takes another object for the class under study. Otherwise
            empty: an image of another object, with a wrong class that is not
            under study.
    """

    text: str
    verdict: str


class Contrast(NamedTuple):
    """An image that both networks classify.

    Attributes:
        picture: The image.
        subject: What it shows, and its light if that is known.
        before: Answer of the original network.
        after: Answer of the hardened network.
    """

    picture: Picture
    subject: str
    before: Answer
    after: Answer


@dataclass(frozen=True)
class FirstScreen:
    """Content of the first screen of a page: an answer, metrics and pictures.

    Attributes:
        answer: Whether hardening helped, or whether the network is safe, in a
            few words.
        sentences: Reasons of the answer.
        numbers: Metrics of the networks.
        rows: Pictures by the title of their row.
        names: Names of both networks, or of the only one.
        images: How many images were scored, of how many objects.
    """

    answer: str
    sentences: Sequence[str]
    numbers: Sequence[Number]
    rows: dict[str, list[Contrast]]
    names: Sequence[str]
    images: str

    def __str__(self) -> str:
        """Return the answer, its reasons and the table of the metrics as text."""
        rows = [number.cells() for number in self.numbers]
        table = Table("", ["", *self.names], rows)
        return f"{' '.join([self.answer, *self.sentences])}\n\n{table}"


class Compared(NamedTuple):
    """Evaluations of two networks on the same images.

    Attributes:
        label: Classes under study in words.
        before: Evaluations of the original network, one for each seed.
        after: Evaluations of the hardened network, one for each seed.
        names: Names of both networks in the legend.
        subjects: The same two networks in sentences.
        place: Where the images are from, to begin a sentence.
        change: What the second network differs by, such as "hardening".
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
        """Subtract a metric of the original network from that of the hardened network."""
        return compare.difference(self.after, self.before, compare.ALL, name)

    @property
    def has_several_classes(self) -> bool:
        """Whether several classes are under study."""
        pool = self.after[0].pools[compare.ALL]
        return len({prediction.label for prediction in pool.positives}) > 1

    def number(self, title: str, note: str, name: str) -> Number | None:
        """Return a metric of both networks, averaged over their seeds.

        Args:
            title: Metric in words.
            note: Which values are good, in words.
            name: Name of the metric in `METRICS`.

        Returns:
            The metric. None if it is unknown for a network.
        """
        before = compare.mean_metric(self.before, compare.ALL, name)
        after = compare.mean_metric(self.after, compare.ALL, name)
        if before is None or after is None:
            return None
        return Number(title, note, before, after, is_percentage=name != "auc")


def place_of(folder: Path | None, name: str) -> str:
    """Say where images are from, to begin a sentence.

    Args:
        folder: Folder of the images. None if it is unknown.
        name: Name of the folder of scores.

    Returns:
        Words such as "Under unusual lighting".
    """
    if folder is not None and (folder / DESCRIPTION).is_file():
        return "Under unusual lighting"
    return f"In the images of “{name}”"


def compare_networks(compared: Compared, rows: dict[str, list[Contrast]]) -> FirstScreen | None:
    """Say whether hardening helped, and at what price.

    Args:
        compared: Evaluations of both networks.
        rows: Pictures by the title of their row.

    Returns:
        The first screen. None if recall, false-positive rate or AUC is unknown.
    """
    label = compared.label
    asked = [
        ("recall", f"Images of {label} recognized", "higher is better"),
        ("false_positive_rate", f"Other objects called {label}", "lower is better"),
        ("auc", "Ranking quality (AUC)", "higher is better; 0.5 is chance"),
    ]
    if compared.has_several_classes:
        title = "Top-1 among all classes, mean over classes"
        asked.append(("class_top1", title, "higher is better"))
    numbers = []
    for name, title, note in asked:
        number = compared.number(title, note, name)
        if number is not None:
            numbers.append(number)
    recall = compared.difference("recall")
    false_positives = compared.difference("false_positive_rate")
    auc = compared.difference("auc")
    if recall is None or false_positives is None or auc is None:
        return None
    return FirstScreen(
        answer=_answer(compared.change, recall, false_positives, auc),
        sentences=_sentences(compared, recall, false_positives),
        numbers=numbers,
        rows=rows,
        names=compared.names,
        images=_describe_images(compared),
    )


def _describe_images(compared: Compared) -> str:
    """Say how many images were scored, of how many objects, and which objects were trained on.

    Args:
        compared: Evaluations of both networks on the same images.

    Returns:
        One sentence, or two.
    """
    auc = compared.after[0].pools[compare.ALL].metrics.auc
    sentence = (
        f"Scored on {auc.positives:,} images of {compared.label} ({auc.positive_objects:,} "
        f"objects) and {auc.negatives:,} of other objects ({auc.negative_objects:,} objects)."
    )
    if compared.trained_objects:
        trained = join_words(compared.trained_objects, "and")
        sentence += f" The images of {trained} show the objects of the training in new light."
    return sentence


def _direction(change: compare.Difference) -> int:
    """Return 1 for a proven increase, -1 for a proven decrease, and otherwise 0.

    A change is proven if its 95% interval does not contain 0.
    """
    assert change.low is not None and change.high is not None
    return int(change.low > 0) - int(change.high < 0)


def _answer(
    change: str,
    recall: compare.Difference,
    false_positives: compare.Difference,
    auc: compare.Difference,
) -> str:
    """Say in a few words whether a change helped.

    Args:
        change: Difference between the two networks in words, such as
            "hardening".
        recall: Difference of the recall.
        false_positives: Difference of the false-positive rate. An increase is
            bad.
        auc: Difference of the area under the ROC curve, which decides.

    Returns:
        A sentence such as "Hardening helped."
    """
    subject = change[0].upper() + change[1:]
    match _direction(auc):
        case 1 if _direction(false_positives) > 0:
            return f"{subject} helped, at a price."
        case 1:
            return f"{subject} helped."
        case -1:
            return f"{subject} did harm."
    if _direction(recall) > 0 and _direction(false_positives) > 0:
        return f"{subject} finds more, and mistakes more; a gain is not proven."
    return f"It is not proven that {change} helped."


def _sentences(
    compared: Compared,
    recall: compare.Difference,
    false_positives: compare.Difference,
) -> list[str]:
    """Say in sentences how recall and false positives changed.

    Args:
        compared: Evaluations of both networks.
        recall: Difference of the recall, with the recall of both networks.
        false_positives: Difference of the false-positive rate, with the rate of
            both networks.

    Returns:
        A sentence about the recall, and one about the false-positive rate. If
        they are known, a sentence about the recall at 10% false positives, and
        one about top-1, follow.
    """
    label = compared.label
    original, hardened = compared.subjects
    sentences = [
        f"{compared.place}, {original} recognizes {recall.before:.0%} of the images of {label}; "
        f"{hardened}, {recall.after:.0%}."
    ]
    before = f"{false_positives.before:.0%}"
    after = f"{false_positives.after:.0%}"
    if _direction(false_positives) > 0:
        price = f"The price: {hardened} calls {after} of the images of other objects “{label}”"
        sentences.append(f"{price}, instead of {before}.")
    else:
        sentences.append(
            f"Of the images of other objects, {original} calls {before} “{label}”; "
            f"{hardened}, {after}."
        )
    equal = compared.difference(EQUAL_RATE)
    if equal is not None:
        text = "At an equal rate of 10% false positives, recall"
        sentences.append(gain_sentence(text, equal))
    top1 = compared.difference("class_top1") if compared.has_several_classes else None
    if top1 is not None:
        text = "Among all classes of the network, top-1 (the mean over classes)"
        sentences.append(gain_sentence(text, top1))
    return sentences


def gain_sentence(subject: str, change: compare.Difference) -> str:
    """Compare a metric of both networks, and say whether the difference is proven.

    Args:
        subject: Start of the sentence, such as "Recall".
        change: Difference of the metric.

    Returns:
        A sentence with the interval of the difference.
    """
    assert change.low is not None and change.high is not None
    verdicts = {1: "a proven gain", -1: "a proven loss", 0: "a difference is not proven"}
    verdict = verdicts[_direction(change)]
    interval = f"95% interval: {_points(change.low)} to {_points(change.high)} points"
    return (
        f"{subject} is {change.after:.0%} instead of {change.before:.0%}; {verdict} ({interval})."
    )


def _points(value: float) -> str:
    """Write a difference of fractions in percentage points, such as "+3", "−2" or "0"."""
    points = round(100 * value)
    # A minus sign replaces the hyphen.
    return f"{points:+d}".replace("-", "−") if points else "0"


def contrasts(
    before: Path,
    after: Path,
    images: Path,
    labels: Sequence[str],
    subjects: tuple[str, str] = NETWORKS,
) -> dict[str, list[Contrast]]:
    """Choose the images that only one of two networks gets right.

    An image of a class under study counts as right if it is predicted as this
    class. Another image counts as right if it is predicted as none of them.

    Args:
        before: Folder of the scores of the original network.
        after: Folder of the scores of the hardened network on the same images.
        images: Folder of the images.
        labels: Classes under study.
        subjects: Both networks in words.

    Returns:
        At most PICTURES images in each row, by the title of the row. They are
        of different objects and lights, if there are enough.
    """
    pairs = zip(_read_one_each(before, labels), _read_one_each(after, labels), strict=True)
    gained = []
    lost = []
    for pair in pairs:
        was_right, is_right = (_is_right(prediction, labels) for prediction in pair)
        if is_right and not was_right:
            gained.append(pair)
        elif was_right and not is_right:
            lost.append(pair)
    original, hardened = subjects
    return {
        f"Only {hardened} is right": _draw(gained, images),
        f"Only {original} is right": _draw(lost, images),
    }


# Predictions of the original network and of the hardened network for an image.
Pair = tuple[Prediction, Prediction]


def _read_one_each(folder: Path, labels: Sequence[str]) -> list[Prediction]:
    """Read one prediction of each image.

    With several classes under study, predictions.csv has one line for an image
    and each of these classes.

    Args:
        folder: Folder of the scores of a network.
        labels: Classes under study.

    Returns:
        For an image of a class under study, the prediction about this class.
        For any other image, the prediction about the first of `labels`.
    """
    predictions = []
    for prediction in read_predictions(folder / PREDICTIONS, labels):
        shown = prediction.photograph.label
        if prediction.label == (shown if shown in labels else labels[0]):
            predictions.append(prediction)
    return predictions


def _is_right(prediction: Prediction, labels: Sequence[str]) -> bool:
    """Return whether a prediction is right about the classes under study.

    An image of a class under study must be predicted as this class. Any other
    image must be predicted as none of these classes.

    Args:
        prediction: Prediction of a network for an image.
        labels: Classes under study.
    """
    shown = prediction.photograph.label
    if shown in labels:
        return prediction.predicted == shown
    return prediction.predicted not in labels


def _draw(pairs: Iterable[Pair], images: Path) -> list[Contrast]:
    """Choose at most PICTURES images, and draw them with the answers of both networks.

    Images whose log-odds differ most between the two networks come first. Each
    class and source of images has one image before any of them has a second.

    Args:
        pairs: Predictions of both networks for each image.
        images: Folder of the images.
    """
    ordered = sorted(pairs, key=lambda pair: -abs(pair[1].log_odds - pair[0].log_odds))
    first_of_group: dict[tuple[str, str | None], Pair] = {}
    for pair in ordered:
        photograph = pair[0].photograph
        first_of_group.setdefault((photograph.label, photograph.source), pair)
    chosen = list(first_of_group.values())
    chosen += [pair for pair in ordered if pair not in chosen]
    return [_contrast(pair, images) for pair in chosen[:PICTURES]]


def _contrast(pair: Pair, images: Path) -> Contrast:
    """Draw an image with the answers of both networks.

    Args:
        pair: Predictions of the original and of the hardened network for the
            image.
        images: Folder that the path of the image is relative to.
    """
    photograph = pair[0].photograph
    subject = in_words(photograph.label)
    if photograph.source:
        subject += f", {in_words(photograph.source)}"
    answers = [answer_of(prediction) for prediction in pair]
    alt = f"{subject}; original network: {answers[0].text}; hardened network: {answers[1].text}"
    pixels = Image.fromarray(read_square(images / photograph.path, SIDE))
    return Contrast(plots.encoded(pixels, alt), subject, *answers)


def answer_of(prediction: Prediction) -> Answer:
    """Describe the class that a network gives an image.

    Args:
        prediction: Prediction for an image.

    Returns:
        The class with its probability, and whether it is right.
    """
    verdict = ""
    if prediction.predicted == prediction.photograph.label:
        verdict = "right"
    elif prediction.positive or prediction.predicted == prediction.label:
        verdict = "wrong"
    return Answer(f"{in_words(prediction.predicted)} {prediction.probability:.0%}", verdict)


def in_words(label: str) -> str:
    """Write the name of a class in words, such as "sweet pepper" for "other_sweet_pepper"."""
    return label.removeprefix(OTHER_PREFIX).replace("_", " ")
