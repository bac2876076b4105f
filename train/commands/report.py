"""pnb-report: a report page about training runs, sweeps and attacks."""

import os
from pathlib import Path

from train.command_settings import ReportSettings
from train.results.overwrite import OF_AUDIT, RESULTS, output_folder
from train.results.page import write_report


def run(settings: ReportSettings) -> None:
    """Write a report page about training runs and attacks, and print its path."""
    folders = [Path(run) for run in settings.runs]
    parent = Path(os.path.commonpath([folder.absolute() for folder in folders]))
    out = Path(settings.out or parent)
    # An earlier report in the common folder of all runs is replaced, unless it is the
    # report of an audit.
    own_files = {*RESULTS}.difference(OF_AUDIT) if out.resolve() == parent.resolve() else ()
    page, _ = write_report(folders, output_folder(out, settings.overwrite, own_files))
    print(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB)")
