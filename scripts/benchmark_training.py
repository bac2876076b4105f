"""Training speed against a plain loop over torchvision's DataLoader, in one run: python scripts/benchmark_training.py

Writes a section of docs/performance.md. conf/benchmark_training.yaml has the settings.
"""

from train.command_line.entry_points import script
from train.studies.training_speed.study import run

if __name__ == "__main__":
    script(run)
