"""Settings of scenes and of the input of networks.

This module imports neither torch nor NumPy; see `renderer.settings`. The settings of attacks are
in `augment.attack_settings`, those of random variation and training renders in
`augment.augmentation_settings`.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any, Self

from renderer import settings as base
from renderer.errors import MAX_SCALE, InputError, is_number, require_choice, require_number
from renderer.settings import REQUIRED, ImageSettings, Settings, Size, setting, setting_like

# Value of the pixels of a mask or a label map that have no class, as in VOC. They do not count.
NO_CLASS_PIXEL = 255
# The name of a network begins with this text if a Python function of the user makes it.
PYTHON = "python:"


def split_function(name: str) -> tuple[str, str]:
    """Split "package.module:function" or "package.module.function" into module and function.

    The name may begin with PYTHON.
    """
    path = name.removeprefix(PYTHON)
    module, _, function = path.rpartition(":" if ":" in path else ".")
    return module, function


@dataclass
class MeshSettings(Settings):
    """A mesh and its material."""

    mesh: str = setting(REQUIRED, "A mesh file, or a solid: solid:NAME or solid:NAME:SEED.")
    _: KW_ONLY
    up: str = setting("auto", "Axis that points up in the file.", choices=("auto", "y", "z"))
    color: list[float] | None = setting(
        None, "Color of a mesh without colors: [r, g, b] in sRGB.", length=3, within=(0, 1)
    )
    gloss: Any = setting(
        None,
        "Specular material: [roughness, metallic, specular factor] or the first of them, from 0 "
        "to 1, or file for the material of a glTF file. null: none.",
    )

    def __post_init__(self) -> None:
        """Check the gloss, which is the word file or one to three numbers."""
        if isinstance(self.mesh, Path):
            self.mesh = str(self.mesh)
        super().__post_init__()
        gloss = self.gloss
        is_file = gloss == "file" and not self.mesh.startswith("solid:")
        numbers = gloss if isinstance(gloss, Sequence) and not isinstance(gloss, str) else []
        is_unit = [is_number(item) and 0 <= item <= 1 for item in numbers]
        is_gloss = 1 <= len(is_unit) <= 3 and all(is_unit)
        if not (gloss is None or is_file or is_gloss):
            wanted = "[roughness, metallic, specular factor] in [0, 1]"
            advice = f"give {wanted}, or the word file for the material in the file of a mesh"
            raise InputError(f"gloss={gloss} of {self.mesh}: {advice}", "gloss")


@dataclass
class ObjectSettings(MeshSettings):
    """One object of a scene, which may have others beside it on the same ground.

    All objects of an entry are rendered with their shadows. Attacks on shape and colors act on the
    first one, attacks on light on the whole image. A list of objects is short for the first one
    with the others.

    >>> import norm_balls as nb
    >>> nb.ObjectSettings("solid:orange", label="orange").albedo_scale
    1.0
    """

    label: str | int = setting("", "Name of its class. Empty for no class.", may_be_empty=True)
    albedo_scale: float = setting(1.0, "Factor of its albedo.", within=(1 / MAX_SCALE, MAX_SCALE))
    at: list[float] | None = setting(
        None,
        "x and y of its center on the ground, in units in which the first object spans [-1, 1]. "
        "null: beside the objects before it, without touching them.",
        length=2,
        within=(-10, 10),
    )
    scale: float = setting(1.0, "Its largest coordinate. The first has 1.", within=(0.1, 10))
    azimuth: float = setting(0.0, "Rotation about the vertical.", "degrees", within=(-360, 360))
    others: list[Any] = setting([], "Objects beside it, as mappings or ObjectSettings.")

    def __post_init__(self) -> None:
        """Convert the other objects to settings, and check what only one kind of object has."""
        super().__post_init__()
        self.others = [*self.others]
        for index, other in enumerate(self.others):
            key = f"others[{index}]"
            self.others[index] = item = base.settings_from(ObjectSettings, other, key)
            if item.others or item.albedo_scale != 1:
                reason = f"{key} has others or albedo_scale={item.albedo_scale}"
                raise InputError(f"{reason}: give both to the first object", key)
        if self.others:
            self.require_first_place()

    def require_first_place(self) -> None:
        """Refuse another place or scale than the first object of an entry has."""
        if self.scale != 1 or any(self.at or ()):
            given = f"at={self.at} and scale={self.scale}"
            reason = f"{given} of the first object do not fit: it has the scale 1 at [0, 0]"
            raise InputError(f"{reason}, and other objects are placed beside it", "at")


@dataclass
class ProjectorSettings(Settings):
    """A projector, and the pattern that it shows before an attack."""

    pixels: int = setting(16, "Pixels per side of its pattern.", within=(1, 256))
    polar: float = setting(45.0, "Its polar angle from +z.", "degrees", within=(0, 180))
    azimuth: float = setting(45.0, "Its azimuth.", "degrees", within=(-360, 360))
    distance: float = setting(4.0, "Its distance in world units.", within=(2, MAX_SCALE))
    fov: float = setting(30.0, "Its field of view.", "degrees", within=(0.1, 170))
    power: float = setting(1.0, "Largest value of a pixel.", within=(1 / MAX_SCALE, MAX_SCALE))
    pattern: Any = setting(0.0, "Start: gray in [0, 1], or a file of linear values.")


@dataclass
class LampsSettings(Settings):
    """Lamps at given positions. They are points or, if they have a radius, discs."""

    positions: list[Any] = setting(
        [[2.0, 2.0, 2.0], [2.0, -2.0, 2.0], [-2.0, 2.0, 2.0], [-2.0, -2.0, 2.0]],
        "Positions [x, y, z] of the lamps in world units.",
    )
    power: float = setting(10.0, "Largest power of a lamp.", within=(1 / MAX_SCALE, MAX_SCALE))
    radius: float = setting(0.0, "Radius of the discs in world units.", within=(0, MAX_SCALE))
    start: Any = setting(
        0.0,
        "Powers with which attacks start: a number, [r, g, b] of each lamp, or the lamps.json of "
        "an adversary. Its positions, power and radius then replace the others.",
    )


# Settings of each kind of local light, see `renderer.light.lamps`.
LOCAL_LIGHT_SETTINGS: dict[str, type[Settings]] = {
    "projector": ProjectorSettings,
    "lamps": LampsSettings,
}
# Power with which each default lamp starts (`LampsSettings.start`) if an attack moves the
# lamps, but does not change their power.
LAMP_POWER = 2.0


# Value of `SceneSettings.exposure` that means: chosen for each mesh.
AUTO = "auto"


@dataclass
class SceneSettings(Settings):
    """Cameras, backgrounds and lighting of a scene."""

    backgrounds: list[Any] = setting([0.5], "Gray values in [0, 1] or image files.", is_filled=True)
    views: int | None = setting(1, "Cameras per mesh at even azimuths.", within=(1, base.MAX_VIEWS))
    polar: float = setting(60.0, "Polar angle of the cameras from +z.", "degrees", within=(0, 180))
    azimuth: float = setting(0.0, "First azimuth from +x toward +y.", "degrees", within=(-360, 360))
    width: float = setting(2.0, "Width of the image at the mesh, which spans [-1, 1].")
    fov: float | None = setting(
        None, "Field of view. null: orthographic.", "degrees", within=(0.1, 150)
    )
    vertices: int = setting(
        0,
        "Subdivide each mesh until it has more vertices than this, such as 1e4 in the paper.",
        within=(0, base.MAX_VERTICES),
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
        within=(0, base.MAX_DEGREE),
    )
    exposure: Any = setting(1.0, "Factor of the environment light. auto: a mean of 0.4 per mesh.")
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
        None, "Color of a table: [r, g, b] in sRGB. null: no table.", length=3, within=(0, 1)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.adapts_exposure:
            require_number("exposure", self.exposure, 1 / MAX_SCALE, MAX_SCALE)
        for name, kind in LOCAL_LIGHT_SETTINGS.items():
            if getattr(self, name) is not None:
                setattr(self, name, base.settings_from(kind, getattr(self, name), name))

    @property
    def adapts_exposure(self) -> bool:
        """Whether the exposure is chosen for each mesh."""
        return self.exposure == AUTO

    @property
    def given_exposure(self) -> float:
        """The exposure, or 1 if it is chosen for each mesh."""
        return 1.0 if self.adapts_exposure else float(self.exposure)

    def with_lights(self, attacked: Collection[str]) -> Self:
        """Return these settings with default lights if attacked parameters need lights.

        A light that the scene has stays.
        """
        lights: Any = {key: kind() for key, kind in LOCAL_LIGHT_SETTINGS.items() if key in attacked}
        # An attack on the positions of lamps needs lamps that shine.
        if "positions" in attacked:
            lights.setdefault("lamps", LampsSettings(start=LAMP_POWER))
        return replace(self, **{name: getattr(self, name) or lights[name] for name in lights})


@dataclass
class RendererSettings(Settings):
    """Settings of the renderer for the images of a scene."""

    rasterizer: str = setting(
        "auto",
        "Rasterizer: auto (torch on a GPU, otherwise numba if it is installed, or numpy), opengl, "
        "numba, numpy or torch.",
        checks_type=False,  # A `Rasterizer` is valid, too.
    )
    samples: int | None = setting(
        None,
        "Samples per pixel side. null: 2 (8 with silhouettes and without shadows and bounces).",
        within=(1, base.MAX_SAMPLES),
    )
    encoding: str = setting_like(ImageSettings, "encoding", "linear")
    normals: str = setting_like(ImageSettings, "normals", "smooth")
    shadows: bool = setting_like(ImageSettings, "shadows", False)
    bounces: int = setting_like(ImageSettings, "bounces", 0)
    silhouettes: bool = setting_like(ImageSettings, "silhouettes", False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not hasattr(self.rasterizer, "rasterize"):
            require_choice("rasterizer", self.rasterizer, base.RASTERIZERS)

    def image(self, size: Size) -> ImageSettings:
        """Return the settings of images with a size: pixels per side, or height and width."""
        options = {name: value for name, value in vars(self).items() if name != "rasterizer"}
        # With shadows or bounces, a search takes drafts, which have few samples anyway.
        needs_many = self.silhouettes and not (self.shadows or self.bounces)
        options["samples"] = base.samples_per_side(self.samples, needs_many)
        return ImageSettings(size, **options)


@dataclass
class NormalizedLightSettings(Settings):
    """How the light of each image is normalized before a classifier sees it.

    `benchmarks/normalized_light.py` chose the defaults on validation data.
    """

    percentile: float = setting(95.0, "Percentile that is mapped to `level`.", above=0, maximum=100)
    level: float = setting(1.0, "Linear value of this percentile.", above=0, maximum=1)
    white_balance: float = setting(0.0, "Balance. 0: none. 1: equal channel means.", within=(0, 1))
    gamma: float = setting(1.25, "Exponent of encoded values. Below 1: brighter.", within=(0.1, 10))
    average: bool = setting(False, "Average the probabilities of dim images over both lights.")


# Type of the argument `normalize_light` of several functions.
NormalizeLight = bool | Mapping[str, Any] | NormalizedLightSettings | None


def read_normalized_light(value: NormalizeLight) -> NormalizedLightSettings | None:
    """Convert a value of the argument `normalize_light` to settings.

    True stands for the defaults. False and None give None.
    """
    if value is None or value is False:
        return None
    given = {} if value is True else value
    return base.settings_from(NormalizedLightSettings, given, "normalize_light")
