"""Objects that move, are painted or stand under moved lamps, view by view: rasterised anew where vertices move."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial, reduce

import numpy as np
import torch
from torch import Tensor

from augment.held_transport import HeldTransport, HeldTransports
from augment.objects import SceneObject
from augment.placed_view import PlacedView
from renderer.albedo import painted_albedo, surface_albedo
from renderer.basis import Basis, Placed, parts_of
from renderer.camera import Camera
from renderer.fragments import Fragments, build_fragments
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.shading import radiance
from renderer.transport.rays import Rays
from renderer.visibility import Backend


class Reshading:
    """What cameras see of objects, by their numbers; what they see of their own shapes is kept.

    Shadows and bounces of distant light are those of a shape close by (`HeldTransport`), shadows of light from places
    are a shape's own (`PlacedView`).
    """

    def __init__(
        self, objects: Sequence[SceneObject], settings: ImageSettings, backend: Backend, basis: Basis, like: Tensor
    ):
        """basis: what lights are coefficients of. like: of the dtype and on the device of the images."""
        self._objects, self._settings, self._backend, self._basis, self._like = objects, settings, backend, basis, like
        self._own: dict[tuple[int, Camera], tuple[Fragments, Tensor]] = {}
        self._transports = HeldTransports(settings, basis)
        self._rays: dict[int, Rays] = {}
        self._placed_views: dict[tuple[int, Camera], PlacedView] = {}

    @cached_property
    def vertices(self) -> list[Tensor]:
        """(V, 3) of each object in its own shape."""
        return [torch.from_numpy(item.mesh.vertices).to(self._like) for item in self._objects]

    def own(self, number: int, camera: Camera) -> tuple[Fragments, Tensor]:
        """Of an object in its own shape: what is seen, and the albedo there (S, 3)."""
        view = number, camera
        if view not in self._own:
            self._own[view] = self._seen(number, camera, self._objects[number].mesh.vertices)
        return self._own[view]

    def placed_view(self, number: int, camera: Camera) -> PlacedView:
        """Of an object in its own shape."""
        view = number, camera
        if view not in self._placed_views:
            mesh, (fragments, _) = self._objects[number].mesh, self.own(*view)
            rays = self._rays.setdefault(number, Rays(mesh))
            self._placed_views[view] = PlacedView(rays, mesh, fragments, self._settings)
        return self._placed_views[view]

    def radiance(
        self,
        example: int,
        number: int,
        camera: Camera,
        light: Tensor,
        vertices: Tensor | None,
        added: Tensor | None,
        places: Tensor | None,
    ) -> tuple[Fragments, Tensor]:
        """What a camera sees of an object in a light (size, 3), and its radiance (3, P), differentiable in all tensors.

        example: whose shapes follow each other closely. vertices (V, 3), places (L, 3) of lamps: None where they are as
        they were. added: to each face's linear albedo, (F, 3).
        """
        mesh, gain = self._objects[number].mesh, self._objects[number].gain
        placed: Callable[[], PlacedView]
        if vertices is None:
            vertices, positions = self.vertices[number], mesh.vertices
            fragments, albedo = self.own(number, camera)
            placed = partial(self.placed_view, number, camera)
        else:
            positions = vertices.detach().cpu().double().numpy()
            fragments, albedo = self._seen(number, camera, positions)
            # once, where lights stand in the scene: a mesh is checked as it is made, and a step's is used by them alone
            placed = cache(partial(self._moved_view, mesh, positions, fragments, vertices))
        if added is not None:
            albedo = painted_albedo(mesh, fragments, self._settings.encoding, gain, added)
        smooth_faces = self._faces[number] if self._settings.normals == "smooth" else None
        seen = []
        for where, part in parts_of(self._basis):
            own = light[where]
            if isinstance(part, Placed):
                seen.append(placed().radiance(part, albedo, own, places))
                continue
            seen.append(radiance(fragments, vertices, own, albedo, smooth_faces))
            if self._settings.transport != "direct":
                held = self._held(example, number, camera, positions)
                seen.append(held.radiance(camera, fragments, albedo, own))
        return fragments, reduce(torch.add, seen)

    def _moved_view(self, mesh: Mesh, positions: np.ndarray, fragments: Fragments, vertices: Tensor) -> PlacedView:
        return PlacedView(Rays(replace(mesh, vertices=positions)), mesh, fragments, self._settings, vertices)

    def _held(self, example: int, number: int, camera: Camera, vertices: np.ndarray) -> HeldTransport:
        """Of a shape near the vertices of an example, and with the camera's view of it."""
        held = self._transports.near(example, number, self._objects[number], vertices)
        if not held.knows(camera):
            held.add(camera, *self._seen(number, camera, held.mesh.vertices))
        return held

    def _seen(self, number: int, camera: Camera, vertices: np.ndarray) -> tuple[Fragments, Tensor]:
        """What a camera sees of an object's vertices, wherever they are, and the albedo there (S, 3)."""
        item, settings = self._objects[number], self._settings
        closed = item.mesh.closed
        (fragments,) = build_fragments(vertices, item.mesh.faces, [camera], settings, self._backend, closed=closed)
        fragments = fragments.to(self._like.device)
        return fragments, (surface_albedo(item.mesh, fragments, settings.encoding) * item.gain).to(self._like)

    @cached_property
    def _faces(self) -> list[Tensor]:
        return [torch.from_numpy(item.mesh.faces).to(self._like.device) for item in self._objects]
