"""Classes as users name them: by name, by index, or by the name of a mesh."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from augment.scene.objects import MESHES_IN_MEMORY, name_mesh
from augment.settings import ObjectSettings
from augment.tasks.classification import class_index, nearest
from renderer.errors import InputError, as_list, describe
from renderer.mesh import Mesh
from renderer.solids import HARD_NEGATIVES, SOLIDS
from train import settings as common
from train.settings import ExperimentSettings, is_of_no_class, simplified, solid_name

# File of a mesh, solid:NAME, or the mesh itself.
MeshSource = str | Path | Mesh
# A mesh as an argument: alone, in a pair with its class, as settings, or a list of pairs and
# settings of several objects on the same ground.
MeshItem = MeshSource | tuple[MeshSource, str | int] | ObjectSettings | list[Any]
EXPECTED = (
    "a list of files, of solids such as 'solid:orange', of nb.Mesh, of pairs of these and a class "
    "such as ('orange.glb', 'orange'), of nb.ObjectSettings, or of lists of pairs and settings"
)


def class_name(classes: Sequence[str], label: str | int, key: str) -> str:
    """Return the name of a class of a network, which is given by its name or its index."""
    return classes[class_index(classes, label, key)]


def with_class_name(item: Any, classes: Sequence[str], key: str) -> Any:
    """Return the settings of a mesh, in which its class is given by name instead of by index.

    The same holds for the objects beside it, and for a list of meshes. A mapping without a label,
    or with one that no network has, such as "other_lemon", keeps it. Only a mapping can have a
    label.
    """
    if isinstance(item, list | tuple):
        return [with_class_name(one, classes, key) for one in item]
    if not isinstance(item, dict):
        return item
    named = dict(item)
    if not is_of_no_class(item.get("label")):
        named["label"] = class_name(classes, item["label"], f"{key}.label")
    if item.get("others"):
        named["others"] = with_class_name(item["others"], classes, key)
    return named


def class_of_name(name: str, classes: Sequence[str]) -> str | None:
    """Find the class of a network that a name means, such as "sweet pepper" for "Sweet_Pepper".

    Upper and lower case, "_", "-" and spaces make no difference. None if no class matches, or if
    several match and none of them is exactly `name`.
    """
    matches = [known for known in classes if simplified(known) == simplified(name)]
    if name in matches:
        return name
    return matches[0] if len(matches) == 1 else None


def name_of_mesh(mesh: str) -> str:
    """Return what a mesh shows according to its name: NAME of "solid:NAME" or "NAME.glb".

    A seed, as in "solid:NAME:SEED", is left out.
    """
    return solid_name(mesh) or Path(mesh).stem


def classes_of_meshes(items: Sequence[Any], classes: Sequence[str], key: str) -> list[str]:
    """Find the class of each mesh by its label or, without a label, by its name.

    Without a label, the file "banana.glb" and the solid "solid:banana" are of the class "banana".
    An unknown class raises InputError, whose message names `key`.
    """
    found = []
    for place, item in common.read_objects(items, "", key).items():
        if item.label in (None, ""):
            # None if no class has this name.
            name = class_of_name(name_of_mesh(item.mesh), classes)
        else:
            name = class_name(classes, item.label, f"{place}.label")
        if name is None:
            raise _unknown_class_error(item.mesh, classes)
        found.append(name)
    return found


def _unknown_class_error(mesh: str, classes: Sequence[str]) -> InputError:
    """Create the error for a mesh whose class is unknown."""
    if mesh in MESHES_IN_MEMORY:
        return InputError(f"an nb.Mesh has no class: give (mesh, {classes[0]!r}) or label")
    solid, solids = solid_name(mesh), (*SOLIDS, *HARD_NEGATIVES)
    if not solid and not Path(mesh).exists():
        return InputError(f"{mesh} does not exist: give the path of a mesh, or solid:NAME")
    if solid and solid not in solids:
        return InputError(f"{mesh} is not a solid: choose one, such as {nearest(solid, solids)}")
    fault = f"label is not set, and {mesh} is not named like a class of the network"
    choices = nearest(name_of_mesh(mesh), classes)
    return InputError(f"{fault}: give label=CLASS or {{mesh, label}}, such as {choices}", "label")


def class_of_meshes(items: list[Any], classes: Sequence[str], key: str, label: Any = None) -> str:
    """Find the class of meshes, which is `label`, a name or an index, if it is given.

    Meshes of several classes raise InputError.
    """
    if label is not None:
        return class_name(classes, label, "label")
    found = sorted(set(classes_of_meshes(items, classes, key)))
    if len(found) != 1:
        raise InputError(f"label is not set: {key} are of {', '.join(found)}: give one", "label")
    return found[0]


def require_others(
    hard_negatives: Mapping[str, ObjectSettings], labels: Sequence[str], classes: Sequence[str]
) -> None:
    """Check that no hard negative is an object of a positive class.

    With several positive classes, an object of one of them may be a hard negative for the others.
    The settings must then give its class as a label. The keys are such as
    "hard_negatives[0]", and labels such as "", "other" and "other_lemon" are of no class.
    """
    for key, item in hard_negatives.items():
        is_labeled = not is_of_no_class(item.label)
        name = class_of_name(name_of_mesh(item.mesh), classes)
        if is_labeled:
            name = class_name(classes, item.label, f"label of {key}")
        if name in labels and not (is_labeled and len(labels) > 1):
            raise InputError(f"{key} is {item.mesh}, of the positive class {name}: remove it", key)


def with_class_names(settings: ExperimentSettings, classes: Sequence[str]) -> ExperimentSettings:
    """Name the classes in the settings of a run, some of which may be given by index.

    A missing label becomes the list of the classes of the meshes, and each mesh gets its class.
    """
    if settings.label is None:
        found = classes_of_meshes(settings.meshes, classes, "meshes")
        mappings = map(common.as_mapping, settings.meshes)
        meshes = [item | {"label": name} for item, name in zip(mappings, found, strict=True)]
        # A dictionary has each name once, in the order of the meshes.
        names = [*dict.fromkeys(found)]
    else:
        names = [class_name(classes, name, "label") for name in settings.labels]
        meshes = settings.meshes
    meshes = with_class_name(meshes, classes, "meshes")
    negatives = with_class_name(settings.hard_negatives, classes, "hard_negatives")
    # A single positive class is given by its name, several are given as a list.
    label = names[0] if len(names) == 1 else names
    return replace(settings, label=label, meshes=meshes, hard_negatives=negatives)


def as_mappings(name: str, items: Sequence[MeshItem]) -> list[dict[str, Any]]:
    """Convert the meshes of a caller to mappings with the fields of `ObjectSettings`.

    A mapping has a "label" if the class is given, by name or index.
    """
    kinds = MeshSource | tuple | list | ObjectSettings
    mappings = []
    for index, item in enumerate(as_list(name, items, kinds, EXPECTED)):
        key = f"{name}[{index}]"
        # A list of objects is one mesh with others around it, which are in the same render.
        if isinstance(item, list) and any(isinstance(of, tuple | ObjectSettings) for of in item):
            first, *others = as_mappings(key, item)
            mapping = first | {"others": [*first.get("others", ()), *others]}
        elif isinstance(item, ObjectSettings):
            mapping = asdict(item)
        else:
            # Other items are a source, or a pair of a source and a class.
            source, *label = [item] if isinstance(item, MeshSource) else item or [None]
            if not isinstance(source, MeshSource) or len(label) > 1:
                raise InputError(f"{key} is {describe(item)}: give {EXPECTED}")
            mesh = name_mesh(source) if isinstance(source, Mesh) else str(source)
            mapping = {"mesh": mesh, **({"label": label[0]} if label else {})}
        mappings.append(mapping)
    return mappings
