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

from augment.memory import has_memory, operator_bytes
from augment.parameter_settings import MaterialSettings
from augment.scene.materials import ROUGHNESS, initial_materials
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from renderer.geometry.mesh import select_faces
from renderer.light.basis import DEGREE, harmonics_of
from renderer.light.harmonics import irradiance_error
from renderer.light.highlights import highlight_error, required_degree
from renderer.light.presets import load_light
from renderer.settings import MIN_ROUGHNESS
from renderer.shading.gloss import Gloss, smallest_roughness

if TYPE_CHECKING:
    from augment.settings import SpecularLayerSettings

# `warn_of_cut_light` warns of an rms error of the irradiance above this fraction of the rms
# irradiance.
NOTICED = 0.05
# `degree_of_scene` warns if the user gives a lower degree than this. It is the lowest that
# shades the sides of an object about right. The irradiance of a point source is off by 0.09
# at this degree, and by 0.42 or more at lower degrees.
SHADED = 2
# Degree of the light whose irradiance `warn_of_cut_light` takes as exact. The irradiance of
# every lighting of a higher degree differs from it by less than `NOTICED`.
COMPARED = 8
# Roughness in `Smoothest` of surfaces without gloss.
MATTE = 1.0


class Smoothest(NamedTuple):
    """The smoothest surface that a run can reach.

    Attributes:
        roughness: Its roughness. It is 1 if no surface has gloss.
        name: Name of the object that has this surface.
        verb: "has", or "can reach" if an attack or a variation makes it.
    """

    roughness: float
    name: str
    verb: str = "has"

    @property
    def gloss(self) -> float | None:
        """Return the roughness, or None if no surface has gloss."""
        return self.roughness if self.roughness < MATTE else None

    @property
    def degree(self) -> int:
        """Return the degree of light that the gloss needs, or 0 if no surface has gloss."""
        return required_degree(self.roughness) if self.roughness < MATTE else 0

    def warn(self, choice: str, degree: int) -> None:
        """Warn of the error of highlights in lighting of a degree that is too low.

        Args:
            choice: Beginning of a clause about the degree, such as "degree=6".
            degree: The degree.
        """
        surface = f"{self.name} {self.verb} gloss of roughness {self.roughness:.2g}"
        needed = f"which takes light of degree {self.degree}"
        error = highlight_error(degree, self.roughness)
        least_error = highlight_error(self.degree, self.roughness)
        errors = f"off by {error:.0%} (rms) instead of {least_error:.0%}"
        message = f"{surface}, {needed}: {choice} shows the highlight of a point of light {errors}"
        warnings.warn(message, stacklevel=4)


def reached_gloss(
    objects: Iterable[SceneObject],
    material: MaterialSettings | None = None,
    varnish: SpecularLayerSettings | None = None,
) -> Smoothest:
    """Find the smoothest surface of all objects, also after an attack and a variation.

    Args:
        objects: The objects of a scene, which include hard negatives. Their
            props count, too.
        material: Settings of an attack on the material. It lowers the roughness
            as far as its norm ball allows.
        varnish: Settings from which the gloss of the objects is drawn.

    Returns:
        The lowest roughness and the object that has or reaches it.
    """
    # `min` compares the roughness first, which is the first field of `Smoothest`.
    least = Smoothest(MATTE, "")
    for item in objects:
        initial_roughness = smallest_roughness(item.mesh)
        least = min(least, Smoothest(initial_roughness, item.name))
        reached_roughness = _reached_roughness(item, material, varnish)
        if reached_roughness < initial_roughness:
            least = min(least, Smoothest(reached_roughness, item.name, "can reach"))
    return least


def _reached_roughness(
    item: SceneObject, material: MaterialSettings | None, varnish: SpecularLayerSettings | None
) -> float:
    """Compute the lowest roughness that an attack and a variation can give to an object.

    Args:
        item: Object. Its props and its table keep their gloss and do not count.
        material: Settings of an attack on the material, or None.
        varnish: Settings from which the gloss of the object is drawn, or None.

    Returns:
        The lowest roughness. It is `MATTE` if neither an attack nor a variation changes the
        gloss.
    """
    has_specular_layer = varnish is not None and any(varnish.specular_factor)
    is_attacked = material is not None and any(
        (material.roughness, material.metallic, material.specular_factor)
    )
    if not has_specular_layer and not is_attacked:
        return MATTE
    materials = initial_materials(item)
    # Roughness of each face of the object itself.
    roughness = materials.face_gloss[materials.object_mask, ROUGHNESS]
    if varnish is not None and has_specular_layer:
        lowest_drawn = varnish.roughness[0]
        roughness = torch.full_like(roughness, lowest_drawn)
    if material is not None and is_attacked and material.roughness:
        # An attack changes the mean and adds the change of the mean to each face. Its radius
        # is in multiples of the unit `material.roughness`. No radius means no limit.
        mean = float(roughness.mean())
        largest_change = math.inf
        if material.radius is not None:
            largest_change = material.radius * material.roughness
        change = max(mean - largest_change, MIN_ROUGHNESS) - mean
        roughness = (roughness + min(change, 0.0)).clamp(min=0)
    # The strength of this gloss is 1, because attacks and variations can raise it to 1.
    gloss = Gloss(roughness, textured=not has_specular_layer)
    own_mesh = select_faces(item.mesh, slice(item.own))
    return smallest_roughness(gloss.on(own_mesh))


def degree_of_scene(reached: Smoothest, given: int | None, pixels: int) -> int:
    """Choose the degree of a scene's lighting.

    Without a given degree, it is the lowest that shows all gloss, and at least
    6. Warnings report a degree above 6, a given degree that is too low, and a
    degree that memory limits.

    Args:
        reached: The smoothest surface of the run.
        given: The degree that the user asked for, or None.
        pixels: Number of pixels of the views of all objects.

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
        fault = "shades no side of an object right"
        if given == 0:
            fault = "shades all sides of an object alike"
        message = (
            f"degree={given} {fault} in light that is not even, and so do attacks and variations "
            f"of the light, which keep to this degree: give {SHADED} or more, or leave degree out"
        )
        warnings.warn(message, stacklevel=3)
    return given


def _affordable_degree(reached: Smoothest, pixels: int) -> int:
    """Find the degree of light for the smoothest gloss of a run, as far as memory allows.

    Args:
        reached: The smoothest surface of the run.
        pixels: Number of pixels of the views of all objects.

    Returns:
        The degree that the gloss needs. If its operators do not fit in memory, the highest
        degree whose operators fit. It is at least `DEGREE`.
    """
    degree = max(DEGREE, reached.degree)
    cpu = torch.device("cpu")
    while degree > DEGREE and not has_memory(operator_bytes(degree, pixels), cpu):
        degree -= 1
    return degree


def warn_of_cut_light(name: str, light: Tensor) -> None:
    """Warn if a low degree changes the irradiance of a named lighting by more than 5 %.

    The error is the rms difference to the irradiance of the same lighting of
    degree 8, over normals and channels, relative to the rms irradiance of the
    latter (`irradiance_error`).

    Args:
        name: Name of the lighting, as for `load_light`. A lighting that is not
            the file of a map has no harmonics above its own degree.
        light: The coefficients that were loaded, shape ((degree + 1)², 3).
    """
    degree = math.isqrt(len(light)) - 1
    if degree >= COMPARED // 2:
        return
    error = float(irradiance_error(light, load_light(name, COMPARED)))
    if error > NOTICED:
        fault = f"has an irradiance that is off by {error:.0%} (rms over normals)"
        message = f"light {name} of degree={degree} {fault}: give a higher degree"
        warnings.warn(message, stacklevel=3)


def with_needed_degree(
    scene: Scene,
    material: MaterialSettings | None = None,
    varnish: SpecularLayerSettings | None = None,
) -> Scene:
    """Raise the degree of a scene's lighting to what an attack and a variation need.

    Only a degree that `build_scene` chose is raised. If the user gave the
    degree or the coefficients, a warning reports that the degree is too low.

    Args:
        scene: The scene.
        material: Settings of an attack on the material.
        varnish: Settings from which the gloss of the objects is drawn.

    Returns:
        A scene with more coefficients of the same lighting, or the given scene.
    """
    reached = reached_gloss(scene.objects, material, varnish)
    degree = harmonics_of(scene.basis).degree
    view_count = sum(len(cameras) for cameras in scene.cameras)
    needed = _affordable_degree(reached, view_count * scene.settings.size**2)
    if needed <= degree:
        return scene
    if scene.lights_of_degree is not None:
        # The lights that `build_scene` made. If the lights of the scene differ from them, they
        # were changed later and are known to their present degree only.
        _, built = scene.lights_of_degree(degree, reached_gloss(scene.objects).gloss)
        has_same_shape = scene.lights.shape[1:] == built.shape
        if has_same_shape and (scene.lights == built.to(scene.lights)).all():
            reached.warn(f"degree={degree} takes less time, but", degree)
            basis, lights = scene.lights_of_degree(needed, reached.gloss)
            return scene.changed(basis=basis, lights=lights.to(scene.lights))
    # Coefficients of the harmonics of exactly this degree. If they are zero, the lighting has
    # no detail that a higher degree could add, and needs no warning.
    highest_band = scene.lights[:, degree**2 : (degree + 1) ** 2]
    if highest_band.any():
        reached.warn(f"degree={degree}", degree)
    return scene
