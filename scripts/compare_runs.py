"""Markdown tables of finished runs, side by side: python scripts/compare_runs.py 'runs=[runs/a,runs/b]'"""

from dataclasses import dataclass
from pathlib import Path

import hydra
from omegaconf import DictConfig

from renderer.errors import InputError
from train.cli import one_sentence_errors, with_suggestions
from train.report import format_comparison, summarise
from train.settings import read_settings


@dataclass
class Settings:
    """conf/compare_runs.yaml."""

    runs: list[str]
    exclude: list[str]

    def __post_init__(self):
        if not self.runs:
            raise InputError("runs is empty: give the folders of one run or more, as in runs=[runs/a,runs/b]")


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="compare_runs")
@one_sentence_errors
def main(config: DictConfig) -> None:
    config = read_settings(Settings, config)
    print(format_comparison([summarise(Path(run)) for run in config.runs], config.exclude))


if __name__ == "__main__":
    with_suggestions(main, "compare_runs")
