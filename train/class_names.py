"""Classes as users name them: by name, by index, or by the name of a mesh."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from augment.classifiers import Classifier
from augment.classifiers.adapter import nearest
from renderer.errors import InputError
from train.data.photographs import OTHER_PREFIX
from train.settings import OTHER, solid_name
from train.system.user_errors import keyed


def class_name(classifier: Classifier, label: str | int, key: str) -> str:
    """Return the name of a class of a classifier.

    Args:
        classifier: The classifier.
        label: Name of the class, or its index.
        key: Setting that names the class, for the error.

    Raises:
        InputError: If there is no such class.
    """
    with keyed(key):
        return classifier.classes[classifier.label(label)]


def with_class_name(item: Any, classifier: Classifier, key: str) -> Any:
    """Return a mesh of the settings with its class by name.

    A class of no classifier, such as "other" or "other_lemon", stays.

    Args:
        item: File, solid or mapping with the fields of `ObjectSettings`.
        classifier: Classifier that has the class.
        key: Setting that lists the mesh, for the error.

    Raises:
        InputError: If the classifier lacks the class of the mesh.
    """
    label = item.get("label") if isinstance(item, dict) else None
    if label is None or label == "" or label == OTHER or str(label).startswith(OTHER_PREFIX):
        return item
    return {**item, "label": class_name(classifier, label, f"{key}.label")}


def simplified(name: str) -> str:
    """Return a name in lower case, in which "_" and "-" are spaces."""
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


def class_of_name(name: str, classifier: Classifier) -> str | None:
    """Return the class whose name differs only in case, "_", "-" and spaces. None if not unique."""
    same = [known for known in classifier.classes if simplified(known) == simplified(name)]
    if name in same:
        return name
    return same[0] if len(same) == 1 else None


def class_of_meshes(items: Sequence[Any], classifier: Classifier, key: str) -> str:
    """Find the class that the names of meshes tell.

    The name of a file without its suffix, or the name of a solid, must be the
    name of a class. Case, "_", "-" and spaces make no difference.

    Args:
        items: Files, solids or mappings with the fields of `ObjectSettings`.
        classifier: Classifier that has the classes.
        key: Setting that lists the meshes, for the error.

    Returns:
        Name of the class.

    Raises:
        InputError: If the meshes tell no class, or several.
    """
    found = []
    for item in items:
        values = item if isinstance(item, dict) else {"mesh": item}
        if values.get("label"):
            found.append(class_name(classifier, values["label"], f"{key}.label"))
            continue
        mesh = str(values.get("mesh"))
        stem = solid_name(mesh) or Path(mesh).stem
        name = class_of_name(stem, classifier)
        if name is None:
            choices = nearest(stem, classifier.classes)
            fault = f"label is not set, and {mesh} is not named like a class of {classifier.name}"
            raise InputError(f"{fault}: set label=CLASS, such as {choices}", "label")
        found.append(name)
    if len(set(found)) != 1:
        fault = f"label is not set, and {key} are of the classes {', '.join(sorted(set(found)))}"
        raise InputError(f"{fault}: give the meshes of one class, or label=CLASS", "label")
    return found[0]
