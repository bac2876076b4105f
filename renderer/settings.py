"""Settings: dataclasses whose fields carry their explanation, unit, range and choices.

A field of a settings class is made by `setting`. Its facts stand there once: the base class
`Settings` checks the values of an instance by them, and `--help` of a command prints them.

This module and the modules of settings above it import neither torch nor NumPy. Commands read
and check their settings before anything that takes seconds to import.
"""

from __future__ import annotations

import math
import operator
import os
import types
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import cache, partial
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from renderer.errors import (
    InputError,
    describe,
    is_flag,
    is_number,
    is_whole,
    require_choice,
    require_range,
)

Kind = TypeVar("Kind")
REQUIRED = MISSING  # the default of a setting that has none

ENCODINGS = ("linear", "srgb")
NORMALS = ("flat", "smooth")
RASTERIZERS = ("auto", "opengl", "numba", "numpy")
MAX_BOUNCES = 100
MAX_SIZE = 4096  # pixels per side of an image
MAX_SAMPLES_PER_ROW = 2**15  # samples in a row of an image, so at most a billion in all of it
SILHOUETTE_SAMPLES = 8  # the default if gradients include visibility changes at silhouettes
MAX_SAMPLES = 64  # samples per side of a pixel, which resolve its coverage to 1/4096
MAX_DEGREE = 40  # spherical-harmonic degree of lighting, enough for reflections at MIN_ROUGHNESS
MIN_ROUGHNESS = 0.2  # below it, lighting of degree 40 is too smooth for the highlights
MAX_VIEWS = 10**5
MAX_VERTICES = 10**7  # some 5 GB
TURBIDITY = (2.0, 10.0)  # range of the haze of the air, from clear to hazy (pure air has 1)


@dataclass(frozen=True)
class Facts:
    """Explanation, unit and range of a field. They are the arguments of `setting`."""

    about: str = ""
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    below: float | None = None
    choices: Collection[str] = ()
    is_pair: bool = False
    is_text: bool = False
    may_be_empty: bool = False
    checks_type: bool = True

    def limits(self) -> list[Limit]:
        """List the ends of the range that the field has."""
        ends = (
            Limit("at least", "≥", operator.ge, self.minimum),
            Limit("above", ">", operator.gt, self.above),
            Limit("at most", "≤", operator.le, self.maximum),
            Limit("below", "<", operator.lt, self.below),
        )
        return [limit for limit in ends if limit.end is not None]


@dataclass(frozen=True)
class Limit:
    """One end of a range, in words for errors and as a sign for `--help`."""

    words: str
    sign: str
    holds: Callable[[Any, Any], Any]
    end: float | None


def setting(
    default: Any,
    about: str,
    unit: str = "",
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    below: float | None = None,
    choices: Collection[str] = (),
    is_pair: bool = False,
    is_text: bool = False,
    may_be_empty: bool = False,
    checks_type: bool = True,
) -> Any:
    """Make a field of a settings class.

    The range and the choices of a list are those of its items. None is always permitted where
    the annotation permits it.

    Args:
        default: Default value. A list or a mapping is copied for each instance. A function is
            called for each instance. REQUIRED: the user must give a value.
        about: Explanation for the user.
        unit: Unit of the value.
        minimum: Smallest permitted value.
        maximum: Largest permitted value.
        above: Number that the value must exceed.
        below: Number that the value must not reach.
        choices: Names that the value may have.
        is_pair: The list holds two numbers, [minimum, maximum].
        is_text: The annotation is Any, but a plain value is a name or a path. The command line
            then reads 1.10 as text.
        may_be_empty: An empty text is permitted.
        checks_type: Check the value against the annotation. If False, Python code may give more
            than the annotation says.

    Returns:
        A field for a dataclass.

    >>> from dataclasses import dataclass
    >>> @dataclass
    ... class EpochSettings(Settings):
    ...     epochs: int = setting(150, "Number of passes over the images.", minimum=1)
    >>> EpochSettings(epochs=0)
    Traceback (most recent call last):
    renderer.errors.InputError: epochs=0 must be at least 1
    """
    facts = Facts(
        about,
        unit,
        minimum,
        maximum,
        above,
        below,
        choices,
        is_pair,
        is_text,
        may_be_empty,
        checks_type,
    )
    return _field(default, facts)


def setting_like(kind: type, name: str, default: Any) -> Any:
    """Make a field that has the facts of a field of another settings class.

    Args:
        kind: The other class.
        name: Name of its field.
        default: Default value of the new field.

    Returns:
        A field for a dataclass.
    """
    return _field(default, facts_of(kind, name))


def _field(default: Any, facts: Facts) -> Any:
    """Make a field of a dataclass. A list, a mapping or a function makes a default for each."""
    metadata = {"facts": facts}
    if default is REQUIRED:
        return field(metadata=metadata)
    if isinstance(default, list | dict):
        return field(default_factory=partial(deepcopy, default), metadata=metadata)
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


class Settings:
    """Base of all settings classes, which are dataclasses.

    A new instance is refused with an InputError that names the first field whose value has the
    wrong type, is out of its range, is none of its choices, or is an empty text.
    """

    def __post_init__(self) -> None:
        for name, hint, facts in _checked_fields(type(self)):  # type: ignore[arg-type]  # types are hashable
            value = getattr(self, name)
            if facts.checks_type and not _fits(value, hint):
                raise InputError(f"{name} is {describe(value)}: give {_expected(hint)}", name)
            if value is not None:
                _check_value(name, value, facts)


def facts_of(kind: type, name: str) -> Facts:
    """Return the facts of a field.

    A subclass may give a field another default without `setting`. The facts of its parent then
    apply.

    Args:
        kind: Settings class.
        name: Name of the field.

    Returns:
        The facts. They are empty if the field was not made by `setting`.
    """
    for base in kind.__mro__:
        own: dict[str, Field[Any]] = vars(base).get("__dataclass_fields__", {})
        if name in own and "facts" in own[name].metadata:
            return cast(Facts, own[name].metadata["facts"])
    return Facts()


def field_types(kind: type) -> dict[str, Any]:
    """Return the annotations of a dataclass's fields by name."""
    hints = get_type_hints(kind)
    return {item.name: hints[item.name] for item in fields(cast(Any, kind))}


def settings_from(kind: type[Kind], values: Mapping[str, Any], argument: str) -> Kind:
    """Make an instance of a settings class from a mapping.

    Args:
        kind: The settings class.
        values: Values of its fields by name.
        argument: Name of the argument that holds the mapping, for errors.

    Returns:
        The instance.

    Raises:
        InputError: If the mapping has an unknown name, lacks a required one, or has a wrong value.
    """
    known = fields(cast(Any, kind))
    names = [item.name for item in known]
    for name in values:
        if name not in names:
            wrong = f"{argument}.{name}"
            raise InputError(f"{wrong} is not a setting: choose from {', '.join(names)}", wrong)
    for item in known:
        has_default = item.default is not MISSING or item.default_factory is not MISSING
        if not has_default and item.name not in values:
            wrong = f"{argument}.{item.name}"
            raise InputError(f"{wrong} is not set: give its value", wrong)
    try:
        return kind(**values)
    except InputError as error:
        raise error.within(argument, names) from None


@cache
def _checked_fields(kind: type) -> list[tuple[str, Any, Facts]]:
    """List the name, the annotation and the facts of each field."""
    return [(name, hint, facts_of(kind, name)) for name, hint in field_types(kind).items()]


def _check_value(name: str, value: Any, facts: Facts) -> None:
    """Check a value, or each item of a list, by the facts of its field."""
    if isinstance(value, str) and not value and not facts.may_be_empty:
        raise InputError(f"{name} is empty: give a name", name)
    if facts.is_pair:
        _check_pair(name, value, facts)
        return
    if not facts.choices and not facts.limits():
        return
    items = value if isinstance(value, list | tuple) else [value]
    for item in items:
        if facts.choices:
            require_choice(name, item, facts.choices)
        _check_range(name, item, facts.limits())


def _check_range(name: str, value: Any, limits: Sequence[Limit]) -> None:
    """Check one number. NaN is in no range."""
    if limits and not is_number(value):
        raise InputError(f"{name}={describe(value)} must be a number", name)
    if not all(limit.holds(value, limit.end) for limit in limits):
        ends = " and ".join(f"{limit.words} {limit.end:g}" for limit in limits)
        raise InputError(f"{name}={value} must be {ends}", name)


def _check_pair(name: str, value: Any, facts: Facts) -> None:
    """Check a list of a minimum and a maximum."""
    minimum = -math.inf if facts.minimum is None else facts.minimum
    maximum = math.inf if facts.maximum is None else facts.maximum
    if len(value) == 2 and minimum <= value[0] <= value[1] <= maximum:
        return
    expected = f"give [minimum, maximum], both from {minimum:g} to {maximum:g}"
    raise InputError(f"{name}={list(value)}: {expected}", name)


def require_field_types(settings: Any, *unchecked: str) -> None:
    """Check the fields of a dataclass that is no settings class against their annotations.

    Whole numbers pass as numbers, and paths as strings.

    Args:
        settings: Instance of the dataclass.
        unchecked: Names of fields that take more than their annotation says.

    Raises:
        InputError: If a field holds a value of another type.
    """
    for name, hint, _ in _checked_fields(type(settings)):  # type: ignore[arg-type]  # types are hashable
        value = getattr(settings, name)
        if name not in unchecked and not _fits(value, hint):
            raise InputError(f"{name} is {describe(value)}: give {_expected(hint)}", name)


_CHECKS: dict[Any, Callable[[object], bool]] = {
    Any: lambda value: True,
    int: is_whole,
    float: is_number,
    bool: is_flag,
    str: lambda value: isinstance(value, str | os.PathLike),
    type(None): lambda value: value is None,
}


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value is of an annotated type."""
    check = _CHECKS.get(hint)
    if check is not None:
        return check(value)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, option) for option in get_args(hint))
    if origin is list:
        (item_hint,) = get_args(hint)
        is_array = getattr(value, "ndim", 0) > 0
        if isinstance(value, str) or not (is_array or isinstance(value, Sequence)):
            return False
        items = cast(Iterable[Any], value)
        return item_hint is Any or all(_fits(item, item_hint) for item in items)
    return isinstance(value, origin or hint)


_NOUNS: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "True or False",
    str: "a string",
    list: "a list",
    type(None): "None",
}


def _expected(hint: Any) -> str:
    """Describe an annotated type for an error."""
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(_expected(option) for option in get_args(hint))
    if get_origin(hint) is list:
        (item_hint,) = get_args(hint)
        plural = {float: " of numbers", int: " of whole numbers", str: " of strings"}
        return "a list" + plural.get(item_hint, "")
    kind = get_origin(hint) or hint
    return _NOUNS.get(kind) or f"{kind.__name__}(...)"


@dataclass(frozen=True)
class ImageSettings(Settings):
    """Size, sampling and shading of rendered images.

    >>> import norm_balls as nb
    >>> nb.ImageSettings(size=224, samples=2, encoding="srgb", bounces=1).global_illumination
    True
    """

    size: int = setting(32, "Pixels per side.", minimum=1, maximum=MAX_SAMPLES_PER_ROW)
    samples: int = setting(
        2,
        "Samples per side of a pixel. With 2, each pixel has 4 samples.",
        minimum=1,
        maximum=MAX_SAMPLES,
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
    shadows: bool = setting(
        False, "Cast shadows of the mesh on itself. This needs the extra `shadows`."
    )
    bounces: int = setting(
        0,
        "Number of bounces of light between the surfaces. One or more includes shadows.",
        minimum=0,
        maximum=MAX_BOUNCES,
    )
    silhouettes: bool = setting(
        False,
        "Include visibility changes at silhouettes in the gradients by shape and pose. "
        "This takes up to four times as long.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("size × samples", self.size * self.samples, 1, MAX_SAMPLES_PER_ROW)

    @property
    def global_illumination(self) -> bool:
        """Whether a mesh changes its own light, by shadows or bounces."""
        return self.shadows or self.bounces > 0


def samples_per_side(samples: int | None, silhouettes: bool) -> int:
    """Choose the number of samples per side of a pixel.

    Args:
        samples: The number that was asked for. None for the default.
        silhouettes: Whether gradients include visibility changes at silhouettes. Their documented
            accuracy needs more samples.

    Returns:
        The number of samples per side of a pixel.
    """
    if samples is not None:
        return samples
    return SILHOUETTE_SAMPLES if silhouettes else ImageSettings.samples
