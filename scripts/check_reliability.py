"""Try hostile files, names, settings and outputs at every command: python scripts/check_reliability.py; Linux only"""

from train.command_line.entry_points import script
from train.studies.reliability.study import ReliabilitySettings, run

if __name__ == "__main__":
    script(run, ReliabilitySettings)
