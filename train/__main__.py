"""`python -m train`: train an arm, score it, and print the table. See conf/train.yaml for every setting."""

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from train.cli import one_sentence_errors, with_suggestions
from train.experiment import load_data, run, write_pictures
from train.logs import console
from train.report import format_table, summarise


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="train")
@one_sentence_errors
def main(config: DictConfig) -> None:
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    alone = hydra_config.mode == RunMode.RUN  # the cells of a sweep are compared with each other instead
    data = load_data(config)
    write_pictures(config, data.size)
    folders = []
    for arm in config.compare if alone else []:
        console.info("\n== augment=%s, for comparison", arm)
        folders.append(folder / arm)
        run(OmegaConf.merge(config, {"augment": {"arm": arm}}), data, folders[-1])
    console.info("\n== augment=%s", config.augment.arm)
    run(config, data, folder)
    console.info("\n%s", format_table([summarise(path) for path in [*folders, folder]]))


if __name__ == "__main__":
    with_suggestions(main, "train")
