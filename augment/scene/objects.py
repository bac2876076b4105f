"""What a scene shows: objects, examples and conditions.

An object is a mesh with the name of its class, others beside it and a table. An example is such an
object seen by cameras. Conditions are the light, the shape and the colors with which it is
rendered.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.settings import MeshSettings, ObjectSettings
from renderer.camera import Camera
from renderer.errors import InputError, ShortRepr, as_tensor, keyed
from renderer.io.meshes import load_mesh
from renderer.mesh import Mesh, center_and_extent, concatenate, normalize, select_faces, subdivide
from renderer.solids import solid
from renderer.surface.gloss import Gloss

# Smallest distance of the sides of a table from its center below the object, in world units.
MIN_TABLE_REACH = 1.2
# Smallest distance by which a table extends beyond all objects on it, in world units.
TABLE_MARGIN = 0.2
# Smallest distance between objects that have no position, in world units.
GAP = 0.2
# Meshes that callers of Python functions gave, by the names of `name_mesh`.
MESHES_IN_MEMORY: WeakValueDictionary[str, Mesh] = WeakValueDictionary()


@dataclass(frozen=True)
class SceneObject:
    """The objects of an entry of a scene, of which the first is attacked, and their table.

    Attributes:
        label: Name or index of the class of the first object.
        mesh: One mesh of all faces: first those of the first object, which spans
            [-1, 1], then those of the others and of the table.
        albedo_scale: Factor that multiplies the albedo of all faces.
        name: Name of the object in messages.
        own: Number of faces of the first object. None if the mesh has no others
            and no table.
        others: Label, empty for none, and mesh of each other object. They stand on
            the plane z = 0.
        ground: Color of the table. None for no table.
        center: Center of the mesh before normalization, shape (3,).
        extent: Scale of the mesh before normalization. A vertex v of `mesh` was
            at center + extent · v before.
        source: Arguments of `load_object`, with which other instances are loaded.
    """

    label: str | int
    mesh: Mesh
    albedo_scale: float = 1.0
    name: str = "the mesh"
    own: int | None = None
    others: Sequence[tuple[str | int, Mesh]] = ()
    ground: Sequence[float] | None = None
    center: Sequence[float] = (0.0, 0.0, 0.0)
    extent: float = 1.0
    source: tuple[ObjectSettings, int, str] | None = None

    @classmethod
    def from_mesh(
        cls, label: str | int, given: Mesh, albedo_scale: float = 1.0, name: str = "the mesh"
    ) -> SceneObject:
        """Create an object from a mesh of any size at any place.

        Args:
            label: Name or index of the class of the object.
            given: The mesh. The object gets a copy that is moved and scaled to
                span [-1, 1].
            albedo_scale: Factor that multiplies the albedo of all faces.
            name: Name of the object in messages.

        Returns:
            The object, without others and table.
        """
        center, extent = center_and_extent(given)
        place, mesh = tuple(center.tolist()), normalize(given)
        return cls(label, mesh, albedo_scale, name, center=place, extent=float(extent))

    @property
    def own_faces(self) -> np.ndarray:
        """Return a mask of the faces that belong to the object itself, shape (F,).

        The other faces belong to other objects or to a table.
        """
        return np.arange(len(self.mesh.faces)) < (math.inf if self.own is None else self.own)

    @property
    def labels(self) -> list[str | int]:
        """Return the labels of the first and the other objects, which are empty for none."""
        return [self.label, *(label for label, _ in self.others)]

    @property
    def ends(self) -> np.ndarray:
        """Return the number of faces up to the end of each object, shape (O,)."""
        return np.cumsum([int(self.own_faces.sum()), *(len(mesh.faces) for _, mesh in self.others)])

    @property
    def own_vertices(self) -> np.ndarray:
        """Return a mask of the vertices that belong to the object itself, shape (V,).

        The other vertices belong to faces of other objects or of a table.
        """
        return ~np.isin(np.arange(len(self.mesh.vertices)), self.mesh.faces[~self.own_faces])

    @property
    def own_mesh(self) -> Mesh:
        """Return the mesh of the first object, whose faces come first, without others and table."""
        return select_faces(self.mesh, slice(self.own))

    @cached_property
    def radius(self) -> float:
        """Return the largest distance of a vertex from the origin, including others and table."""
        # Index by faces, to ignore vertices that no face uses.
        return float(np.linalg.norm(self.mesh.vertices, axis=1)[self.mesh.faces].max())

    @property
    def lowest(self) -> float:
        """Return the height z of the lowest vertex, at which a table is placed."""
        # Index by faces, to ignore vertices that no face uses.
        return float(self.mesh.vertices[self.mesh.faces, 2].min())

    def move_cameras(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """Move and scale cameras in the same way as the mesh was normalized.

        Args:
            cameras: Cameras around the mesh before normalization.

        Returns:
            Cameras whose images of the normalized mesh are the same as those of
            the given cameras before normalization.
        """
        return tuple(each.normalized(np.array(self.center), 1 / self.extent) for each in cameras)

    def joined(self, others: Sequence[Mesh]) -> SceneObject:
        """Append the faces of other meshes to the mesh of the object.

        Args:
            others: Meshes of other objects or of a table. Their faces do not count as
                faces of the object itself.

        Returns:
            A copy of the object with one mesh of all faces.
        """
        if not others:
            return self
        return replace(self, mesh=concatenate([self.mesh, *others]), own=int(self.own_faces.sum()))


def name_mesh(mesh: Mesh) -> str:
    """Name a mesh in memory by its content, so that settings, which hold texts, can name it.

    `load_object` finds the mesh by this name as long as the caller keeps the mesh.
    """
    # Hash the names, types, shapes and values of all arrays of the mesh.
    digest = hashlib.sha256()
    for field in fields(mesh):
        value = getattr(mesh, field.name)
        arrays = value if isinstance(value, tuple) else () if value is None else (value,)
        for array in arrays:
            digest.update(f"{field.name}{array.dtype}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data)
    name = f"mesh_in_memory_{digest.hexdigest()[:8]}"
    MESHES_IN_MEMORY[name] = mesh
    return name


def load_object(item: ObjectSettings, vertices: int = 0, encoding: str = "linear") -> SceneObject:
    """Load an object and the others beside it.

    The first object spans [-1, 1]. It is subdivided until it has more than `vertices` vertices.
    Objects without a position stand to the right and to the left of all before them, by turns.
    """
    item.require_first_place()
    mesh = subdivide(_load(item), vertices, encoding)
    loaded = SceneObject.from_mesh(item.label, mesh, item.albedo_scale, item.mesh)
    loaded = replace(loaded, source=(item, vertices, encoding))
    if item.azimuth:
        loaded = rotated(loaded, _turn(item.azimuth))
    others = [_load_other(other) for other in item.others]
    # Smallest and largest y of all objects with a position. The first may turn about the origin.
    spans = [_span_of_y(mesh) for mesh, given in zip(others, item.others, strict=True) if given.at]
    ends = np.array([-loaded.radius, loaded.radius, *(end for span in spans for end in span)])
    left, right = ends.min(), ends.max()
    # Put the others without a position at the ends of the row, with a gap.
    free = [index for index, given in enumerate(item.others) if given.at is None]
    for turn, index in enumerate(free):
        low, high = _span_of_y(others[index])
        shift = left - GAP - high if turn % 2 else right + GAP - low
        left, right = min(left, low + shift), max(right, high + shift)
        moved = others[index].vertices + np.array([0, shift, 0])
        others[index] = replace(others[index], vertices=moved)
    return with_others(loaded, [*zip([other.label for other in item.others], others, strict=True)])


def with_others(item: SceneObject, others: Sequence[tuple[str | int, Mesh]]) -> SceneObject:
    """Put labeled meshes, which attacks do not change, beside an object.

    They stand on the plane z = 0 and are moved to the height of the lowest vertex of the object.
    """
    offset = np.array([0, 0, item.lowest])
    raised = [replace(mesh, vertices=_rounded(mesh.vertices + offset)) for _, mesh in others]
    return replace(item.joined(raised), others=others)


def _rounded(vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """Round vertices to float32, as `normalize` does."""
    return vertices.astype(np.float32).astype(np.float64)


def add_table(item: SceneObject, color: Sequence[float] | None) -> SceneObject:
    """Put a table under all objects of an entry.

    The color is sRGB-encoded. None stands for no table.
    """
    if color is None:
        return item
    # Horizontal coordinates x and y of the vertices that a face uses.
    horizontal = item.mesh.vertices[np.unique(item.mesh.faces), :2]
    # Smallest and largest x and y of the table, with a margin around the objects.
    left, near = np.minimum(horizontal.min(0) - TABLE_MARGIN, -MIN_TABLE_REACH)
    right, far = np.maximum(horizontal.max(0) + TABLE_MARGIN, MIN_TABLE_REACH)
    square = ((left, near), (right, near), (right, far), (left, far))
    corners = [[x, y, item.lowest] for x, y in square]
    table = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], np.array(color))
    return replace(item.joined([table]), ground=color)


def resample_instance(item: SceneObject, seed: int) -> SceneObject:
    """Replace a generated solid by another random shape of its kind, such as another orange.

    A solid that is named with a seed, such as "solid:orange:3", and other meshes stay as they are.
    """
    # The name of a solid is "solid:NAME" or "solid:NAME:SEED".
    kind, *name_and_seed = item.name.split(":")
    if kind != "solid" or len(name_and_seed) != 1 or item.source is None:
        return item
    settings, vertices, encoding = item.source
    settings = replace(settings, mesh=f"{item.name}:{seed}", others=[])
    return with_own_mesh(item, load_object(settings, vertices, encoding).mesh)


def rotated(item: SceneObject, rotation: Float[np.ndarray, "3 3"]) -> SceneObject:
    """Rotate an object about the origin. The others and the table do not rotate.

    They stand at the height of its new lowest vertex.
    """
    mesh = item.own_mesh
    return with_own_mesh(item, replace(mesh, vertices=_rounded(mesh.vertices @ rotation.T)))


def with_own_mesh(item: SceneObject, mesh: Mesh) -> SceneObject:
    """Return a copy with another mesh of the first object. The others and the table stay."""
    return add_table(with_others(replace(item, mesh=mesh, own=None), item.others), item.ground)


def _turn(azimuth: float) -> Float[np.ndarray, "3 3"]:
    """Return the matrix of a rotation about the vertical, by an angle in degrees."""
    cosine, sine = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def _load_other(item: ObjectSettings) -> Mesh:
    """Load the mesh of an object beside another one, and put it on the plane z = 0."""
    mesh = normalize(_load(item))
    # Rows are points, so the rotation matrix is transposed.
    turned = item.scale * mesh.vertices @ _turn(item.azimuth).T
    lowest = turned[mesh.faces, 2].min()
    return replace(mesh, vertices=turned + np.array([*(item.at or (0.0, 0.0)), -lowest]))


def _span_of_y(mesh: Mesh) -> tuple[float, float]:
    """Return the smallest and the largest y of the faces of a mesh."""
    y = mesh.vertices[mesh.faces, 1]
    return float(y.min()), float(y.max())


def _load(item: MeshSettings) -> Mesh:
    """Load a mesh file or generate a solid, and give it the color and the gloss of its settings."""
    kind, _, name = item.mesh.partition(":")
    if item.mesh in MESHES_IN_MEMORY:
        mesh = MESHES_IN_MEMORY[item.mesh]
    elif kind == "solid":
        name, _, seed = name.partition(":")
        if seed and not seed.isdecimal():
            raise InputError(f"{item.mesh} has the seed {seed!r}: give a whole number")
        with keyed(item.mesh):
            mesh = solid(name, int(seed or 0))
    else:
        mesh = load_mesh(item.mesh, up=item.up, gloss=item.gloss == "file")
    # Meshes without colors of their own are white.
    has_textures = any((texture < 255).any() for texture in mesh.textures)
    has_colors = has_textures or bool((mesh.corner_colors != 1).any())
    if item.color is not None:
        if has_colors:
            advice = "remove color, and set albedo_scale to make them brighter or darker"
            raise InputError(f"color is set, but {item.mesh} has its own colors: {advice}")
        colors = Mesh.plain(mesh.vertices, mesh.faces, np.array(item.color)).corner_colors
        mesh = replace(mesh, corner_colors=colors)
    if item.gloss not in (None, "file"):
        # The order of the values is roughness, metallic, specular factor.
        mesh = Gloss(*(float(value) for value in item.gloss)).on(mesh)
    is_metal = mesh.gloss is not None and mesh.gloss[:, METALLIC].any()
    has_no_color = item.color is None and not mesh.textures and not has_colors
    if item.gloss is not None and is_metal and has_no_color:
        advice = "give color=[red,green,blue], or a metallic of 0"
        raise InputError(f"{item.mesh} is a metal without a color: {advice}")
    return mesh


# Each face has three numbers: roughness, metallic and specular factor. These are the positions of
# the first two.
ROUGHNESS = 0
METALLIC = 1

# Roughness, metallic and specular factor of a matte surface, which is neither specular nor
# metallic.
MATTE = (1.0, 0.0, 0.0)
# Roughness, metallic and specular factor with which an attack on a matte object starts.
SPECULAR_LAYER = (0.5, 0.0, 1.0)


def initial_materials(item: SceneObject) -> Float[Tensor, "F 3"]:
    """Return the materials with which an attack on the material of an object starts.

    They are roughness, metallic and specular factor of the F faces of the mesh. If the object is
    matte (metallic and specular factor are zero on all its faces), its faces get the material
    `SPECULAR_LAYER`. Others and table keep their materials.
    """
    object_mask = torch.from_numpy(item.own_faces)
    face_gloss = torch.tensor([MATTE]).expand(len(object_mask), 3)
    if item.mesh.gloss is not None:
        face_gloss = torch.from_numpy(item.mesh.gloss)
    # A matte object has no metallic and no specular factor, which are the last two columns.
    if not face_gloss[object_mask, METALLIC:].any():
        specular_layer = face_gloss.new_tensor(SPECULAR_LAYER)
        face_gloss = torch.where(object_mask[:, None], specular_layer, face_gloss)
    return face_gloss


# Fields of `Conditions` whose second axis is the faces of a mesh.
OF_FACES = ("albedo", "gloss", "hue")


@dataclass(frozen=True)
class Example:
    """Example of a scene: an object in front of a background, seen from V cameras.

    Attributes:
        object: Index of the object among the objects of the scene.
        cameras: The V cameras.
        background: Index of the background among the backgrounds of the scene.
        exposure: Factor that multiplies the environment light of the scene.
    """

    object: int
    cameras: tuple[Camera, ...]
    background: int
    exposure: float = 1.0


def with_field(examples: Sequence[Example], name: str, values: Iterable[Any]) -> list[Example]:
    """Return copies of examples, each with its own value of a field."""
    pairs = zip(examples, values, strict=True)
    return [replace(example, **{name: value}) for example, value in pairs]


@dataclass(frozen=True, repr=False)
class Conditions(ShortRepr):
    """Light, shape and colors with which A examples are rendered.

    N and F are the numbers of vertices and faces of the largest mesh of the scene. A smaller mesh
    uses only the first of the N or F entries. A field that is None changes nothing in the scene.

    Attributes:
        light: RGB coefficients of all lights in the scene's basis, shape (A, coefficients, 3).
        vertices: Positions of the vertices, shape (A, N, 3).
        albedo: Linear RGB that is added to the albedo of each face, shape (A, F, 3).
        pixels: Offsets that are added to the pixel values of the V images, shape
            (A, V, 3, height, width).
        positions: Positions of the L lamps, shape (A, L, 3).
        cameras: Change of the polar angle in degrees, change of the azimuth in degrees, and
            change of the logarithm of the distance, shape (A, 3). They apply to all V cameras of
            an example.
        gloss: Roughness, metallic and specular factor of each face, shape (A, F, 3), or of all
            faces, shape (A, 1, 3). Textures of gloss are multiplied by them. Shadows
            and bounces of environment light still have the gloss of the mesh.
        hue: Angle in degrees by which the hue of the albedo of each face is turned, before the
            addition of `albedo`, shape (A, F).
    """

    light: Float[Tensor, "... coefficients 3"]
    vertices: Float[Tensor, "... N 3"] | None = None
    albedo: Float[Tensor, "... F 3"] | None = None
    pixels: Float[Tensor, "... V 3 height width"] | None = None
    positions: Float[Tensor, "... L 3"] | None = None
    cameras: Float[Tensor, "... 3"] | None = None
    gloss: Float[Tensor, "... 1 3"] | Float[Tensor, "... F 3"] | None = None
    hue: Float[Tensor, "... F"] | None = None

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            if values is not None and not isinstance(values, Tensor):
                object.__setattr__(self, name, as_tensor(name, values))
        if self.hue is not None and self.albedo is None:
            # The renderer rotates hues only where it adds a color to the albedo, so add 0.
            object.__setattr__(self, "albedo", self.hue.new_zeros(*self.hue.shape, 3))

    def row(self, index: int, mesh: Mesh) -> Conditions:
        """Return the conditions of one example, without the dimension of the examples.

        Args:
            index: Index of the example in the first dimension of all fields.
            mesh: Mesh of the example. Entries of vertices and faces are cut to the numbers of
                its vertices and faces.
        """
        rows = {name: field[index] for name, field in vars(self).items() if field is not None}
        # Only these fields are padded to the size of the largest mesh.
        counts = {"vertices": len(mesh.vertices)} | dict.fromkeys(OF_FACES, len(mesh.faces))
        return Conditions(**{name: row[: counts.get(name)] for name, row in rows.items()})
