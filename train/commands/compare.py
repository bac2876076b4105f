"""pnb-compare: tables that compare finished training runs."""

from dataclasses import dataclass
from pathlib import Path

from renderer.errors import InputError
from renderer.settings import REQUIRED, Settings, setting
from train.settings import GROUPS
from train.system import is_verbose, shortened


@dataclass
class CompareSettings(Settings):
    """Settings of the command pnb-compare, which prints tables of the metrics of training runs."""

    runs: list[str] = setting(
        REQUIRED, "Folders of finished runs and of sweeps. Folders below them count, too."
    )
    exclude: list[str] = setting([], "Sources of photographs to leave out of the averages.")
    by: str = setting("source", "Groups of the tables.", choices=GROUPS)
    photos: str = setting(
        "photographs", "Sub-folder of the scores to compare: its name in `photos`."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError(
                "runs is empty: give the folders of one run or more, as in runs=[runs/a,runs/b]",
                "runs",
            )


def run(settings: CompareSettings) -> None:
    """Print a Markdown table that compares finished training runs.

    With --verbose, intervals, settings, differences and other tables are
    printed, too.
    """
    # --help does not wait for these imports.
    from train.results.compare import format_comparison, format_short_comparison
    from train.results.store import finished_runs

    runs = finished_runs([Path(run) for run in settings.runs])
    options = (settings.exclude, settings.photos, settings.by)
    if is_verbose():
        print(format_comparison(runs, *options))
        return
    table = format_short_comparison(runs, *options)
    print("\n".join(shortened(table.splitlines())))
    print(f"-v shows intervals, settings, differences and scores by {settings.by}")
