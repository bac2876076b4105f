"""Arguments of functions that run a command: meshes, and the folder of the results."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from augment.classifier import Classifier
from augment.scene.objects import name_mesh
from augment.settings import ObjectSettings
from renderer.errors import InputError, as_folder, as_list, describe
from renderer.mesh import Mesh
from train.class_names import classes_of_meshes

# File of a mesh, solid:NAME, or the mesh itself.
MeshSource = str | Path | Mesh
# A mesh as an argument: alone, in a pair with its class, or as settings.
MeshItem = MeshSource | tuple[MeshSource, str | int] | ObjectSettings
EXPECTED = (
    "a list of files, of solids such as 'solid:orange', of nb.Mesh, of pairs of these and a class "
    "such as ('orange.glb', 'orange'), or of nb.ObjectSettings"
)


def as_mappings(
    name: str, meshes: Sequence[MeshItem], classifier: Classifier
) -> list[dict[str, Any]]:
    """Convert the meshes of a caller to mappings with the fields of `ObjectSettings`.

    A mapping has a "label" if the class is given.
    """
    kinds = MeshSource | tuple | list | ObjectSettings
    mappings = []
    for index, item in enumerate(as_list(name, meshes, kinds, EXPECTED)):
        mapping: dict[str, Any]
        if isinstance(item, ObjectSettings):
            mapping = asdict(item)
        elif isinstance(item, MeshSource):
            mapping = {"mesh": _name(item)}
        elif len(item) == 2 and isinstance(item[0], MeshSource):
            source, label = item
            mapping = {"mesh": _name(source), "label": label}
        else:
            raise InputError(f"{name}[{index}] is {describe(item)}: give {EXPECTED}")
        if mapping.get("label", "") != "":
            mapping["label"] = classifier.classes[classifier.label(mapping["label"])]
        mappings.append(mapping)
    return mappings


def _name(source: MeshSource) -> str:
    """Return the text that names a mesh in settings: its file, its solid, or a name in memory."""
    return name_mesh(source) if isinstance(source, Mesh) else str(source)


def find_positive_classes(
    label: str | int | None,
    meshes: Sequence[MeshItem],
    mappings: Sequence[dict[str, Any]],
    classifier: Classifier,
) -> list[str]:
    """Return the names of the classes that the meshes of a caller show.

    Without a label, each class of the meshes is listed once, in their order. `mappings` come from
    `as_mappings`.
    """
    if label is not None:
        return [classifier.classes[classifier.label(label)]]
    for index, item in enumerate(meshes):
        if isinstance(item, Mesh):
            name = classifier.classes[0]
            raise InputError(
                f"meshes[{index}] is an nb.Mesh without a class: give it in a pair, such as "
                f"(mesh, {name!r}), or give label={name!r}"
            )
    names = classes_of_meshes(mappings, classifier.classes, "meshes")
    # A dictionary has each name once, in the order of the meshes.
    return list(dict.fromkeys(names))


@contextmanager
def folder_or_temporary(out: str | Path | None) -> Iterator[Path]:
    """Yield a folder for files: the folder of the caller, or a temporary folder.

    A temporary folder is removed at the end of the block.
    """
    if out is not None:
        yield as_folder("out", out)
        return
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield Path(folder)
