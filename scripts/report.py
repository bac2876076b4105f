"""A page to look at, of runs, sweeps and attacks: python scripts/report.py runs/sweep"""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from renderer.errors import InputError
from train.command_line.entry_points import script
from train.command_line.outputs import writable_folder
from train.command_line.overrides import quoted
from train.report.page import write_report


@dataclass
class Settings:
    """conf/report.yaml."""

    runs: list[str]
    out: str | None

    def __post_init__(self):
        if not self.runs:
            raise InputError("runs is empty: give the folders of runs, sweeps or attacks")


def main(settings: Settings) -> None:
    out = settings.out or os.path.commonpath([Path(run).absolute() for run in settings.runs])
    page = write_report([Path(run) for run in settings.runs], writable_folder(out, "out"))
    print(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB; {time.process_time():.0f} s of one core)")


def _as_overrides(arguments: list[str]) -> list[str]:
    """Folders without a key are those of `runs`."""
    folders = [each for each in arguments if each[0:1] not in ("-", "") and (os.path.exists(each) or "=" not in each)]
    rest = [each for each in arguments if each not in folders]
    return [*rest, f"runs=[{','.join(map(quoted, folders))}]"] if folders else rest


if __name__ == "__main__":
    sys.argv[1:] = _as_overrides(sys.argv[1:])
    script(main, Settings)
