"""pnb-report: a report page about training runs, sweeps and attacks."""

import os
from dataclasses import dataclass
from pathlib import Path

from renderer.errors import InputError
from renderer.settings import REQUIRED, Settings, setting


@dataclass
class ReportSettings(Settings):
    """Settings of the command pnb-report, which writes an HTML page about runs and attacks."""

    runs: list[str] = setting(
        REQUIRED, "Folders of runs, sweeps and attacks. Folders below them count, too."
    )
    out: str | None = setting(
        None,
        "Folder of the page and its images. null: the common parent of the runs, whose page is "
        "replaced.",
    )
    overwrite: bool = setting(False, "Replace results in the folder `out`.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs is empty: give the folders of runs, sweeps or attacks", "runs")


def run(settings: ReportSettings) -> None:
    """Write a report page about training runs and attacks, and print its path."""
    # --help does not wait for these imports.
    from train.results.overwrite import OF_AUDIT, RESULTS, require_replaceable
    from train.results.page import write_report
    from train.run_folder import writable_folder

    folders = [Path(run) for run in settings.runs]
    parent = Path(os.path.commonpath([folder.absolute() for folder in folders]))
    out = writable_folder(settings.out or parent, "out")
    # An earlier report in the common folder of all runs is replaced, unless it is the
    # report of an audit.
    own_files: list[str] = []
    if out.resolve() == parent.resolve():
        own_files = [pattern for pattern in RESULTS if pattern not in OF_AUDIT]
    require_replaceable(out, "out", settings.overwrite, own_files)
    page, _ = write_report(folders, out)
    print(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB)")
