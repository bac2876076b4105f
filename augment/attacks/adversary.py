"""One example as it leaves the program: everything that its images follow from, and the images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from augment.objects import SceneObject
from augment.scene import Conditions, Example, Scene
from renderer.basis import Basis
from renderer.camera import Camera
from renderer.files.albedo_bake import with_added_albedo
from renderer.image import ImageSettings
from renderer.visibility import Backend


@dataclass(frozen=True)
class Adversary:
    """V views of one object, each (3, size, size), before an attack and after.

    shown: with the shape and the colours that the attack left, in the scene's own coordinates. light: (size, 3) of the
    basis, exposure included. background: (C, size, size), C 3 or 1. pixels: (V, 3, size, size) added to the images, or
    None.
    """

    shown: SceneObject
    cameras: tuple[Camera, ...]
    light: Tensor
    basis: Basis
    background: Tensor
    settings: ImageSettings
    images_before: Tensor
    images: Tensor
    pixels: Tensor | None = None

    @staticmethod
    def of(scene: Scene, example: int, after: Conditions, before: Tensor, images: Tensor) -> Adversary:
        """An example of a scene under its row of all conditions, with its images (V, 3, size, size)."""
        row, shown = scene.examples[example], scene.objects[scene.examples[example].object]
        mesh, gain = shown.mesh, shown.gain
        if after.albedo is not None:
            added = after.albedo[example, : len(mesh.faces)].detach().cpu().double().numpy()
            mesh, gain = with_added_albedo(mesh, added, scene.settings.encoding, gain)
        if after.vertices is not None:
            vertices = after.vertices[example, : len(mesh.vertices)].detach().cpu().double().numpy()
            mesh = replace(mesh, vertices=vertices)
        return Adversary(
            shown=replace(shown, mesh=mesh, gain=gain),
            cameras=row.cameras,
            light=after.light[example].detach().cpu() * row.exposure,
            basis=scene.basis_under(after, example),
            background=scene.backgrounds[row.background].cpu(),
            settings=scene.settings,
            images_before=before.cpu(),
            images=images.cpu(),
            pixels=None if after.pixels is None else after.pixels[example].detach().cpu(),
        )

    def scene(self, backend: Backend, device: torch.device | str = "cpu") -> Scene:
        """Its one example."""
        background, light = self.background[None], self.light.to(device)
        return Scene(
            [self.shown], [Example(0, self.cameras, 0)], background, light, self.settings, backend, basis=self.basis
        )

    @torch.no_grad()
    def render(self, backend: Backend) -> Tensor:
        """Its images (V, 3, size, size) anew."""
        pixels = None if self.pixels is None else self.pixels[None]
        return self.scene(backend).render(Conditions(self.light[None], pixels=pixels), torch.arange(1))[0]
