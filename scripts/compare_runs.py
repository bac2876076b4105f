"""Markdown tables of finished runs, side by side: python scripts/compare_runs.py 'runs=[runs/a,runs/b]'"""

from dataclasses import dataclass
from pathlib import Path

import train.command_line.entry_points as command
from augment.utils import progress
from renderer.errors import InputError
from train.report.compare import format_comparison
from train.report.summary import summarize


@dataclass
class Settings:
    """conf/compare_runs.yaml."""

    runs: list[str]
    exclude: list[str]
    photographs: str

    def __post_init__(self):
        if not self.runs:
            raise InputError("runs is empty: give the folders of one run or more, as in runs=[runs/a,runs/b]")
        folders = [Path(run).resolve() for run in self.runs]
        if twice := [run for run, folder in zip(self.runs, folders, strict=True) if folders.count(folder) > 1]:
            raise InputError(f"runs names {twice[0]} twice, as if it were another seed: name each run once")


def main(settings: Settings) -> None:
    runs = [summarize(Path(run)) for run in progress(settings.runs, "runs")]
    print(format_comparison(runs, settings.exclude, settings.photographs))


if __name__ == "__main__":
    command.script(main, Settings)
