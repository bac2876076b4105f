"""What projectors and lamps cost, and how right they are: python scripts/benchmark_lights.py

Writes a section of docs/performance.md. Takes a minute or two on one CPU thread, and needs the extra `shadows`.
"""

from train.command_line.entry_points import script
from train.studies.placed_lights import run
from train.studies.transport.cost import CupSettings

if __name__ == "__main__":
    script(run, CupSettings)
