"""What a scene shows: meshes from files or solids, each with the name of its class."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from renderer.errors import FACTOR, InputError, require_range
from renderer.mesh import Mesh, concatenate, load_mesh, normalise
from renderer.shapes import solid
from renderer.subdivision import subdivide

GROUND = 1.2  # half a table's width: its corners are within what cameras see in depth


@dataclass
class ObjectSettings:
    """One mesh of a scene.

    mesh: a file that trimesh reads, or `solid:NAME` or `solid:NAME:SEED`, a built-in procedural solid. label: the
    name of its class. up: the axis that points up in the file, auto|y|z. gain: multiplies the albedo. color: RGB (3),
    sRGB-encoded in [0, 1], of a mesh that brings no colours.
    """

    mesh: str
    label: str
    up: str = "auto"
    gain: float = 1.0
    color: list[float] | None = None

    def __post_init__(self) -> None:
        if not self.mesh:
            raise InputError("scene.meshes: a mesh is '': give a file or solid:NAME")
        require_range(f"scene.meshes: {self.mesh}: gain", self.gain, 1 / FACTOR, FACTOR)
        if self.color is not None and (len(self.color) != 3 or not all(0 <= each <= 1 for each in self.color)):
            raise InputError(f"scene.meshes: {self.mesh}: color={self.color} must be red, green and blue from 0 to 1")


@dataclass(frozen=True)
class SceneObject:
    """A mesh that spans [-1, 1], the name of its class, what multiplies its albedo, and its own name in messages.

    ground: the colour of the table that the mesh ends in, if it stands on one.
    """

    label: str
    mesh: Mesh
    gain: float = 1.0
    name: str = "the mesh"
    ground: Sequence[float] | None = None


def load_object(item: ObjectSettings, vertices: int = 0) -> SceneObject:
    """The mesh, subdivided until it has more than so many vertices, and normalised.

    InputError: as `load_mesh` and `solid`.
    """
    mesh = _load(item)
    if item.color is not None:
        mesh = _colored(mesh, item)
    return SceneObject(item.label, normalise(subdivide(mesh, vertices)), item.gain, item.mesh)


def on_ground(item: SceneObject, color: Sequence[float] | None) -> SceneObject:
    """The object on a square table, as one mesh; color: RGB, sRGB-encoded in [0, 1], multiplied with the gain, too, or
    None for no table.

    InputError: no colour.
    """
    if color is None:
        return item
    if len(color) != 3 or not all(0 <= each <= 1 for each in color):
        raise InputError(f"scene.ground={color} must be red, green and blue from 0 to 1")
    lowest = item.mesh.vertices[np.unique(item.mesh.faces), 2].min()
    corners = [[x * GROUND, y * GROUND, lowest] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    table = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], np.array(color))
    return replace(item, mesh=concatenate([item.mesh, table]), ground=color)


def another_individual(item: SceneObject, seed: int) -> SceneObject:
    """Another of the same kind, on the same table, where the object is a solid named without a seed, and otherwise the
    object itself."""
    kind, *rest = item.name.split(":")
    if kind != "solid" or len(rest) != 1:
        return item
    return on_ground(replace(item, mesh=normalise(solid(rest[0], seed))), item.ground)


def _colored(mesh: Mesh, item: ObjectSettings) -> Mesh:
    if not mesh.uncolored:
        raise InputError(
            f"scene.meshes: {item.mesh} brings colours of its own: leave color out; gain brightens or dims them"
        )
    return Mesh.plain(mesh.vertices, mesh.faces, np.array(item.color))


def _load(item: ObjectSettings) -> Mesh:
    kind, _, name = item.mesh.partition(":")
    if kind != "solid":
        return load_mesh(item.mesh, up=item.up)
    name, _, seed = name.partition(":")
    if seed and not seed.isdecimal():
        raise InputError(f"scene.meshes: the seed in {item.mesh!r} must be a whole number, as in solid:orange:3")
    return solid(name, int(seed or 0))
