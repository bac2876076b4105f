"""A page of runs, sweeps and attacks: pnb-report runs/sweep"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from omegaconf import MISSING

from renderer.errors import InputError
from train.errors import writable_folder
from train.report.page import write_report
from train.results import OF_AUDIT, RESULTS, require_replaceable
from train.settings import quoted


@dataclass
class Settings:
    runs: list[str] = MISSING  # folders of runs, sweeps and attacks; folders below them count, too
    out: str | None = None  # the folder of the page and its images; null: their common parent, whose page it replaces
    overwrite: bool = False  # write over the results that out holds

    def __post_init__(self) -> None:
        if not self.runs:
            raise InputError("runs is empty: give the folders of runs, sweeps or attacks")


def as_overrides(arguments: list[str]) -> list[str]:
    """Folders without a key are `runs`."""
    folders = [text for text in arguments if text[:1] not in ("-", "") and (os.path.exists(text) or "=" not in text)]
    rest = [text for text in arguments if text not in folders]
    return [*rest, f"runs=[{','.join(map(quoted, folders))}]"] if folders else rest


@cli.command(as_overrides)
def main(settings: Settings) -> None:
    parent = Path(os.path.commonpath([Path(run).absolute() for run in settings.runs]))
    out = writable_folder(settings.out or parent, "out")
    # The page beside the runs is of them, and is written anew. That of an audit is not.
    is_beside = out.resolve() == parent.resolve()
    own = [pattern for pattern in RESULTS if pattern not in OF_AUDIT] if is_beside else []
    require_replaceable(out, "out", settings.overwrite, own)
    page = write_report([Path(run) for run in settings.runs], out)
    print(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    main()
