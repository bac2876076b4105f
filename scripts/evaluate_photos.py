"""Score a trained network on a folder of photographs: python scripts/evaluate_photos.py run=... photos=..."""

from dataclasses import dataclass
from pathlib import Path

from renderer.errors import require_range
from train.checkpoint import load_network
from train.cli import script
from train.device import MixedPrecision, choose_device, choose_precision
from train.outputs import writable_folder
from train.photographs import evaluate_photographs, format_summary
from train.run_folder import sole_writer
from train.settings import LARGEST_SIZE


@dataclass
class Settings:
    """conf/evaluate_photos.yaml."""

    run: str
    photos: str
    label: str
    out: str
    skip_unreadable: bool
    size: int | None
    precision: str
    device: str

    def __post_init__(self):
        require_range("size", self.size, 1, LARGEST_SIZE)


def main(settings: Settings) -> None:
    device = choose_device(settings.device)
    network = load_network(Path(settings.run), settings.size)
    model = MixedPrecision(network.module.to(device), choose_precision(settings.precision, device))
    out = writable_folder(settings.out, "out")
    with sole_writer("out", out):
        summary = evaluate_photographs(
            model,
            network.classes,
            Path(settings.photos),
            settings.label,
            out,
            size=network.size,
            skip_unreadable=settings.skip_unreadable,
            device=device,
        )
    print(format_summary(summary))
    print(f"\ntable, scores and picture: {settings.out}")


if __name__ == "__main__":
    script(main, Settings)
