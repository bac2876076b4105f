"""The meshes that callers name, as the settings take them."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from augment.classifiers import Classifier
from augment.settings import ObjectSettings
from renderer.errors import InputError, describe
from renderer.validation import as_list
from train.class_names import classes_of_meshes, name_of_mesh

# A mesh as an argument: a file or solid:NAME, a pair of these and a class, or
# settings.
MeshItem = str | Path | tuple[str | Path, str | int] | ObjectSettings
EXPECTED = (
    "a list of files or solids such as 'solid:orange', "
    "of pairs such as ('orange.glb', 'orange'), or of ObjectSettings"
)


def as_mappings(
    name: str, meshes: Sequence[MeshItem], classifier: Classifier
) -> list[dict[str, Any]]:
    """Convert meshes to mappings with the fields of `ObjectSettings`.

    Args:
        name: Name of the argument, for errors.
        meshes: Meshes, with or without their classes.
        classifier: Classifier whose classes the labels name or count.

    Returns:
        The mappings. Without a class, a mapping has no key "label".

    Raises:
        InputError: If an item is something else, or if the classifier lacks a
            class.
    """
    kinds = str | Path | tuple | list | ObjectSettings
    mappings = []
    for index, item in enumerate(as_list(name, meshes, kinds, EXPECTED)):
        if isinstance(item, ObjectSettings):
            mapping = asdict(item)
        elif isinstance(item, str | Path):
            mapping = {"mesh": str(item)}
        elif len(item) == 2 and isinstance(item[0], str | Path):
            mapping = {"mesh": str(item[0]), "label": item[1]}
        else:
            raise InputError(f"{name}[{index}] is {describe(item)}: give {EXPECTED}")
        if mapping.get("label", "") != "":
            mapping["label"] = classifier.classes[classifier.label(mapping["label"])]
        mappings.append(mapping)
    return mappings


def studied_classes(
    label: str | int | None, meshes: Sequence[dict[str, Any]], classifier: Classifier
) -> list[str]:
    """Return the positive classes.

    Args:
        label: A class, or None for those of the meshes.
        meshes: Meshes as `as_mappings` returns them.
        classifier: Classifier that has the classes.

    Returns:
        Names of the classes, each once, in the order of the meshes.

    Raises:
        InputError: If the classifier lacks the class, or if neither `label` nor
            a mesh tells a class.
    """
    if label is not None:
        return [classifier.classes[classifier.label(label)]]
    return list(dict.fromkeys(classes_of_meshes(meshes, classifier.classes, "meshes")))


def require_others(hard_negatives: Sequence[dict[str, Any]], labels: Sequence[str]) -> None:
    """Check that no hard negative is of a positive class.

    Args:
        hard_negatives: Hard negatives as `as_mappings` returns them.
        labels: Positive classes.

    Raises:
        InputError: If one is of such a class, by its label or by its name.
    """
    for index, item in enumerate(hard_negatives):
        name = item.get("label") or name_of_mesh(item["mesh"])
        # If there are several positive classes, an object of one class is a hard negative for
        # the others.
        is_studied = name in labels and (len(labels) == 1 or not item.get("label"))
        if is_studied:
            raise InputError(
                f"hard_negatives[{index}] is {item['mesh']}, of the positive class {name}: "
                "move it to meshes, or remove it"
            )
