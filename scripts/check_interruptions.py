"""Interrupt training runs in many ways and show that they end as if nothing had happened.

python scripts/check_interruptions.py; Linux only, since the size of a process's files is limited from outside.
"""

from train.command_line.entry_points import script
from train.studies.interruptions.study import InterruptionSettings, run

if __name__ == "__main__":
    script(run, InterruptionSettings)
