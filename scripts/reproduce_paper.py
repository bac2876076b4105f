"""Measure a section of docs/paper.md anew: python scripts/reproduce_paper.py section=norm_balls 'scene.meshes=[...]'"""

from train.command_line.entry_points import script
from train.studies.paper.study import PaperSettings, run

if __name__ == "__main__":
    script(run, PaperSettings)
