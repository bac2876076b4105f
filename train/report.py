"""Tables of finished runs, from the files in their folders."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from omegaconf import OmegaConf

from renderer.errors import InputError
from train.logs import read_metrics


@dataclass(frozen=True)
class RunSummary:
    """What a run's folder says: its arm, its final scores and its mean seconds per epoch and phase."""

    folder: Path
    arm: str
    seed: int
    label: str
    scores: dict[str, float]
    seconds: dict[str, float]
    photographs: dict | None


def summarise(folder: Path) -> RunSummary:
    """Read a finished run; InputError for a folder that holds none."""
    lines = read_metrics(folder)
    if not lines or "epoch" in lines[-1]:
        raise InputError(f"{folder} holds no finished run: let it finish, or resume it with train.resume=true")
    config = OmegaConf.load(folder / "config.yaml")
    phases = sorted({name for line in lines for name in line if name.startswith("seconds/")})
    photographs = folder / "photographs" / "summary.json"
    return RunSummary(
        folder=folder,
        arm=config.augment.arm,
        seed=config.seed,
        label=config.label,
        scores=lines[-1],
        seconds={name.partition("/")[2]: fmean(line.get(name, 0.0) for line in lines[:-1]) for name in phases},
        photographs=json.loads(photographs.read_text()) if photographs.is_file() else None,
    )


def format_table(runs: Sequence[RunSummary]) -> str:
    """A Markdown table, one row per run, and the pictures to look at."""
    label = runs[0].label
    header = ["augment", "seed", "test accuracy", f"{label} recognised", f"others called {label}", "seconds per epoch"]
    rows = [[run.arm, str(run.seed), f"{run.scores['test/accuracy']:.3f}", *_shares(run), _epoch(run)] for run in runs]
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    lines = [
        _row(header, widths),
        _row(["-" * width for width in widths], widths),
        *(_row(row, widths) for row in rows),
    ]
    sheets = [run.folder / "photographs" / "contact_sheet.png" for run in runs if run.photographs]
    return "\n".join([*lines, *(f"picture: {sheet}" for sheet in sheets)])


def _shares(run: RunSummary) -> list[str]:
    if run.photographs is None:
        return ["-", "-"]
    return [_interval(run.photographs["recall"]), _interval(run.photographs["false_alarms"])]


def _interval(share: dict) -> str:
    if share["value"] is None:
        return "-"
    return f"{share['value']:.3f} [{share['low']:.3f}, {share['high']:.3f}]"


def _epoch(run: RunSummary) -> str:
    nested = {"attack_classifier", "operators"}  # a part of the attack's time; once per run
    return f"{sum(value for name, value in run.seconds.items() if name not in nested):.1f}"


def _row(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
