"""Shadows and bounces while a mesh is deformed or painted: as they are for a shape close by, in its own colours."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from augment.objects import SceneObject
from renderer.basis import Basis
from renderer.camera import Camera
from renderer.fragments import Fragments
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.transport.precomputed import build_transport
from renderer.transport.surface import Surface

NEAR = 0.001  # world units: shadows are found anew once a coordinate has moved by more since they were


class HeldTransport:
    """What transport adds to the images of a mesh, per unit of each coefficient of light.

    It stays where it is in the image, as the outline does for derivatives, and goes with the albedo of its pixel.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, gain: float, basis: Basis):
        self.mesh, self._settings = mesh, settings
        self._transport = build_transport(mesh, settings, gain, basis)
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


class HeldTransports:
    """The transport of a scene's objects in their own shapes, and of examples in the last that was not near these."""

    def __init__(self, settings: ImageSettings, basis: Basis):
        self._like = settings, basis
        self._own: dict[int, HeldTransport] = {}  # of objects
        self._moved: dict[int, HeldTransport] = {}  # of examples

    def near(self, example: int, number: int, item: SceneObject, vertices: np.ndarray) -> HeldTransport:
        """That of a shape near the vertices (V, 3) of an example, which shows the object of a number."""
        if number not in self._own:
            self._own[number] = self._of(item, item.mesh)
        if self._own[number].fits(vertices):
            return self._own[number]
        if example not in self._moved or not self._moved[example].fits(vertices):
            self._moved[example] = self._of(item, replace(item.mesh, vertices=vertices))
        return self._moved[example]

    def _of(self, item: SceneObject, mesh: Mesh) -> HeldTransport:
        settings, basis = self._like
        return HeldTransport(mesh, settings, item.gain, basis)


def _by_pixel(fragments: Fragments, albedo: Tensor) -> Tensor:
    """(3, size²) the sum of the samples' albedo (S, 3) over each pixel."""
    pixel = fragments.pixels[fragments.pixel]
    return albedo.new_zeros(3, fragments.size**2).index_add(1, pixel, albedo.T)
