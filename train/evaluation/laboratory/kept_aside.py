"""Settings of renders that are kept aside from training.

They show the classes of the training as other instances in other light.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from renderer.geometry.shapes import HARD_NEGATIVES, SOLIDS
from train.command_settings import OTHER_PATTERNS, LabSettings
from train.data.photographs import OTHER_PREFIX
from train.settings import ExperimentSettings, label_names, simplified

# Seed of the first instance of a solid. The next instances have the next seeds.
# Training draws its seeds from far larger numbers, or names lower ones.
FIRST_SEED = 2001
# Number of instances of each class under study.
INSTANCES = 6
# Number of instances of each solid in OTHERS.
OTHER_INSTANCES = 2
# Generated solids that a network may confuse with the class under study: fruit, a
# vegetable and a ball.
OTHERS = ("lemon", "peach", "ball", "apple", "pear", "sweet_pepper", "orange")


def kept_aside_settings(
    settings: ExperimentSettings,
    classes: Sequence[str],
    size: int,
    out: Path,
) -> LabSettings:
    """Choose objects, patterns and seeds of renders that training does not use.

    A class that can be generated has generated instances of its own. Another
    class has the meshes of training, in other light.

    Args:
        settings: Settings of the run. `evaluate.laboratory_setups` is a multiple of 5.
        classes: Names of the classes of the network.
        size: Pixels per side of the renders.
        out: Folder of the renders.

    Returns:
        Settings of `write_laboratory`.
    """
    labels = label_names(settings.label)
    meshes: list[Any] = []
    for label in labels:
        meshes += _objects(settings, label)
    names_in_use = {simplified(label) for label in labels}
    by_name = {simplified(name): name for name in classes}
    for other in OTHERS:
        if simplified(other) in names_in_use:
            continue
        label = by_name.get(simplified(other), OTHER_PREFIX + other)
        meshes += _instances(other, label, OTHER_INSTANCES)
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


def _objects(settings: ExperimentSettings, label: str) -> list[Any]:
    """Choose the objects of a class under study.

    Args:
        settings: Settings of the run, with the meshes of the training.
        label: The class.

    Returns:
        Settings of INSTANCES generated solids, if the class is one that can be
        generated. Otherwise the settings of its meshes in the training.
    """
    name = simplified(label).replace(" ", "_")
    if name in SOLIDS or name in HARD_NEGATIVES:
        return _instances(name, label, INSTANCES)
    return [asdict(item) for item in settings.objects.values() if item.label == label]


def _instances(name: str, label: str, count: int) -> list[Any]:
    """Return the settings of generated instances of a solid.

    Args:
        name: Name of the solid.
        label: Class of the instances.
        count: Number of instances.
    """
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    return [{"mesh": f"solid:{name}:{seed}", "label": label} for seed in seeds]
