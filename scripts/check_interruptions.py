"""Interrupt training runs in many ways and show that they end as if nothing had happened.

python scripts/check_interruptions.py; Linux only, since the size of a process's files is limited from outside.
"""

import sys

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.settings import read_settings
from train.studies.interruptions.study import InterruptionSettings, run


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="check_interruptions")
@one_sentence_errors
def main(config: DictConfig) -> None:
    if failed := run(read_settings(InterruptionSettings, config)):
        sys.exit("\n".join(failed))


if __name__ == "__main__":
    with_suggestions(main, "check_interruptions")
