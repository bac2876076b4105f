"""Write a run's network as half-precision safetensors with a card: python scripts/publish.py run=... out=..."""

from dataclasses import dataclass
from pathlib import Path

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.outputs import writable_folder
from train.report import publish_run
from train.settings import read_settings


@dataclass
class Settings:
    """conf/publish.yaml."""

    run: str
    out: str


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="publish")
@one_sentence_errors
def main(config: DictConfig) -> None:
    config = read_settings(Settings, config)
    publish_run(Path(config.run), writable_folder(config.out, "out"))
    print(f"published in {config.out}")


if __name__ == "__main__":
    with_suggestions(main, "publish")
