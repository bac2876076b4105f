"""Measure the renderer's largest errors and write them as docs/accuracy.md: python scripts/check_accuracy.py"""

from train.command_line.entry_points import script
from train.studies.accuracy.study import AccuracySettings, run

if __name__ == "__main__":
    script(run, AccuracySettings)
