"""What becomes of adversaries outside of the floats that they were found in, as `attack.verify` counts it."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from hydra.errors import HydraException

from augment.attacks.attack import NotCleanCorrectError
from augment.attacks.evaluate import RENDERERS
from augment.objects import ObjectSettings
from renderer.errors import InputError
from renderer.files.mitsuba_scene import SAMPLES
from train.attacks.experiment import attacks
from train.attacks.search import overrides
from train.attacks.settings import AttackExperimentSettings
from train.report.tables import markdown
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent
from train.studies.paper.subjects import short_name

TITLE = "What survives outside"


@dataclass
class Settings(SectionSettings):
    """examples: of each mesh and attack. overrides: of scripts/attack.py, such as attack.max_steps=10."""

    examples: int
    overrides: list[str]


ATTACKS = {  # by their names in the table, as `attack=` of scripts/attack.py
    "light": "lighting",
    "projector": "projector",
    "lamps": "lamps",
    "shape": "geometry",
    "albedo": "albedo",
    "light, shape and albedo": "lighting,geometry,albedo",
    "projector and shape": "projector,geometry",
}
LIT = ["light", "projector", "lamps"]  # what changes the light alone, counted together, too


def measure(study: Study, settings: Settings) -> Section:
    """Every attack on every mesh."""
    records = [record for item in study.items for record in outcomes(item, study, settings)]
    recognised = [record for record in records if record["recognised"]]
    versions = list(dict.fromkeys(version for record in recognised for version in record["versions"]))
    rows = {**{name: [name] for name in ATTACKS}, ", ".join(LIT): LIT}
    told = command(study.items[0], "lighting", 0, study, settings)
    values = {
        "meshes": len(study.items),
        "around": f"{360 / settings.examples:g}",
        "searched": sum(not record["recognised"] or record["scene"] is not None for record in records),
        "told": told,
        "rounding": "8 bits" if told.attack.rounded else "floats",
        "samples": SAMPLES,
        "table": markdown(
            ["attack", "success", *versions],
            ([name, *shares(recognised, kinds, versions)] for name, kinds in rows.items()),
        ),
        "lost": lost(recognised, RENDERERS[-1]),
        "same": sum(record["versions"]["reload"]["largest_difference"] <= 1 / 255 for record in recognised),
        "attacked": len(recognised),
        "total": len(records),
    }
    return Section(values, records)


def outcomes(item: ObjectSettings, study: Study, settings: Settings) -> Iterator[dict[str, Any]]:
    """A record per attack and example, of which there is no more where no scene was found."""
    for name, kinds in ATTACKS.items():
        for example in range(settings.examples):
            told = command(item, kinds, example, study, settings)
            record = {"mesh": short_name(item), "attack": name, "example": example}
            try:
                ((_, scene, done),) = attacks(told, study.classifier, torch.device("cpu"))
            except NotCleanCorrectError:
                yield {**record, "recognised": False}
                continue
            with TemporaryDirectory() as folder:
                rerender_checks = done.save(Path(folder), verify=RENDERERS)
            yield {
                **record,
                "recognised": True,
                "scene": overrides(scene, told.scene) or None,
                "steps": int(done.steps[0]),
                "success": bool(done.success[0]),
                "versions": {each.version: each.of(0, done.classifier.classes) for each in rerender_checks},
            }


def command(
    item: ObjectSettings, kinds: str, example: int, study: Study, settings: Settings
) -> AttackExperimentSettings:
    """An attack from a side of the mesh of the example's own, under the section's overrides."""
    azimuth = 360 * example / settings.examples
    chosen = [f"attack=[{kinds}]", f"scene.azimuth={azimuth}", f"seed={study.seed + example}"]
    try:
        return study.command(item, [*chosen, *settings.overrides])
    except HydraException as error:
        raise InputError(f"section.overrides={settings.overrides}: {str(error).splitlines()[0]}") from error


def shares(recognised: Sequence[dict[str, Any]], kinds: Sequence[str], versions: Sequence[str]) -> list[str]:
    """Of some attacks: those that fooled, and of these, those that still do in each version."""
    here = [record for record in recognised if record["attack"] in kinds]
    success = [record for record in here if record["success"]]
    kept = [percent([record["versions"][version]["success"] for record in success]) for version in versions]
    return [percent([record["success"] for record in here]), *kept]


def lost(recognised: Sequence[dict[str, Any]], version: str) -> str:
    """The meshes of adversaries that fool no longer in a version, with their number."""
    found = Counter(
        record["mesh"] for record in recognised if record["success"] and not record["versions"][version]["success"]
    )
    return ", ".join(f"{count} of {mesh}" for mesh, count in found.items()) or "none"
