"""Compare the remedies for unusual lighting: normalized light, hardening, or both.

Normalized light changes the colors of an image before the network classifies it. It
needs no training. Hardening trains the network on renders in unusual lighting.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from augment.classifier import Classifier
from train.results.compare import ALL, Evaluation, Evaluations, difference, mean_metric
from train.results.first_screen import EQUAL_RATE, gain_sentence
from train.results.metrics import metric_title
from train.results.tables import Table, describe_intervals, format_interval

# Keys of the two networks of an audit. They are also the names of the subfolders for
# their results.
CLASSIFIER = "classifier"
HARDENED = "hardened"
# End of the key of a network whose images are normalized before they are classified.
NORMALIZED = "_normalized_light"
# Name of the audited network in the comparison with the remedies.
ORIGINAL = "the original network"
# Names of the remedies, from the cheapest to the most expensive.
LIGHT_ALONE = "normalized light"
HARDENING = "hardening"
BOTH = "hardening and normalized light"
# What a user does for each remedy.
CHECK = "Choose its threshold and check it on your own photographs first."
ADVICE = {
    ORIGINAL: "Keep the original network: no remedy that was tested is proven to help.",
    LIGHT_ALONE: "Recommended: the network as it is, with normalize_light=true.",
    HARDENING: f"Recommended: the hardened network. {CHECK}",
    BOTH: f"Recommended: the hardened network, with normalize_light=true. {CHECK}",
}
# What a user does next if no remedy helps: without and with a hardened network.
NEXT_HARDENING = (
    "Next: harden it (pnb-train experiment=classifier), and audit both with hardened=run:FOLDER."
)
NEXT_DATA = (
    "Next: harden with more meshes of the class and photographs of the place of use, and audit "
    "again."
)
# Remedies are compared by top-1 accuracy if there are several positive classes.
TOP1 = "class_top1"


@dataclass(frozen=True)
class Recommendation:
    """Remedy for unusual lighting that an audit recommends.

    Attributes:
        remedy: Name of the recommended remedy. None if none is recommended.
        advice: What the user should do, in words.
        sentence: The advice and the reason for it.
        table: Metric of the network with each remedy, and its gain over the
            original network.
    """

    remedy: str | None
    advice: str
    sentence: str
    table: Table


def normalizing(networks: Mapping[str, Classifier]) -> dict[str, Classifier]:
    """Add the remedy "normalized light" to the networks of an audit.

    This remedy normalizes the colors of an image before the network classifies it. Keys become such
    as "hardened_normalized_light". Networks that normalize light already are left out.
    """
    return {
        key + NORMALIZED: network.normalizing_light()
        for key, network in networks.items()
        if network.normalized_light is None
    }


def name_remedies(networks: Mapping[str, Classifier]) -> dict[str, str]:
    """Name the remedies that an audit compares, and find their results.

    The values are subfolders. The original network comes first, then the remedies from the cheapest
    to the most expensive.
    """
    subfolders = {ORIGINAL: CLASSIFIER}
    for key, network in {**normalizing(networks), **networks}.items():
        if key == CLASSIFIER:
            continue
        is_normalized = network.normalized_light is not None
        if not key.startswith(HARDENED):
            subfolders[LIGHT_ALONE] = key
        else:
            subfolders[BOTH if is_normalized else HARDENING] = key
    order = (ORIGINAL, LIGHT_ALONE, HARDENING, BOTH)
    return {name: subfolders[name] for name in order if name in subfolders}


def recommend(evaluations: Evaluations) -> Recommendation | None:
    """Recommend the cheapest remedy that helps, unless a more expensive one helps more.

    A remedy helps if the 95% interval of its gain over the original network is above 0. It helps
    more than a cheaper one if the interval of its gain over the cheaper one is above 0, too. The
    metric is the recall at 10% false positives. With several positive classes, it is top-1
    accuracy. The first evaluation is of the original network, and remedies follow by price. None if
    a metric is unknown.
    """
    original, *remedies = evaluations
    metric = _metric_for(evaluations[original])
    gains = {
        name: difference(evaluations[name], evaluations[original], ALL, metric) for name in remedies
    }
    if any(gain is None for gain in gains.values()):
        return None
    chosen = original
    for name in remedies:
        is_better_than_original = _is_gain(evaluations, name, original, metric)
        if is_better_than_original and _is_gain(evaluations, name, chosen, metric):
            chosen = name
    title = metric_title(metric)
    gain = gains.get(chosen)
    if gain is None:
        reason = f"No gain in {title} is proven for: {', '.join(remedies)}. "
        reason += NEXT_DATA if {HARDENING, BOTH} & {*remedies} else NEXT_HARDENING
    else:
        reason = gain_sentence(f"With {chosen}, {title}", gain)
    rows = []
    for name, evaluations_of_network in evaluations.items():
        value = format_interval(mean_metric(evaluations_of_network, ALL, metric))
        rows.append([name, value, format_interval(gains.get(name), "+")])
    intervals = describe_intervals(gains.values())
    table = Table(intervals, ["network", title, "gain over the original network"], rows)
    advice = ADVICE[chosen]
    return Recommendation(
        remedy=None if gain is None else chosen,
        advice=advice,
        sentence=f"{advice} {reason}",
        table=table,
    )


def _metric_for(evaluations: Sequence[Evaluation]) -> str:
    """Choose top-1 accuracy for several positive classes, or else recall at 10% false positives."""
    labels = {prediction.label for prediction in evaluations[0].pooled.all.positives}
    return TOP1 if len(labels) > 1 else EQUAL_RATE


def _is_gain(evaluations: Evaluations, name: str, reference: str, metric: str) -> bool:
    """Return whether the 95% interval of the gain of `name` over `reference` is above 0."""
    gain = difference(evaluations[name], evaluations[reference], ALL, metric)
    return gain is not None and gain.low is not None and gain.low > 0
