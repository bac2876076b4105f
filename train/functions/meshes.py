"""The meshes that callers name, as the settings take them."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from augment.classifiers import Classifier
from augment.settings import ObjectSettings
from renderer.errors import InputError, describe
from renderer.geometry.mesh import Mesh
from renderer.io.export import export_mesh
from renderer.io.files import atomic_write
from renderer.validation import as_list
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
    name: str, meshes: Sequence[MeshItem], classifier: Classifier, folder: Path
) -> list[dict[str, Any]]:
    """Convert meshes to mappings with the fields of `ObjectSettings`.

    Args:
        name: Name of the argument, for errors.
        meshes: Meshes, with or without their classes.
        classifier: Classifier whose classes the labels name or count.
        folder: Folder to which meshes in memory are written, since settings
            name files.

    Returns:
        The mappings. Without a class, a mapping has no key "label".

    Raises:
        InputError: If an item is something else, or if the classifier lacks a
            class.
    """
    kinds = MeshSource | tuple | list | ObjectSettings
    mappings = []
    for index, item in enumerate(as_list(name, meshes, kinds, EXPECTED)):
        if isinstance(item, ObjectSettings):
            mapping = asdict(item)
        elif isinstance(item, MeshSource):
            mapping = _of_source(item, folder)
        elif len(item) == 2 and isinstance(item[0], MeshSource):
            source, label = item
            mapping = _of_source(source, folder) | {"label": label}
        else:
            raise InputError(f"{name}[{index}] is {describe(item)}: give {EXPECTED}")
        if mapping.get("label", "") != "":
            mapping["label"] = classifier.classes[classifier.label(mapping["label"])]
        mappings.append(mapping)
    return mappings


def _of_source(source: MeshSource, folder: Path) -> dict[str, Any]:
    """Describe a mesh by fields of `ObjectSettings`.

    Args:
        source: File, solid or mesh in memory.
        folder: Folder to which a mesh in memory is written.

    Returns:
        Mapping with the key "mesh". A mesh in memory has "gloss" in addition.
    """
    if not isinstance(source, Mesh):
        return {"mesh": str(source)}
    with TemporaryDirectory() as temporary:
        written = Path(temporary) / "mesh.glb"
        export_mesh(source, written)
        content = written.read_bytes()
    # The hash in the name keeps the meshes of an earlier call in the folder.
    path = folder / f"mesh_{hashlib.sha256(content).hexdigest()[:8]}.glb"
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write(path, content)
    return {"mesh": str(path), "gloss": None if source.gloss is None else "file"}


def studied_classes(
    label: str | int | None,
    given: Sequence[MeshItem],
    meshes: Sequence[dict[str, Any]],
    classifier: Classifier,
) -> list[str]:
    """Return the positive classes.

    Args:
        label: A class, or None for those of the meshes.
        given: Meshes as the caller gave them.
        meshes: The same meshes as `as_mappings` returns them.
        classifier: Classifier that has the classes.

    Returns:
        Names of the classes, each once, in the order of the meshes.

    Raises:
        InputError: If the classifier lacks the class, or if neither `label` nor
            a mesh tells a class.
    """
    if label is not None:
        return [classifier.classes[classifier.label(label)]]
    for index, item in enumerate(given):
        if isinstance(item, Mesh):
            name = classifier.classes[0]
            raise InputError(
                f"meshes[{index}] is an nb.Mesh without a class: give it in a pair, such as "
                f"(mesh, {name!r}), or give label={name!r}"
            )
    return list(dict.fromkeys(classes_of_meshes(meshes, classifier.classes, "meshes")))
