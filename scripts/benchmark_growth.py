"""How the cost of adversarial renders grows with their number, size, meshes and processes: docs/performance_growth.md

python scripts/benchmark_growth.py; three minutes on a free core, 23 where other work left it a tenth of one.
"""

from train.command_line.entry_points import script
from train.studies.growth.study import GrowthSettings, run

if __name__ == "__main__":
    script(run, GrowthSettings)
