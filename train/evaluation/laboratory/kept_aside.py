"""Settings of renders that are kept aside: what training saw, as other instances in other light."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from renderer.geometry.shapes import HARD_NEGATIVES, SOLIDS
from train.command_settings import OTHER_PATTERNS, LabSettings
from train.data.photographs import OTHER_PREFIX
from train.settings import ExperimentSettings, label_names, simplified

# Seeds of the first instance. Training draws its seeds from far larger numbers,
# or names lower ones.
FIRST_SEED = 2001
# Number of instances of each class under study, and of each other thing.
INSTANCES = 6
OTHER_INSTANCES = 2
# Generated things that resemble fruit.
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
    """Return generated instances of a class, or its meshes of training if there are none."""
    name = simplified(label).replace(" ", "_")
    if name in SOLIDS or name in HARD_NEGATIVES:
        return _instances(name, label, INSTANCES)
    return [asdict(item) for item in settings.objects.values() if item.label == label]


def _instances(name: str, label: str, count: int) -> list[Any]:
    """Return the settings of generated instances."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    return [{"mesh": f"solid:{name}:{seed}", "label": label} for seed in seeds]
