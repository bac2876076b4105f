"""Time against error of the renderer, in one run: python scripts/benchmark_renderer.py peers=true

Writes docs/performance_renderer.md with docs/renderer_pareto.{png,csv} and docs/renderer_scaling.{png,csv}. Takes a few
minutes on one CPU thread; peers=true adds Mitsuba 3 and, where it is installed, PyTorch3D.
"""

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.settings import read_settings
from train.studies.renderer_speed.study import RendererSpeedSettings, run


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="benchmark_renderer")
@one_sentence_errors
def main(config: DictConfig) -> None:
    run(read_settings(RendererSpeedSettings, config))


if __name__ == "__main__":
    with_suggestions(main, "benchmark_renderer")
