"""Compare the remedies for unusual lighting: normalized light, hardening, or both.

Normalized light is in front of the network at test time, and needs no training.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from augment.classifiers import Classifier
from train.evaluation.scores.metrics import metric_title
from train.evaluation.tables import Table, format_interval
from train.report.comparison import ALL, Evaluation, Evaluations, difference, mean_metric
from train.report.first_screen import EQUAL_RATE, gain_sentence

# Keys of the networks of an audit, and names of the folders of their parts.
CLASSIFIER = "classifier"
HARDENED = "hardened"
# End of the key of a network with normalized light in front.
NORMALIZED = "_normalized_light"
# Name of the audited network among the remedies.
ORIGINAL = "the original network"
# Remedies, from the cheapest to the most expensive.
LIGHT_ALONE = "normalized light"
HARDENING = "hardening"
BOTH = "hardening and normalized light"
# Metric for several classes under study. For one class, it is EQUAL_RATE.
TOP1 = "class_top1"


@dataclass(frozen=True)
class Recommendation:
    """Which remedy an audit recommends.

    Attributes:
        remedy: Name of the remedy. None for none.
        sentence: The recommendation in words.
        table: The metric with each remedy, and its gain over the original network.
    """

    remedy: str | None
    sentence: str
    table: Table


def normalizing(networks: Mapping[str, Classifier]) -> dict[str, Classifier]:
    """Put normalized light in front of the networks of an audit.

    Args:
        networks: Networks by `CLASSIFIER` and `HARDENED`.

    Returns:
        Networks by the name of the folder of their parts. Those that normalize
        the light already are left out.
    """
    return {
        key + NORMALIZED: network.normalizing_light()
        for key, network in networks.items()
        if network.normalized_light is None
    }


def name_remedies(networks: Mapping[str, Classifier]) -> dict[str, str]:
    """Name the networks that are compared.

    Args:
        networks: Networks by `CLASSIFIER` and `HARDENED`.

    Returns:
        Folder of the parts of each network by name: `ORIGINAL`, and then the
        remedies, from the cheapest to the most expensive.
    """
    folders = {ORIGINAL: CLASSIFIER}
    for key, network in {**normalizing(networks), **networks}.items():
        if key == CLASSIFIER:
            continue
        is_normalized = network.normalized_light is not None
        if not key.startswith(HARDENED):
            folders[LIGHT_ALONE] = key
        else:
            folders[BOTH if is_normalized else HARDENING] = key
    order = (ORIGINAL, LIGHT_ALONE, HARDENING, BOTH)
    return {name: folders[name] for name in order if name in folders}


def recommend(evaluations: Evaluations) -> Recommendation | None:
    """Recommend the cheapest remedy that no more expensive one improves on.

    A remedy counts only if the 95% interval of its gain over the original
    network is above 0. A more expensive remedy replaces a cheaper one only if
    the interval of its gain over the cheaper one is above 0, too. The metric is
    the recall at 10% false positives for one class under study, and top-1 for
    several.

    Args:
        evaluations: Evaluations of the original network, and then of each
            remedy, from the cheapest to the most expensive, by name.

    Returns:
        The recommendation. None if the metric of a network is unknown.
    """
    original, *remedies = evaluations
    metric = _metric_for(evaluations[original])
    gains = {
        name: difference(evaluations[name], evaluations[original], ALL, metric) for name in remedies
    }
    if any(gain is None for gain in gains.values()):
        return None
    # A remedy must gain over the original network and over the cheaper remedy that
    # was chosen so far.
    chosen = original
    for name in remedies:
        if _is_gain(evaluations, name, original, metric) and _is_gain(
            evaluations, name, chosen, metric
        ):
            chosen = name
    subject = metric_title(metric)
    gain = gains.get(chosen)
    if gain is None:
        listed = ", ".join(remedies)
        sentence = f"Recommended: nothing. No gain in {subject} is proven for: {listed}."
    else:
        sentence = f"Recommended: {chosen}. " + gain_sentence(f"With it, {subject}", gain)
    rows = []
    for name, group in evaluations.items():
        change = format_interval(gains.get(name), "+")
        rows.append([name, format_interval(mean_metric(group, ALL, metric)), change])
    table = Table("", ["network", subject, "gain over the original network"], rows)
    return Recommendation(None if gain is None else chosen, sentence, table)


def _metric_for(group: Sequence[Evaluation]) -> str:
    """Return the metric by which remedies are compared.

    Args:
        group: Evaluations of the original network.

    Returns:
        TOP1 with several classes under study. Otherwise EQUAL_RATE.
    """
    labels = {prediction.label for prediction in group[0].pools[ALL].positives}
    return TOP1 if len(labels) > 1 else EQUAL_RATE


def _is_gain(evaluations: Evaluations, name: str, reference: str, metric: str) -> bool:
    """Return whether a remedy is proven to be better than another network.

    It is proven if the 95% interval of its gain is above 0.

    Args:
        evaluations: Evaluations by the name of the network.
        name: Name of the remedy.
        reference: Name of the other network.
        metric: Name of the metric.
    """
    gain = difference(evaluations[name], evaluations[reference], ALL, metric)
    return gain is not None and gain.low is not None and gain.low > 0
