import os
import shutil

import pytest
from omegaconf import OmegaConf

from renderer.errors import InputError
from train.command_line.configuration import read_settings
from train.run import load_data, prepare
from train.run_folder.continuation import INPUTS, fingerprints, require_same_inputs
from train.settings import ExperimentSettings
from train.sweep import _check_same_settings


def test_a_run_knows_its_inputs_by_content(tiny_config, tiny_npz, finished):
    assert OmegaConf.load(finished / "config.yaml")[INPUTS] == fingerprints(tiny_config())
    assert [*fingerprints(tiny_config())] == [str(tiny_npz)]


@pytest.mark.parametrize(
    "override",
    [
        "scene.meshes=[{}]",
        "scene.hard_negatives=[{{mesh: {}, label: apple}}]",
        "scene.meshes=[{{mesh: solid:orange, props: [{{mesh: {}}}]}}]",
        "scene.light={}",
        "scene.backgrounds=[0.5,{}]",
        "augment.vary.environments=[{}]",
        "data.path={}",
    ],
)
def test_a_file_that_changed_has_another_fingerprint(tiny_config, tmp_path, override):
    file = tmp_path / "input.bin"
    file.write_bytes(b"one")
    config = tiny_config(override.format(file))
    before, written = fingerprints(config)[str(file)], file.stat().st_mtime_ns
    file.write_bytes(b"two")
    os.utime(file, ns=(written, written + 1))  # a file system's clock may not have moved on
    assert fingerprints(config)[str(file)] != before


def test_a_folder_that_changed_has_another_fingerprint(tiny_config, tmp_path):
    (tmp_path / "apple").mkdir()
    config, found = tiny_config(f"data.path={tmp_path}"), set()
    for name in ("apple/0.png", "apple/1.png"):
        found.add(fingerprints(config)[str(tmp_path)])
        (tmp_path / name).write_bytes(name.encode())
    assert len(found | {fingerprints(config)[str(tmp_path)]}) == 3


def test_going_on_with_another_file_of_the_same_name_is_refused_by_name(tiny_config, tiny_npz, finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run")
    config = OmegaConf.load(folder / "config.yaml")
    config[INPUTS][str(tiny_npz)] = "of another time"
    OmegaConf.save(config, folder / "config.yaml")
    asked = tiny_config("train.resume=true")
    settings = read_settings(ExperimentSettings, asked)
    with pytest.raises(InputError, match=rf"{tiny_npz} is not what {folder} was trained with: put that back"):
        prepare(settings, load_data(settings), folder)
    with pytest.raises(InputError, match=rf"{tiny_npz} is not what"):  # nor is the cell of a sweep taken as it is
        _check_same_settings(folder, config)
    del config[INPUTS]
    OmegaConf.save(config, folder / "config.yaml")
    require_same_inputs(folder, asked)  # of a run that is older nothing is known
