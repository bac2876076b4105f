"""Score a trained network on a folder of photographs: python scripts/evaluate_photos.py run=... photos=..."""

from pathlib import Path

from omegaconf import DictConfig

from train.checkpoint import load_network
from train.cli import script
from train.device import choose_device
from train.photographs import evaluate_photographs, format_summary
from train.precision import MixedPrecision, choose_precision


def main(config: DictConfig) -> None:
    device = choose_device(config.device)
    network = load_network(Path(config.run), config.size)
    model = MixedPrecision(network.module.to(device), choose_precision(config.precision, device))
    summary = evaluate_photographs(
        model,
        network.classes,
        Path(config.photos),
        config.label,
        Path(config.out),
        size=network.size,
        skip_unreadable=config.skip_unreadable,
        device=device,
    )
    print(format_summary(summary))
    print(f"\ntable, scores and picture: {config.out}")


if __name__ == "__main__":
    script(main)
