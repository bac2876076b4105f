"""Images of objects that move, are painted or stand under moved lamps, view by view."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial

import numpy as np
import torch
from torch import Tensor

from augment.objects import SceneObject
from renderer.albedo import painted_albedo, surface_albedo
from renderer.camera import Camera
from renderer.fragments import Fragments, build_fragments
from renderer.image import ImageSettings
from renderer.light.basis import Basis, parts_of
from renderer.mesh import Mesh
from renderer.rasterizer import Rasterizer
from renderer.rendering import view_radiance
from renderer.transport.local import LocalLightView
from renderer.transport.precomputed import build_transport
from renderer.transport.rays import Rays
from renderer.transport.surface import Surface

NEAR = 0.001  # world units: shadows are found anew once a coordinate has moved by more since they were


class FrozenTransport:
    """What transport adds to the images of a mesh, per unit of each coefficient of light.

    It stays where it is in the image, as the outline does for derivatives, and goes with the albedo of its pixel.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis):
        self.mesh, self._settings = mesh, settings
        self._transport = build_transport(mesh, settings, albedo_scale, basis)
        self._views: dict[Camera, tuple[Tensor, Tensor] | None] = {}

    def fits(self, vertices: np.ndarray) -> bool:
        """Whether vertices (V, 3) are near the mesh's."""
        return bool(np.abs(vertices - self.mesh.vertices).max() <= NEAR)

    def knows(self, camera: Camera) -> bool:
        return camera in self._views

    def add(self, camera: Camera, fragments: Fragments, albedo: Tensor) -> None:
        """A view of the mesh, and its albedo there (S, 3)."""
        surface = Surface.of(self.mesh, fragments.to("cpu"), self._settings)
        change = self._transport.change(surface, albedo.cpu().double()) if self._transport else None
        if change is None:
            self._views[camera] = None
        else:
            canvas = change.new_zeros(*change.shape[:2], fragments.size**2)
            canvas[..., surface.fragments.pixels] = change
            self._views[camera] = canvas.to(albedo), _by_pixel(fragments, albedo)

    def radiance(self, camera: Camera, fragments: Fragments, albedo: Tensor, light: Tensor) -> Tensor:
        """(3, P) of a known view's fragments with albedo (S, 3) in a light (size, 3); differentiable in both."""
        view = self._views[camera]
        if view is None:
            return light.new_zeros(3, len(fragments.pixels))
        change, before = (each[..., fragments.pixels] for each in view)
        added = torch.einsum("ckp,kc->cp", change.to(light), light)
        now = _by_pixel(fragments, albedo)[:, fragments.pixels]
        return added * torch.where(before > 0, now / before.masked_fill(before == 0, 1), 1).to(light)


class FrozenTransports:
    """The transport of a scene's objects in their own shapes, and of examples in the last that was not near these."""

    def __init__(self, settings: ImageSettings, basis: Basis):
        self._like = settings, basis
        self._own: dict[int, FrozenTransport] = {}  # of objects
        self._moved: dict[int, FrozenTransport] = {}  # of examples

    def near(self, example: int, number: int, item: SceneObject, vertices: np.ndarray) -> FrozenTransport:
        """That of a shape near the vertices (V, 3) of an example, which shows the object of a number."""
        if number not in self._own:
            self._own[number] = self._of(item, item.mesh)
        if self._own[number].fits(vertices):
            return self._own[number]
        if example not in self._moved or not self._moved[example].fits(vertices):
            self._moved[example] = self._of(item, replace(item.mesh, vertices=vertices))
        return self._moved[example]

    def _of(self, item: SceneObject, mesh: Mesh) -> FrozenTransport:
        settings, basis = self._like
        return FrozenTransport(mesh, settings, item.albedo_scale, basis)


def _by_pixel(fragments: Fragments, albedo: Tensor) -> Tensor:
    """(3, size²) the sum of the samples' albedo (S, 3) over each pixel."""
    pixel = fragments.pixels[fragments.pixel]
    return albedo.new_zeros(3, fragments.size**2).index_add(1, pixel, albedo.T)


class Reshading:
    """What cameras see of objects, by their numbers; what they see of their own shapes is kept.

    Shadows and bounces of distant light are those of a shape close by (`FrozenTransport`), shadows of light from places
    are a shape's own (`LocalLightView`).
    """

    def __init__(
        self,
        objects: Sequence[SceneObject],
        settings: ImageSettings,
        rasterizer: Rasterizer,
        basis: Basis,
        like: Tensor,
    ):
        """basis: what lights are coefficients of. like: of the dtype and on the device of the images."""
        self._objects, self._settings, self._rasterizer, self._basis, self._like = (
            objects,
            settings,
            rasterizer,
            basis,
            like,
        )
        self._own: dict[tuple[int, Camera], tuple[Fragments, Tensor]] = {}
        self._transports = FrozenTransports(settings, basis)
        self._rays: dict[int, Rays] = {}
        self._placed_views: dict[tuple[int, Camera], LocalLightView] = {}

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

    def placed_view(self, number: int, camera: Camera) -> LocalLightView:
        """Of an object in its own shape."""
        view = number, camera
        if view not in self._placed_views:
            mesh, (fragments, _) = self._objects[number].mesh, self.own(*view)
            rays = self._rays.setdefault(number, Rays(mesh))
            self._placed_views[view] = LocalLightView(rays, mesh, fragments, self._settings)
        return self._placed_views[view]

    def radiance(
        self,
        example: int,
        number: int,
        camera: Camera,
        light: Tensor,
        vertices: Tensor | None,
        added: Tensor | None,
        positions: Tensor | None,
    ) -> tuple[Fragments, Tensor]:
        """What a camera sees of an object in a light (size, 3), and its radiance (3, P), differentiable in all tensors.

        example: whose shapes follow each other closely. vertices (V, 3), places (L, 3) of lamps: None where they are as
        they were. added: to each face's linear albedo, (F, 3).
        """
        mesh, albedo_scale = self._objects[number].mesh, self._objects[number].albedo_scale
        placed: Callable[[], LocalLightView]
        if vertices is None:
            vertices, shape = self.vertices[number], mesh.vertices
            fragments, albedo = self.own(number, camera)
            placed = partial(self.placed_view, number, camera)
        else:
            shape = vertices.detach().cpu().double().numpy()
            fragments, albedo = self._seen(number, camera, shape)
            # once, where lights stand in the scene: a mesh is checked as it is made, and a step's is used by them alone
            placed = cache(partial(self._moved_view, mesh, shape, fragments, vertices))
        if added is not None:
            albedo = painted_albedo(mesh, fragments, self._settings.encoding, albedo_scale, added)
        smooth_faces = self._faces[number] if self._settings.normals == "smooth" else None
        lights = [(part, light[where]) for where, part in parts_of(self._basis)]

        def indirect(albedo: Tensor, light: Tensor) -> Tensor:
            return self._frozen(example, number, camera, shape).radiance(camera, fragments, albedo, light)

        extra = indirect if self._settings.global_illumination else None
        return fragments, view_radiance(fragments, vertices, albedo, lights, smooth_faces, placed, extra, positions)

    def _moved_view(self, mesh: Mesh, positions: np.ndarray, fragments: Fragments, vertices: Tensor) -> LocalLightView:
        return LocalLightView(Rays(replace(mesh, vertices=positions)), mesh, fragments, self._settings, vertices)

    def _frozen(self, example: int, number: int, camera: Camera, vertices: np.ndarray) -> FrozenTransport:
        """Of a shape near the vertices of an example, and with the camera's view of it."""
        frozen = self._transports.near(example, number, self._objects[number], vertices)
        if not frozen.knows(camera):
            frozen.add(camera, *self._seen(number, camera, frozen.mesh.vertices))
        return frozen

    def _seen(self, number: int, camera: Camera, vertices: np.ndarray) -> tuple[Fragments, Tensor]:
        """What a camera sees of an object's vertices, wherever they are, and the albedo there (S, 3)."""
        item, settings = self._objects[number], self._settings
        closed = item.mesh.closed
        (fragments,) = build_fragments(vertices, item.mesh.faces, [camera], settings, self._rasterizer, closed=closed)
        fragments = fragments.to(self._like.device)
        return fragments, (surface_albedo(item.mesh, fragments, settings.encoding) * item.albedo_scale).to(self._like)

    @cached_property
    def _faces(self) -> list[Tensor]:
        return [torch.from_numpy(item.mesh.faces).to(self._like.device) for item in self._objects]
