"""The numbers of an audit, as `nb.audit` returns them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from renderer.io.files import atomic_write
from renderer.validation import as_path
from train.auditing.audit_page import RECOGNIZED, TRANSFER, Audited, write_answer
from train.auditing.lights import KINDS
from train.auditing.remedies import CLASSIFIER, HARDENED
from train.evaluation.scores.metrics import METRICS, read_metric
from train.evaluation.scores.scoring import SUMMARY
from train.evaluation.tables import Estimate
from train.runs.run_config import read_json


@dataclass(frozen=True)
class AttackCounts:
    """Numbers of views that an attack on one kind of lighting makes misclassified.

    Attributes:
        unit: Unit of the radii in words.
        radii: Radii of the L∞ balls, ascending.
        views: Number of views.
        correct: Number of views that are classified correctly before.
        adversarial: For each radius, number of the correct views that an attack
            or random draws make misclassified, also with noise of a sensor.
        random: For each radius, the same number for the random draws alone.
    """

    unit: str
    radii: tuple[float, ...]
    views: int
    correct: int
    adversarial: tuple[int, ...]
    random: tuple[int, ...]


@dataclass(frozen=True)
class NetworkReport:
    """Numbers of one network of an audit.

    Attributes:
        name: Name of the network.
        answer: Sentence that says whether it is safe, and why it is not.
        recognized: Fraction of the views that it recognizes, by the name of the
            environment lighting. Names of random lights begin with "random".
        attacks: Counts by kind of lighting: "lighting" (from all around),
            "skylight", "projector" and "lamps".
        scores: Metrics such as "recall" and "false_positive_rate" by part,
            "laboratory" or "photographs".
        transfers: For each kind of lighting, counts of adversaries that also
            fool the other network, as `train.auditing.lights.transfers` returns
            them. Empty with one network.
    """

    name: str
    answer: str
    recognized: Mapping[str, float]
    attacks: Mapping[str, AttackCounts]
    scores: Mapping[str, Mapping[str, Estimate]]
    transfers: Mapping[str, Any]


@dataclass(frozen=True)
class AuditReport:
    """Report of an audit.

    Attributes:
        label: Class whose objects were tested.
        network: Numbers of the audited network.
        hardened: Numbers of the hardened network. None without one.
        recommendation: Sentence that recommends normalized light, hardening,
            both or nothing, by the recall at 10% false positives. Empty if no
            images were scored.
        page: The report as HTML, which loads nothing else.
    """

    label: str
    network: NetworkReport
    hardened: NetworkReport | None
    recommendation: str
    page: str

    def save(self, path: str | Path) -> Path:
        """Write the report as a page.

        Args:
            path: File of the page, such as "audit.html".

        Returns:
            Path of the page.
        """
        file = as_path("path", path)
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(file, self.page)
        return file

    def __str__(self) -> str:
        """Return the answer of each network and the recommendation, one in each line."""
        networks = [self.network] if self.hardened is None else [self.network, self.hardened]
        lines = [network.answer for network in networks]
        if self.recommendation:
            lines.append(self.recommendation)
        return "\n".join(lines)


def read_audit(audited: Audited) -> AuditReport:
    """Read the numbers of an audit from its folder.

    Args:
        audited: The page in the folder of the audit, and what it shows.

    Returns:
        The report.
    """
    folder = audited.path.parent
    label = audited.label
    networks = {}
    for key, name in audited.names.items():
        networks[key] = _read_network(label, name, folder / key)
    text = audited.path.read_text(encoding="utf-8")
    recommended = audited.recommendation
    return AuditReport(
        label=label,
        network=networks[CLASSIFIER],
        hardened=networks.get(HARDENED),
        recommendation="" if recommended is None else recommended.sentence,
        page=text,
    )


def _read_network(label: str, name: str, folder: Path) -> NetworkReport:
    """Read what the audit measured of one network.

    Args:
        label: Class whose objects were tested.
        name: Name of the network.
        folder: Folder of the measurements of this network.

    Returns:
        The numbers, with the fraction of recognized views by lighting.
    """
    summaries = {path.parent.name: read_json(path) for path in folder.glob(f"*/{SUMMARY}")}
    # Whether each view is recognized, by the name of the lighting.
    recognized_views = read_json(folder / RECOGNIZED)
    recognized_fraction = {}
    for light, is_recognized in recognized_views.items():
        recognized_fraction[light] = sum(is_recognized) / len(is_recognized)
    return NetworkReport(
        name=name,
        answer=write_answer(label, name, folder, sorted(summaries)),
        recognized=recognized_fraction,
        attacks={kind: _read_attack(kind, folder / f"{kind}.json") for kind in KINDS},
        scores={part: _read_scores(summary) for part, summary in summaries.items()},
        transfers=read_json(folder / TRANSFER) if (folder / TRANSFER).exists() else {},
    )


def _read_attack(kind: str, path: Path) -> AttackCounts:
    """Read the counts of the attack on one kind of lighting.

    Args:
        kind: Key of KINDS.
        path: File that `success_by_light` returned the content of.
    """
    counts = read_json(path)
    return AttackCounts(
        unit=KINDS[kind].unit,
        radii=KINDS[kind].radii,
        views=counts["n"],
        correct=counts["correct"],
        adversarial=tuple(counts["adversarial"]),
        random=tuple(counts["random"]),
    )


def _read_scores(summary: Mapping[str, Any]) -> dict[str, Estimate]:
    """Read the metrics in `METRICS` that a summary.json has, by name."""
    found = {name: read_metric(summary, name) for name in METRICS}
    return {name: estimate for name, estimate in found.items() if estimate is not None}
