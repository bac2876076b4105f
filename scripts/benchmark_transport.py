"""What shadows and bounces cost, and how right they are: python scripts/benchmark_transport.py

Writes docs/transport.md. Takes a few minutes on one CPU thread, and needs the extras `shadows` and `lab`, and for
Mitsuba's gradients LLVM (`apt install libllvm19`).
"""

from train.command_line.entry_points import script
from train.studies.transport.cost import CupSettings
from train.studies.transport.study import run

if __name__ == "__main__":
    script(run, CupSettings)
