"""pnb-compare: tables that compare finished training runs."""

from pathlib import Path

from train.command_settings import CompareSettings
from train.results.compare import format_comparison, format_short_comparison
from train.results.store import finished_runs
from train.system import is_verbose, shortened


def run(settings: CompareSettings) -> None:
    """Print a Markdown table that compares finished training runs.

    With --verbose, intervals, settings, differences and other tables are
    printed, too.
    """
    runs = finished_runs([Path(run) for run in settings.runs])
    if is_verbose():
        print(format_comparison(runs, settings.by))
        return
    print("\n".join(shortened(format_short_comparison(runs, settings.by).splitlines())))
    print(f"-v shows intervals, settings, differences and scores by {settings.by}")
