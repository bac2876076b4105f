"""Interrupt training runs in many ways, and compare their ends: python scripts/check_interruptions.py"""

from train.command_line.entry_points import script
from train.studies.interruptions.study import InterruptionSettings, run

if __name__ == "__main__":
    script(run, InterruptionSettings)
