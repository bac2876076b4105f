"""Markdown tables of finished runs, side by side: pnb-compare 'runs=[runs/a,runs/b]'"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from omegaconf import MISSING

from renderer.errors import InputError, require_choice
from train.photographs.metrics import GROUPS
from train.report.compare import format_comparison
from train.report.summary import summarize


@dataclass
class Settings:
    runs: list[str] = MISSING  # finished run folders
    exclude: list[str] = field(default_factory=list)  # sources of photographs to leave out of the averages
    by: str = "source"  # source | mesh: the groups of the tables
    photographs: str = "photographs"  # the sub-folder of scores to compare, by its name in evaluate.photos

    def __post_init__(self) -> None:
        require_choice("by", self.by, GROUPS)
        if not self.runs:
            raise InputError("runs is empty: give the folders of one run or more, as in runs=[runs/a,runs/b]")
        folders = [Path(run).resolve() for run in self.runs]
        if repeated := [run for run, folder in zip(self.runs, folders, strict=True) if folders.count(folder) > 1]:
            raise InputError(f"runs names {repeated[0]} twice, as if it were another seed: name each run once")


@cli.command()
def main(settings: Settings) -> None:
    runs = [summarize(Path(run)) for run in settings.runs]
    print(format_comparison(runs, settings.exclude, settings.photographs, settings.by))


if __name__ == "__main__":
    main()
