"""pnb-report: a report page about training runs, sweeps and attacks."""

import os
from pathlib import Path

from train.command_settings import ReportSettings
from train.results.overwrite import OF_AUDIT, RESULTS, require_replaceable
from train.results.page import write_report
from train.run_folder import writable_folder


def run(settings: ReportSettings) -> None:
    """Write a report page about training runs and attacks, and print its path."""
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
