"""A command's configuration, composed, and read into dataclasses or plain values; errors name the key at fault."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar, cast

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from renderer.errors import InputError

Settings = TypeVar("Settings")
_PLAIN = "give a plain value, no list or mapping"
_UNREADABLE = (OmegaConfBaseException, OverflowError)  # the latter for a whole number that no float holds


def composed(command: str, overrides: Sequence[str]) -> DictConfig:
    """What a command of conf/ is configured by under overrides."""
    with _no_other_hydra(), initialize_config_module("conf", version_base="1.3"):
        return compose(command, list(overrides))


@contextmanager
def _no_other_hydra() -> Iterator[None]:
    """The one of the command that asks steps aside."""
    other, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
    try:
        yield
    finally:
        GlobalHydra.instance().hydra = other


def read_settings(kind: type[Settings], config: DictConfig, parent: str = "") -> Settings:
    """The dataclass from its configuration; InputError naming the key that is unknown, unset or of the wrong type."""

    def named(key: str) -> str:
        return ".".join(filter(None, (parent, key)))

    try:
        merged = OmegaConf.merge(OmegaConf.structured(kind), config)
        for nested in _nested(merged):
            raise InputError(f"{named(nested)}: {_PLAIN}")
        if unset := OmegaConf.missing_keys(config) | OmegaConf.missing_keys(merged):
            raise InputError(f"{named(min(unset))} is not set: give {named(min(unset))}=...")
        for key, value in dotted(as_dict(config)):
            if isinstance(value, int) and value not in (0, 1) and isinstance(OmegaConf.select(merged, key), bool):
                raise InputError(f"{named(key)}={value}: give true or false")
        return cast(Settings, OmegaConf.to_object(merged))
    except _UNREADABLE as error:
        within = getattr(error, "full_key", None) or ""
        said = str(getattr(error, "msg", error)).splitlines()[0]
        if said.startswith(("Cannot convert 'DictConfig'", "Cannot convert 'ListConfig'")):
            raise InputError(f"{named(within)}: {_PLAIN}") from error
        at_fault = (
            key for key, value in dotted(as_dict(config)) if key.startswith(within) and not _fits(kind, key, value)
        )
        said = "give a list, as in [a,b]" if "is not a ListConfig" in said else said
        raise InputError(f"{named(next(at_fault, within))}: {said}") from error


def _nested(node: Any) -> Iterator[str]:
    """The keys of lists and mappings that stand where plain values are declared, which OmegaConf lets pass."""
    if isinstance(node, ListConfig | DictConfig) and not (node._is_none() or node._is_missing()):
        plain = node._metadata.element_type in (str, int, float, bool)
        keys: Iterable[Any] = range(len(node)) if isinstance(node, ListConfig) else node
        for key in keys:
            child = node._get_node(key)
            if plain and OmegaConf.is_config(child):
                yield node._get_full_key(key)
            yield from _nested(child)


def _fits(kind: type, key: str, value: object) -> bool:
    """Whether a value is no fault by itself, of which OmegaConf names the group at most."""
    alone = OmegaConf.create()
    OmegaConf.update(alone, key, value, force_add=True)
    try:
        OmegaConf.merge(OmegaConf.structured(kind), alone)
    except _UNREADABLE:
        return False
    return True


def as_dict(config: DictConfig, resolve: bool = False) -> dict[str, Any]:
    """The settings as plain dictionaries and lists."""
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=resolve))


def is_within(key: str, groups: Collection[str]) -> bool:
    """Whether a dotted key is one of the groups, or within one."""
    return any(key == group or key.startswith(f"{group}.") for group in groups)


def dotted(node: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, object]]:
    """The values of nested settings by dotted key."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
