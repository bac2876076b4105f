"""The page: what was done to how many runs, when, and whether they ended as they should."""

import platform
from collections import Counter
from collections.abc import Sequence

import torch

from train.report.tables import markdown
from train.studies.interruptions.bench import Bench, Outcome
from train.studies.interruptions.process import ORDER
from train.studies.page import filled, joined

CONCERNS = {  # of faults, and the heads of their columns
    "checkpoints": "weights, optimiser",
    "metrics": "metrics",
    "TensorBoard": "TensorBoard",
    "images": "images",
    "said": "exit status and words",
}


def merged(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """One for each case, in their order."""
    cases: dict[str, Outcome] = {}
    for outcome in outcomes:
        whole = cases.setdefault(outcome.case, Outcome(outcome.case))
        whole.runs += outcome.runs
        whole.stops += outcome.stops
        for concern, faults in outcome.faults.items():
            whole.add(concern, *faults)
    return list(cases.values())


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Everything that was not as it should be, in words."""
    return [f"{item.case}: {fault}" for item in outcomes for faults in item.faults.values() for fault in faults]


def page(outcomes: Sequence[Outcome], bench: Bench, command: str) -> str:
    """Markdown."""
    seconds, epochs = bench.seconds, bench.small.epochs
    introduction = filled(
        __file__,
        command=command,
        torch=torch.__version__,
        machine=platform.machine(),
        epochs=epochs,
        epoch=1000 * (seconds["training"] - seconds["scoring"]) / epochs,
        start=seconds["start"] - seconds["training"],
    )
    header = ["case", "runs", "stops", "found in", *CONCERNS.values()]
    return joined([introduction, markdown(header, map(_row, outcomes))])


def _row(outcome: Outcome) -> list[str]:
    if not outcome.runs:
        return [outcome.case, "0", "-", "not done: it needs a privilege", *["-"] * len(CONCERNS)]
    return [
        outcome.case,
        str(outcome.runs),
        str(outcome.stops.total() or "-"),
        _phases(outcome.stops),
        *(_verdict(outcome, concern) for concern in CONCERNS),
    ]


def _phases(stops: Counter[str]) -> str:
    return ", ".join(f"{phase} {stops[phase]}" for phase in ORDER if stops[phase]) or "-"


def _verdict(outcome: Outcome, concern: str) -> str:
    if concern not in outcome.faults and concern != "said":
        return "-"  # no run came to its end
    if faults := outcome.faults.get(concern):
        return f"**faults: {len(faults)}**"
    return "as it should" if concern == "said" else "equal"
