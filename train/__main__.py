"""`python -m train`: train an arm, score it, and print the table. See conf/train.yaml for every setting."""

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from train.cli import one_sentence_errors, with_suggestions
from train.experiment import load_data, prepare, write_pictures
from train.logs import console
from train.report import format_table, summarise
from train.sweep import check_launcher, run_cell


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="train")
@one_sentence_errors
def main(config: DictConfig) -> None:
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    config.run = str(folder)
    if hydra_config.mode == RunMode.MULTIRUN:
        run_cell(config, folder)
    else:
        run_arms(config, folder)


def run_arms(config: DictConfig, folder: Path) -> None:
    """Train the arms to compare with and the arm itself, and print their table."""
    OmegaConf.resolve(config)  # before any copy is made, since a copy would read the clock again
    data = load_data(config)
    write_pictures(config, data.size)
    arms = {folder / arm: OmegaConf.merge(config, {"augment": {"arm": arm}}) for arm in config.compare}
    arms[folder] = config
    runs = {path: prepare(arm, data, path) for path, arm in arms.items()}  # all first: a mistake in any shows at once
    for path, train_and_score in runs.items():
        console.info("\n== augment=%s%s", arms[path].augment.arm, "" if path == folder else ", for comparison")
        train_and_score()
    console.info("\n%s", format_table([summarise(path) for path in arms]))


if __name__ == "__main__":
    one_sentence_errors(check_launcher)(sys.argv[1:])
    with_suggestions(main, "train")
