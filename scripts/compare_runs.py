"""Markdown tables of finished runs, side by side: python scripts/compare_runs.py 'runs=[runs/a,runs/b]'"""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.report import format_comparison, summarise


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="compare_runs")
@one_sentence_errors
def main(config: DictConfig) -> None:
    print(format_comparison([summarise(Path(run)) for run in config.runs], list(config.exclude)))


if __name__ == "__main__":
    with_suggestions(main, "compare_runs")
