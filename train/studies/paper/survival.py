"""What becomes of adversaries outside of the floats that they were found in, as `attack.verify` counts it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from augment.attacks.run import Attacked, attack
from augment.attacks.settings import AttackSettings
from augment.attacks.verification import RENDERERS, Verdict
from augment.objects import SceneObject
from augment.parameters import StepSettings
from augment.scene import Scene
from renderer.mitsuba_scene import SAMPLES
from train.studies.paper.adversaries import LIGHT, SHAPE
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent
from train.studies.paper.subjects import Subject, recognised_scene
from train.tables import markdown

ALBEDO = StepSettings("linf", 0.1, "sign", 0.02)
ATTACKS: dict[str, dict[str, Any]] = {
    "light": {"lighting": LIGHT},
    "shape": {"geometry": SHAPE},
    "albedo": {"albedo": ALBEDO},
    "light, shape and albedo": {"lighting": LIGHT, "geometry": SHAPE, "albedo": ALBEDO},
}
MARGIN, BATCH = 2.0, 8
TEXT = """
Adversaries of {classifier} on `{label}`, found as `scripts/attack.py` does unless told otherwise: images of 8 bits,
physical light, and {margin:g} more in the logit of what fools than in any other; {steps} steps at most. Views of
{meshes} at random azimuths, distances and greys, in the nearest light to `{probe}` without negative radiance,
{examples} of each mesh that are recognised in `{probe}` itself. Each adversary is written as a folder; *reload* and
*mitsuba* render it from these files alone, the latter by direct illumination, in which meshes shade themselves and here
do not, with {samples} samples a pixel. The shares that still fool are of those that fooled:

{table}

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
        label=study.label,
        margin=MARGIN,
        steps=settings.steps,
        meshes=study.meshes,
        probe=study.light,
        examples=settings.examples,
        samples=SAMPLES,
        table=markdown(["attack", "fooled", *versions], (_row(name, records, versions) for name in ATTACKS)),
        differences=markdown(
            ["values differ from ours, in 255ths", *ATTACKS], (_differences(version, fooled) for version in versions)
        ),
        same=sum(record["versions"]["reload"]["largest_difference"] <= 1 / 255 for record in records),
        total=len(records),
    )
    return Section(text, records, {})


def _outcomes(subject: Subject, study: Study, settings: SurvivalSettings) -> Iterator[dict[str, Any]]:
    """A record per attack and example that was recognised where the attack began."""
    scene = _physical(recognised_scene(subject, study.classifier, study.light, settings.examples, study.seed), subject)
    for name, kinds in ATTACKS.items():
        chosen = AttackSettings(
            **kinds,
            max_steps=settings.steps,
            shorten="geometry" in kinds,
            margin=MARGIN,
            rounded=True,
            batch_size=BATCH,
        )
        done = attack(study.classifier, scene, settings=chosen, seed=study.seed, force=True)
        with TemporaryDirectory() as folder:
            verdicts = done.save(Path(folder), verify=RENDERERS)
        for example in torch.nonzero(done.recognised).flatten().tolist():
            yield {"mesh": subject.name, "attack": name, **_record(done, verdicts, example)}


def _physical(scene: Scene, subject: Subject) -> Scene:
    shown = SceneObject(subject.label, subject.mesh, subject.gain, subject.name)
    return scene.with_rows(scene.examples, objects=[shown], light=scene.basis.nearest_physical(scene.lights))


def _record(done: Attacked, verdicts: Sequence[Verdict], example: int) -> dict[str, Any]:
    versions = {each.version: each.of(example, done.classifier.classes) for each in verdicts}
    return {"example": example, "fooled": bool(done.success[example]), "versions": versions}


def _row(name: str, records: Sequence[dict[str, Any]], versions: Sequence[str]) -> list[str]:
    here = [record for record in records if record["attack"] == name]
    fooled = [record for record in here if record["fooled"]]
    kept = [percent([record["versions"][version]["fooled"] for record in fooled]) for version in versions]
    return [name, percent([record["fooled"] for record in here]), *kept]


def _differences(version: str, fooled: Sequence[dict[str, Any]]) -> list[str]:
    """Mean, and the largest of any value, by attack."""
    cells = [version]
    for name in ATTACKS:
        found = [record["versions"][version] for record in fooled if record["attack"] == name]
        mean = sum(each["mean_difference"] for each in found) / max(len(found), 1)
        cells.append(f"{255 * mean:.2g}, at most {255 * max((e['largest_difference'] for e in found), default=0):.2g}")
    return cells
