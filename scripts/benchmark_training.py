"""Training speed against a plain loop over torchvision's DataLoader, in one run: python scripts/benchmark_training.py

Writes docs/performance.md and a figure beside it. conf/benchmark_training.yaml has the settings.
"""

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.studies.training_speed.study import run


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="benchmark_training")
@one_sentence_errors
def main(config: DictConfig) -> None:
    run(config)


if __name__ == "__main__":
    with_suggestions(main, "benchmark_training")
