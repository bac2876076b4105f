"""The configuration of a command, asked for by another."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig


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
