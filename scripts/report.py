"""pnb-report: write a page of runs, sweeps and attacks."""

import os

from train.cli import Command, HelpText, quoted
from train.commands.report import ReportSettings


def name_folders(words: list[str]) -> list[str]:
    """Replace the paths of folders on a command line by one setting, runs=[...].

    For example, "runs/a runs/b out=page" becomes "out=page runs=[runs/a,runs/b]".
    """
    folders = [word for word in words if names_folder(word)]
    other_words = [word for word in words if not names_folder(word)]
    if not folders:
        return other_words
    quoted_folders = ",".join(quoted(folder) for folder in folders)
    return [*other_words, f"runs=[{quoted_folders}]"]


def names_folder(word: str) -> bool:
    """Return whether a word of the command line is the path of a folder.

    A word that begins with "-" is an option. A word with "=" is a setting, such
    as out=page, unless a file or folder of this name exists.
    """
    if not word or word.startswith("-"):
        return False
    return "=" not in word or os.path.exists(word)


main = Command(
    name="report",
    settings=ReportSettings,
    body="train.commands.report:run",
    help=HelpText(
        about="Write a page of runs, sweeps and attacks.", examples=["pnb-report runs/sweep"]
    ),
    rewrite=name_folders,
)

if __name__ == "__main__":
    main()
