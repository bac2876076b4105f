"""pnb-report: write a page of runs, sweeps and attacks."""

import os

from train.command import Command, quoted
from train.command_settings import ReportSettings
from train.help import HelpText


def name_folders(words: list[str]) -> list[str]:
    """Write folders without a key as runs=[...]."""
    folders: list[str] = []
    rest: list[str] = []
    for word in words:
        is_setting = word.startswith("-") or not word or ("=" in word and not os.path.exists(word))
        (rest if is_setting else folders).append(word)
    if not folders:
        return rest
    return [*rest, f"runs=[{','.join(map(quoted, folders))}]"]


main = Command(
    name="report",
    settings=ReportSettings,
    body="train.commands.report:report",
    help=HelpText(
        about="Write a page of runs, sweeps and attacks.",
        examples=[
            "pnb-report runs/sweep",
        ],
    ),
    rewrite=name_folders,
)

if __name__ == "__main__":
    main()
