"""Write a run's network as half-precision safetensors with a card: python scripts/publish.py run=... out=..."""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from train.cli import one_sentence_errors, with_suggestions
from train.report import publish_run


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="publish")
@one_sentence_errors
def main(config: DictConfig) -> None:
    publish_run(Path(config.run), Path(config.out))
    print(f"published in {config.out}")


if __name__ == "__main__":
    with_suggestions(main, "publish")
