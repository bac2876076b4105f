"""Markdown tables of finished runs, side by side: python scripts/compare_runs.py 'runs=[runs/a,runs/b]'"""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.comparison import format_comparison
from train.report import summarise


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="compare_runs")
@one_sentence_errors
def main(config: DictConfig) -> None:
    runs = [summarise(Path(run)) for run in config.runs]
    print(format_comparison(runs, list(config.exclude), config.photographs))


if __name__ == "__main__":
    with_suggestions(main, "compare_runs")
