"""Time against error of the renderer, in one run: python scripts/benchmark_renderer.py peers=true

Writes docs/performance_renderer.md with docs/renderer_pareto.{png,csv} and docs/renderer_scaling.{png,csv}. Takes a few
minutes on one CPU thread; peers=true adds Mitsuba 3.
"""

from train.command_line.entry_points import script
from train.studies.renderer_speed.study import RendererSpeedSettings, run

if __name__ == "__main__":
    script(run, RendererSpeedSettings)
