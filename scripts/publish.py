"""Write a run's network as half-precision safetensors: pnb-publish run=runs/a out=published/a

The file's metadata holds the run's settings and scores as JSON.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from omegaconf import MISSING

from train import checkpoint
from train.errors import writable_folder
from train.networks import PUBLISHED, PYTHON, load_run, publish
from train.report.summary import summarize


@dataclass
class Settings:
    run: str = MISSING  # a finished run folder
    out: str = MISSING  # the folder of the weights


def without_folders(value: Any) -> Any:
    """Settings with the names of files in place of their paths, which are of this machine alone."""
    match value:
        case dict():
            return {key: without_folders(item) for key, item in value.items()}
        case list():
            return [without_folders(item) for item in value]
        case str() if value.startswith("/"):
            return Path(value).name
    return value


@cli.command()
def main(settings: Settings) -> None:
    out, run = writable_folder(settings.out, "out"), summarize(Path(settings.run))
    state = checkpoint.load(run.folder / checkpoint.BEST)
    if not str(state["architecture"].get("name")).startswith(PYTHON):  # only its user runs that code
        load_run(run.folder / checkpoint.BEST)  # or InputError, since nobody could use it
    out.mkdir(parents=True, exist_ok=True)
    publish(
        out / PUBLISHED,
        state,
        settings=without_folders(run.settings),
        scores={**run.scores, **run.photographs},
        versions=dict(run.config.versions),
    )
    print(f"published in {settings.out}")


if __name__ == "__main__":
    main()
