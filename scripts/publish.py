"""Write a run's network as half-precision safetensors: pnb-publish run=runs/a out=published/a

The file's metadata holds the run's settings and scores as JSON. A published network gets an operating point by
pnb-publish run=published/a out=published/a calibrate=lab false_positive_rate=0.05
"""

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from omegaconf import MISSING

from train.errors import writable_folder
from train.networks import PUBLISHED, PYTHON, load_run, load_selected, publish, published
from train.photographs import scoring
from train.photographs.predictions import Predictor
from train.report.summary import summarize
from train.results import require_replaceable
from train.settings import mapped


@dataclass
class Settings:
    run: str = MISSING  # a finished run folder, or a published network
    out: str = MISSING  # the folder of the weights
    false_positive_rate: float | None = None  # for a threshold on the log-odds of `label`, chosen on calibrate
    calibrate: str | None = None  # a folder of photographs as for pnb-evaluate; null: the threshold it has, if any
    label: Any = "orange"  # the class of the threshold, or several, each with its own
    model: str | None = None  # python:package.module:function, if such a function made the run's network
    overwrite: bool = False  # write over the results that out holds

    def __post_init__(self) -> None:
        scoring.require_calibration(self.false_positive_rate, self.calibrate)


@cli.command()
def main(settings: Settings) -> None:
    out, given = writable_folder(settings.out, "out"), Path(settings.run)
    path, state = load_selected(given)
    own = [PUBLISHED] if path.resolve() == (out / PUBLISHED).resolve() else []  # it gets an operating point
    require_replaceable(out, "out", settings.overwrite, own)
    if path.suffix != Path(PUBLISHED).suffix:  # a run of pnb-train
        run = summarize(given)
        # Names of files in place of their paths, which are of this machine alone.
        state["settings"] = mapped(dict(run.settings), lambda text: Path(text).name if text[:1] == "/" else text)
        state["versions"] = dict(run.config.versions)
        photographs = {name: scores.to_published() for name, scores in run.photographs.items()}
        state["scores"] = {**run.scores, **photographs}
    if settings.calibrate or not str(state["architecture"].get("name")).startswith(PYTHON):  # its user runs that code
        network = load_run(path, model=settings.model)  # or InputError, since nobody could use it
    if settings.calibrate and settings.false_positive_rate:
        network.half().float()  # as it is published
        folder, rate = published(Path(settings.calibrate)), settings.false_positive_rate
        predictor = Predictor(network, network.classes, network.size)
        points = scoring.choose_operating_points(predictor, folder, settings.label, rate)
        state["operating_point"] = [asdict(point) for point in points]
        for point in points:
            print(f"{point.label}: threshold {point.threshold:.3f} for {scoring.describe_point(asdict(point))}")
    out.mkdir(parents=True, exist_ok=True)
    publish(out / PUBLISHED, state)
    print(f"published in {settings.out}")


if __name__ == "__main__":
    main()
