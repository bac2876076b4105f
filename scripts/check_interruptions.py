"""Interrupt training runs in many ways and show that they end as if nothing had happened; docs/interruptions.md"""

from train.command_line.entry_points import script
from train.studies.interruptions.study import InterruptionSettings, run

if __name__ == "__main__":
    script(run, InterruptionSettings)
