"""What becomes of adversaries outside of the floats that they were found in, as `attack.verify` counts it."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from hydra.errors import HydraException

from augment.attacks.run import NotRecognisedError
from augment.attacks.verification import RENDERERS
from augment.objects import ObjectSettings
from renderer.errors import InputError
from renderer.files.mitsuba_scene import SAMPLES
from train.attacks.experiment import attacks
from train.attacks.search import overrides
from train.attacks.settings import AttackExperimentSettings
from train.command_line.configuration import composed, read_settings
from train.report.tables import markdown
from train.studies.page import filled
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent

ATTACKS = {  # by their names in the tables, as `attack=` of scripts/attack.py
    "light": "lighting",
    "projector": "projector",
    "lamps": "lamps",
    "shape": "geometry",
    "albedo": "albedo",
    "light, shape and albedo": "lighting,geometry,albedo",
    "projector and shape": "projector,geometry",
}
LIT = ["light", "projector", "lamps"]  # what changes the light alone, counted together, too


@dataclass
class SurvivalSettings(SectionSettings):
    """examples: of each mesh and attack. overrides: of scripts/attack.py, such as attack.max_steps=10."""

    examples: int
    overrides: list[str]


def measure(study: Study, settings: SurvivalSettings) -> Section:
    """Every attack on every mesh."""
    records = [record for item in study.items for record in _outcomes(item, study, settings)]
    recognised = [record for record in records if record["recognised"]]
    versions = list(dict.fromkeys(version for record in recognised for version in record["versions"]))
    fooled = [record for record in recognised if record["fooled"]]
    meshes = dict.fromkeys(record["mesh"] for record in records)
    head = ["recognised", "fooled", *versions]
    rows = {**{name: [name] for name in ATTACKS}, ", ".join(LIT): LIT}
    command = _command(study.items[0], "lighting", 0, study, settings)
    text = filled(
        __file__,
        classifier=study.classifier.name,
        meshes=", ".join(f"{_name(item)} (`{item.label}`)" for item in study.items),
        examples=settings.examples,
        around=f"{360 / settings.examples:g}",
        searched=sum(not record["recognised"] or record["scene"] is not None for record in records),
        rounding="8 bits" if command.attack.rounded else "floats",
        margin=command.attack.margin,
        steps=command.attack.max_steps,
        light=command.attack.light,
        transport=command.renderer.transport,
        samples=SAMPLES,
        table=markdown(
            ["attack", *head],
            (_row(name, _of("attack", names, records), versions) for name, names in rows.items()),
        ),
        by_mesh=markdown(["mesh", *head], (_row(name, _of("mesh", [name], records), versions) for name in meshes)),
        differences=markdown(
            ["values differ from ours, in 255ths", *ATTACKS], (_differences(version, fooled) for version in versions)
        ),
        same=sum(record["versions"]["reload"]["largest_difference"] <= 1 / 255 for record in recognised),
        attacked=len(recognised),
        total=len(records),
    )
    return Section(text, records, {})


def _outcomes(item: ObjectSettings, study: Study, settings: SurvivalSettings) -> Iterator[dict[str, Any]]:
    """A record per attack and example, of which there is no more where no scene was found."""
    for name, kinds in ATTACKS.items():
        for example in range(settings.examples):
            command = _command(item, kinds, example, study, settings)
            record = {"mesh": _name(item), "attack": name, "example": example}
            try:
                ((_, scene, done),) = attacks(command, study.classifier, torch.device("cpu"))
            except NotRecognisedError:
                yield {**record, "recognised": False}
                continue
            with TemporaryDirectory() as folder:
                verdicts = done.save(Path(folder), verify=RENDERERS)
            yield {
                **record,
                "recognised": True,
                "scene": overrides(scene, command.scene) or None,
                "steps": int(done.steps[0]),
                "fooled": bool(done.success[0]),
                "versions": {each.version: each.of(0, done.classifier.classes) for each in verdicts},
            }


def _command(
    item: ObjectSettings, kinds: str, example: int, study: Study, settings: SurvivalSettings
) -> AttackExperimentSettings:
    """What scripts/attack.py is told: its own configuration, but for the mesh, the side that it is seen from, the light
    and the section's overrides."""
    azimuth = 360 * example / settings.examples
    chosen = [f"attack=[{kinds}]", f"scene.azimuth={azimuth}", f"seed={study.seed + example}"]
    try:
        config = composed("attack", [*chosen, *settings.overrides])
    except HydraException as error:
        raise InputError(f"section.overrides={settings.overrides}: {str(error).splitlines()[0]}") from error
    config.scene.meshes, config.scene.light = [asdict(item)], study.light
    return read_settings(AttackExperimentSettings, config)


def _name(item: ObjectSettings) -> str:
    return Path(item.mesh).stem


def _of(column: str, names: Sequence[str], records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [record for record in records if record[column] in names]


def _row(name: str, here: Sequence[dict[str, Any]], versions: Sequence[str]) -> list[str]:
    recognised = [record for record in here if record["recognised"]]
    fooled = [record for record in recognised if record["fooled"]]
    kept = [percent([record["versions"][version]["fooled"] for record in fooled]) for version in versions]
    count = f"{len(recognised)} of {len(here)}"
    return [name, count, percent([record["fooled"] for record in recognised]), *kept]


def _differences(version: str, fooled: Sequence[dict[str, Any]]) -> list[str]:
    """Mean, and the largest of any value, by attack."""
    cells = [version]
    for name in ATTACKS:
        found = [record["versions"][version] for record in fooled if record["attack"] == name]
        mean = sum(each["mean_difference"] for each in found) / max(len(found), 1)
        largest = max((each["largest_difference"] for each in found), default=0)
        cells.append(f"{255 * mean:.2g}, at most {255 * largest:.3g}")
    return cells
