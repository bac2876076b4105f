"""Score a network on a folder of photographs: python scripts/evaluate_photos.py run=... photos=...

classifier= takes any other network, by a name that scripts/attack.py knows.
"""

from dataclasses import dataclass
from pathlib import Path

import train.command_line.entry_points as command
from augment.classifiers import Classifier
from renderer.errors import InputError
from train.command_line.outputs import writable_folder
from train.networks import load_classifier, load_run
from train.photographs.scoring import evaluate_photographs, format_summary
from train.run_folder.files import sole_writer
from train.runtime import MixedPrecision, choose_device, choose_precision


@dataclass
class Settings:
    """conf/evaluate_photos.yaml."""

    run: str | None
    model: str | None
    classifier: str | None
    weights: str | None
    photos: str
    label: str
    out: str
    skip_unreadable: bool
    precision: str
    device: str

    def __post_init__(self):
        if (self.run is None) == (self.classifier is None):
            raise InputError("give one network: run=FOLDER, or classifier=NAME")
        if self.classifier and self.model:
            raise InputError(f"model={self.model} is for run=FOLDER: a classifier has its own, leave it out")


def main(settings: Settings) -> None:
    device = choose_device(settings.device)
    network = _load(settings)
    network.label(settings.label)  # refused here, where the network has a name
    model = MixedPrecision(network.to(device), choose_precision(settings.precision, device))
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
    print(f"\ntable, scores and image: {settings.out}")


def _load(settings: Settings) -> Classifier:
    if settings.run is None:
        return load_classifier(settings.classifier, settings.weights)
    return load_run(settings.run, settings.weights, settings.model)


if __name__ == "__main__":
    command.script(main, Settings)
