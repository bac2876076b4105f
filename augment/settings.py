"""Settings of scenes, their variation and the augmentation service.

This module imports neither torch nor NumPy; see `renderer.settings`. The settings of attacks are
in `augment.attack_settings`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

from augment.attack_settings import AttackSettings, StepSettings
from renderer.errors import MAX_SCALE, InputError, describe, is_number, require_choice
from renderer.settings import (
    MAX_DEGREE,
    MAX_SAMPLES,
    MAX_VERTICES,
    MAX_VIEWS,
    MIN_ROUGHNESS,
    RASTERIZERS,
    REQUIRED,
    ImageSettings,
    Settings,
    samples_per_side,
    setting,
    setting_like,
    settings_from,
)

MODES = {
    "none": "no renders",
    "random": "randomized renders",
    "adversarial": "attacked renders",
    "folder": "images",
}
INITS = ("scene", "random")
UP_AXES = ("auto", "y", "z")
MAX_EXAMPLES = 10**6
MAX_INTERVAL = 10**9  # Largest number of training images between two regenerations of renders.
MAX_PROP_DISTANCE = 10.0  # Largest distance and size of meshes beside an object, in world units.
MAX_PROJECTOR_PIXELS = 256  # per side
MAX_BLUR = 1.5  # pixels
# Limits of a random field of view in degrees. The larger it is, the closer is the camera. Beyond
# 45 degrees, the camera could be inside of a mesh that spans [-1, 1].
MIN_FOV = 1.0
MAX_FOV = 45.0
UNCHANGED = (1.0, 1.0)  # Range of a factor that is always 1.
NONE = (0.0, 0.0)  # Range of a number that is always 0.


@dataclass
class MeshSettings(Settings):
    """A mesh and its material."""

    mesh: str = setting(
        REQUIRED, "A mesh file, or a procedural solid as solid:NAME or solid:NAME:SEED."
    )
    _: KW_ONLY
    up: str = setting("auto", "Axis that points up in the file.", choices=UP_AXES)
    color: list[float] | None = setting(
        None, "Color of a mesh without colors: red, green and blue in sRGB, from 0 to 1."
    )
    gloss: Any = setting(
        None,
        "Specular material: [roughness, metallic, specular factor] or the first of them, from 0 "
        "to 1, or file for the material of a glTF file. null: none.",
    )

    def __post_init__(self) -> None:
        """Check the gloss and the color of the mesh.

        Raises:
            InputError: If one of them is not valid.
        """
        if isinstance(self.mesh, Path):
            self.mesh = str(self.mesh)
        super().__post_init__()
        if self.gloss == "file" and self.mesh.startswith("solid:"):
            raise InputError(
                f"gloss=file, but {self.mesh} is not a file with a material: "
                "give [roughness, metallic, specular factor] in [0, 1]",
                "gloss",
            )
        if self.gloss not in (None, "file") and not _is_gloss(self.gloss):
            raise InputError(
                f"gloss={self.gloss}: "
                "give [roughness, metallic, specular factor] in [0, 1], "
                "or the word file for the material in the file of the mesh",
                "gloss",
            )
        require_color("color", self.color)


def _is_gloss(values: object) -> bool:
    """Return whether a value is a list of one to three numbers in [0, 1], such as a gloss."""
    if not isinstance(values, Sequence) or isinstance(values, str):
        return False
    return 1 <= len(values) <= 3 and all(is_number(item) and 0 <= item <= 1 for item in values)


def require_color(name: str, color: Sequence[float] | None) -> None:
    """Check that a color has three channels from 0 to 1."""
    if color is None:
        return
    if len(color) != 3 or not all(0 <= channel <= 1 for channel in color):
        raise InputError(f"{name}={color}: give red, green and blue from 0 to 1", name)


@dataclass
class PropSettings(MeshSettings):
    """A prop: a mesh beside the object, on the same ground. It is never attacked."""

    at: list[float] = setting(
        REQUIRED,
        "x and y of its centroid in world units.",
        minimum=-MAX_PROP_DISTANCE,
        maximum=MAX_PROP_DISTANCE,
    )
    scale: float = setting(
        1.0,
        "Its largest coordinate. The largest coordinate of the object is 1.",
        minimum=1 / MAX_PROP_DISTANCE,
        maximum=MAX_PROP_DISTANCE,
    )
    azimuth: float = setting(
        0.0, "Rotation about the vertical.", "degrees", minimum=-360, maximum=360
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.at) != 2:
            message = f"at={self.at}: give two numbers, the position x and y on the ground"
            raise InputError(message, "at")


@dataclass
class ObjectSettings(MeshSettings):
    """One object of a scene.

    It may have props, which are meshes beside it. They are rendered with their shadows, but they
    are never attacked.

    >>> import norm_balls as nb
    >>> nb.ObjectSettings("solid:orange", label="orange").albedo_scale
    1.0
    """

    label: str = setting(REQUIRED, "Name of its class. It may be empty.", may_be_empty=True)
    albedo_scale: float = setting(
        1.0, "Factor of its albedo.", minimum=1 / MAX_SCALE, maximum=MAX_SCALE
    )
    props: list[Any] = setting([], "Meshes beside the object, as mappings or PropSettings.")

    def __post_init__(self) -> None:
        """Convert the props, which are meshes beside the object, to settings.

        Raises:
            InputError: If a prop is neither a mapping nor `PropSettings`.
        """
        super().__post_init__()
        for index, prop in enumerate(self.props):
            if isinstance(prop, Mapping):
                self.props[index] = settings_from(PropSettings, prop, f"props[{index}]")
            elif not isinstance(prop, PropSettings):
                raise InputError(
                    f"props[{index}] is {describe(prop)}: give a mapping, or an object "
                    "of the class norm_balls.PropSettings",
                    "props",
                )


@dataclass
class ProjectorSettings(Settings):
    """A projector, and the pattern that it shows before an attack."""

    pixels: int = setting(
        16, "Pixels per side of its pattern.", minimum=1, maximum=MAX_PROJECTOR_PIXELS
    )
    polar: float = setting(
        45.0, "Polar angle of the projector from +z.", "degrees", minimum=0, maximum=180
    )
    azimuth: float = setting(
        45.0, "Azimuth of the projector.", "degrees", minimum=-360, maximum=360
    )
    distance: float = setting(
        4.0, "Distance from the origin in world units.", minimum=2, maximum=MAX_SCALE
    )
    fov: float = setting(
        30.0, "Angle between the sides of its image.", "degrees", minimum=0.1, maximum=170
    )
    power: float = setting(
        1.0, "Largest value of a pixel.", minimum=1 / MAX_SCALE, maximum=MAX_SCALE
    )
    pattern: Any = setting(
        0.0, "Pattern with which attacks start: a gray value in [0, 1] or an image file."
    )


@dataclass
class LampsSettings(Settings):
    """Lamps at given positions. They are points or, if they have a radius, discs."""

    positions: list[Any] = setting(
        [[2.0, 2.0, 2.0], [2.0, -2.0, 2.0], [-2.0, 2.0, 2.0], [-2.0, -2.0, 2.0]],
        "Positions [x, y, z] of the lamps in world units.",
    )
    power: float = setting(
        10.0, "Largest power of a lamp.", minimum=1 / MAX_SCALE, maximum=MAX_SCALE
    )
    radius: float = setting(
        0.0, "Radius of the discs in world units.", minimum=0, maximum=MAX_SCALE
    )
    start: Any = setting(
        0.0,
        "Powers with which attacks start: a number, [r, g, b] of each lamp, or the lamps.json of "
        "an adversary. Its positions, power and radius then replace the others.",
    )


# Settings of each kind of local light, see `renderer.light.local_lights`.
LOCAL_LIGHT_SETTINGS: dict[str, type[Settings]] = {
    "projector": ProjectorSettings,
    "lamps": LampsSettings,
}


@dataclass
class SceneSettings(Settings):
    """Cameras, backgrounds and lighting of a scene."""

    backgrounds: list[Any] = setting([0.5], "Gray values in [0, 1] or image files.")
    views: int | None = setting(
        1, "Number of cameras per mesh, at equal azimuths.", minimum=1, maximum=MAX_VIEWS
    )
    polar: float = setting(
        60.0, "Polar angle of the cameras from +z.", "degrees", minimum=0, maximum=180
    )
    azimuth: float = setting(
        0.0,
        "Azimuth of the first camera from +x toward +y.",
        "degrees",
        minimum=-360,
        maximum=360,
    )
    width: float = setting(
        2.0, "Width of the image in world units, at the mesh. The mesh spans [-1, 1]."
    )
    fov: float | None = setting(
        None,
        "Angle between the sides of the image. null: orthographic.",
        "degrees",
        minimum=0.1,
        maximum=150,
    )
    vertices: int = setting(
        0,
        "Subdivide each mesh until it has more vertices than this. The paper attacks shapes with "
        "more than 10,000.",
        minimum=0,
        maximum=MAX_VERTICES,
        checks_type=False,  # A float such as 1e4 is valid, too.
    )
    light: str = setting(
        "grace",
        "Environment lighting: grace, eucalyptus, st_peters, uniform, an environment map "
        "(.npy, .hdr, .exr) or coefficients (.json).",
        checks_type=False,  # A tensor of coefficients is valid, too.
    )
    degree: int | None = setting(
        None,
        "Spherical-harmonic degree of the lighting. "
        "null: 6, or what the smoothest specular material needs that the run can reach.",
        minimum=0,
        maximum=MAX_DEGREE,
    )
    exposure: float = setting(
        1.0, "Factor of the lighting.", minimum=1 / MAX_SCALE, maximum=MAX_SCALE
    )
    # `projector` and `lamps` are dictionaries that `__post_init__` converts to settings, because
    # OmegaConf cannot set a single field of an optional dataclass.
    projector: Any = setting(
        None,
        "A projector: {pixels: 16, polar: 45, azimuth: 45, distance: 4, fov: 30, power: 1, "
        "pattern: 0.0 or FILE}, or some of these keys. null: none.",
    )
    lamps: Any = setting(
        None,
        "Lamps: {positions: [[2, 2, 2], ...], power: 10, radius: 0.0, start: 0.0 or FILE.json}, "
        "or some of these keys. null: none.",
    )
    ground: list[float] | None = setting(
        None, "Color of a table under each mesh: [r, g, b] in sRGB. null: no table."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, kind in LOCAL_LIGHT_SETTINGS.items():
            setattr(self, name, _as_settings(name, getattr(self, name), kind))


def _as_settings(name: str, value: object, kind: type[Settings]) -> Settings | None:
    """Convert a mapping to settings. None and settings are returned as they are."""
    if isinstance(value, Mapping):
        return settings_from(kind, value, name)
    if value is None or isinstance(value, kind):
        return value
    raise InputError(f"{name} is {describe(value)}: give a mapping or {kind.__name__}(...)", name)


@dataclass
class RendererSettings(Settings):
    """Settings of the renderer for the images of a scene."""

    rasterizer: str = setting(
        "auto",
        "Rasterizer: auto (numba if it is installed, otherwise numpy), opengl, numba or numpy.",
        checks_type=False,  # A `Rasterizer` is valid, too.
    )
    samples: int | None = setting(
        None,
        "Samples per side of a pixel. With 2, each pixel has 4 samples. null: 2, or 8 with "
        "silhouettes.",
        minimum=1,
        maximum=MAX_SAMPLES,
    )
    encoding: str = setting_like(ImageSettings, "encoding", "linear")
    normals: str = setting_like(ImageSettings, "normals", "smooth")
    shadows: bool = setting_like(ImageSettings, "shadows", False)
    bounces: int = setting_like(ImageSettings, "bounces", 0)
    silhouettes: bool = setting_like(ImageSettings, "silhouettes", False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not hasattr(self.rasterizer, "rasterize"):
            require_choice("rasterizer", self.rasterizer, RASTERIZERS)

    def image(self, size: int) -> ImageSettings:
        """Return the settings of images with a size in pixels per side."""
        return ImageSettings(
            size=size,
            samples=samples_per_side(self.samples, self.silhouettes),
            encoding=self.encoding,
            normals=self.normals,
            shadows=self.shadows,
            bounces=self.bounces,
            silhouettes=self.silhouettes,
        )


@dataclass
class SpecularLayerSettings(Settings):
    """Ranges of a random specular layer, such as varnish, that each object gets in each render."""

    roughness: list[float] = setting(
        [0.4, 0.8],
        "Smallest and largest roughness. Below 0.5, the lighting gets a higher degree.",
        minimum=MIN_ROUGHNESS,
        maximum=1,
        is_pair=True,
    )
    specular_factor: list[float] = setting(
        list(NONE),
        "Smallest and largest strength. [0, 0]: no layer.",
        minimum=0,
        maximum=1,
        is_pair=True,
    )


@dataclass
class CameraEffectSettings(Settings):
    """Random effects of a camera and of a projected pattern on each render.

    `white_balance`, `blur` and `noise` are upper limits. The strength for each
    render is drawn uniformly between 0 and the limit.
    """

    pattern_fraction: float = setting(
        0.0, "Fraction of renders under a projected pattern.", minimum=0, maximum=1
    )
    slides: str | None = setting(
        None, "Folder of photographs, which half of the patterns show. null: none."
    )
    pattern_fill: list[float] = setting(
        list(NONE),
        "Smallest and largest factor of the lighting of the scene beneath the pattern.",
        minimum=0,
        maximum=1,
        is_pair=True,
    )
    white_balance: float = setting(
        0.0, "Largest change of each channel.", "stops", minimum=0, maximum=5
    )
    blur: float = setting(
        0.0, "Largest standard deviation of the blur.", "pixels", minimum=0, maximum=MAX_BLUR
    )
    noise: float = setting(
        0.0, "Largest standard deviation of the pixel noise.", minimum=0, maximum=1
    )


@dataclass
class VariationSettings(Settings):
    """Ranges of the random pose, lighting and surroundings of each render during training.

    By default nothing is random. An attack changes the lighting of the object only. The
    background keeps the random lighting.

    >>> import norm_balls as nb
    >>> nb.VariationSettings(shift=0.1).moves, nb.VariationSettings(exposure=[0.5, 2.0]).moves
    (True, False)
    """

    shift: float = setting(
        0.0,
        "Largest distance of the mesh from the center of the image, as a fraction of its width.",
        minimum=0,
        maximum=1,
    )
    scale: list[float] = setting(
        list(UNCHANGED),
        "Smallest and largest factor of the size in the image.",
        minimum=1 / MAX_SCALE,
        maximum=MAX_SCALE,
        is_pair=True,
    )
    exposure: list[float] = setting(
        list(UNCHANGED),
        "Smallest and largest factor of the lighting.",
        minimum=1 / MAX_SCALE,
        maximum=MAX_SCALE,
        is_pair=True,
    )
    backgrounds: str | None = setting(
        None, "Folder of images that replace scene.backgrounds. null: none."
    )
    instances: bool = setting(
        False, "Draw another instance of each solid that is named without a seed."
    )
    azimuth: float = setting(
        0.0,
        "Largest motion of the camera around the mesh, to either side and up and down.",
        "degrees",
        minimum=0,
        maximum=180,
    )
    fov: list[float] = setting(
        list(NONE),
        "Smallest and largest angle between the sides of the image, from 1 to 45. [0, 0]: the "
        "camera of the scene.",
        "degrees",
        minimum=0,
        maximum=MAX_FOV,
        is_pair=True,
    )
    rotation: float = setting(
        0.0,
        "Largest rotation of the mesh about a random axis.",
        "degrees",
        minimum=0,
        maximum=180,
    )
    environments: list[str] = setting(
        [], "Environment lightings that replace scene.light, one of them for each render."
    )
    directional_fraction: float = setting(
        0.0,
        "Fraction of renders in directional lighting from the side of the camera, up to 70 "
        "degrees from it.",
        minimum=0,
        maximum=1,
    )
    fill_light: list[float] = setting(
        list(NONE),
        "Smallest and largest factor of the environment lighting of these renders.",
        minimum=0,
        maximum=1,
        is_pair=True,
    )
    lit_background: bool = setting(False, "Light the backgrounds as walls that face the camera.")
    tables: float = setting(
        0.0,
        "Fraction of renders on a table in front of a wall, in the lighting and the shadow of the "
        "object.",
        minimum=0,
        maximum=1,
    )
    background_saturation: float = setting(
        0.0,
        "Largest saturation of a random color that multiplies each background.",
        minimum=0,
        maximum=1,
    )
    gloss: SpecularLayerSettings = setting(
        SpecularLayerSettings, "A specular layer on each object, which replaces its own material."
    )
    camera: CameraEffectSettings = setting(
        CameraEffectSettings, "Effects of a camera on each render."
    )

    def __post_init__(self) -> None:
        """Check the range of the field of view.

        Raises:
            InputError: If the smallest field of view is too small.
        """
        super().__post_init__()
        if tuple(self.fov) != NONE and self.fov[0] < MIN_FOV:
            raise InputError(
                f"fov={list(self.fov)}: "
                f"give [minimum, maximum], both from {MIN_FOV:g} to {MAX_FOV:g}",
                "fov",
            )

    @property
    def moves(self) -> bool:
        """Return whether objects or cameras are random, so that they are rasterized each time."""
        new_objects = self.instances or self.rotation > 0 or any(self.gloss.specular_factor)
        is_scaled = tuple(self.scale) != UNCHANGED
        moved = self.shift > 0 or is_scaled or any((self.azimuth, *self.fov))
        return moved or new_objects or self.tables > 0


@dataclass
class RandomLightSettings(Settings):
    """Random perturbation of the lighting of the scene."""

    amplitude: float = setting(
        0.5,
        "Each coefficient changes by a uniform draw between minus and plus this value.",
        minimum=1 / MAX_SCALE,
        maximum=MAX_SCALE,
    )
    radius: float | None = setting(
        None,
        "L2 norm of the perturbation instead. 30 attack steps of 0.05 reach 1.5 at most. null: "
        "the amplitude applies.",
        minimum=1 / MAX_SCALE,
        maximum=MAX_SCALE,
    )


@dataclass
class TrainingAttackSettings(AttackSettings):
    """Attack during training.

    By default, this is the attack of appendix C of the paper, which changes all coefficients of
    the lighting. It takes 30 steps of length 0.05 along the direction of the gradient, and permits
    negative radiance. It stops when the classifier is wrong, without sensor noise and without the
    rounding of images to 8 bits.
    """

    step: str = setting_like(StepSettings, "step", "unit")
    step_size: float = setting_like(StepSettings, "step_size", 0.05)
    allow_negative: bool = True
    margin: float = 0.0
    quantized: bool = False
    sensor_noise: float = 0.0
    batch_size: int = 128

    @property
    def parameters(self) -> dict[str, StepSettings]:
        """Return the settings of the attacked parameters by their names.

        If no parameter is set, the lighting is attacked.
        """
        lighting = StepSettings(step=self.step, step_size=self.step_size)
        return super().parameters or {"lighting": lighting}


@dataclass
class AugmentationSettings(Settings):
    """Renders that augment the training, and how often they are rendered again.

    >>> import norm_balls as nb
    >>> random_light = nb.RandomLightSettings(radius=1.5)
    >>> nb.AugmentationSettings(mode="random", random_light=random_light).renders
    True
    """

    mode: str = setting("adversarial", "Kind of renders.", choices=MODES)
    folder: str | None = setting(
        None,
        "Folder of images for mode=folder: a folder per class, or other_NAME. They replace the "
        "renders.",
    )
    examples: int | None = setting(
        100,
        "Renders per regeneration: meshes × views × backgrounds. null: as many as scene.views "
        "makes, or all images of the folder.",
        minimum=0,
        maximum=MAX_EXAMPLES,
    )
    init: str = setting(
        "scene",
        "Start of an attack: the lighting of the scene (scene) or a random perturbation (random).",
        choices=INITS,
    )
    warm_start: bool = setting(
        False, "Start each attack where the attack of the previous regeneration ended."
    )
    regenerate_every: int | None = setting(
        None,
        "Training images between two regenerations. null: regenerate once per epoch.",
        minimum=1,
        maximum=MAX_INTERVAL,
    )
    vary: VariationSettings = setting(
        VariationSettings, "What is drawn anew for each render in each regeneration."
    )
    random_light: RandomLightSettings = setting(
        RandomLightSettings, "Perturbation of the lighting for mode=random and for init=random."
    )
    attack: TrainingAttackSettings = setting(
        TrainingAttackSettings,
        "The attack during training.",
        checks_type=False,  # `AttackSettings` are valid, too.
    )

    def __post_init__(self) -> None:
        """Check that the settings do not contradict each other.

        Raises:
            InputError: If the attack changes nothing, if a folder or a radius is missing, or if
                `warm_start` is combined with random shapes.
        """
        super().__post_init__()
        if not isinstance(self.attack, AttackSettings):
            raise InputError(
                f"attack is {describe(self.attack)}: give the settings of an attack", "attack"
            )
        if not self.attack.parameters:
            raise InputError(
                "attack changes nothing: give TrainingAttackSettings(), or name a parameter",
                "attack",
            )
        if self.mode == "folder" and not self.folder:
            raise InputError(
                f"folder is {self.folder}, but mode=folder needs a folder of images: "
                "set folder, or choose another mode",
                "folder",
            )
        uses_random_draws = "random" in (self.mode, self.init)
        for name, steps in self.attack.parameters.items():
            if uses_random_draws and name != "lighting" and steps.radius is None:
                missing = f"attack.{name}.radius"
                message = (
                    f"{missing} is None, but random values are drawn from the norm-ball: "
                    "set a radius"
                )
                raise InputError(message, missing)
        if self.warm_start and self.vary.instances:
            raise InputError(
                "warm_start=True continues the last attack, but vary.instances=True changes the "
                "shapes: set one of them to False",
                "warm_start",
            )

    @property
    def renders(self) -> bool:
        """Return whether these settings ask for any renders or other images."""
        return self.mode != "none" and self.examples != 0


def count_views(examples: int | None, objects: int, backgrounds: int, views: int | None) -> int:
    """Compute the number of views of each mesh from the number of renders.

    The number of renders is meshes × views × backgrounds. For example, 2 meshes, 10 views and 5
    backgrounds give 100 renders. None stands for a number that follows from the other.
    """
    if not objects or not backgrounds:
        raise InputError("meshes and backgrounds must not be empty: name one of each", "meshes")
    if examples is None and views is not None:
        return views
    derived, rest = divmod(examples or 0, objects * backgrounds)
    if rest or derived < 1 or views not in (None, derived):
        raise InputError(
            f"examples={examples} is not "
            f"{objects} meshes × {views or 'some'} views × {backgrounds} backgrounds: "
            "change one of these numbers, or set views or examples to None to compute it",
            "examples",
        )
    return derived


@dataclass
class NormalizedLightSettings(Settings):
    """How the light of each image is normalized before a classifier sees it.

    `benchmarks/normalized_light.py` chose the defaults on validation data.
    """

    percentile: float = setting(
        95.0,
        "Percentile of all pixels and channels that the exposure maps to `level`.",
        above=0,
        maximum=100,
    )
    level: float = setting(
        1.0,
        "Linear value of this percentile after the exposure.",
        above=0,
        maximum=1,
    )
    white_balance: float = setting(
        0.0,
        "Degree of the white balance. 0: none. 1: all channels have the same mean (gray world).",
        minimum=0,
        maximum=1,
    )
    gamma: float = setting(
        1.25,
        "Exponent of the encoded image. 1: sRGB. Less than 1 brightens the image.",
        minimum=0.1,
        maximum=10,
    )


# Type of the argument `normalize_light` of several functions.
NormalizeLight = bool | Mapping[str, Any] | NormalizedLightSettings | None


def read_normalized_light(value: NormalizeLight) -> NormalizedLightSettings | None:
    """Convert a value of the argument `normalize_light` to settings.

    True stands for the defaults. False and None give None.
    """
    if value is None or value is False:
        return None
    if value is True:
        return NormalizedLightSettings()
    if isinstance(value, NormalizedLightSettings):
        return value
    if isinstance(value, Mapping):
        return settings_from(NormalizedLightSettings, value, "normalize_light")
    raise InputError(
        f"normalize_light is {describe(value)}: give "
        "true, false, or a mapping such as {white_balance: 0.5}",
        "normalize_light",
    )
