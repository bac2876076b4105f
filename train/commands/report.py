"""pnb-report: a page of runs, sweeps and attacks."""

import os
from pathlib import Path

from train.command_settings import ReportSettings
from train.report.report_page import write_report
from train.report.results import OF_AUDIT, RESULTS, require_replaceable
from train.system.user_errors import writable_folder


def report(settings: ReportSettings) -> None:
    """Write the page of runs and attacks, and print its path.

    Args:
        settings: Settings of pnb-report.

    Raises:
        InputError: If a folder holds no run and no attack, or if the page cannot
            be written.
    """
    folders = [Path(run) for run in settings.runs]
    parent = Path(os.path.commonpath([folder.absolute() for folder in folders]))
    out = writable_folder(settings.out or parent, "out")
    # The folder that holds the runs may have a report of them, which is replaced.
    # The report of an audit is not replaced.
    own: list[str] = []
    if out.resolve() == parent.resolve():
        own = [pattern for pattern in RESULTS if pattern not in OF_AUDIT]
    require_replaceable(out, "out", settings.overwrite, own)
    page = write_report(folders, out)
    print(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB)")
