"""What becomes of adversaries outside of the floats that they were found in, as `attack.verify` counts it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from augment.attacks.run import Attacked, attack
from augment.attacks.settings import AttackSettings
from augment.attacks.verification import RENDERERS, Verdict
from augment.objects import SceneObject
from augment.parameters import StepSettings
from augment.placed_lights import LampsSettings, ProjectorSettings
from augment.scene import Scene
from renderer.basis import with_placed
from renderer.lamps import Lamps
from renderer.mitsuba_scene import SAMPLES
from renderer.projector import Projector
from train.studies.paper.adversaries import LIGHT, SHAPE
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent
from train.studies.paper.subjects import Subject, recognised_scene
from train.tables import markdown

ALBEDO = StepSettings("linf", 0.1, "sign", 0.02)
ATTACKS: dict[str, dict[str, Any]] = {
    "light": {"lighting": LIGHT},
    "projector": {"projector": StepSettings("linf", None, "unit", 1.0)},
    "lamps": {"lamps": StepSettings("linf", None, "unit", 0.2)},
    "shape": {"geometry": SHAPE},
    "albedo": {"albedo": ALBEDO},
    "light, shape and albedo": {"lighting": LIGHT, "geometry": SHAPE, "albedo": ALBEDO},
}
PLACED: dict[str, ProjectorSettings | LampsSettings] = {"projector": ProjectorSettings(), "lamps": LampsSettings()}
MARGIN, BATCH = 2.0, 8
TEXT = """
Adversaries of {classifier}, found as `scripts/attack.py` does unless told otherwise: images of 8 bits, physical light,
and {margin:g} more in the logit of what fools than in any other; {steps} steps at most. Views at random azimuths,
distances and greys of {meshes}, in the nearest light to `{probe}` without negative radiance, {examples} of each mesh
that are recognised in `{probe}` itself; the projector and the lamps, dark to begin with, add to it. Each adversary is
written as a folder; *reload* and *mitsuba* render it from these files alone, the latter by direct illumination, in
which meshes shade themselves and here do not, with {samples} samples a pixel. The shares that still fool are of those
that fooled:

{table}

{by_mesh}

{differences}

Adversaries that are reloaded to the same image within 1/255: {same} of {total}.
"""


@dataclass
class SurvivalSettings(SectionSettings):
    """examples: of each mesh and attack. steps: of a descent at most."""

    examples: int
    steps: int


def measure(study: Study, settings: SurvivalSettings) -> Section:
    """Every attack on every mesh."""
    records = [record for subject in study.subjects for record in _outcomes(subject, study, settings)]
    versions = list(records[0]["versions"])
    fooled = [record for record in records if record["fooled"]]
    text = TEXT.format(
        classifier=study.classifier.name,
        margin=MARGIN,
        steps=settings.steps,
        meshes=", ".join(f"{subject.name} (`{subject.label}`)" for subject in study.subjects),
        probe=study.light,
        examples=settings.examples,
        samples=SAMPLES,
        table=markdown(["attack", "fooled", *versions], (_row("attack", name, records, versions) for name in ATTACKS)),
        by_mesh=markdown(
            ["mesh", "fooled", *versions], (_row("mesh", each.name, records, versions) for each in study.subjects)
        ),
        differences=markdown(
            ["values differ from ours, in 255ths", *ATTACKS], (_differences(version, fooled) for version in versions)
        ),
        same=sum(record["versions"]["reload"]["largest_difference"] <= 1 / 255 for record in records),
        total=len(records),
    )
    return Section(text, records, {})


def _outcomes(subject: Subject, study: Study, settings: SurvivalSettings) -> Iterator[dict[str, Any]]:
    """A record per attack and example that was recognised where the attack began."""
    scene = recognised_scene(subject, study.classifier, study.light, settings.examples, study.seed)
    for name, kinds in ATTACKS.items():
        chosen = AttackSettings(
            **kinds,
            max_steps=settings.steps,
            shorten="geometry" in kinds,
            margin=MARGIN,
            rounded=True,
            batch_size=BATCH,
        )
        shown = _shown(scene, subject, [PLACED[kind].build() for kind in kinds if kind in PLACED])
        done = attack(study.classifier, shown, settings=chosen, seed=study.seed, force=True)
        with TemporaryDirectory() as folder:
            verdicts = done.save(Path(folder), verify=RENDERERS)
        for example in torch.nonzero(done.recognised).flatten().tolist():
            yield {"mesh": subject.name, "attack": name, **_record(done, verdicts, example)}


def _shown(scene: Scene, subject: Subject, placed: Sequence[tuple[Projector | Lamps, Tensor]]) -> Scene:
    """The subject by its name and class, with lights that stand in the scene; all examples begin in the same light."""
    shown = SceneObject(subject.label, subject.mesh, subject.gain, subject.name)
    basis, light = with_placed(scene.lights[0], placed)
    return scene.with_rows(scene.examples, objects=[shown], basis=basis, light=light)


def _record(done: Attacked, verdicts: Sequence[Verdict], example: int) -> dict[str, Any]:
    versions = {each.version: each.of(example, done.classifier.classes) for each in verdicts}
    return {"example": example, "fooled": bool(done.success[example]), "versions": versions}


def _row(column: str, name: str, records: Sequence[dict[str, Any]], versions: Sequence[str]) -> list[str]:
    here = [record for record in records if record[column] == name]
    fooled = [record for record in here if record["fooled"]]
    kept = [percent([record["versions"][version]["fooled"] for record in fooled]) for version in versions]
    return [name, percent([record["fooled"] for record in here]), *kept]


def _differences(version: str, fooled: Sequence[dict[str, Any]]) -> list[str]:
    """Mean, and the largest of any value, by attack."""
    cells = [version]
    for name in ATTACKS:
        found = [record["versions"][version] for record in fooled if record["attack"] == name]
        mean = sum(each["mean_difference"] for each in found) / max(len(found), 1)
        largest = max((each["largest_difference"] for each in found), default=0)
        cells.append(f"{255 * mean:.2g}, at most {255 * largest:.3g}")
    return cells
