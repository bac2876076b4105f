"""Every number in every script's configuration has a range, and an error beyond it that names its key."""

import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from renderer.errors import InputError
from train.command_line.configuration import as_dict, composed, dotted, read_settings
from train.lab.folder import LabSettings

SCRIPTS = Path(__file__).parents[2] / "scripts"
SETTINGS = {
    "lab": LabSettings,
}
OWN = ("compare_runs", "evaluate_photos", "export_light", "fit_skylight", "publish", "report")  # in the script itself
GIVEN = {  # without which a command is refused
    "compare_runs": ["runs=[a]"],
    "evaluate_photos": ["run=a", "photos=a"],
    "export_light": ["light=grace", "out=a.hdr"],
    "lab": ["out=a"],
    "publish": ["run=a", "out=b"],
    "report": ["runs=[a]"],
}
KINDS: dict[str, tuple[type, list[str]]] = {
    **{name: (kind, [*GIVEN.get(name, [])]) for name, kind in SETTINGS.items()},
    **{name: (runpy.run_path(str(SCRIPTS / f"{name}.py"))["Settings"], GIVEN.get(name, [])) for name in OWN},
}
ELSEWHERE = ("train", "attack")  # whose numbers are tried in the tests of their settings


def beyond(config: DictConfig) -> Iterator[tuple[str, Any]]:
    """Every number, or the first of a list, as it can hardly be meant."""
    for key, value in dotted(as_dict(config)):
        number = value[0] if isinstance(value, list) and value else value
        if isinstance(number, int | float) and not isinstance(number, bool):
            for absurd in [-(10**30), 10**30, *([float("nan")] if isinstance(number, float) else [])]:
                yield key, [absurd, *value[1:]] if isinstance(value, list) else absurd


def check(kind: type, config: DictConfig, parent: str = "") -> None:
    read_settings(kind, config, parent)
    for key, value in beyond(config):
        changed = OmegaConf.create(as_dict(config))
        OmegaConf.update(changed, key, value)
        with pytest.raises(InputError) as refusal:
            read_settings(kind, changed, parent)
        assert key.rpartition(".")[2] in str(refusal.value), key


def test_every_script_is_tried():
    assert {*KINDS, *ELSEWHERE} == {"train", *(path.stem for path in SCRIPTS.glob("*.py"))}


@pytest.mark.parametrize("name", KINDS)
def test_every_number_of_a_scripts_configuration_has_a_range(name):
    kind, given = KINDS[name]
    config = composed(name, given)
    check(kind, config)
