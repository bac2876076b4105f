"""What a scene shows: meshes from files or solids, each with the name of its class."""

from dataclasses import dataclass, replace

from renderer.errors import FACTOR, InputError, require_range
from renderer.mesh import Mesh, load_mesh, normalise
from renderer.shapes import solid
from renderer.subdivision import subdivide


@dataclass
class ObjectSettings:
    """One mesh of a scene.

    mesh: a file that trimesh reads, or `solid:NAME` or `solid:NAME:SEED`, a built-in procedural solid. label: the
    name of its class. up: the axis that points up in the file, auto|y|z. gain: multiplies the albedo.
    """

    mesh: str
    label: str
    up: str = "auto"
    gain: float = 1.0

    def __post_init__(self) -> None:
        if not self.mesh:
            raise InputError("scene.meshes: a mesh is '': give a file or solid:NAME")
        require_range(f"scene.meshes: {self.mesh}: gain", self.gain, 1 / FACTOR, FACTOR)


@dataclass(frozen=True)
class SceneObject:
    """A mesh that spans [-1, 1], the name of its class, what multiplies its albedo, and its own name in messages."""

    label: str
    mesh: Mesh
    gain: float = 1.0
    name: str = "the mesh"


def load_object(item: ObjectSettings, vertices: int = 0) -> SceneObject:
    """The mesh, subdivided until it has more than so many vertices, and normalised.

    InputError: as `load_mesh` and `solid`.
    """
    return SceneObject(item.label, normalise(subdivide(_load(item), vertices)), item.gain, item.mesh)


def another_individual(item: SceneObject, seed: int) -> SceneObject:
    """Another of the same kind, where the object is a solid named without a seed, and otherwise the object itself."""
    kind, *rest = item.name.split(":")
    if kind != "solid" or len(rest) != 1:
        return item
    return replace(item, mesh=normalise(solid(rest[0], seed)))


def _load(item: ObjectSettings) -> Mesh:
    kind, _, name = item.mesh.partition(":")
    if kind != "solid":
        return load_mesh(item.mesh, up=item.up)
    name, _, seed = name.partition(":")
    if seed and not seed.isdecimal():
        raise InputError(f"scene.meshes: the seed in {item.mesh!r} must be a whole number, as in solid:orange:3")
    return solid(name, int(seed or 0))
