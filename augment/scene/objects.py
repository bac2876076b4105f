"""Load the objects of a scene: a mesh with the name of its class, props beside it and a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from augment.settings import MeshSettings, ObjectSettings, PropSettings, require_color
from renderer.camera import Camera
from renderer.errors import InputError
from renderer.geometry.mesh import (
    Mesh,
    center_and_extent,
    concatenate,
    normalize,
    select_faces,
    subdivide,
)
from renderer.geometry.shapes import solid
from renderer.shading.gloss import Gloss

# `add_table` makes each side of a table at least this far from the vertical axis through the
# origin, in world units.
MIN_TABLE_REACH = 1.2
# `add_table` makes a table reach at least this far beyond the object and its props, in world
# units.
TABLE_MARGIN = 0.2


@dataclass(frozen=True)
class SceneObject:
    """An object of a scene, with its props and its table.

    Attributes:
        label: Name of its class.
        mesh: A mesh whose first faces are those of the object, which spans
            [-1, 1]. The faces of props and table follow.
        albedo_scale: Factor of the albedo of all faces.
        name: Name of the object in messages.
        own: Number of the object's own faces. None if all faces are its own.
        props: Meshes of the props, which stand on z = 0.
        ground: Color of the table, or None without a table.
        center: Point of the mesh as it was given that is the origin of `mesh`,
            shape (3,).
        extent: Length in the mesh as it was given that is 1 in `mesh`. A vertex v
            of `mesh` lies at center + extent · v.
    """

    label: str
    mesh: Mesh
    albedo_scale: float = 1.0
    name: str = "the mesh"
    own: int | None = None
    props: Sequence[Mesh] = ()
    ground: Sequence[float] | None = None
    center: Sequence[float] = (0.0, 0.0, 0.0)
    extent: float = 1.0

    @classmethod
    def from_mesh(
        cls, label: str, given: Mesh, albedo_scale: float = 1.0, name: str = "the mesh"
    ) -> SceneObject:
        """Create an object from a mesh of any size at any place.

        Args:
            label: Name of its class.
            given: The mesh. The object has a copy that is moved and scaled to
                span [-1, 1].
            albedo_scale: Factor of the albedo of all faces.
            name: Name of the object in messages.

        Returns:
            The object, without props and table.
        """
        mesh = normalize(given)
        center, extent = center_and_extent(given)
        place = tuple(center.tolist())
        return cls(label, mesh, albedo_scale, name, center=place, extent=float(extent))

    @property
    def own_faces(self) -> np.ndarray:
        """Return a mask of the faces of the object itself, shape (F,).

        It is False for the faces of props and table.
        """
        face_count = len(self.mesh.faces)
        own_count = face_count if self.own is None else self.own
        return np.arange(face_count) < own_count

    @property
    def own_vertices(self) -> np.ndarray:
        """Return a mask of the vertices of the object itself, shape (V,).

        It is False for the vertices that a face of a prop or of the table uses.
        """
        corners_of_others = self.mesh.faces[~self.own_faces]
        return ~np.isin(np.arange(len(self.mesh.vertices)), corners_of_others)

    @cached_property
    def radius(self) -> float:
        """Return the largest distance of a vertex from the origin, including props and table."""
        distances = np.linalg.norm(self.mesh.vertices, axis=1)
        # A mesh may have vertices that no face uses. These do not count.
        return float(distances[self.mesh.faces].max())

    @property
    def lowest(self) -> float:
        """Return the height z of the lowest vertex, at which a table is placed."""
        heights = self.mesh.vertices[:, 2]
        # A mesh may have vertices that no face uses. These do not count.
        return float(heights[self.mesh.faces].min())

    def move_cameras(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """Move and scale cameras as the given mesh was moved and scaled to the object's mesh.

        Args:
            cameras: Cameras of the given mesh.

        Returns:
            Cameras that show the object's mesh as the others show the given
            mesh.
        """
        center = np.array(self.center)
        return tuple(camera.normalized(center, 1 / self.extent) for camera in cameras)

    def joined(self, others: Sequence[Mesh]) -> SceneObject:
        """Append other meshes to the mesh of the object.

        Args:
            others: The other meshes. They are not the object's own.

        Returns:
            The object with one mesh of all faces.
        """
        if not others:
            return self
        mesh = concatenate([self.mesh, *others])
        return replace(self, mesh=mesh, own=int(self.own_faces.sum()))


def load_object(item: ObjectSettings, vertices: int = 0) -> SceneObject:
    """Load an object and its props.

    Args:
        item: Settings of the object.
        vertices: The object's mesh is subdivided until it has more vertices
            than this number.

    Returns:
        The object, scaled and moved to span [-1, 1].

    Raises:
        InputError: If a mesh cannot be loaded, has colors besides those of the
            settings, or is a metal without a color.

    Example:
        >>> load_object(ObjectSettings("solid:orange", "orange")).label
        'orange'
    """
    mesh = subdivide(_load(item), vertices)
    loaded = SceneObject.from_mesh(item.label, mesh, item.albedo_scale, item.mesh)
    return with_props(loaded, [_load_prop(prop) for prop in item.props])


def with_props(item: SceneObject, props: Sequence[Mesh]) -> SceneObject:
    """Put props beside an object.

    Args:
        item: The object.
        props: Meshes that stand on z = 0. They are moved to the height of the
            object's lowest vertex.

    Returns:
        The object with its props.
    """
    offset = np.array([0, 0, item.lowest])
    raised = []
    for prop in props:
        # `normalize` rounds the vertices of the object to float32. Props are rounded
        # in the same way.
        vertices = (prop.vertices + offset).astype(np.float32)
        raised.append(replace(prop, vertices=vertices.astype(np.float64)))
    return replace(item.joined(raised), props=props)


def add_table(item: SceneObject, color: Sequence[float] | None) -> SceneObject:
    """Put a table under an object and its props.

    Args:
        item: The object. Its `albedo_scale` applies to the table, too.
        color: Red, green and blue of the table, sRGB-encoded in [0, 1]. None
            for no table.

    Returns:
        The object with its table.

    Raises:
        InputError: If the color is none.
    """
    if color is None:
        return item
    require_color("ground", color)
    used_vertices = np.unique(item.mesh.faces)
    # x and y of each vertex that a face uses.
    horizontal = item.mesh.vertices[used_vertices, :2]
    left, near = np.minimum(horizontal.min(0) - TABLE_MARGIN, -MIN_TABLE_REACH)
    right, far = np.maximum(horizontal.max(0) + TABLE_MARGIN, MIN_TABLE_REACH)
    corners = [
        [left, near, item.lowest],
        [right, near, item.lowest],
        [right, far, item.lowest],
        [left, far, item.lowest],
    ]
    table = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], np.array(color))
    return replace(item.joined([table]), ground=color)


def resample_instance(item: SceneObject, seed: int) -> SceneObject:
    """Replace a solid by another random shape of the same kind, such as another orange.

    Args:
        item: The object. Only a solid whose name has no seed, such as "solid:orange" and not
            "solid:orange:3", is replaced.
        seed: Seed of the instance.

    Returns:
        The new object with the same gloss, props and table, or the given
        object.
    """
    kind, *name_and_seed = item.name.split(":")
    if kind != "solid" or len(name_and_seed) != 1:
        return item
    mesh = normalize(solid(name_and_seed[0], seed))
    gloss = item.mesh.gloss
    if gloss is not None:
        # All faces of a solid have the same gloss.
        gloss = gloss[:1].repeat(len(mesh.faces), axis=0)
    return _with_mesh(item, replace(mesh, gloss=gloss))


def rotated(item: SceneObject, rotation: np.ndarray) -> SceneObject:
    """Rotate an object about the origin.

    Args:
        item: The object.
        rotation: Rotation matrix, shape (3, 3).

    Returns:
        The rotated object. The same props and table are at the height of its
        new lowest vertex.
    """
    # The faces of the object itself come first. `item.own` is their number, or None for all.
    mesh = select_faces(item.mesh, slice(item.own))
    # `normalize` rounds vertices to float32. Rotated vertices are rounded again.
    vertices = (mesh.vertices @ rotation.T).astype(np.float32)
    return _with_mesh(item, mesh.moved(vertices.astype(np.float64)))


def add_specular_layer(item: SceneObject, gloss: Gloss) -> SceneObject:
    """Return a copy of an object with another specular material.

    Args:
        item: Object, which may have props and a table.
        gloss: Specular material of the object. Props and table keep their own.

    Returns:
        The copy.
    """
    # The faces of the object itself come first. `item.own` is their number, or None for all.
    own_mesh = select_faces(item.mesh, slice(item.own))
    return _with_mesh(item, gloss.on(own_mesh))


def _with_mesh(item: SceneObject, mesh: Mesh) -> SceneObject:
    """Return a copy of an object with another mesh.

    Args:
        item: Object, which may have props and a table.
        mesh: New mesh of the object itself, without props and table.

    Returns:
        The copy. Its props and its table stand at the height of the new lowest vertex.
    """
    without_props = replace(item, mesh=mesh, own=None)
    return add_table(with_props(without_props, item.props), item.ground)


def _load_prop(item: PropSettings) -> Mesh:
    """Load the mesh of a prop, turn, scale and move it, and put it on z = 0."""
    mesh = normalize(_load(item))
    angle = math.radians(item.azimuth)
    cosine = math.cos(angle)
    sine = math.sin(angle)
    # This matrix is transposed, because it multiplies rows from the right.
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    turned = item.scale * mesh.vertices @ turn
    used_vertices = np.unique(mesh.faces)
    lowest = turned[used_vertices, 2].min()
    return replace(mesh, vertices=turned + np.array([*item.at, -lowest]), skin=None)


def _load(item: MeshSettings) -> Mesh:
    """Load a mesh with the color and the gloss of its settings.

    Raises:
        InputError: If the mesh is metallic and has no colors.
    """
    mesh = _load_with_color(item)
    if item.gloss is None:
        return mesh
    # With "file", the gloss of the file has been loaded with the mesh.
    if item.gloss != "file":
        mesh = _as_gloss(item.gloss).on(mesh)
    # Column 1 of the gloss is the metallic factor of each face.
    is_metal = mesh.gloss is not None and mesh.gloss[:, 1].any()
    if is_metal and item.color is None and not _has_colors(mesh):
        raise InputError(
            f"{item.mesh} is a metal without a color: "
            "give color=[red,green,blue], or a metallic of 0",
        )
    return mesh


def _load_with_color(item: MeshSettings) -> Mesh:
    """Load a mesh file or build a solid, and color it as its settings say."""
    kind, _, name = item.mesh.partition(":")
    if kind == "solid":
        mesh = _build_solid(item.mesh, name)
    else:
        # Importing trimesh takes half a second.
        from renderer.io.meshes import load_mesh

        mesh = load_mesh(item.mesh, up=item.up, gloss=item.gloss == "file")
    if item.color is None:
        return mesh
    if _has_colors(mesh):
        raise InputError(
            f"color is set, but {item.mesh} has its own colors: "
            "remove color, and set albedo_scale to make them brighter or darker",
        )
    colored = Mesh.plain(mesh.vertices, mesh.faces, np.array(item.color))
    return replace(colored, gloss=mesh.gloss, skin=mesh.skin)


def _build_solid(mesh_name: str, name_and_seed: str) -> Mesh:
    """Build a solid.

    Args:
        mesh_name: Full name for error messages, such as "solid:orange:3".
        name_and_seed: Name and seed of the solid, such as "orange:3". The seed is 0 if it is
            left out.

    Returns:
        The mesh.
    """
    name, _, seed = name_and_seed.partition(":")
    if seed and not seed.isdecimal():
        raise InputError(f"{mesh_name}: its seed is {seed!r}, give a whole number")
    try:
        return solid(name, int(seed or 0))
    # The name is unknown, or the seed is no number.
    except ValueError as error:
        raise InputError(f"{mesh_name}: {error}") from error


def _has_colors(mesh: Mesh) -> bool:
    """Return whether a mesh has textures, or vertex colors other than white."""
    return bool(mesh.textures) or bool((mesh.corner_colors != 1).any())


def _as_gloss(values: Sequence[float]) -> Gloss:
    """Convert the values of the setting `gloss` to a gloss.

    Args:
        values: Roughness, metallic and specular factor. The last value, or the last two, may be
            left out.

    Returns:
        The gloss. Values that are left out have the defaults of `Gloss`.
    """
    roughness, *others = [float(value) for value in values]
    return Gloss(roughness, *others)
