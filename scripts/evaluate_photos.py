"""Score a trained network on a folder of photographs: python scripts/evaluate_photos.py run=... photos=..."""

from dataclasses import dataclass
from pathlib import Path

import hydra
from omegaconf import DictConfig

from renderer.errors import require_range
from train.checkpoint import load_network
from train.cli import one_sentence_errors, with_suggestions
from train.device import choose_device
from train.outputs import writable_folder
from train.photographs import evaluate_photographs, format_summary
from train.precision import MixedPrecision, choose_precision
from train.settings import LARGEST_SIZE, read_settings


@dataclass
class Settings:
    """conf/evaluate_photos.yaml."""

    run: str
    photos: str
    label: str
    out: str
    skip_unreadable: bool
    size: int
    precision: str
    device: str

    def __post_init__(self):
        require_range("size", self.size, 1, LARGEST_SIZE)


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="evaluate_photos")
@one_sentence_errors
def main(config: DictConfig) -> None:
    config = read_settings(Settings, config)
    device = choose_device(config.device)
    network, classes = load_network(Path(config.run))
    model = MixedPrecision(network.to(device), choose_precision(config.precision, device))
    writable_folder(config.out, "out")
    summary = evaluate_photographs(
        model,
        classes,
        Path(config.photos),
        config.label,
        Path(config.out),
        size=config.size,
        skip_unreadable=config.skip_unreadable,
        device=device,
    )
    print(format_summary(summary))
    print(f"\ntable, scores and picture: {config.out}")


if __name__ == "__main__":
    with_suggestions(main, "evaluate_photos")
