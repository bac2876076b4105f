"""Choose the degree of a scene's lighting: as high as its smoothest surface needs.

The lighting is a sum of spherical harmonics up to a degree. The smoother a surface is, the sharper
are its highlights, and the higher is the degree that shows them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from augment.memory import operator_bytes
from augment.parameter_settings import MaterialSettings
from augment.scene.materials import ROUGHNESS, initial_materials
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from renderer.light.basis import DEGREE, harmonics_of
from renderer.light.harmonics import irradiance_error
from renderer.light.highlights import highlight_error, required_degree
from renderer.light.presets import load_light
from renderer.memory import has_memory
from renderer.mesh import select_faces
from renderer.settings import MIN_ROUGHNESS
from renderer.surface.gloss import Gloss, smallest_roughness

if TYPE_CHECKING:
    from augment.settings import SpecularLayerSettings

# Warnings are given if the irradiance of a lighting is off by more than this: the rms error divided
# by the rms irradiance.
MAX_IRRADIANCE_ERROR = 0.05
# Lowest degree of spherical harmonics that shades the sides of an object about right. The
# irradiance of a point source has an error of 0.09 at this degree, and of 0.42 or more below it.
MIN_SHADING_DEGREE = 2
# The irradiance of lighting of this degree counts as exact. More harmonics change it by less than
# `MAX_IRRADIANCE_ERROR`.
REFERENCE_DEGREE = 8
# Roughness that stands for a surface without gloss.
MATTE = 1.0


class Smoothest(NamedTuple):
    """The smoothest surface that the objects have, or get by an attack or a random variation.

    Attributes:
        roughness: Roughness of the surface. It is 1 if no surface has gloss.
        name: Name of the object that has this surface.
        verb: "has" if the object has it now, "can reach" if an attack or a
            variation makes it.
    """

    roughness: float
    name: str
    verb: str = "has"

    @property
    def gloss_roughness(self) -> float | None:
        """Return the roughness, or None if no surface has gloss."""
        return self.roughness if self.roughness < MATTE else None

    @property
    def degree(self) -> int:
        """Return the degree of lighting that shows the highlights of the surface.

        It is 0 if no surface has gloss.
        """
        return required_degree(self.roughness) if self.roughness < MATTE else 0

    def warn(self, subject: str, degree: int) -> None:
        """Warn that the degree of the lighting is too low for the highlights of the surface."""
        surface = f"{self.name} {self.verb} gloss of roughness {self.roughness:.2g}"
        needed = f"which takes light of degree {self.degree}"
        error = highlight_error(degree, self.roughness)
        least_error = highlight_error(self.degree, self.roughness)
        errors = f"off by {error:.0%} (rms) instead of {least_error:.0%}"
        message = f"{surface}, {needed}: {subject} shows the highlight of a point of light {errors}"
        warnings.warn(message, stacklevel=4)


def reached_gloss(
    objects: Iterable[SceneObject],
    material: MaterialSettings | None = None,
    layer: SpecularLayerSettings | None = None,
) -> Smoothest:
    """Find the smoothest surface that objects have, or get by an attack or a random variation.

    Surfaces of props count, too. None stands for no attack or no variation.
    """
    lowest = Smoothest(MATTE, "")
    for item in objects:
        initial_roughness = smallest_roughness(item.mesh)
        candidates = [lowest, Smoothest(initial_roughness, item.name)]
        reached_roughness = _reached_roughness(item, material, layer)
        if reached_roughness < initial_roughness:
            candidates.append(Smoothest(reached_roughness, item.name, "can reach"))
        lowest = min(candidates)
    return lowest


def _reached_roughness(
    item: SceneObject, material: MaterialSettings | None, layer: SpecularLayerSettings | None
) -> float:
    """Compute the lowest roughness that an attack or a random variation can give to an object.

    It is `MATTE` if neither changes the gloss. Props and table do not count.
    """
    has_specular_layer = layer is not None and any(layer.specular_factor)
    is_attacked = material is not None and any(
        (material.roughness, material.metallic, material.specular_factor)
    )
    if not has_specular_layer and not is_attacked:
        return MATTE
    materials = initial_materials(item)
    # Roughness of each face of the object itself.
    roughness = materials.face_gloss[materials.object_mask, ROUGHNESS]
    if layer is not None and has_specular_layer:
        lowest_drawn = layer.roughness[0]
        roughness = torch.full_like(roughness, lowest_drawn)
    if material is not None and is_attacked and material.roughness:
        # An attack lowers the mean roughness of the faces, and each face by the same amount.
        mean = float(roughness.mean())
        # The radius counts units of size `material.roughness`. No radius means no limit.
        largest_change = math.inf
        if material.radius is not None:
            largest_change = material.radius * material.roughness
        lowest_mean = max(mean - largest_change, MIN_ROUGHNESS)
        change = min(lowest_mean - mean, 0.0)
        roughness = (roughness + change).clamp(min=0)
    # `Gloss` gets its default specular factor of 1, because attacks and variations can reach 1.
    gloss = Gloss(roughness, textured=not has_specular_layer)
    own_mesh = select_faces(item.mesh, slice(item.own))
    return smallest_roughness(gloss.on(own_mesh))


def degree_of_scene(smoothest: Smoothest, given: int | None, pixels: int) -> int:
    """Choose the degree of the spherical harmonics of a scene's lighting.

    If the user gives none, it is the lowest degree that shows the highlights of
    all surfaces, but at least 6. Warnings are given if it is above 6, if memory
    limits it, or if the user gives a degree that is too low.
    """
    if given is None:
        degree = _affordable_degree(smoothest, pixels)
        if degree < smoothest.degree:
            smoothest.warn(f"degree={degree}, the highest that fits in memory,", degree)
        elif degree > DEGREE:
            smoothest.warn(f"degree={DEGREE} takes less time, but", DEGREE)
        return degree
    if smoothest.degree > given:
        smoothest.warn(f"degree={given}", given)
    if given < MIN_SHADING_DEGREE:
        fault = "is too low to shade objects correctly"
        if given == 0:
            fault = "gives all sides of an object the same irradiance"
        message = (
            f"degree={given} {fault}, and attacks and variations of the light have the same "
            f"degree: give {MIN_SHADING_DEGREE} or more, or leave degree out"
        )
        warnings.warn(message, stacklevel=3)
    return given


def _affordable_degree(smoothest: Smoothest, pixels: int) -> int:
    """Find the degree of lighting that the smoothest surface needs, as far as memory permits."""
    degree = max(DEGREE, smoothest.degree)
    cpu = torch.device("cpu")
    while degree > DEGREE and not has_memory(operator_bytes(degree, pixels), cpu):
        degree -= 1
    return degree


def warn_of_low_degree(name: str, light: Tensor) -> None:
    """Warn if a named lighting was loaded with too low a degree for its irradiance.

    The irradiance is compared with that of the same lighting of degree 8. The
    warning is given if the rms difference, over normals and channels, is more
    than 5 % of the rms irradiance.
    """
    degree = math.isqrt(len(light)) - 1
    if degree >= REFERENCE_DEGREE // 2:
        return
    error = float(irradiance_error(light, load_light(name, REFERENCE_DEGREE)))
    if error > MAX_IRRADIANCE_ERROR:
        fault = f"has an irradiance that is off by {error:.0%} (rms over normals)"
        message = f"light {name} of degree={degree} {fault}: give a higher degree"
        warnings.warn(message, stacklevel=3)


def with_needed_degree(
    scene: Scene,
    material: MaterialSettings | None = None,
    layer: SpecularLayerSettings | None = None,
) -> Scene:
    """Raise the degree of a scene's lighting if an attack or a variation needs it.

    Attacks and variations may make surfaces smoother, so that their highlights
    need a higher degree. Only a degree that `build_scene` chose is raised. If
    the user gave the degree or the coefficients, a warning is given instead.
    """
    smoothest = reached_gloss(scene.objects, material, layer)
    degree = harmonics_of(scene.basis).degree
    view_count = sum(len(cameras) for cameras in scene.cameras)
    needed = _affordable_degree(smoothest, view_count * scene.settings.size**2)
    if needed <= degree:
        return scene
    # `lights_of_degree` loads the lighting of the scene with another degree. It is None if the
    # user gave the degree or the coefficients.
    if scene.lights_of_degree is not None:
        # Lighting that was changed after `build_scene` cannot be loaded again with another
        # degree. Compare the lighting of the scene with what `build_scene` loaded.
        _, built = scene.lights_of_degree(degree, reached_gloss(scene.objects).gloss_roughness)
        has_same_shape = scene.lights.shape[1:] == built.shape
        if has_same_shape and (scene.lights == built.to(scene.lights)).all():
            smoothest.warn(f"degree={degree} takes less time, but", degree)
            basis, lights = scene.lights_of_degree(needed, smoothest.gloss_roughness)
            return scene.changed(basis=basis, lights=lights.to(scene.lights))
    # If the coefficients of the highest degree are zero, the lighting is so smooth that a higher
    # degree would add nothing, and no warning is needed.
    highest_band = scene.lights[:, degree**2 : (degree + 1) ** 2]
    if highest_band.any():
        smoothest.warn(f"degree={degree}", degree)
    return scene
