"""How the cost of adversarial renders grows with their number, size, meshes and processes

python scripts/benchmark_growth.py writes a section of docs/performance.md, in three minutes on a free core, or in 23
where other work left it a tenth of one.
"""

from train.command_line.entry_points import script
from train.studies.growth.study import GrowthSettings, run

if __name__ == "__main__":
    script(run, GrowthSettings)
