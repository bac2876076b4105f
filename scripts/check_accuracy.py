"""Measure the renderer's largest errors and write them as docs/accuracy.md: python scripts/check_accuracy.py"""

import sys

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.settings import read_settings
from train.studies.accuracy.study import AccuracySettings, run


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="check_accuracy")
@one_sentence_errors
def main(config: DictConfig) -> None:
    if failed := run(read_settings(AccuracySettings, config)):
        sys.exit("\n".join(failed))


if __name__ == "__main__":
    with_suggestions(main, "check_accuracy")
