"""The page: what was tried at which door, and what came of it."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from train.report.tables import markdown
from train.studies.page import filled, joined, versions, wrapped

NO_FAULTS = "Nothing was mishandled."


@dataclass(frozen=True)
class Outcome:
    """status: see `Ending`. fault: None where all was as it should be. started: whether its process was not forked."""

    door: str
    kind: str
    name: str
    status: int | None
    fault: str | None
    started: bool = False


def failures(outcomes: Iterable[Outcome]) -> list[str]:
    return [f"{each.door}: {each.name!r}: {each.fault}" for each in outcomes if each.fault]


def page(outcomes: Sequence[Outcome], command: str, number: int, patience: float) -> str:
    """Markdown. number: of the inputs there are."""
    started = sum(each.started for each in outcomes)
    introduction = filled(
        __file__,
        command=command,
        versions=versions(),
        tried=len(outcomes),
        all=number,
        started=started,
        patience=patience,
    )
    pairs = list(dict.fromkeys((each.door, each.kind) for each in outcomes))
    rows = [_row(*pair, [each for each in outcomes if (each.door, each.kind) == pair]) for pair in pairs]
    total = _row("all", "", outcomes)
    table = markdown(["door", "kind", "tried", "used", "refused", "mishandled"], [*rows, total])
    faults = failures(outcomes)
    listed = "\n".join(f"- {fault}" for fault in faults) if faults else NO_FAULTS
    return joined([wrapped(introduction), table, "## Mishandled", listed])


def _row(door: str, kind: str, outcomes: Sequence[Outcome]) -> list[str | int]:
    fates = Counter("mishandled" if each.fault else "refused" if each.status else "used" for each in outcomes)
    return [door, kind, len(outcomes), *(fates[fate] for fate in ("used", "refused", "mishandled"))]
