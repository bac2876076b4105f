"""Write a page of runs, sweeps and attacks."""

import os

from train.cli import Command, quoted


def name_folders(words: list[str]) -> list[str]:
    """Replace the paths of folders on a command line by one setting, runs=[...].

    For example, "runs/a runs/b out=page" becomes "out=page runs=[runs/a,runs/b]". A word that
    begins with "-" is an option. A word with "=" is a setting, unless a file or folder of this name
    exists.
    """
    folders: list[str] = []
    other_words: list[str] = []
    for word in words:
        is_option = not word or word.startswith("-")
        is_folder = not is_option and ("=" not in word or os.path.exists(word))
        (folders if is_folder else other_words).append(word)
    runs = [f"runs=[{','.join(map(quoted, folders))}]"] if folders else []
    return [*other_words, *runs]


examples = ["pnb-report runs/sweep"]
settings = "train.command_settings:ReportSettings"
main = Command("report", settings, __doc__, examples, rewrite=name_folders)

if __name__ == "__main__":
    main()
