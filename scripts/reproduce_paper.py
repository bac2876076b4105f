"""Measure a section of docs/paper.md anew: python scripts/reproduce_paper.py section=norm_balls 'scene.meshes=[...]'"""

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.settings import read_settings
from train.studies.paper.study import PaperSettings, run


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="reproduce_paper")
@one_sentence_errors
def main(config: DictConfig) -> None:
    run(read_settings(PaperSettings, config))


if __name__ == "__main__":
    with_suggestions(main, "reproduce_paper")
