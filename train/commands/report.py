"""pnb-report: a page of runs, sweeps and attacks."""

import os
from pathlib import Path

from train.command_settings import ReportSettings
from train.report.report_page import write_report
from train.report.results import OF_AUDIT, RESULTS, require_replaceable
from train.system.user_errors import writable_folder


def report(settings: ReportSettings) -> None:
    """Write the page, and print its path.

    Raises:
        InputError: If a folder holds nothing to report, or the page cannot be written.
    """
    folders = [Path(run) for run in settings.runs]
    parent = Path(os.path.commonpath([folder.absolute() for folder in folders]))
    out = writable_folder(settings.out or parent, "out")
    # The page beside the runs is of them, and is written anew. That of an audit is not.
    own: list[str] = []
    if out.resolve() == parent.resolve():
        own = [pattern for pattern in RESULTS if pattern not in OF_AUDIT]
    require_replaceable(out, "out", settings.overwrite, own)
    page = write_report(folders, out)
    print(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB)")
