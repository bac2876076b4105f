"""Score a network on a folder of photographs: pnb-evaluate run=pretrained/best photos=photos

classifier= takes any other network, by a name that pnb-attack knows.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from omegaconf import MISSING

from augment.classifiers import load_classifier
from augment.classifiers.adapter import label_names
from renderer.errors import InputError, require_choice
from train.device import MixedPrecision, choose_device, choose_precision
from train.errors import writable_folder
from train.networks import load_run, published
from train.photographs import scoring
from train.photographs.folder import require_outside
from train.photographs.metrics import GROUPS
from train.photographs.predictions import Predictor
from train.results import require_replaceable
from train.run_folder import sole_writer


@dataclass
class Settings:
    run: str | None = None  # a run folder, or a folder under pretrained/
    model: str | None = None  # python:package.module:function, if such a function made the run's network
    classifier: str | None = None  # instead of run, any other network, by a name that conf/attack.yaml explains
    weights: str | None = None  # the classifier's local weights file, if it brings none
    photos: str = MISSING  # a folder of class folders, or of images of `label`; pretrained/laboratory is installed
    label: Any = "orange"  # the class whose recall and false positives count, or several; that of a flat folder
    out: str = "runs/photographs/${now:%Y-%m-%d}/${now:%H-%M-%S-%f}"  # the folder of the scores
    false_positive_rate: float | None = None  # for a threshold on the log-odds of `label`, chosen on calibrate
    calibrate: str | None = None  # a folder like photos; null: the threshold that a published network carries, if any
    by: str = "source"  # source | mesh: the groups of the tables, columns of photos.csv
    skip_unreadable: bool = False  # skip broken photographs
    overwrite: bool = False  # write over the results that out holds
    precision: str = "auto"  # auto (bfloat16 where the hardware has it) | bfloat16 | float32
    device: str = "auto"  # auto | cpu | cuda | cuda:N

    def __post_init__(self) -> None:
        require_choice("by", self.by, GROUPS)
        scoring.require_calibration(self.false_positive_rate, self.calibrate)
        if (self.run is None) == (self.classifier is None):
            raise InputError("give one network: run=FOLDER, or classifier=NAME")
        if self.classifier and self.model:
            raise InputError(f"model={self.model} is for run=FOLDER: leave it out, since a classifier has its own")


@cli.command()
def main(settings: Settings) -> None:
    device = choose_device(settings.device)
    if settings.run is None:
        network = load_classifier(str(settings.classifier), settings.weights)
    else:
        network = load_run(settings.run, settings.weights, settings.model)
    labels = label_names(settings.label)
    for name in labels:
        network.label(name)  # or InputError that names the network
    model = MixedPrecision(network.to(device), choose_precision(settings.precision, device))
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite)
    points = network.operating_points
    predictor = Predictor(model, network.classes, network.size, device)
    with sole_writer("out", out):
        if settings.calibrate and settings.false_positive_rate:
            folder, rate = published(Path(settings.calibrate)), settings.false_positive_rate
            skip = settings.skip_unreadable
            points = scoring.choose_operating_points(predictor, folder, labels, rate, skip)
        by_label = {point.label: point for point in points}
        points = [by_label[name] for name in labels] if by_label.keys() >= set(labels) else []
        photos = published(Path(settings.photos))
        require_outside(out, photos)
        answers = predictor.predict(photos, labels, settings.skip_unreadable)
        scores = scoring.score(answers, settings.by, points)
        scoring.write(scores, out)
    print(f"{scoring.format_scores(scores)}\n\ntable, scores and image: {out}")


if __name__ == "__main__":
    main()
