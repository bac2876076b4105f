"""Build a scene from meshes, names of lightings and files of backgrounds.

The lighting is a sum of spherical harmonics up to a degree. The smoother a surface is, the sharper
are its highlights, and the higher is the degree that shows them. If the user gives no degree, it is
chosen for the smoothest surface. The exposure is a factor for the light of each object, which can
be chosen as a camera does.
"""

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.attack_settings import AttackSettings, MaterialSettings
from augment.augmentation_settings import SpecularLayerSettings, VariationSettings
from augment.network import say_once
from augment.progress import progress
from augment.scene import objects as placed
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from augment.scene.truth import unlabeled
from augment.settings import ObjectSettings, RendererSettings, SceneSettings
from renderer import errors
from renderer.camera import Camera, orbit_cameras
from renderer.errors import InputError
from renderer.image import clamp, encode
from renderer.io.images import gray_or_image
from renderer.light import harmonics, ringing
from renderer.light.basis import DEGREE, Basis, harmonics_of, with_local_lights
from renderer.light.environment import SUFFIXES
from renderer.light.files import load_light
from renderer.light.lamps import LOCAL_LIGHTS
from renderer.mesh import Mesh, require_mesh
from renderer.settings import MIN_ROUGHNESS, ImageSettings, Size, settings_from
from renderer.surface.gloss import Gloss, smallest_roughness
from renderer.visibility import choose

# Bytes of the linear operator from light to image, for each pixel and each coefficient of the
# light: two channels of float32.
OPERATOR_BYTES = 8
# A mesh is given as the path of its file, as "solid:NAME", or as a `Mesh`.
MeshSource = str | Path | Mesh
MeshItem = ObjectSettings | tuple[MeshSource, str | int]
# Example of an entry of `build_scene` in messages.
EXAMPLE = "such as ('solid:orange', 'orange')"
# Names of the fields of `SceneSettings` and `RendererSettings` that `build_scene` takes as keyword
# arguments.
SCENE_OPTIONS = {item.name for item in fields(SceneSettings)} - {"views"}
RENDERER_OPTIONS = {item.name for item in fields(RendererSettings)}


def build_scene(
    meshes: Sequence[MeshItem | Sequence[MeshItem]],
    size: Size,
    views: int = 1,
    *,
    cameras: Sequence[Camera] | None = None,
    normalize: bool = True,
    shared: bool = False,
    scene: SceneSettings | None = None,
    renderer: RendererSettings | None = None,
    attack: AttackSettings | None = None,
    vary: VariationSettings | None = None,
    device: torch.device | str = "cpu",
    **options: Any,
) -> Scene:
    """Build a scene that shows every mesh from every camera in front of every background.

    Args:
        meshes: Pairs of a mesh and the name or the index of its class, or
            `ObjectSettings`. A mesh is a file, solid:NAME or a `Mesh`. An entry may
            also be a list of several objects on the same ground, of which attacks
            on shape and colors change the first.
        size: Pixels per side of the images, or (height, width). `width` and `fov`
            of the cameras are horizontal.
        views: Number of cameras, which are placed on a circle around the mesh.
        cameras: Cameras to use instead of a circle, such as those of
            `nb.load_cameras`. `views` must then be left out.
        normalize: Whether the cameras see each mesh moved to the origin and
            scaled to span [-1, 1]. If False, they see it at its place, in the
            units of its file. The scene then moves and scales mesh and cameras
            together. In both cases, lengths in settings, such as positions of
            lamps, are measured from the center of the object in units of its
            `SceneObject.extent`.
        shared: Whether all views of an object in front of a background are one
            example, for which an attack finds one lighting, shape and color. By
            default, each view is an example of its own.
        scene: Further settings of the scene. Its `views` are
            ignored.
        renderer: Settings of the renderer.
        attack: Settings of an attack that will follow. The attack may make
            surfaces smoother. The degree of the lighting is then high enough
            for their highlights.
        vary: Settings of a random variation (`augment.scene.vary.vary`)
            that will follow. They matter for the same reason.
        device: Device of the images.
        options: Fields of `SceneSettings` or `RendererSettings`, which replace
            those of `scene` and `renderer`.

    Returns:
        The scene.

    Raises:
        InputError: If an argument has the wrong type, is unknown or out of
            bounds, or if a file is missing.

    Example:
        >>> from dataclasses import replace
        >>> import norm_balls as nb
        >>> meshes = [("solid:orange", "orange"), ("solid:apple", "apple")]
        >>> scene = nb.build_scene(meshes, size=32, views=3, backgrounds=[0.2, 0.8], samples=1)
        >>> len(scene), scene.labels[0]
        (12, 'orange')

        A mesh and cameras in world units, as photogrammetry gives them:

        >>> mesh = nb.solid("orange")
        >>> placed = replace(mesh, vertices=mesh.vertices + [10.0, 0.0, 0.0])
        >>> view = [[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 15], [0, 0, 0, 1]]
        >>> camera = nb.PinholeCamera.from_matrix(view, [[40, 0, 16], [0, 40, 16], [0, 0, 1]], 32)
        >>> scene = nb.build_scene([(placed, "orange")], 32, cameras=[camera], normalize=False)
        >>> round(scene.objects[0].center[0])
        10
    """
    settings = SceneSettings.or_default("scene", scene)
    renderer_settings = RendererSettings.or_default("renderer", renderer)
    errors.require_flag("shared", shared)
    errors.require_whole("views", views)
    errors.require_flag("normalize", normalize)
    given_cameras = _as_cameras(cameras, views, normalize)
    views = len(given_cameras) or views
    image = ImageSettings(size)
    if unknown := sorted(options.keys() - SCENE_OPTIONS - RENDERER_OPTIONS):
        choices = ", ".join(sorted(SCENE_OPTIONS | RENDERER_OPTIONS))
        raise InputError(f"{unknown[0]} is no option of build_scene: choose from {choices}")
    scene_options = {name: options[name] for name in options.keys() & SCENE_OPTIONS}
    renderer_options = {name: options[name] for name in options.keys() - SCENE_OPTIONS}
    settings = replace(settings, views=views, **scene_options)
    renderer_settings = replace(renderer_settings, **renderer_options)
    objects = _load_objects(meshes, settings, renderer_settings.encoding)
    environment: Any = settings.light
    # Loads the lighting again with a higher degree, which a smoother surface may need later. It
    # stays None if the user gave coefficients or chose the degree.
    lights_of_degree = None
    if isinstance(environment, str | Path):
        # Only a map has detail that a smoother surface would show.
        material = _shown_material(attack, Path(environment).suffix.lower() in SUFFIXES)
        smoothest = reached_gloss(objects, material, vary.gloss if vary else None)
        pixels = views * len(objects) * image.pixel_count
        degree = degree_of_scene(smoothest, settings.degree, pixels)
        environment = load_light(environment, degree, smoothest.gloss_roughness)
        # Without gloss, light of half the reference degree is exact enough. For gloss, a window
        # that keeps highlights from ringing dims the light of any degree.
        if degree < REFERENCE_DEGREE // 2 or smoothest.gloss_roughness is not None:
            _warn_of_wrong_irradiance(settings.light, environment, degree)
        if settings.degree is None:
            lights_of_degree = partial(_lights_of_degree, settings)
    else:
        environment = errors.as_tensor("light", environment)
        # `degree_of` raises InputError if the shape is not that of coefficients.
        harmonics.degree_of(environment)
        errors.require_bounded(light=environment)
    basis, lights = build_lights(settings, environment)
    rasterizer = renderer_settings.rasterizer
    orbit = settings.width, settings.polar, settings.azimuth, settings.fov
    built = Scene.grid(
        objects,
        given_cameras or orbit_cameras(views, *orbit),
        load_backgrounds(settings.backgrounds, size),
        lights.to(errors.as_device(device)),
        renderer_settings.image(size),
        choose(rasterizer) if isinstance(rasterizer, str) else rasterizer,
        shared=shared,
        placed=not normalize,
        basis=basis,
        lights_of_degree=lights_of_degree,
        exposure=settings.given_exposure,
    )
    return expose(built) if settings.adapts_exposure else built


def _load_objects(meshes: object, settings: SceneSettings, encoding: str) -> list[SceneObject]:
    """Load the entries of the argument `meshes` of `build_scene`, and put a table under each."""
    expected = f"a list of pairs {EXAMPLE}, of nb.ObjectSettings, or of lists of them"
    members = errors.as_list("meshes", meshes, ObjectSettings | tuple | list, expected)
    if not members:
        raise InputError(f"meshes is empty: give pairs {EXAMPLE}")
    objects = []
    for index, member in enumerate(progress(members, "reading meshes")):
        name = f"meshes[{index}]"
        # A pair of a mesh and a label is a list, too, but has no settings or pairs inside.
        is_list = isinstance(member, list | tuple) and any(
            isinstance(part, ObjectSettings | tuple | list | Mapping) for part in member
        )
        given = enumerate(member) if is_list else ()
        parts = [_as_object(f"{name}[{part}]", item) for part, item in given]
        # All further objects of an entry stand beside its first one.
        first, *others = parts or [_as_object(name, member)]
        together = replace(first, others=[*first.others, *others])
        item = placed.load_object(together, settings.vertices, encoding)
        objects.append(placed.add_table(item, settings.ground))
    return objects


def _as_object(name: str, given: Any) -> ObjectSettings:
    """Convert settings, or a pair of a mesh and a label, to settings."""
    if isinstance(given, Mapping):
        given = settings_from(ObjectSettings, given, name)
    if isinstance(given, ObjectSettings):
        return given
    if not isinstance(given, tuple | list) or len(given) != 2:
        shown = errors.describe(given)
        raise InputError(f"{name} is {shown}: give a pair of a mesh and a label, {EXAMPLE}")
    mesh, label = given
    if not errors.is_whole(label):
        errors.require_kind(f"{name}: its label", label, str, "the name of a class, or its index")
    if not isinstance(mesh, str | Path):
        require_mesh(name, mesh)
        mesh = placed.name_mesh(mesh)
    # An index remains a number, because a class may have this number as its name.
    return ObjectSettings(str(mesh), label=label if isinstance(label, str) else int(label))


def _as_cameras(cameras: object, views: int, normalize: bool) -> list[Camera]:
    """Check the arguments `cameras`, `views` and `normalize` of `build_scene`.

    Return the given cameras without gradients, or an empty list for None.
    """
    if cameras is None:
        if not normalize:
            raise InputError("normalize=False needs cameras in the units of the mesh: give them")
        return []
    expected = "a list of cameras, such as list(nb.load_cameras(path).values())"
    given = errors.as_list("cameras", cameras, Camera, expected)
    if not given:
        raise InputError("cameras is empty: give one camera for each view, or leave it out")
    if views not in (1, len(given)):
        raise InputError(f"views={views} does not fit {len(given)} cameras: leave views out")
    fixed = [camera.fixed() for camera in given]
    # The scene turns cameras about the origin. Make the origin the center of these cameras.
    return [camera.normalized(np.zeros(3), 1.0) for camera in fixed] if normalize else fixed


def _lights_of_degree(
    settings: SceneSettings, degree: int, roughness: float | None
) -> tuple[Basis, Tensor]:
    """Load the lights with another degree, for a roughness that is None without gloss."""
    return build_lights(settings, load_light(settings.light, degree, roughness))


def build_lights(settings: SceneSettings, environment: Tensor) -> tuple[Basis, Tensor]:
    """Join the environment lighting with the projector and the lamps of the settings.

    Return the basis of all lights and their RGB coefficients.
    """
    given = {kind: getattr(settings, name) for name, kind in LOCAL_LIGHTS.items()}
    local = [kind.from_settings(light) for kind, light in given.items() if light is not None]
    return with_local_lights(environment * settings.given_exposure, local)


def load_backgrounds(choices: Sequence[float | str | Path], size: Size) -> Tensor:
    """Load the backgrounds of a scene.

    The shape is (B, 3, height, width), or (B, 1, height, width) if all backgrounds are gray.
    """
    expected = "gray values in [0, 1] or image files"
    choices = errors.as_list("backgrounds", choices, object, f"a list of {expected}")
    images = [gray_or_image("backgrounds", choice, size) for choice in choices]
    channels = max(len(image) for image in images)
    return torch.stack([image.expand(channels, -1, -1) for image in images])


# Warnings are given if the irradiance of a lighting is off by more than this: the rms error divided
# by the rms irradiance.
MAX_IRRADIANCE_ERROR = 0.05
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
        """Return the degree of lighting that shows the highlights, or 0 without gloss."""
        return ringing.required_degree(self.roughness) if self.roughness < MATTE else 0

    def affordable_degree(self, pixels: int) -> int:
        """Return the degree of lighting that the surface needs, as far as memory permits."""
        free = errors.free_memory(torch.device("cpu"))
        # An unknown amount of free memory counts as enough.
        if free is None:
            return max(DEGREE, self.degree)
        # Light of degree d has (d + 1)² coefficients.
        fitting = math.isqrt(free // (OPERATOR_BYTES * pixels)) - 1
        return max(DEGREE, min(self.degree, fitting))

    def warn(self, subject: str) -> None:
        """Warn that the degree of the lighting is too low for the highlights of the surface."""
        surface = f"{self.name} {self.verb} gloss of roughness {self.roughness:.2g}"
        needed = f"which takes light of degree {self.degree}"
        warnings.warn(f"{surface}, {needed}: {subject} blurs its highlights", stacklevel=4)


def reached_gloss(
    objects: Iterable[SceneObject],
    material: MaterialSettings | None = None,
    layer: SpecularLayerSettings | None = None,
) -> Smoothest:
    """Find the smoothest surface that objects have, or get by an attack or a random variation.

    Surfaces of all objects count. None stands for no attack or no variation.
    """
    candidates = [Smoothest(MATTE, "")]
    for item in objects:
        reached = _reached_roughness(item, material, layer)
        candidates.append(Smoothest(smallest_roughness(item.mesh), item.name))
        candidates.append(Smoothest(reached, item.name, "can reach"))
    return min(candidates, key=lambda smoothest: smoothest.roughness)


def _reached_roughness(
    item: SceneObject, material: MaterialSettings | None, layer: SpecularLayerSettings | None
) -> float:
    """Compute the lowest roughness that an attack or a random variation can give to an object.

    It is `MATTE` if neither changes the gloss. Other objects and the table do not count.
    """
    if layer is not None and not any(layer.specular_factor):
        layer = None
    parts = (material.roughness, material.metallic, material.specular_factor) if material else ()
    if layer is None and not any(parts):
        return MATTE
    # Roughness of each face of the object itself.
    roughness = placed.initial_materials(item)[item.own_faces, placed.ROUGHNESS]
    if layer is not None:
        roughness = torch.full_like(roughness, layer.roughness[0])
    if material is not None and material.roughness:
        # An attack lowers the mean roughness of the faces, and each face by the same amount. Its
        # radius counts units of size `material.roughness`.
        radius = math.inf if material.radius is None else material.radius
        mean = float(roughness.mean())
        lowest_mean = max(mean - radius * material.roughness, MIN_ROUGHNESS)
        roughness = (roughness + min(lowest_mean - mean, 0.0)).clamp(min=0)
    # `Gloss` gets its default specular factor of 1, because attacks and variations can reach 1.
    return smallest_roughness(Gloss(roughness, textured=layer is None).on(item.own_mesh))


def degree_of_scene(smoothest: Smoothest, given: int | None, pixels: int) -> int:
    """Choose the degree of the spherical harmonics of a scene's lighting.

    If the user gives none, it is the lowest degree that shows the highlights of
    all surfaces, but at least 6. Warnings are given if it is above 6, if memory
    limits it, or if the user gives a degree that is too low.
    """
    if given is None:
        degree = smoothest.affordable_degree(pixels)
        if degree < smoothest.degree:
            smoothest.warn(f"degree={degree}, the highest that fits in memory,")
        elif degree > DEGREE:
            smoothest.warn(f"degree={DEGREE} takes less time, but")
        return degree
    if smoothest.degree > given:
        smoothest.warn(f"degree={given}")
    return given


def _warn_of_wrong_irradiance(name: str, light: Tensor, degree: int) -> None:
    """Warn if a named lighting has too low a degree for its irradiance.

    The irradiance is compared with that of the same lighting without a window, of a degree that is
    high enough.
    """
    reference = degree if degree >= REFERENCE_DEGREE // 2 else REFERENCE_DEGREE
    error = float(harmonics.irradiance_error(light, load_light(name, reference)))
    if error > MAX_IRRADIANCE_ERROR:
        reason = f"has an irradiance that is off by {error:.0%} (rms over normals)"
        advice = "and attacks of it have the same degree: give a higher degree"
        warnings.warn(f"light {name} of degree={degree} {reason}, {advice}", stacklevel=3)


def _shown_material(attack: AttackSettings | None, has_detail: bool) -> MaterialSettings | None:
    """Return the material for whose highlights the degree of the lighting is chosen, if any.

    Light without detail shows no more of them at a higher degree. Attacked light keeps its degree,
    because each step makes it nonnegative, which takes seconds at degree 25.
    """
    if attack and not attack.lighting and (has_detail or attack.skylight):
        return attack.material
    return None


def with_needed_degree(
    scene: Scene, attack: AttackSettings, layer: SpecularLayerSettings | None = None
) -> Scene:
    """Raise the degree of a scene's lighting if an attack or a variation needs it.

    Attacks and variations may make surfaces smoother, so that their highlights
    need a higher degree. Only a degree that `build_scene` chose is raised. If
    the user gave the degree or the coefficients, or if the attack changes them,
    a warning is given instead.
    """
    degree = harmonics_of(scene.basis).degree
    # If the coefficients of the highest degree are zero, the lighting is so smooth that a higher
    # degree would add nothing.
    has_detail = bool(scene.lights[:, degree**2 : (degree + 1) ** 2].any())
    smoothest = reached_gloss(scene.objects, _shown_material(attack, has_detail), layer)
    needed = smoothest.affordable_degree(len(scene) * scene.views * scene.settings.pixel_count)
    if needed > degree and scene.lights_of_degree is not None:
        # Lighting that was changed after `build_scene` cannot be loaded again with another
        # degree. Compare the lighting of the scene with what `build_scene` loaded.
        _, built = scene.lights_of_degree(degree, reached_gloss(scene.objects).gloss_roughness)
        has_same_shape = scene.lights.shape[1:] == built.shape
        if has_same_shape and (scene.lights == built.to(scene.lights)).all():
            smoothest.warn(f"degree={degree} takes less time, but")
            basis, lights = scene.lights_of_degree(needed, smoothest.gloss_roughness)
            return scene.changed(basis=basis, lights=lights.to(scene.lights))
    reached = reached_gloss(scene.objects, attack.material, layer)
    if reached.degree > degree and (has_detail or attack.lighting):
        reached.warn(f"degree={degree}")
    return scene


# Mean value of an object's pixels at the exposure "auto", and the largest one of its values
# that are not 0, as most are in a black or in a red object.
MEAN, LIT_MEAN = 0.4, 0.8
# Means beyond these limits are warned about.
DARK, BRIGHT = 0.05, 0.95
# Largest number of examples of an object from which its exposure is chosen.
PROBED = 8
# The exposure "auto" is sought between 2 to the power of minus and plus this number of stops.
STOPS = 20


def expose(scene: Scene) -> Scene:
    """Choose the exposure of each object at which its pixels have the mean MEAN, and say it."""
    factors = []
    for index, item in enumerate(scene.objects):
        all_rows = scene.rows_of(index)
        # At most `PROBED` examples at equal distances. -(-a // b) divides and rounds up.
        rows = all_rows[:: -(-len(all_rows) // PROBED)]
        shown = {"examples": [scene.examples[row] for row in rows], "lights": scene.lights[rows]}
        # Black lies behind them. Transfer operators would be built for light that never changes.
        black = torch.zeros_like(scene.backgrounds)
        probe = scene.changed(**shown, backgrounds=black, camera_effects=None, one_light=True)
        # Light of projector and lamps, which the exposure leaves as it is.
        local = _linear_values(probe, 0.0) if scene.basis.local_lights else torch.zeros(1)
        values = _linear_values(probe, 1.0) - local
        # Fraction of the values that are not 0, which alone can grow with the exposure.
        lit = float((values > 0).float().mean())
        aim = min(MEAN, LIT_MEAN * lit)
        low, high = -float(STOPS), float(STOPS)
        # The mean grows with the exposure. 40 halvings leave 2^-35 stops.
        for _ in range(40):
            middle = (low + high) / 2
            mean = encode(clamp(values * 2**middle + local), scene.settings.encoding).mean()
            low, high = (middle, high) if mean < aim else (low, middle)
        # Nothing brightens what is black, and nothing darkens projector and lamps.
        local_mean = encode(clamp(local), scene.settings.encoding).mean()
        is_above = lit > 0 and float(local_mean) >= aim
        factors.append(2**low if lit and not is_above else 1.0)
        mean = encode(clamp(values * factors[-1] + local), scene.settings.encoding).mean()
        said = f"{item.name}: exposure={factors[-1]:.3g}, at which its mean is {mean:.2g}"
        if is_above:
            said += f", because projector and lamps alone exceed {aim:.2g}: lower their power"
        say_once(said)
    exposures = [each.exposure * factors[each.object] for each in scene.examples]
    return scene.changed(examples=placed.with_field(scene.examples, "exposure", exposures))


def _linear_values(probe: Scene, factor: float) -> Float[Tensor, "N 3"]:
    """Return the linear values, before clamping, of the pixels of the first object in examples.

    The environment light is multiplied by the factor.
    """
    every = torch.arange(len(probe))
    # Images that have the values of the object at its pixels, and 0 elsewhere.
    canvas = torch.zeros(len(probe) * probe.views, 3, probe.settings.pixel_count)
    lights = probe.lights.clone()
    if probe.basis.environment is not None:
        lights[:, probe.basis.environment.rows] *= factor
    # With `one_light`, a scene keeps the shadows of its first light, so make a copy.
    lit = probe.changed(lights=lights)
    for layer in lit.layers(lit.conditions(every), every.to(lights.device)):
        shown = layer.composite.detach().float().cpu()
        canvas[layer.rows] = canvas[layer.rows].index_copy(2, layer.pixels.cpu(), shown)
    masks = probe.truth(unlabeled).masks[:, :, 0].flatten(0, 1).flatten(1).cpu()
    return canvas.transpose(1, 2)[masks]


@torch.no_grad()
def warn_of_exposure(scene: Scene, images: Float[Tensor, "E V 3 H W"] | None = None) -> None:
    """Warn of objects that are almost black or white in their first example.

    Without the images of all examples, that example is rendered.
    """
    # First example of each object.
    shown_objects = scene.object_of.unique().tolist()[:PROBED]
    firsts = [scene.rows_of(index)[0] for index in shown_objects]
    rows = torch.tensor(firsts, device=scene.lights.device)
    shown = scene.render(scene.conditions(rows), rows) if images is None else images[rows]
    masks = scene.truth(unlabeled, rows).masks[:, :, 0]
    for index, image, mask in zip(shown_objects, shown, masks, strict=True):
        mean = float(image.movedim(1, 0)[:, mask].mean()) if mask.any() else MEAN
        if not DARK <= mean <= BRIGHT:
            kind = "dark" if mean < DARK else "bright"
            advice = "set exposure=auto or another light"
            say_once(f"{scene.objects[index].name} is too {kind}: its mean is {mean:.2f}; {advice}")
