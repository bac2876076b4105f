"""Classes as users name them: by name, by index, or by the name of a mesh."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from augment.classifiers.adapter import class_index, nearest
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.geometry.shapes import HARD_NEGATIVES, SOLIDS
from train.data.photographs import OTHER_PREFIX
from train.settings import OTHER, ExperimentSettings, label_names, simplified, solid_name


def class_name(classes: Sequence[str], label: str | int, key: str) -> str:
    """Return the name of a class.

    Args:
        classes: Names of all classes of a network.
        label: Name of the class, or its index.
        key: Setting that names the class, for the error.

    Returns:
        Name of the class.

    Raises:
        InputError: If there is no such class.
    """
    return classes[class_index(classes, label, key)]


def with_class_name(item: Any, classes: Sequence[str], key: str) -> Any:
    """Return a mesh of the settings with its class by name.

    A class of no network, such as "other" or "other_lemon", stays.

    Args:
        item: File, solid or mapping with the fields of `ObjectSettings`.
        classes: Names of all classes of a network.
        key: Setting that lists the mesh, for the error.

    Returns:
        The mesh.

    Raises:
        InputError: If the network lacks the class of the mesh.
    """
    label = item.get("label") if isinstance(item, dict) else None
    if label is None or label == "" or label == OTHER or str(label).startswith(OTHER_PREFIX):
        return item
    return {**item, "label": class_name(classes, label, f"{key}.label")}


def class_of_name(name: str, classes: Sequence[str]) -> str | None:
    """Find the class of a name. Case, "_", "-" and spaces make no difference.

    Args:
        name: Name of a class as a user writes it.
        classes: Names of all classes of a network.

    Returns:
        Name of the class. None if no class or several classes match.
    """
    same = [known for known in classes if simplified(known) == simplified(name)]
    if name in same:
        return name
    return same[0] if len(same) == 1 else None


def name_of_mesh(mesh: str) -> str:
    """Return the name of a solid, or that of a file without its ending.

    Args:
        mesh: File, or solid:NAME with or without a seed.

    Returns:
        The name.

    >>> name_of_mesh("meshes/banana.glb")
    'banana'
    """
    return solid_name(mesh) or Path(mesh).stem


def classes_of_meshes(items: Sequence[Any], classes: Sequence[str], key: str) -> list[str]:
    """Find the class of each mesh by its label or, without a label, by its name.

    The name of a file without its suffix, or the name of a solid, must be the
    name of a class. Case, "_", "-" and spaces make no difference.

    Args:
        items: Files, solids or mappings with the fields of `ObjectSettings`.
        classes: Names of all classes of a network.
        key: Setting that lists the meshes, for the error.

    Returns:
        Name of the class of each mesh.

    Raises:
        InputError: If the network lacks the class of a mesh, or if a mesh tells
            no class.
    """
    found = []
    for index, item in enumerate(items):
        values = item if isinstance(item, dict) else {"mesh": item}
        if values.get("label") not in (None, ""):
            found.append(class_name(classes, values["label"], f"{key}[{index}].label"))
            continue
        mesh = str(values.get("mesh"))
        name = class_of_name(name_of_mesh(mesh), classes)
        if name is None:
            raise _unnamed(mesh, classes)
        found.append(name)
    return found


def _unnamed(mesh: str, classes: Sequence[str]) -> InputError:
    """Create the error for a mesh whose class is unknown.

    Args:
        mesh: File, or solid:NAME. Its name is not the name of a class.
        classes: Names of all classes of the network.
    """
    solid = solid_name(mesh)
    if not solid and not Path(mesh).exists():
        return InputError(f"{mesh} does not exist: give the path of a mesh, or solid:NAME")
    if solid and solid not in (*SOLIDS, *HARD_NEGATIVES):
        choices = nearest(solid, (*SOLIDS, *HARD_NEGATIVES))
        return InputError(f"{mesh} is not a solid: choose one, such as {choices}")
    if list(classes) == [str(index) for index in range(len(classes))]:
        remedy = f"give label=INDEX, from 0 to {len(classes) - 1}, or name the classes in classes="
        return InputError(f"label is not set, and the classes have no names: {remedy}", "label")
    choices = nearest(name_of_mesh(mesh), classes)
    fault = f"label is not set, and {mesh} is not named like a class of the network"
    remedy = f"give label=CLASS or {{mesh: '{mesh}', label: CLASS}}, such as {choices}"
    return InputError(f"{fault}: {remedy}", "label")


def class_of_meshes(items: Sequence[Any], classes: Sequence[str], key: str) -> str:
    """Find the only class of meshes, see `classes_of_meshes`.

    Args:
        items: Files, solids or mappings with the fields of `ObjectSettings`.
        classes: Names of all classes of a network.
        key: Setting that lists the meshes, for the error.

    Returns:
        Name of the class.

    Raises:
        InputError: If the meshes tell no class, or several.
    """
    found = classes_of_meshes(items, classes, key)
    if len(set(found)) != 1:
        raise InputError(
            f"label is not set, and {key} are of the classes {', '.join(sorted(set(found)))}: "
            "give the meshes of one class, or label=CLASS",
            "label",
        )
    return found[0]


def require_others(
    hard_negatives: Mapping[str, ObjectSettings], labels: Sequence[str], classes: Sequence[str]
) -> None:
    """Check that no hard negative is of a positive class.

    The class of a mesh without a label is the class that its name tells. If
    there are several positive classes, a labeled object of one of them is a
    hard negative for the others.

    Args:
        hard_negatives: Hard negatives by their keys, as `read_objects` returns
            them. The label of an object without a class is empty, OTHER, or
            begins with OTHER_PREFIX.
        labels: Names of the positive classes.
        classes: Names of all classes of the network.

    Raises:
        InputError: If one is of a positive class, or of a class that the
            network lacks.
    """
    for key, item in hard_negatives.items():
        is_labeled = item.label not in ("", OTHER) and not item.label.startswith(OTHER_PREFIX)
        if is_labeled:
            name: str | None = class_name(classes, item.label, f"label of {key}")
        else:
            name = class_of_name(name_of_mesh(item.mesh), classes)
        if name in labels and not (is_labeled and len(labels) > 1):
            raise InputError(
                f"{key} is {item.mesh}, which is of the positive class {name}: "
                "move it to meshes, or remove it",
                key,
            )


def with_classes_of_meshes(
    settings: ExperimentSettings, classes: Sequence[str]
) -> ExperimentSettings:
    """Return settings whose label is the classes of their meshes.

    Args:
        settings: Settings of a run. Their label is None.
        classes: Names of all classes of the network.

    Returns:
        Settings in which each mesh names its class. Each class is once in the
        label, in the order of the meshes.

    Raises:
        InputError: See `classes_of_meshes`.
    """
    items = settings.scene.meshes
    names = classes_of_meshes(items, classes, "scene.meshes")
    meshes = []
    for item, name in zip(items, names, strict=True):
        values = item if isinstance(item, dict) else {"mesh": item}
        meshes.append({**values, "label": name})
    negatives = [
        with_class_name(item, classes, "scene.hard_negatives")
        for item in settings.scene.hard_negatives
    ]
    labels = list(dict.fromkeys(names))
    return replace(
        settings,
        label=labels[0] if len(labels) == 1 else labels,
        scene=replace(settings.scene, meshes=meshes, hard_negatives=negatives),
    )


def with_class_names(settings: ExperimentSettings, classes: Sequence[str]) -> ExperimentSettings:
    """Return settings in which classes are given by name instead of by index.

    Args:
        settings: Settings of a run with a label.
        classes: Names of all classes of the network.

    Returns:
        Settings with the names in the label and in the meshes.

    Raises:
        InputError: If the network lacks a class.
    """
    names = [class_name(classes, name, "label") for name in label_names(settings.label)]
    meshes = [with_class_name(item, classes, "scene.meshes") for item in settings.scene.meshes]
    negatives = [
        with_class_name(item, classes, "scene.hard_negatives")
        for item in settings.scene.hard_negatives
    ]
    # A generated hard negative of the class is left out, which changes this number.
    examples = settings.augment.examples if settings.scene.views is None else None
    return replace(
        settings,
        label=names[0] if len(names) == 1 else names,
        augment=replace(settings.augment, examples=examples),
        scene=replace(settings.scene, meshes=meshes, hard_negatives=negatives),
    )
