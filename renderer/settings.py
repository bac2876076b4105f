"""Settings: dataclasses whose fields have an explanation, a unit, a range and choices.

The function `setting` creates a field of a settings class and stores these facts about the
field. The base class `Settings` checks the values of an instance with them, and `--help` of a
command prints them.

This module and the other modules of settings do not import torch and NumPy, which takes
seconds. Commands read and check their settings before they import torch.
"""

from __future__ import annotations

import math
import operator
import os
import re
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import cache, partial
from inspect import formatannotation
from typing import Any, Self, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import renderer.errors as errors
from renderer.errors import InputError

# Type variable for any settings class.
Kind = TypeVar("Kind")
# Value of the argument `default` of `setting`
# for a field that the user must set.
REQUIRED = MISSING

# Allowed encodings of image values.
ENCODINGS = ("linear", "srgb")
# CIE 1931 chromaticities x and y of red, green, blue and white (ITU-R BT.709).
REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
# Allowed kinds of normals.
NORMALS = ("flat", "smooth")
# Allowed names of rasterizers.
RASTERIZERS = ("auto", "opengl", "numba", "numpy", "torch")
# Largest number of bounces of light between surfaces.
MAX_BOUNCES = 100
# Largest width and height of images in
# pixels that the settings of commands allow.
MAX_SIZE = 4096
# Largest number of samples in a row of an image. A
# square image then has at most a billion samples.
MAX_SAMPLES_PER_ROW = 2**15
# Default number of samples along one side of a pixel if gradients include
# visibility changes at silhouettes. Other renders use fewer samples.
SILHOUETTE_SAMPLES = 8
# Largest number of samples along one side
# of a pixel. A pixel then has 4096 samples.
MAX_SAMPLES = 64
# Largest degree of the spherical harmonics of a light. Highlights on
# surfaces with the smallest allowed roughness, 0.2, need this degree.
MAX_DEGREE = 40
# Smallest roughness of a surface. Highlights on smoother surfaces would
# need light of a higher spherical-harmonic degree than MAX_DEGREE.
MIN_ROUGHNESS = 0.2
# Largest number of cameras on an orbit.
MAX_VIEWS = 10**5
# Largest number of vertices that `subdivide` can be asked
# to exceed. Such a mesh takes about 5 GB of memory.
MAX_VERTICES = 10**7
# Smallest and largest turbidity (haziness) of the air for the
# skylight, from clear to hazy. Pure air would have the turbidity 1.
TURBIDITY = (2.0, 10.0)


@dataclass(frozen=True)
class Facts:
    """Explanation, unit, range and choices of a field of a settings class.

    Attributes:
        about: Explanation for the user.
        unit: Unit of the value.
        minimum: Smallest permitted value.
        maximum: Largest permitted value.
        above: Number that the value must exceed.
        below: Number that the value must not reach.
        choices: Names that the value may have.
        length: Number of items of a list.
        is_pair: True for a list of two numbers [minimum, maximum].
        is_text: True for a name or a path whose annotation is Any.
        may_be_empty: True if an empty text is permitted.
        is_filled: True for a list with one item or more.
        checks_type: True if the value must have the annotated type.
    """

    about: str = ""
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    below: float | None = None
    choices: Collection[str] = ()
    length: int | None = None
    is_pair: bool = False
    is_text: bool = False
    may_be_empty: bool = False
    is_filled: bool = False
    checks_type: bool = True

    @property
    def limits(self) -> list[tuple[str, str, Callable[[Any, Any], Any], float]]:
        """Limits of the range: words in errors, sign in --help, comparison and number of each."""
        all_limits = (
            ("at least", "≥", operator.ge, self.minimum),
            ("above", ">", operator.gt, self.above),
            ("at most", "≤", operator.le, self.maximum),
            ("below", "<", operator.lt, self.below),
        )
        return [(*limit, end) for *limit, end in all_limits if end is not None]  # type: ignore[misc]


def setting(
    default: Any,
    about: str,
    unit: str = "",
    *,
    within: tuple[float | None, float | None] = (None, None),
    **facts: Any,
) -> Any:
    """Create a field of a settings class. `facts` are further attributes of `Facts`.

    `within` is the smallest and the largest permitted value. `above` and `below` exclude the
    limit. If the value is a list, its items are checked against the range and the choices. None is
    permitted if the annotation of the field permits None. A function as default is called for each
    instance, and REQUIRED means that there is none. `is_text` makes the command line read 1.10 as
    text.
    """
    limits: dict[str, Any] = {"minimum": within[0], "maximum": within[1]}
    return _field(default, Facts(about, unit, **limits | facts))


def pair(default: Any, about: str, within: tuple[float, float], unit: str = "") -> Any:
    """Create a field for the smallest and the largest value of what `about` says."""
    about = f"Smallest and largest {about}"
    return setting(default, about, unit, within=within, length=2, is_pair=True)


def setting_like(kind: type, name: str, default: Any) -> Any:
    """Create a field with the explanation, unit and range of a field of another class."""
    return _field(default, facts_of(kind, name))


def _field(default: Any, facts: Facts) -> Any:
    """Create a field of a dataclass, and store facts about the field in its metadata."""
    metadata = {"facts": facts}
    if isinstance(default, list | dict):
        default = partial(deepcopy, default)
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


class Settings:
    """Base class of all settings classes, which are dataclasses.

    A new instance raises an InputError if a value has the wrong type, is out of range, is not one
    of the choices, or is an empty text. The error names the first such field.
    """

    def __post_init__(self) -> None:
        """Check the type, the range and the choices of each field."""
        for name, hint, facts in _checked_fields(type(self)):  # type: ignore[arg-type]  # types are hashable
            value = getattr(self, name)
            if facts.checks_type and hasattr(value, "tolist"):
                # Arrays and tensors have no single truth value.
                value = value.tolist()
                object.__setattr__(self, name, value)
            if facts.checks_type and not _fits(value, hint):
                # `formatannotation` puts the module before the name of a class.
                expected = re.sub(r"\b[\w.]+\.", "", formatannotation(hint))
                given = errors.describe(value)
                raise InputError(f"{name} is {given}: give a value of type {expected}", name)
            if value is not None:
                _check_value(name, value, facts)

    @classmethod
    def or_default(cls, name: str, given: Self | None, **defaults: Any) -> Self:
        """Check the type of the argument of a function, and replace None by default settings."""
        errors.require_kind(name, given, cls | None, f"nb.{cls.__name__}(...) or None")
        return cls(**defaults) if given is None else given

    def wrong(self, name: str, text: str) -> InputError:
        """Make an error about a field, such as wrong("size", "is odd") for "size=3 is odd"."""
        return InputError(f"{name}={getattr(self, name)} {text}", name)


def facts_of(kind: type, name: str) -> Facts:
    """Return the explanation, unit, range and choices of a field.

    If a subclass only changes the default of a field, the facts of the parent class apply.
    They are empty if no class created the field with `setting`.
    """
    for base in kind.__mro__:
        fields_of_base: dict[str, Field[Any]] = vars(base).get("__dataclass_fields__", {})
        if name in fields_of_base and "facts" in fields_of_base[name].metadata:
            return cast(Facts, fields_of_base[name].metadata["facts"])
    return Facts()


def field_types(kind: type) -> dict[str, Any]:
    """Return the types with which the fields of a dataclass are annotated."""
    hints = get_type_hints(kind)
    return {item.name: hints[item.name] for item in fields(cast(Any, kind))}


def settings_from(kind: type[Kind], values: object, argument: str) -> Kind:
    """Create an instance of a settings class from a mapping. An instance is returned as it is.

    `argument` is the name of the mapping, with which errors begin.
    """
    if isinstance(values, kind):
        return values
    if not isinstance(values, Mapping):
        expected = f"give a mapping or {kind.__name__}(...)"
        raise InputError(f"{argument} is {errors.describe(values)}: {expected}", argument)
    names = [item.name for item in fields(cast(Any, kind))]
    for name in values:
        if name not in names:
            unknown = f"{argument}.{name}"
            raise InputError(f"{unknown} is not a setting: choose from {', '.join(names)}", unknown)
    # A setting without a default must be given.
    for item in fields(cast(Any, kind)):
        if item.name not in values and item.default is item.default_factory is MISSING:
            missing = f"{argument}.{item.name}"
            raise InputError(f"{missing} is not set: give a value", missing)
    with errors.keyed(argument, **{name: f"{argument}.{name}" for name in names}):
        return kind(**values)


@cache
def _checked_fields(kind: type) -> list[tuple[str, Any, Facts]]:
    """List the name, the annotated type and the facts of each field of a dataclass."""
    return [(name, hint, facts_of(kind, name)) for name, hint in field_types(kind).items()]


def _check_value(name: str, value: Any, facts: Facts) -> None:
    """Check a value, or each item of a list, against the range and the choices of its field."""
    if isinstance(value, str) and not value and not facts.may_be_empty:
        raise InputError(f"{name} is empty: give a name", name)
    if facts.is_filled and not value:
        raise InputError(f"{name} must not be empty: name one or more", name)
    items = list(value) if _is_list(value) else [value]
    if facts.length not in (None, len(items)):
        raise InputError(f"{name}={items}: give {facts.length} numbers", name)
    if facts.is_pair and items[0] > items[1]:
        raise InputError(f"{name}={items}: give [minimum, maximum]", name)
    # Words for the error, sign, comparison and number of each limit.
    limits = facts.limits
    for item in items:
        if facts.choices:
            errors.require_choice(name, item, facts.choices)
        if limits and not errors.is_number(item):
            raise InputError(f"{name}={errors.describe(item)} must be a number", name)
        # NaN is outside of all limits.
        if not all(holds(item, end) for _, _, holds, end in limits):
            range_in_words = " and ".join(f"{words} {end:g}" for words, _, _, end in limits)
            raise InputError(f"{name}={item} must be {range_in_words}", name)


# Functions that tell whether a value is accepted for a
# field, by the type with which the field is annotated.
_CHECKS: dict[Any, Callable[[object], bool]] = {
    Any: lambda value: True,
    int: errors.is_whole,
    float: errors.is_number,
    bool: errors.is_flag,
    str: lambda value: isinstance(value, str | os.PathLike),
    type(None): lambda value: value is None,
}


def _fits(value: object, hint: Any) -> bool:
    """Tell whether a value is accepted for a field with a given type annotation."""
    check = _CHECKS.get(hint)
    if check is not None:
        return check(value)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, option) for option in get_args(hint))
    if origin is list:
        (item_hint,) = get_args(hint)
        return _is_list(value) and all(_fits(item, item_hint) for item in cast(Any, value))
    return isinstance(value, origin or hint)


def _is_list(value: object) -> bool:
    """Tell whether a value is a list. An array or a tensor with at least one axis counts as one."""
    is_array = getattr(value, "ndim", 0) > 0
    return not isinstance(value, str) and (is_array or isinstance(value, Sequence))


# Pixels per side of a square image, or height and width.
Size = int | Sequence[int]


def as_size(name: str, size: Any, largest: int = MAX_SAMPLES_PER_ROW) -> int | tuple[int, int]:
    """Check the size of an image. A square has one number, and a rectangle (height, width)."""
    sides = tuple(size) if _is_list(size) else (size, size)
    if len(sides) != 2 or not all(errors.is_whole(side) and 1 <= side <= largest for side in sides):
        expected = f"a whole number from 1 to {largest:,}, or two, (height, width)"
        raise InputError(f"{name} is {errors.describe(size)}: give {expected}", name)
    height, width = map(int, sides)
    return height if height == width else (height, width)


def height_and_width(size: Size) -> tuple[int, int]:
    """Return height and width of an image in pixels."""
    height, width = size if isinstance(size, Sequence) else (size, size)
    return int(height), int(width)


@dataclass(frozen=True)
class ImageSettings(Settings):
    """Size, sampling and shading of rendered images.

    >>> import norm_balls as nb
    >>> nb.ImageSettings(size=224, samples=2, encoding="srgb", bounces=1).global_illumination
    True
    """

    size: int | Sequence[int] = setting(
        32, "Pixels per side, or height and width.", within=(1, MAX_SAMPLES_PER_ROW)
    )
    samples: int = setting(
        2, "Samples per side of a pixel. With 2, each pixel has 4 samples.", within=(1, MAX_SAMPLES)
    )
    encoding: str = setting(
        "linear",
        "Encoding of the pixels. With linear, the radiance is the value of the pixel.",
        choices=ENCODINGS,
    )
    normals: str = setting(
        "flat",
        "Use one normal per face (flat) or interpolate the normals of the vertices (smooth).",
        choices=NORMALS,
    )
    shadows: bool = setting(False, "Let the mesh shadow itself. This needs the extra `shadows`.")
    bounces: int = setting(
        0,
        "Number of bounces of light between the surfaces. One or more includes shadows.",
        within=(0, MAX_BOUNCES),
    )
    silhouettes: bool = setting(
        False,
        "Include visibility changes at silhouettes in the gradients by shape and pose. "
        "This takes up to four times as long.",
    )

    def __post_init__(self) -> None:
        """Check each field, and the number of samples in a row and a column of the image."""
        object.__setattr__(self, "size", as_size("size", self.size))
        super().__post_init__()
        for side in self.shape:
            errors.require_range("size × samples", side * self.samples, 1, MAX_SAMPLES_PER_ROW)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return height_and_width(self.size)

    @property
    def pixel_count(self) -> int:
        """Number of pixels of an image."""
        return math.prod(self.shape)

    @property
    def global_illumination(self) -> bool:
        """True if the mesh casts shadows on itself, or if light bounces between its surfaces."""
        return self.shadows or self.bounces > 0


def samples_per_side(samples: int | None, silhouettes: bool) -> int:
    """Choose the number of samples along one side of a pixel: the user's, or 2, or 8.

    It is 8 with `silhouettes`, because the documented accuracy of these gradients needs
    more samples.
    """
    if samples is not None:
        return samples
    return SILHOUETTE_SAMPLES if silhouettes else ImageSettings.samples
