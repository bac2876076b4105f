"""Results of an audit for one network: read once, judged, and as `nb.audit` returns them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from augment.classifier import Classifier
from renderer.errors import ShortRepr, as_path
from renderer.io.files import atomic_write
from train.auditing import lights
from train.auditing.lights import KINDS, PLAIN, RANDOM, RECOGNIZED, TRANSFER, PlainViews
from train.results import tables
from train.results.compare import ALL, Difference, Evaluation, Evaluations, difference, mean_metric
from train.results.first_screen import EQUAL_RATE, gain_sentence
from train.results.intervals import Units, leave_out_of_mean
from train.results.metrics import METRICS, TITLES
from train.results.store import RunSummary, ScoredRun, read_summaries
from train.results.tables import Estimate, Proportion, Table, fraction
from train.run_folder import read_json
from train.settings import LABORATORY, PHOTOGRAPHS

# The images in the two folders of test images, in words.
IN_WORDS = {LABORATORY: "path-traced test images", PHOTOGRAPHS: "photographs"}
# With fewer views that an attack could lose, attacks and renders alone decide nothing.
MIN_VIEWS = 6
# A network is called safe only if it classifies at least this fraction of the images
# correctly, both of the tested class and of other objects.
PASS_THRESHOLD = 0.9


# Keys of the two networks of an audit. They are also the names of the subfolders for
# their results.
CLASSIFIER = "classifier"
HARDENED = "hardened"
# Name of the audited network in the comparison with the remedies.
ORIGINAL = "the original network"
# Names of the remedies, from the cheapest to the most expensive.
LIGHT_ALONE = "normalized light"
HARDENING = "hardening"
BOTH = "hardening and normalized light"
# What a user does for each remedy, from the cheapest to the most expensive.
CHECK = "Choose its threshold and check it on your own photographs first."
ADVICE = {
    ORIGINAL: "Keep the original network.",
    LIGHT_ALONE: "Recommended: the network as it is, with normalize_light=true.",
    HARDENING: f"Recommended: the hardened network. {CHECK}",
    BOTH: f"Recommended: the hardened network, with normalize_light=true. {CHECK}",
}
# What a user does next if no remedy helps: without and with a hardened network.
NEXT_HARDENING = (
    "Next, if the network has weights: harden a classifier with pnb-train experiment=classifier, "
    "or a detector with nb.harden, and audit both with hardened=run:FOLDER."
)
NEXT_DATA = (
    "Next: harden with more meshes of the class and photographs of the place of use, and audit "
    "again."
)
# What a user does first if the network knows no view of the class.
NEXT_TRAINING = (
    "First, train the network on these objects in natural light: most of the gain of hardening "
    "comes from seeing the objects at all."
)


@dataclass(frozen=True)
class AttackCounts:
    """Numbers of views that become misclassified by an attack on one kind of lighting.

    Attributes:
        unit: Unit of the radii in words.
        radii: Radii of the L∞ norm-balls, in ascending order.
        views: Number of views.
        correct: Number of views that are classified correctly before the
            attack.
        adversarial: For each radius, the number of correct views that an attack
            or random draws make misclassified, even with the noise of a camera.
        random: For each radius, the same number for random draws alone.
    """

    unit: str
    radii: tuple[float, ...]
    views: int
    correct: int
    adversarial: tuple[int, ...]
    random: tuple[int, ...]


@dataclass(frozen=True, repr=False)
class NetworkReport(ShortRepr):
    """Results of an audit for one network.

    Attributes:
        name: Name of the network.
        answer: Sentence that says whether the network is safe in unusual
            lighting, and why it is not.
        recognized: For the name of each environment light, the fraction of the
            views that the network recognizes. Names of random lights begin with
            "random".
        attacks: Numbers of misclassified views for each kind of lighting:
            "lighting" (environment lighting), "skylight", "projector" and
            "lamps".
        scores: Metrics such as "recall" and "false_positive_rate" on each set
            of test images: "laboratory" (path-traced renders) and
            "photographs".
        transfers: For each kind of lighting, how often an attack on this
            network also fools the other network. See `transfer_success` of
            `train.auditing.lights`. Empty with one network.
    """

    name: str
    answer: str
    recognized: Mapping[str, float]
    attacks: Mapping[str, AttackCounts]
    scores: Mapping[str, Mapping[str, Estimate]]
    transfers: Mapping[str, Any]


@dataclass(frozen=True, repr=False)
class AuditReport(ShortRepr):
    """Report of an audit.

    Attributes:
        label: Class whose objects were tested.
        network: Results for the audited network.
        hardened: Results for the hardened network. None without one.
        recommendation: Sentence that recommends normalized light, hardening,
            both or neither, by the recall at 10% false positives. Empty if
            there are no test images.
        page: Report as a single HTML page, which loads no other files.
    """

    label: str
    network: NetworkReport
    hardened: NetworkReport | None
    recommendation: str
    page: str

    def save(self, path: str | Path) -> Path:
        """Write the report to an HTML file.

        Args:
            path: File to write, such as "audit.html".

        Returns:
            Path of the file.
        """
        file = as_path("path", path)
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(file, self.page)
        return file

    def __str__(self) -> str:
        """Return one line about each network, and the recommendation."""
        lines = [item.answer for item in (self.network, self.hardened) if item is not None]
        return "\n".join([*lines, *filter(None, [self.recommendation])])


class _Finding(NamedTuple):
    """Clause for the report, such as "it recognizes 60% of orange", about correct predictions.

    Attributes:
        text: The clause.
        right: Fraction of images that a network classifies correctly.
        least: Low end of the 95% interval of this fraction.
    """

    text: str
    right: float
    least: float


def _findings(recalls: Mapping[str, Estimate]) -> list[_Finding]:
    """Describe what fraction of the images of each object a network recognizes, if it is known."""
    return [
        _Finding(f"it recognizes {recall.value:.0%} of {subject}", recall.value, recall.low)
        for subject, recall in recalls.items()
        if recall.value is not None and recall.low is not None
    ]


@dataclass(frozen=True)
class AuditedNetwork:
    """Results of an audit for one network.

    Attributes:
        label: Class whose objects were tested.
        name: Name of the network.
        folder: Folder of the results.
    """

    label: str
    name: str
    folder: Path

    @cached_property
    def run(self) -> RunSummary:
        """The scores on test images as those of a run, for tables and comparisons."""
        scores = read_summaries(self.folder)
        return RunSummary(self.folder, self.name, {"network": self.name}, scores, None)

    @cached_property
    def recognized(self) -> dict[str, list[bool]]:
        """Whether the network recognizes each view, by the name of an environment light."""
        return read_json(self.folder / RECOGNIZED)

    @cached_property
    def counts(self) -> dict[str, dict[str, Any]]:
        """Result of `success_by_light` for each kind of lighting, or the first one until then."""
        paths = {kind: self.folder / f"{kind}.json" for kind in KINDS}
        first = {kind: self.folder / (kind + lights.FIRST) for kind in KINDS}
        return {
            kind: read_json(path if path.exists() else first[kind]) for kind, path in paths.items()
        }

    @cached_property
    def transfers(self) -> dict[str, Any]:
        """Result of `transfer_success`. Empty with one network."""
        path = self.folder / TRANSFER
        return read_json(path) if path.exists() else {}

    @property
    def plain(self) -> PlainViews:
        """The plain light in which all networks are tested, and what this one recognizes there."""
        plain = PlainViews(**read_json(self.folder.parent / CLASSIFIER / PLAIN))
        if self.folder.name == CLASSIFIER:
            return plain
        # The light was chosen for the first network. Attacks on the lighting start in it.
        own = self.counts["lighting"]["correct"]
        return replace(plain, recognized=own, recognized_as_given=own)

    def evaluation(self, images: str) -> Evaluation:
        """Predictions for a folder of test images in groups, for comparisons."""
        return Evaluation(self.run, ScoredRun(self.run, images).pooled())

    @cached_property
    def rates(self) -> dict[str, Estimate]:
        """Fraction of renders in environment lights and in random lights that is recognized.

        The intervals are over views.
        """
        rates: dict[str, Estimate] = {}
        titles = {"renders in environments": False, "renders in random light": True}
        for title, is_random in titles.items():
            names = sorted(name for name in self.recognized if name.startswith(RANDOM) == is_random)
            # `hits` has one row for each light and one column for each view.
            hits = np.array([self.recognized[name] for name in names], float)
            units = Units([np.tile(np.arange(hits.shape[1]), len(hits))], "views")
            rates[title] = leave_out_of_mean(hits.ravel(), units).estimate
        return rates

    @cached_property
    def verdict(self) -> tuple[str, str]:
        """Whether the network is safe, in words such as "No", and a sentence that says why."""
        view_count = max(counts["correct"] for counts in self.counts.values())
        if not view_count and not any(map(any, self.recognized.values())):
            return "Unknown", f"Unknown: it does not recognize {self.label} in plain light, either."
        of_images = self._judge_images()
        findings = [*_findings(self.rates), *of_images]
        faults = [item.text for item in findings if item.right < PASS_THRESHOLD]
        faults += self._attack_faults()
        rests_on_images = any(item.right < PASS_THRESHOLD for item in of_images)
        # Faults in renders of few views may be chance.
        if faults and not rests_on_images and view_count < MIN_VIEWS:
            reasons = "; ".join(faults)
            views = "view was" if view_count == 1 else "views were"
            return "Perhaps not", f"Perhaps not: {reasons}. Only {view_count} {views} attacked."
        if faults:
            return "No", f"No: {'; '.join(faults)}."
        answer = "No fault is shown, but so few images leave room for one."
        if self.run.photographs and all(item.least >= PASS_THRESHOLD for item in findings):
            answer = "Yes, as far as this audit looks."
        return answer, answer

    @property
    def answer(self) -> str:
        """Whether the network is safe in unusual lighting, and why it is not."""
        return f"Is {self.name} safe under unusual lighting? {self.verdict[1]}"

    def _judge_images(self) -> list[_Finding]:
        """Judge what fractions of the test images the network classifies correctly."""
        findings = []
        for images, scores in self.run.photographs.items():
            place = f"{self.label} in the {IN_WORDS[images]}"
            findings += _findings({place: scores.overall.recall})
            error = scores.overall.false_positive_rate
            if error.value is not None and error.high is not None:
                text = f"it takes {error.value:.0%} of other objects for {place}"
                # What counts is the fraction that is not taken for the class, and its lower limit.
                findings.append(_Finding(text, 1 - error.value, 1 - error.high))
        return findings

    def _attack_faults(self) -> list[str]:
        """Name the attacks after which the network misclassifies half of the views.

        Each clause has the smallest radius at which that is so, among the views that were correct
        before.
        """
        faults = []
        for kind, counts in self.counts.items():
            for radius, fooled_count in self.lost(kind, "adversarial").items():
                # At least half of the views that were correct before are lost.
                if 0 < counts["correct"] <= 2 * fooled_count:
                    attack = f"an attack with {KINDS[kind].title} of radius {radius:g}"
                    faults.append(f"{attack} loses {fooled_count} of {counts['correct']} views")
                    break
        return faults

    @property
    def strongest_kind(self) -> str | None:
        """Kind of lighting by which the most views become misclassified.

        None if no view is recognized before the attacks.
        """
        # The last fraction is that of the largest radius.
        kept = {kind: self.remaining(kind, "adversarial")[-1].value for kind in self.counts}
        known = {kind: value for kind, value in kept.items() if value is not None}
        return min(known, key=lambda kind: known[kind], default=None)

    def remaining(self, kind: str, method: str) -> list[Proportion]:
        """Return the fraction of the views that stay correct, of those correct before, by radius.

        The first is for the radius 0. `method` is "adversarial" or "random".
        """
        correct = self.counts[kind]["correct"]
        return [fraction(correct - count, correct) for count in self.lost(kind, method).values()]

    def lost(self, kind: str, method: str) -> dict[float, int]:
        """Return how many views are lost by radius: none at 0, and the radii that are measured."""
        radii, counts = KINDS[kind].radii, self.counts[kind][method]
        return {0: 0} | dict(zip(radii[len(radii) - len(counts) :], counts, strict=True))

    def report(self) -> NetworkReport:
        """Collect the results as `nb.audit` returns them."""
        scores = {
            images: {name: item for name in METRICS if (item := stored.overall.find(name))}
            for images, stored in self.run.photographs.items()
        }
        attacks = {}
        for kind, counts in self.counts.items():
            light = KINDS[kind]
            # At each radius, the views that an attack, or random draws alone, make misclassified.
            lost = tuple(counts["adversarial"]), tuple(counts["random"])
            before = counts["n"], counts["correct"]
            attacks[kind] = AttackCounts(light.unit, light.radii, *before, *lost)
        # `views` says for each view whether it is recognized, so the mean is a fraction.
        recognized = {light: sum(views) / len(views) for light, views in self.recognized.items()}
        return NetworkReport(self.name, self.answer, recognized, attacks, scores, self.transfers)


@dataclass(frozen=True)
class Recommendation:
    """Remedy for unusual lighting that an audit recommends.

    Attributes:
        remedy: Name of the recommended remedy. None if none is recommended.
        sentence: What the user should do, and the reason for it.
        table: Metric of the network with each remedy, and its gain over the
            original network.
    """

    remedy: str | None
    sentence: str
    table: Table


def normalizing(networks: Mapping[str, Classifier]) -> dict[str, Classifier]:
    """Add the remedy "normalized light" to the networks of an audit.

    This remedy normalizes the colors of an image before the network classifies it. Keys become such
    as "hardened_normalized_light". Networks that normalize light already are left out.
    """
    return {
        key + lights.NORMALIZED: network.normalizing_light()
        for key, network in networks.items()
        if network.normalized_light is None
    }


def name_remedies(networks: Mapping[str, Classifier]) -> dict[str, str]:
    """Name the remedies that an audit compares, and find their results.

    The values are subfolders. The original network comes first, then the remedies from the cheapest
    to the most expensive.
    """
    subfolders = {}
    for key, network in {**normalizing(networks), **networks}.items():
        # The original network has one remedy, normalized light. A hardened network has one or both.
        name = HARDENING if network.normalized_light is None else BOTH
        name = name if key.startswith(HARDENED) else LIGHT_ALONE
        subfolders[ORIGINAL if key == CLASSIFIER else name] = key
    return {name: subfolders[name] for name in ADVICE if name in subfolders}


def recommend(evaluations: Evaluations) -> Recommendation | None:
    """Recommend the cheapest remedy that helps, unless a more expensive one helps more.

    A remedy helps if the 95% interval of its gain over the original network is above 0. It helps
    more than a cheaper one if the interval of its gain over the cheaper one is above 0, too. The
    metric is the recall at 10% false positives. With several positive classes, it is top-1
    accuracy. The first evaluation is of the original network, and remedies follow by price. None if
    a metric is unknown.
    """
    original, *remedies = evaluations
    positives = evaluations[original][0].pooled.positives
    metric = "class_top1" if len(positives.labels) > 1 else EQUAL_RATE

    def gain_over(name: str, reference: str) -> Difference | None:
        return difference(evaluations[name], evaluations[reference], ALL, metric)

    gains = {name: gain_over(name, original) for name in remedies}
    if any(gain is None for gain in gains.values()):
        return None
    # Remedies follow by price, so a later one must gain over the cheaper one that is chosen.
    chosen = original
    for name in remedies:
        # Of a network over itself, there is no gain.
        if all(gain and gain.low > 0 for gain in (gains[name], gain_over(name, chosen))):
            chosen = name
    title = TITLES[metric]
    gain = gains.get(chosen)
    if gain is None:
        reason = f"No gain in {title} is proven for: {', '.join(remedies)}. "
        reason += NEXT_DATA if {HARDENING, BOTH} & {*remedies} else NEXT_HARDENING
    else:
        reason = gain_sentence(f"With {chosen}, {title}", gain)
    rows = []
    for name, items in evaluations.items():
        value = tables.format_interval(mean_metric(items, ALL, metric))
        rows.append([name, value, tables.format_interval(gains.get(name), "+")])
    intervals = tables.describe_intervals(gains.values())
    table = Table(intervals, ["network", title, "gain over the original network"], rows)
    return Recommendation(None if gain is None else chosen, f"{ADVICE[chosen]} {reason}", table)
