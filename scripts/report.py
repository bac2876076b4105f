"""pnb-report: write a page of runs, sweeps and attacks."""

import os

from train.command import Command, quoted
from train.command_settings import ReportSettings
from train.help import HelpText


def name_folders(words: list[str]) -> list[str]:
    """Write folders that are given without a key as runs=[...].

    Args:
        words: Words of the command line.

    Returns:
        Settings and options, and then runs=[...] if there are folders.
    """
    folders = [word for word in words if names_folder(word)]
    others = [word for word in words if not names_folder(word)]
    if not folders:
        return others
    quoted_folders = ",".join(quoted(folder) for folder in folders)
    return [*others, f"runs=[{quoted_folders}]"]


def names_folder(word: str) -> bool:
    """Return whether a word of the command line is the path of a folder.

    Words that begin with "-" are options. Words that contain "=" are settings,
    such as out=page, except if a file or folder of this name exists.
    """
    if not word or word.startswith("-"):
        return False
    return "=" not in word or os.path.exists(word)


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
