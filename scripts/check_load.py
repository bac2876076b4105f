"""A great many renders, views, faces, photographs and runs, to the end and until Ctrl-C: docs/load.md

python scripts/check_load.py; a quarter of an hour on one free core.
"""

from train.command_line.entry_points import script
from train.studies.load.study import LoadSettings, run

if __name__ == "__main__":
    script(run, LoadSettings)
