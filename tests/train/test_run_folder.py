import errno
import itertools
import json
import os
import time
from pathlib import Path

import pytest
import torch
from gltf_files import Gltf
from oracles import png_of
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from renderer.errors import InputError
from train import run_config
from train.cli import read_settings
from train.command_settings import AuditSettings
from train.run_folder import LOCK, METRICS, attack_success, locked, read_metrics, sole_writer
from train.settings import ExperimentSettings
from train.system import user_message
from train.training.run_log import RunLog


def test_a_configuration_is_read_as_it_was_written_and_trains_the_same_run(tiny, tmp_path):
    settings = tiny("train.learning_rate=3e-7", "label=pear", "scene.lamps={power: 3}")
    run_config.write_config(
        tmp_path, settings, precision="bfloat16", command="python -m train 'out=${label}'"
    )
    config = run_config.read_config(tmp_path / run_config.CONFIG)
    assert "command" not in config  # An interpolation would be refused.
    assert config.pop("precision") == "bfloat16"
    assert config.pop("working_folder") == os.getcwd()
    assert config.pop("versions").torch == torch.__version__
    assert config.pop("inputs").keys() == {settings.data.path}
    assert read_settings(ExperimentSettings, config) == settings


BOMB = "a0: &a0 [x, x]\n"
for number in range(9):
    references = ", ".join(9 * [f"*a{number}"])
    BOMB += f"a{number + 1}: &a{number + 1} [{references}]\n"


@pytest.mark.parametrize(
    "file, content",
    [
        (run_config.CONFIG, "- 1"),
        (run_config.CONFIG, BOMB),
        (run_config.CONFIG, "!!python/object/apply:os.system [touch hacked]"),
        (run_config.CONFIG, "a: ${oc.env:HOME}"),
        (METRICS, "{\n"),
        (METRICS, '{"test/accuracy": "high"}\n'),
        (METRICS, '{"epoch": 1}\n[]\n'),
        (METRICS, 2 * '{"test/accuracy": 1}\n'),
        (METRICS, '{"test/accuracy": 1}\n{"epoch": 1}\n'),
        (METRICS, '{"epoch": 1}\n{"epoch": 1}\n{"test/accuracy": 1}\n'),
    ],
    ids=[
        *("list", "bomb", "code", "variable", "cut", "text", "no object"),
        *("two final lines", "final line before its end", "doubled epoch"),
    ],
)
def test_a_damaged_file_is_one_sentence_that_names_it(tmp_path, file, content):
    (tmp_path / file).write_text(content)
    with pytest.raises(InputError, match=rf"^{tmp_path / file} is damaged [^\n]*$"):
        run_config.read_config(tmp_path / file) if file == run_config.CONFIG else read_metrics(
            tmp_path
        )


def test_settings_that_change_no_weights_are_not_among_the_decisive_ones(tiny):
    photos = "photos=${out}/images"
    here = run_config.decisive_settings(tiny(photos, "out=here"))
    elsewhere = ("out=there/a", "sweep=x", "train.resume=true", "train.cache=null")
    assert run_config.decisive_settings(tiny(photos, *elsewhere)) == here
    assert here["photos"] == "<run>/images"
    assert here["augment.attack.max_steps"] == 3


@pytest.mark.parametrize(
    "override",
    [
        *("meshes=[[solid:orange, {{mesh: {}, at: [1, 1]}}]]", "scene.backgrounds=[0.5,{}]"),
        *("augment.vary.environments=[{}]", "network={0.parent}", "data.path={0.parent}"),
        *("scene.light={}", "augment.folder={0.parent}", "photos={{lab: {0.parent}}}"),
    ],
)
def test_an_input_that_changed_is_refused_by_name(tiny, tmp_path, override):
    file = tmp_path / "inputs" / "best.pt"
    folder = tmp_path / "run"
    file.parent.mkdir()
    file.write_bytes(b"one")
    settings = tiny(override.format(file), "augment.examples=null", "scene.views=1")
    run_config.write_config(folder, settings)
    run_config.require_same_run(folder, settings)
    file.write_bytes(b"another")
    with pytest.raises(
        InputError, match=rf"{file.parent}\S* has changed since {folder} began: put it back"
    ):
        run_config.require_same_run(folder, settings)


def test_the_module_of_a_network_from_scratch_is_an_input(tiny, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "drawn.py").write_text("# one\n")
    settings = tiny("model=python:drawn:build")
    assert "python:drawn:build" in run_config.fingerprints(settings)


def replace_content(file: Path) -> None:
    status = file.stat()
    file.write_bytes(file.read_bytes()[::-1])
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    run_config._hash_version.cache_clear()  # As in another process.


VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n"
OBJ = f"# comment\n  mtllib my mesh.mtl\n{VERTICES}usemtl red\nf 1/1 2/1 3/1\n"
MATERIAL = "newmtl red\nmap_Kd -s 1 1 1 my skin.png\n"
TEXTURED = Gltf().square(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
TEXTURED.tree |= {"images": [{"uri": "textures/my%20skin.png"}], "textures": [{"source": 0}]}
BUFFER = {"uri": "mesh.bin", "byteLength": len(TEXTURED.buffer)}
INPUT_FILES = {
    "photographs/orange/a.png": "ab",
    "linked/b.png": "ab",
    "mesh.obj": OBJ,
    "my mesh.mtl": MATERIAL,
    "my skin.png": "ab",
    "mesh.gltf": json.dumps(TEXTURED.tree | {"buffers": [BUFFER]}),
    "mesh.bin": TEXTURED.buffer,
    "textures/my skin.png": png_of(255, 0, 0),
    "network.py": "# ab\n",
    "wall.png": "ab",
    "classes.txt": "ab",
    "network.onnx": "ab",
    "network.onnx.data": "ab",
}
AUDIT = {"network": "c", "meshes": ["solid:orange"], "out": "audit"}


@pytest.mark.parametrize(
    ("given", "changed"),
    [
        (AUDIT | {"meshes": [], "unlabeled": "photographs"}, "photographs/orange/a.png"),
        (AUDIT | {"photos": "photographs"}, "linked/b.png"),
        (AUDIT | {"laboratory": "photographs"}, "photographs/orange/a.png"),
        (AUDIT | {"meshes": ["mesh.obj"]}, "my skin.png"),
        (AUDIT | {"meshes": [{"mesh": "mesh.gltf"}]}, "mesh.bin"),
        (AUDIT | {"hard_negatives": ["mesh.gltf"]}, "textures/my skin.png"),
        (AUDIT | {"network": "python:network:build"}, "network.py"),
        (AUDIT | {"network": "python:network.build"}, "network.py"),
        (AUDIT | {"decode": "network:decode"}, "network.py"),
        (AUDIT | {"network": "network.onnx"}, "network.onnx.data"),
        (AUDIT | {"network": "hf:photographs"}, "photographs/orange/a.png"),
        (AUDIT | {"network": "lit:c+run:photographs"}, "photographs/orange/a.png"),
        (AUDIT | {"hardened": "dim:run:photographs+d"}, "photographs/orange/a.png"),
        (AUDIT | {"hardened": "run:photographs"}, "photographs/orange/a.png"),
        (AUDIT | {"environments": ["wall.png"]}, "wall.png"),
        (AUDIT | {"weights": "wall.png"}, "wall.png"),
        (AUDIT | {"classes": "classes.txt"}, "classes.txt"),
    ],
)
def test_an_input_whose_content_alone_changed_is_refused(tmp_path, monkeypatch, given, changed):
    for name, content in INPUT_FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    (tmp_path / "photographs" / "apple").symlink_to(tmp_path / "linked")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    settings = AuditSettings(**given)
    run_config.write_config(tmp_path / "audit", settings)
    (tmp_path / "unrelated.png").write_text("new")
    run_config.require_same(tmp_path / "audit", settings, "out=", lambda *_: False)
    replace_content(tmp_path / changed)
    with pytest.raises(InputError, match="has changed since"):
        run_config.require_same(tmp_path / "audit", settings, "out=", lambda *_: False)


def test_a_last_line_that_was_cut_short_is_skipped(tmp_path):
    assert read_metrics(tmp_path) == []  # This log has no file.
    (tmp_path / METRICS).write_text('{"epoch": 1}\n{"epo')
    assert read_metrics(tmp_path) == [{"epoch": 1}]


def write_epochs(folder: Path, epochs: range, history=()) -> None:
    log = RunLog(folder, history)
    for epoch in epochs:
        log.scalars({"train/loss": 1 / epoch, "validation/accuracy": 0.25}, epoch)


@pytest.mark.parametrize("done", [0, 2, 3])
def test_resuming_continues_the_metrics_from_the_checkpoints_epoch(tmp_path, done, monkeypatch):
    """Later lines and scores are written again. Lines that were cut or lost come back."""
    # TensorBoard orders the files by their seconds.
    monkeypatch.setattr(time, "time", itertools.count(1e9).__next__)
    write_epochs(tmp_path, range(1, 4))
    epochs = read_metrics(tmp_path)
    (tmp_path / METRICS).write_text('{"epoch": 3, "train/lo')
    write_epochs(tmp_path, range(done + 1, 4), epochs[:done])
    assert read_metrics(tmp_path) == epochs
    for accuracy in (0.5, 0.25):  # A finished run is scored again.
        RunLog(tmp_path, epochs).scalars({"test/accuracy": accuracy}, 4, is_final=True)
    assert read_metrics(tmp_path) == [*epochs, {"test/accuracy": 0.25}]
    board = EventAccumulator(str(tmp_path)).Reload()
    assert [event.step for event in board.Scalars("train/loss")] == [1, 2, 3]
    assert [(event.step, event.value) for event in board.Scalars("test/accuracy")] == [(4, 0.25)]


def test_attack_success_is_the_fraction_of_the_clean_correct_examples():
    """Of ten examples, two were wrong before, and six are wrong after the attack."""
    of_ten = {"attack_success_before": 0.2, "attack_success": 0.6}
    assert attack_success(of_ten) == pytest.approx(4 / 8)
    assert attack_success({"attack_success_before": 1.0, "attack_success": 1.0}) is None


def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch):
    """Some network file systems have no locks, and the system names no file then."""
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError) as caught, locked(tmp_path):
        pass
    assert user_message(caught.value) == (
        f"{tmp_path / LOCK} cannot be read or written: {os.strerror(errno.ENOLCK)}"
    )


@pytest.mark.parametrize(
    "method, error", [("unlink", PermissionError()), ("rmdir", OSError(errno.ENOTEMPTY, ""))]
)
def test_an_error_is_not_hidden_by_a_lock_that_is_kept(tmp_path, monkeypatch, method, error):
    """Windows removes no open file, and NFS keeps it in its folder under another name."""

    def refuse(*_, **options):
        raise error

    monkeypatch.setattr(Path, method, refuse)
    with pytest.raises(InputError, match="mistake"), sole_writer(tmp_path / "out"):
        raise InputError("mistake")
