"""pnb-compare: tables of finished runs."""

from pathlib import Path

from train.command_settings import CompareSettings
from train.report.comparison import format_comparison
from train.report.summary import summarize


def print_comparison(settings: CompareSettings) -> None:
    """Print Markdown tables that compare finished runs.

    Args:
        settings: Settings of pnb-compare.

    Raises:
        InputError: If a folder holds no finished run.
    """
    runs = [summarize(Path(run)) for run in settings.runs]
    print(format_comparison(runs, settings.exclude, settings.photographs, settings.by))
