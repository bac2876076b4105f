"""Settings of the test renders that a training run makes after training.

They show the same classes as the training, but other objects in other lighting.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from renderer.solids import HARD_NEGATIVES, SOLIDS
from train.command_settings import OTHER_PATTERNS, LabSettings
from train.settings import OTHER_PREFIX, ExperimentSettings, label_names, simplified

# The generated solids for testing have the seeds 2001, 2002 and so on. Training uses
# lower seeds, or draws seeds that are far larger.
FIRST_SEED = 2001
# Number of generated solids of each positive class.
POSITIVE_COUNT = 6
# Number of generated solids for each name in NEGATIVES.
NEGATIVE_COUNT = 2
# Solids that a network may confuse with the positive class: fruit, a vegetable and a
# ball. A solid of a positive class is left out.
NEGATIVES = ("lemon", "peach", "ball", "apple", "pear", "sweet_pepper", "orange")


def kept_aside_settings(
    settings: ExperimentSettings,
    classes: Sequence[str],
    size: int,
    out: Path,
) -> LabSettings:
    """Choose objects and lighting for test renders that training does not use.

    If a positive class is the name of a generated solid, new solids are
    generated. Otherwise the meshes of training are rendered in other lighting. The number of setups
    is a multiple of the number of projected patterns.
    """
    labels = label_names(settings.label)
    meshes: list[Any] = []
    for label in labels:
        meshes += _positives(settings, label)
    # Names are compared in lower case and with spaces instead of "_" and "-", as `simplified`
    # returns them.
    simplified_labels = {simplified(label) for label in labels}
    class_of_simplified = {simplified(name): name for name in classes}
    for solid_name in NEGATIVES:
        if simplified(solid_name) in simplified_labels:
            continue
        # A solid that is no class of the network gets a label that marks it as another object.
        label = class_of_simplified.get(simplified(solid_name), OTHER_PREFIX + solid_name)
        meshes += _generated(solid_name, label, NEGATIVE_COUNT)
    return LabSettings(
        out=str(out),
        label=settings.label,
        meshes=meshes,
        setups=settings.evaluate.laboratory_setups,
        patterns=[*OTHER_PATTERNS],
        size=size,
        seed=FIRST_SEED + settings.seed,
        overwrite=True,
    )


def can_be_generated(label: str) -> bool:
    """Return whether a class has generated solids."""
    name = _solid_name(label)
    return name in SOLIDS or name in HARD_NEGATIVES


def _solid_name(label: str) -> str:
    """Return the name that the solid of a class would have, such as "golf_ball"."""
    return simplified(label).replace(" ", "_")


def _positives(settings: ExperimentSettings, label: str) -> list[Any]:
    """Choose the objects of a positive class for the test renders.

    These are generated solids of its name, or else the meshes of the training.
    """
    if can_be_generated(label):
        return _generated(_solid_name(label), label, POSITIVE_COUNT)
    return [asdict(item) for item in settings.objects.values() if item.label == label]


def _generated(name: str, label: str, count: int) -> list[Any]:
    """Return the settings of generated solids of the same kind with different seeds."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    return [{"mesh": f"solid:{name}:{seed}", "label": label} for seed in seeds]
