"""Path-trace photographs of oranges and look-alikes under a projector: python scripts/lab.py out=lab"""

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.laboratory.folder import write_laboratory
from train.laboratory.settings import LabSettings
from train.settings import read_settings


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="lab")
@one_sentence_errors
def main(config: DictConfig) -> None:
    settings = read_settings(LabSettings, config)
    count = write_laboratory(settings)
    print(f"{settings.out}: {count} photographs under {settings.lights} lights")


if __name__ == "__main__":
    with_suggestions(main, "lab")
