"""Top of the report of an audit: main numbers, sentences, and pictures of attacks.

Plain light is ordinary light, before an attack changes it. The result of an attack
is the dictionary that `success_by_light` of `train.auditing.lights` returned. It has
the numbers of views that are correct before the attack and misclassified after it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from train.auditing.lights import KINDS, LightKind, PlainViews
from train.results.first_screen import (
    ComparedImage,
    FirstScreen,
    ShownMetric,
    ShownPrediction,
)
from train.results.metrics import Pool
from train.results.pictures import Picture, plot_by_radius, read_pictures
from train.results.tables import Estimate, fraction, join_words
from train.settings import in_words

# Width of the picture that shows a view before and after an attack, in pixels.
PAIR_WIDTH = 400
# Results of attacks by the kind of lighting. A result is a dictionary with numbers of
# views.
Counts = Mapping[str, Mapping[str, Any]]


def plain_sentence(label: str, name: str, plain: PlainViews) -> str:
    """Write how many views a classifier recognizes in plain light, before any attack."""
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
    """Return the kind of lighting by which the most views become misclassified.

    None if no view is recognized before the attacks.
    """
    attacked = [kind for kind in KINDS if counts[kind]["correct"]]
    if not attacked:
        return None
    return max(attacked, key=lambda kind: _misclassified_fraction(counts[kind]))


def _misclassified_fraction(attack_counts: Mapping[str, Any]) -> float:
    """Return which fraction of the correct views the attack at the largest radius changes."""
    return attack_counts["adversarial"][-1] / attack_counts["correct"]


def screen_of_one(
    label: str,
    name: str,
    answer: str,
    plain: PlainViews,
    counts: Counts,
    pool: Pool | None,
) -> FirstScreen:
    """Make the top of the report of an audit of one network."""
    numbers = [
        ShownMetric(
            title="Views recognized in plain light",
            note="higher is better",
            before=None,
            after=fraction(plain.recognized, plain.n),
        )
    ]
    kind = strongest_kind(counts)
    sentences = [plain_sentence(label, name, plain)]
    if kind is not None:
        correct_count = counts[kind]["correct"]
        remaining_count = correct_count - counts[kind]["adversarial"][-1]
        title = f"Of these, under attack by {KINDS[kind].title}"
        remaining = fraction(remaining_count, correct_count)
        numbers.append(ShownMetric(title, "higher is better", before=None, after=remaining))
        sentences.append(
            f"If an attacker controls {KINDS[kind].title} (radius {KINDS[kind].radii[-1]:g}), it "
            f"still recognizes {remaining_count} of the {correct_count} views that it recognizes "
            "before the attack."
        )
    false_positive_rate = pool.metrics.false_positive_rate if pool else None
    if false_positive_rate is not None and false_positive_rate.value is not None:
        title = f"Other objects called {in_words(label)}"
        numbers.append(
            ShownMetric(title, "lower is better", before=None, after=false_positive_rate)
        )
    if pool:
        sentences += _score_sentence(label, pool)
    return FirstScreen(
        answer=answer,
        sentences=sentences,
        numbers=numbers,
        rows={},
        names=[name],
        images="",
    )


def _score_sentence(label: str, pool: Pool) -> list[str]:
    """Write a sentence about recall and false positives on test images."""
    recall = pool.metrics.recall
    mistaken = pool.metrics.false_positive_rate
    if recall.value is None or mistaken.value is None:
        return []
    name = in_words(label)
    return [
        f"In the scored images, it recognizes {recall.value:.0%} of {name} and calls "
        f"{mistaken.value:.0%} of other objects “{name}”."
    ]


def attack_pictures(folder: Path, counts: Counts) -> list[ComparedImage]:
    """Read a picture for each kind of lighting: one view before and after the attack.

    A kind of lighting by which no attack succeeds has no picture.
    """
    compared = []
    for kind, light in KINDS.items():
        answers = _answers(counts[kind])
        if not answers:
            continue
        path = folder / f"{kind}.png"
        alt_text = f"{light.title}: {answers[0].text}, after the attack {answers[1].text}"
        for picture in read_pictures(path, alt_text, PAIR_WIDTH):
            lost = f"{counts[kind]['adversarial'][-1]} of {counts[kind]['correct']} views lost"
            caption = f"{light.title}: {lost} at radius {light.radii[-1]:g}"
            compared.append(ComparedImage(picture, caption, *answers))
    return compared


def withstood_sentence(name: str, counts: Counts) -> str:
    """Name the kinds of lighting by which no attack on a network succeeds.

    Empty if attacks with each kind succeed, or if no view is recognized before them.
    """
    withstood = [
        light.title
        for kind, light in KINDS.items()
        if counts[kind]["correct"] and not counts[kind]["adversarial"][-1]
    ]
    if not withstood:
        return ""
    return f"No attack on {name} succeeded with {join_words(withstood, 'or')}."


def _answers(attack_counts: Mapping[str, Any]) -> list[ShownPrediction]:
    """Describe the right prediction before an attack and the wrong one after it, if it succeeds."""
    texts = [in_words(name) for name in attack_counts.get("predicted", ())]
    # Earlier versions of the library did not write the key "confidence".
    for index, probability in enumerate(attack_counts.get("confidence", ())):
        texts[index] += f" {probability:.0%}"
    return [
        ShownPrediction(text, verdict)
        for text, verdict in zip(texts, ("right", "wrong"), strict=False)
    ]


def charts(counts_by_network: Mapping[str, Counts]) -> list[Picture]:
    """Plot the fraction of recognized views against the radius of attacks.

    Each network has a line for the attack and one for random draws, unless it recognizes no view
    before.
    """
    pictures = []
    for kind, light in KINDS.items():
        lines = {}
        for name, counts in counts_by_network.items():
            attack_counts = counts[kind]
            if attack_counts["correct"]:
                lines[name] = _remaining(attack_counts, "adversarial")
                lines[f"{name}, random"] = _remaining(attack_counts, "random")
        if lines:
            pictures.append(_chart(light, lines))
    return pictures


def _remaining(attack_counts: Mapping[str, Any], method: str) -> list[Estimate]:
    """Compute the fraction of views that stay correctly classified, for each radius.

    The first is 1, at the radius 0. `method` is "adversarial" or "random"; views that are correct
    before count.
    """
    correct = attack_counts["correct"]
    misclassified_by_radius = (0, *attack_counts[method])
    return [fraction(correct - count, correct) for count in misclassified_by_radius]


def _chart(light: LightKind, lines: Mapping[str, Sequence[Estimate]]) -> Picture:
    """Plot fractions of recognized views against the radius of attacks on one kind of lighting."""
    return plot_by_radius(lines, (0, *light.radii), light.title, f"radius ({light.unit})")
