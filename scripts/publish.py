"""Write a run's network as half-precision safetensors with a card: python scripts/publish.py run=... out=..."""

from pathlib import Path

from omegaconf import DictConfig

from train.cli import script
from train.report import publish_run


def main(config: DictConfig) -> None:
    publish_run(Path(config.run), Path(config.out))
    print(f"published in {config.out}")


if __name__ == "__main__":
    script(main)
