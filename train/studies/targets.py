"""What was asked of the speed, beside what a run found."""

from collections.abc import Sequence
from dataclasses import dataclass

from train.report.tables import markdown


@dataclass(frozen=True)
class Target:
    """What is asked, what this run found, and whether that is enough: None where it could not be measured."""

    what: str
    asked: str
    found: str
    passed: bool | None


def table_of(targets: Sequence[Target]) -> str:
    """A Markdown table of targets, those that are missed in bold."""
    lines = [(t.what, t.asked, t.found, "—" if t.passed is None else "yes" if t.passed else "**no**") for t in targets]
    return markdown(["what", "asked", "found", "met"], lines)
