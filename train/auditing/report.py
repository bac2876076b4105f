"""The numbers of an audit, as `nb.audit` returns them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from renderer.errors import as_path
from renderer.io.files import atomic_write
from renderer.short_repr import ShortRepr
from train.auditing.lights import KINDS
from train.auditing.network import AuditedNetwork
from train.auditing.page import Audited
from train.auditing.remedies import CLASSIFIER, HARDENED
from train.results.metrics import METRICS
from train.results.tables import Estimate


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
        networks = [self.network] if self.hardened is None else [self.network, self.hardened]
        lines = [network.answer for network in networks]
        if self.recommendation:
            lines.append(self.recommendation)
        return "\n".join(lines)


def read_audit(audited: Audited) -> AuditReport:
    """Collect the numbers of an audit."""
    networks = {key: _report_on(network) for key, network in audited.networks.items()}
    recommended = audited.recommendation
    return AuditReport(
        label=audited.label,
        network=networks[CLASSIFIER],
        hardened=networks.get(HARDENED),
        recommendation="" if recommended is None else recommended.sentence,
        page=audited.path.read_text(encoding="utf-8"),
    )


def _report_on(network: AuditedNetwork) -> NetworkReport:
    """Collect the results of an audit for one network."""
    scores = {}
    for images, stored in network.run.photographs.items():
        metrics = {name: stored.overall.find(name) for name in METRICS}
        scores[images] = {name: item for name, item in metrics.items() if item is not None}
    attacks = {}
    for kind, counts in network.counts.items():
        attacks[kind] = AttackCounts(
            unit=KINDS[kind].unit,
            radii=KINDS[kind].radii,
            views=counts["n"],
            correct=counts["correct"],
            adversarial=tuple(counts["adversarial"]),
            random=tuple(counts["random"]),
        )
    return NetworkReport(
        name=network.name,
        answer=network.answer,
        recognized={light: sum(views) / len(views) for light, views in network.recognized.items()},
        attacks=attacks,
        scores=scores,
        transfers=network.transfers,
    )
