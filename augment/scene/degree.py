"""The degree of a scene's light, which the smoothest surface that a run can reach decides."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from augment.attacks.parameter_settings import MaterialSettings
from augment.attacks.parameters.material import ROUGHNESS, initial_surface
from augment.memory import has_memory, operator_bytes
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from renderer.geometry.mesh import select_faces
from renderer.light.basis import DEGREE, harmonics_of
from renderer.light.harmonics import irradiance_error
from renderer.light.presets import load_light
from renderer.settings import MIN_ROUGHNESS
from renderer.surface.gloss import Gloss, smoothest
from renderer.surface.microfacets import degree_for, highlight_error

if TYPE_CHECKING:
    from augment.settings import VarnishSettings

NOTICED = 0.05  # irradiance error, of the rms irradiance, from which on it is told
SHADED = 2  # degree: of lower ones, irradiance of a point source is off by 0.42 or more, of 2 by 0.09
COMPARED = 8  # degree, beyond which irradiance of no light is off by NOTICED


class Smoothest(NamedTuple):
    """The least roughness that a run can reach, 1 where nothing has gloss; of which object; and what this does."""

    roughness: float
    name: str
    verb: str = "has"

    @property
    def gloss(self) -> float | None:
        """The roughness of the smoothest gloss; None where nothing has gloss."""
        return self.roughness if self.roughness < 1 else None

    @property
    def degree(self) -> int:
        """The degree of light that shows its gloss; 0 without gloss."""
        return degree_for(self.roughness) if self.roughness < 1 else 0

    def warn(self, choice: str, degree: int) -> None:
        """Warn of the error that a choice of a lower degree makes in highlights."""
        told = f"{self.name} {self.verb} gloss of roughness {self.roughness:.2g}"
        takes = f"which takes light of degree {self.degree}"
        error = highlight_error(degree, self.roughness)
        least = highlight_error(self.degree, self.roughness)
        shows = f"shows the highlight of a point of light off by {error:.0%} (rms) instead of {least:.0%}"
        warnings.warn(f"{told}, {takes}: {choice} {shows}", stacklevel=4)


def reached_gloss(
    objects: Iterable[SceneObject], material: MaterialSettings | None = None, varnish: VarnishSettings | None = None
) -> Smoothest:
    """Find the least roughness among the faces of objects, props included, and of what a run makes of them.

    Args:
        objects: Those of a scene, hard negatives included.
        material: Of an attack on the material, which lowers the roughness as far as its norm-ball allows.
        varnish: From which the gloss of the objects is drawn anew.

    Returns:
        The least roughness and the object that has or reaches it.
    """
    least = Smoothest(1.0, "")
    for item in objects:
        now = smoothest(item.mesh)
        least = min(least, Smoothest(now, item.name))
        reached = _reached_roughness(item, material, varnish)
        if reached < now:
            least = min(least, Smoothest(reached, item.name, "can reach"))
    return least


def _reached_roughness(item: SceneObject, material: MaterialSettings | None, varnish: VarnishSettings | None) -> float:
    """The least roughness of an object's own faces, whatever a variation draws and an attack does."""
    surface = initial_surface(item)
    roughness = surface.face_gloss[surface.object_mask, ROUGHNESS]
    varnished = varnish is not None and any(varnish.strength)
    attacked = material is not None and any((material.roughness, material.metallic, material.strength))
    if varnish is not None and varnished:
        roughness = torch.full_like(roughness, varnish.roughness[0])
    if material is not None and attacked and material.roughness:
        mean = float(roughness.mean())
        reach = math.inf if material.radius is None else material.radius * material.roughness
        change = max(mean - reach, MIN_ROUGHNESS) - mean
        roughness = (roughness + min(change, 0.0)).clamp(min=0)
    if not varnished and not attacked:
        return 1.0
    mesh = select_faces(item.mesh, slice(item.own))
    gloss = Gloss(roughness, textured=not varnished)  # of strength 1, since it may become so
    return smoothest(gloss.on(mesh))


def degree_of_scene(reached: Smoothest, given: int | None, pixels: int) -> int:
    """The degree of a scene's light: the given one, or the least that shows all gloss, at least 6.

    A warning tells where gloss takes more than 6, than what is given or than there is memory for.

    Args:
        reached: The smoothest surface of the run.
        given: The degree that was asked for.
        pixels: How many pixels the views of all objects have.

    Returns:
        The degree, from 0 to 40.
    """
    if given is None:
        degree = _affordable_degree(reached, pixels)
        if degree < reached.degree:
            reached.warn(f"there is memory for degree {degree} alone, which", degree)
        elif degree > DEGREE:
            reached.warn(f"degree={DEGREE} takes less time, but", DEGREE)
        return degree
    if reached.degree > given:
        reached.warn(f"degree={given}", given)
    if given < SHADED:
        sides = "shades all sides of an object alike" if given == 0 else "shades no side of an object right"
        cut = "so do attacks and variations of the light, which keep to it"
        advice = f"give {SHADED} or more, or leave degree out"
        warnings.warn(f"degree={given} {sides} in light that is not even, and {cut}: {advice}", stacklevel=3)
    return given


def _affordable_degree(reached: Smoothest, pixels: int) -> int:
    """The degree that shows all gloss, or the highest from 6 on for whose operators there is memory."""
    degree = max(DEGREE, reached.degree)
    cpu = torch.device("cpu")
    while degree > DEGREE and not has_memory(operator_bytes(degree, pixels), cpu):
        degree -= 1
    return degree


def warn_of_cut_light(name: str, light: Tensor) -> None:
    """Warn where cutting a named light off after a low degree changes its irradiance by more than 5 %.

    Measured is the rms over normals and channels of the error of irradiance, relative to the rms irradiance of the
    light to degree 8, by `irradiance_error`.

    Args:
        name: As for `load_light`, which has no more harmonics than this degree where it is not a map's file.
        light: What was loaded, of shape ((degree + 1)², 3).
    """
    degree = math.isqrt(len(light)) - 1
    if degree < COMPARED // 2:
        error = float(irradiance_error(light, load_light(name, COMPARED)))
        if error > NOTICED:
            told = f"light {name} of degree={degree} has an irradiance that is off by {error:.0%} (rms over normals)"
            warnings.warn(f"{told}: give a higher degree", stacklevel=3)


def with_needed_degree(
    scene: Scene, material: MaterialSettings | None = None, varnish: VarnishSettings | None = None
) -> Scene:
    """The scene in light of the degree that a run needs, where its own is lower and `build_scene` chose it.

    Args:
        scene: With `lights_of_degree`, unless it was not built by name, or with a given degree. Otherwise, a warning
            tells of a light that the scene's degree cuts off.
        material: Of an attack.
        varnish: Of a variation.

    Returns:
        The scene itself, where its degree is enough or nothing else is known.
    """
    reached, degree = reached_gloss(scene.objects, material, varnish), harmonics_of(scene.basis).degree
    pixels = sum(map(len, scene.cameras)) * scene.settings.size**2
    needed = _affordable_degree(reached, pixels)
    if needed <= degree:
        return scene
    if scene.lights_of_degree is not None:
        _, built = scene.lights_of_degree(degree, reached_gloss(scene.objects).gloss)
        if scene.lights.shape[1:] == built.shape and (scene.lights == built.to(scene.lights)).all():
            reached.warn(f"degree={degree} takes less time, but", degree)
            basis, lights = scene.lights_of_degree(needed, reached.gloss)
            return scene.changed(basis=basis, lights=lights.to(scene.lights))
    if scene.lights[:, degree**2 : (degree + 1) ** 2].any():  # it may go on
        reached.warn(f"degree={degree}", degree)
    return scene
