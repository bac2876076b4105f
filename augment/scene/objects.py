"""Objects of a scene: meshes from files or solids, each with the name of its class, props and a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from augment.settings import MeshSettings, ObjectSettings, PropSettings, require_color
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh, concatenate, normalize, select_faces, subdivide
from renderer.geometry.shapes import solid
from renderer.surface.gloss import Gloss

TABLE, RIM = 1.2, 0.2  # half the width of a table, at least; and how far it reaches beyond everything


@dataclass(frozen=True)
class SceneObject:
    """A mesh that spans [-1, 1], the name of its class, a factor of its albedo, and its own name in messages.

    The mesh has the faces of props and table, whose albedo is multiplied, too, after the object's own. own: the number
    of the object's faces, None where all are. props: their meshes, on z = 0. ground: the table's color, or None.
    """

    label: str
    mesh: Mesh
    albedo_scale: float = 1.0
    name: str = "the mesh"
    own: int | None = None
    props: Sequence[Mesh] = ()
    ground: Sequence[float] | None = None

    @property
    def own_faces(self) -> np.ndarray:
        """(F,) bool: the object's, not those of props and table."""
        return np.arange(len(self.mesh.faces)) < (len(self.mesh.faces) if self.own is None else self.own)

    @property
    def own_vertices(self) -> np.ndarray:
        """(V,) bool: all but those of props and table."""
        others = self.mesh.faces[~self.own_faces]
        return ~np.isin(np.arange(len(self.mesh.vertices)), others)

    @cached_property
    def radius(self) -> float:
        """Of a ball around the origin that holds the whole mesh, props and table included."""
        return float(np.linalg.norm(self.mesh.vertices, axis=1)[self.mesh.faces].max())

    @property
    def lowest(self) -> float:
        """The height of the ground that it stands on."""
        return float(self.mesh.vertices[:, 2][self.mesh.faces].min())

    def joined(self, others: Sequence[Mesh]) -> SceneObject:
        """The object with other meshes in its own."""
        if not others:
            return self
        return replace(self, mesh=concatenate([self.mesh, *others]), own=int(self.own_faces.sum()))


def load_object(item: ObjectSettings, vertices: int = 0) -> SceneObject:
    """The mesh, subdivided until it has more than `vertices`, and normalized; with its props.

    InputError: as `load_mesh` and `solid`.
    """
    mesh = normalize(subdivide(_load(item), vertices))
    return with_props(SceneObject(item.label, mesh, item.albedo_scale, item.mesh), [_prop(prop) for prop in item.props])


def with_props(item: SceneObject, props: Sequence[Mesh]) -> SceneObject:
    """The object among meshes that stand on z = 0, moved to its ground."""
    height = np.array([0, 0, item.lowest])
    raised = [(prop.vertices + height).astype(np.float32) for prop in props]  # rounded as the object is
    meshes = [replace(prop, vertices=vertices.astype(np.float64)) for prop, vertices in zip(props, raised, strict=True)]
    return replace(item.joined(meshes), props=props)


def on_ground(item: SceneObject, color: Sequence[float] | None) -> SceneObject:
    """The object on a table under everything, as one mesh; color: RGB, sRGB-encoded in [0, 1], or None for no table.

    The table's albedo is scaled, too. InputError: not a color.
    """
    if color is None:
        return item
    require_color("ground", color)
    across = item.mesh.vertices[np.unique(item.mesh.faces), :2]
    (left, near), (right, far) = np.minimum(across.min(0) - RIM, -TABLE), np.maximum(across.max(0) + RIM, TABLE)
    corners = [[x, y, item.lowest] for x, y in ((left, near), (right, near), (right, far), (left, far))]
    table = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], np.array(color))
    return replace(item.joined([table]), ground=color)


def another_instance(item: SceneObject, seed: int) -> SceneObject:
    """Another instance of a solid named without a seed, with the same props and table; of others, the object itself."""
    kind, *rest = item.name.split(":")
    if kind != "solid" or len(rest) != 1:
        return item
    mesh, gloss = normalize(solid(rest[0], seed)), item.mesh.gloss
    gloss = None if gloss is None else gloss[:1].repeat(len(mesh.faces), axis=0)  # of a solid, all faces have the same
    return _with_mesh(item, replace(mesh, gloss=gloss))


def rotated(item: SceneObject, rotation: np.ndarray) -> SceneObject:
    """The object after a rotation (3, 3) about the origin, with the same props and table at its new lowest point."""
    mesh = select_faces(item.mesh, slice(item.own))
    vertices = (mesh.vertices @ rotation.T).astype(np.float32)  # rounded as by `normalize`
    return _with_mesh(item, mesh.moved(vertices.astype(np.float64)))


def varnished(item: SceneObject, gloss: Gloss) -> SceneObject:
    """The object with this gloss in place of its own, and with the same props and table."""
    return _with_mesh(item, gloss.on(select_faces(item.mesh, slice(item.own))))


def _with_mesh(item: SceneObject, mesh: Mesh) -> SceneObject:
    """The same props and table with another object's mesh."""
    return on_ground(with_props(replace(item, mesh=mesh, own=None), item.props), item.ground)


def _prop(item: PropSettings) -> Mesh:
    """Turned, scaled and moved to its position on z = 0."""
    mesh, angle = normalize(_load(item)), math.radians(item.azimuth)
    turn = np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    turned = item.scale * mesh.vertices @ turn
    lowest = turned[np.unique(mesh.faces), 2].min()
    return replace(mesh, vertices=turned + np.array([*item.at, -lowest]), skin=None)


def _load(item: MeshSettings) -> Mesh:
    mesh = _colored(item)
    if item.gloss is None:
        return mesh
    mesh = mesh if item.gloss == "file" else _gloss(item.gloss).on(mesh)
    metal = mesh.gloss is not None and mesh.gloss[:, 1].any()
    if metal and item.color is None and not mesh.textures and (mesh.corner_colors == 1).all():
        raise InputError(f"{item.mesh} is a metal without a color: give color=[red,green,blue], or a metallic of 0")
    return mesh


def _gloss(values: Sequence[float]) -> Gloss:
    """Of [roughness, metallic, strength], or the first of them."""
    roughness, *others = map(float, values)
    return Gloss(roughness, *others)


def _colored(item: MeshSettings) -> Mesh:
    kind, _, name = item.mesh.partition(":")
    if kind == "solid":
        name, _, seed = name.partition(":")
        try:
            mesh = solid(name, int(seed or 0))
        except ValueError as error:  # of the name or the seed
            raise InputError(f"{item.mesh}: {error}") from error
    else:
        from renderer.io.meshes import load_mesh  # trimesh takes half a second

        mesh = load_mesh(item.mesh, up=item.up, gloss=item.gloss == "file")
    if item.color is None:
        return mesh
    if mesh.textures or (mesh.corner_colors != 1).any():
        raise InputError(f"{item.mesh} brings colors of its own: leave color out; albedo_scale brightens or dims them")
    return replace(Mesh.plain(mesh.vertices, mesh.faces, np.array(item.color)), gloss=mesh.gloss, skin=mesh.skin)
