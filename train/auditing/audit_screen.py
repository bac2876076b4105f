"""The first screen of an audit: plain light, attacked light, and the pictures of attacks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from train.auditing.lights import KINDS, LightKind
from train.auditing.plain_light import PlainViews
from train.evaluation.scores.metrics import read_metric
from train.evaluation.tables import Estimate, fraction
from train.report import plots
from train.report.first_screen import (
    ComparedImage,
    FirstScreen,
    ShownMetric,
    ShownPrediction,
    in_words,
)

# Width of a picture before and after an attack, in pixels.
PAIR_WIDTH = 400
# Contents of the files of attacks by kind of lighting.
Counts = Mapping[str, Mapping[str, Any]]


def plain_sentence(label: str, name: str, plain: PlainViews) -> str:
    """Say whether a classifier recognizes objects in plain light, and after which search.

    Args:
        label: Class of the objects.
        name: Name of the classifier.
        plain: Result of the search.

    Returns:
        A sentence, or two.
    """
    counted = f"{plain.recognized} of {plain.n} views of {in_words(label)}"
    if plain.recognized == 0:
        return (
            f"{name} recognizes none of {plain.n} views of {in_words(label)} in plain light, at "
            "any exposure and size that was tried. So this audit cannot tell what unusual light "
            "does."
        )
    if plain.recognized == plain.recognized_as_given:
        return f"In plain light, {name} recognizes {counted}."
    place = f"in the light “{plain.light}” at exposure {plain.exposure:g}, size {plain.size:g}"
    return (
        f"In plain light, {name} recognizes {counted} {place}; before this search, "
        f"{plain.recognized_as_given}. All lights are tested there."
    )


def strongest_kind(counts: Counts) -> str | None:
    """Return the kind of lighting whose attacks leave the fewest views recognized.

    Args:
        counts: Contents of the files of attacks.

    Returns:
        Key of KINDS. None if no view is recognized before the attacks.
    """
    attacked = [kind for kind in KINDS if counts[kind]["correct"]]
    if not attacked:
        return None
    return max(attacked, key=lambda kind: _fooled(counts[kind]))


def _fooled(part: Mapping[str, Any]) -> float:
    """Return the fraction of the correct views that an attack at the largest radius fools.

    Args:
        part: Content of the file of an attack, see `success_by_light`. Its
            lists have an entry for each radius, in ascending order.
    """
    return part["adversarial"][-1] / part["correct"]


def screen_of_one(
    label: str,
    name: str,
    answer: str,
    plain: PlainViews,
    counts: Counts,
    scores: Mapping[str, Any] | None,
) -> FirstScreen:
    """Make the first screen of the audit of one network.

    Args:
        label: Class of the objects.
        name: Name of the network.
        answer: Whether it is safe.
        plain: Result of the search for plain light.
        counts: Contents of the files of attacks.
        scores: summary.json of renders or photographs. None without any.

    Returns:
        The first screen.
    """
    numbers = [
        ShownMetric(
            "Views recognized in plain light",
            "higher is better",
            None,
            fraction(plain.recognized, plain.n),
        )
    ]
    kind = strongest_kind(counts)
    sentences = [plain_sentence(label, name, plain)]
    if kind is not None:
        part = counts[kind]
        left = part["correct"] - part["adversarial"][-1]
        title = f"Of these, under attack by {KINDS[kind].title}"
        numbers.append(
            ShownMetric(title, "higher is better", None, fraction(left, part["correct"]))
        )
        sentences.append(
            f"If an attacker controls {KINDS[kind].title}, it still recognizes {left} of the "
            f"{part['correct']} views that it recognizes before the attack."
        )
    mistaken = read_metric(scores, "false_positive_rate") if scores else None
    if mistaken is not None and mistaken.value is not None:
        called = f"Other objects called {in_words(label)}"
        numbers.append(ShownMetric(called, "lower is better", None, mistaken))
    if scores:
        sentences += _score_sentence(label, scores)
    return FirstScreen(answer, sentences, numbers, {}, [name], "")


def _score_sentence(label: str, scores: Mapping[str, Any]) -> list[str]:
    """Write a sentence on recall and false positives in a folder of images.

    Args:
        label: Class of the objects.
        scores: Content of summary.json.

    Returns:
        One sentence, or nothing if one of the two metrics is unknown.
    """
    recall = read_metric(scores, "recall")
    mistaken = read_metric(scores, "false_positive_rate")
    if recall is None or mistaken is None or recall.value is None or mistaken.value is None:
        return []
    shown = in_words(label)
    return [
        f"In the scored images, it recognizes {recall.value:.0%} of {shown} and calls "
        f"{mistaken.value:.0%} of other objects “{shown}”."
    ]


def attack_pictures(folder: Path, counts: Counts) -> list[ComparedImage]:
    """Read the picture of one view before and after each kind of attack.

    Args:
        folder: Folder of the parts of a network.
        counts: Contents of the files of attacks.

    Returns:
        The pictures. Kinds of lighting without a success have none.
    """
    shown = []
    for kind, light in KINDS.items():
        part = counts[kind]
        answers = _answers(part)
        if not answers:
            continue
        path = folder / f"{kind}.png"
        alt = f"{light.title}: {answers[0].text}, after the attack {answers[1].text}"
        for picture in plots.from_file(path, alt, PAIR_WIDTH):
            shown.append(ComparedImage(picture, light.title, *answers))
    return shown


def _answers(part: Mapping[str, Any]) -> list[ShownPrediction]:
    """Describe the predictions for one view before and after an attack.

    Args:
        part: Content of the file of an attack. "predicted" holds two classes if
            the attack has a success, and "confidence" their probabilities.

    Returns:
        The answer before the attack and the answer after it. Empty if the
        attack has no success.
    """
    texts = [in_words(name) for name in part.get("predicted", ())]
    # Earlier versions did not record the probabilities.
    for index, probability in enumerate(part.get("confidence", ())):
        texts[index] += f" {probability:.0%}"
    return [
        ShownPrediction(text, verdict)
        for text, verdict in zip(texts, ("right", "wrong"), strict=False)
    ]


def charts(counts_by_network: Mapping[str, Counts]) -> list[plots.Picture]:
    """Plot how many views stay recognized by the radius of attacks, one plot per kind of light.

    Args:
        counts_by_network: Contents of the files of attacks by name of the network.

    Returns:
        The plots. Networks that recognize no view before the attacks are left out.
    """
    pictures = []
    for kind, light in KINDS.items():
        lines = {}
        for name, counts in counts_by_network.items():
            part = counts[kind]
            if part["correct"]:
                lines[name] = _remaining(part, "adversarial")
                lines[f"{name}, random"] = _remaining(part, "random")
        if lines:
            pictures.append(_chart(light, lines))
    return pictures


def _remaining(part: Mapping[str, Any], method: str) -> list[Estimate]:
    """Compute the fraction of the correct views that stay recognized at each radius.

    Args:
        part: Content of the file of an attack, see `success_by_light`.
        method: "adversarial", or "random" for random draws alone.

    Returns:
        Fractions at the radius 0, where no view is fooled, and at each radius
        of the attack.
    """
    correct = part["correct"]
    return [fraction(correct - fooled, correct) for fooled in (0, *part[method])]


def _chart(light: LightKind, lines: Mapping[str, Sequence[Estimate]]) -> plots.Picture:
    """Plot the fractions that `_remaining` returns, for one kind of lighting.

    Args:
        light: Kind of lighting, with its radii.
        lines: Fractions at each radius, by the name of the line.
    """
    return plots.by_radius(lines, (0, *light.radii), light.title, f"radius ({light.unit})")
