import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from renderer.errors import InputError
from train.__main__ import main
from train.command_line.configuration import read_settings
from train.command_line.entry_points import (
    USER_ERROR,
    command_line,
    one_sentence,
    one_sentence_errors,
    run_command,
)
from train.command_line.outputs import Folders
from train.command_line.overrides import quoted
from train.run import load_data, prepare
from train.run_folder.checkpoint import LAST
from train.run_folder.files import locked
from train.settings import ExperimentSettings

ROOT = Path(__file__).parents[3]
SMALL = [
    "model.depth=10", "model.width=1", "train.epochs=1", "train.precision=float32", "augment.examples=4",
    "scene.backgrounds=[0,1]", "renderer.rasterizer=numpy", "renderer.samples=2",
]  # fmt: skip


# ---------------------------------------------------------------------------------------- whole commands


REFUSED_BY_HYDRA = [
    (["data=npz", "data.pth=x"], "Could not override 'data.pth'; nearest valid key to 'data.pth': data.path"),
    (
        ["data=mnist"],
        "In 'train': Could not find 'data/mnist' Available options in 'data': cifar100 folder npz shapes",
    ),
    (["seed=1", "augment=null"], "augment=null: Config group override must be a string or a list. Got NoneType"),
    (["data=npz", "data.path=a.npz", "seed=1", "train=[]"], "Error merging override train=[]"),
    (["scene.meshes=[~/a.obj]"], "LexerNoViableAltException: scene.meshes=[~/a.obj] ^"),
    (["~seed"], "~seed: no setting can be taken away: leave this out, or set it to another value"),
    (["run="], "run is empty: give a name, or leave it out"),
    (["model.name=''"], "model.name is empty: give a name, or leave it out"),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED_BY_HYDRA, ids=lambda given: given[-1])
def test_what_hydra_refuses_is_one_sentence_that_names_the_override(monkeypatch, capsys, overrides, message):
    monkeypatch.setattr(sys, "argv", ["train", *overrides])
    with pytest.raises(SystemExit) as stop:
        run_command(main, "train")
    assert stop.value.code == USER_ERROR
    assert capsys.readouterr() == ("", f"error: {message}\n")


def test_an_error_of_the_programs_own_keeps_its_traceback(monkeypatch):
    def broken():
        raise ValueError("a mistake of ours")

    monkeypatch.setattr(sys, "argv", ["train"])
    with pytest.raises(ValueError, match="a mistake of ours"):
        run_command(broken, "train")


def test_a_missing_file_is_one_line(call, capsys):
    assert call("train", "data=npz", "data.path=none.npz") == USER_ERROR
    assert capsys.readouterr().err == "error: data.path=none.npz does not exist: give the path of an .npz file\n"


def test_a_mistake_in_any_arm_stops_the_command_before_the_first_arm_trains(call, capsys, tmp_path, tiny_npz):
    arms = ["run=here", "data=npz", f"data.path={tiny_npz}", "compare=[none]"]
    assert call("train", *arms, *SMALL, "scene.views=3") == USER_ERROR
    told = capsys.readouterr().err
    assert told.startswith("error: augment.examples=4 is not 2 meshes × 3 views × 2 backgrounds = 12")
    assert len(told.splitlines()) == 1
    assert not list(tmp_path.rglob(LAST))


def test_a_command_trains_every_arm_and_ends_with_their_table(tmp_path, tiny_npz, photos):
    """From another folder than the repository's."""
    overrides = ["run=here", "data=npz", f"data.path={tiny_npz}", f"evaluate.photos={photos}", "compare=[none]"]
    environment = {name: value for name, value in os.environ.items() if name != "HYDRA_FULL_ERROR"}
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-m", "train", *overrides, *SMALL]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    rows = [line.split("|")[1].strip() for line in done.stdout.splitlines() if line.startswith("|")]
    assert [row for row in rows if row in ("augment", "none", "adversarial")] == ["augment", "none", "adversarial"] * 2
    for folder in (tmp_path / "here", tmp_path / "here" / "none"):
        assert (folder / LAST).is_file() and (folder / "photographs" / "contact_sheet.png").is_file()
    assert (tmp_path / "here" / "train.log").read_text() == done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here"]


def test_a_run_folder_that_cannot_be_written_is_one_line(call, capsys, tmp_path):
    (tmp_path / "file").touch()
    assert call("train", "run=file/run") == USER_ERROR
    error = "error: run=file/run cannot be written to (Not a directory): choose another folder\n"
    assert capsys.readouterr() == ("", error)


@pytest.mark.parametrize("start", [Folders().on_run_start, Folders().on_multirun_start])
@pytest.mark.parametrize("folder", ["/proc/none", ["a", "b"], {"a": "b"}])
def test_a_folder_for_runs_that_cannot_be_meant_or_written_is_one_line(capsys, start, folder):
    config = OmegaConf.create({"hydra": {"run": {"dir": folder}, "sweep": {"dir": folder}}})
    with pytest.raises(SystemExit) as stop:
        start(config)
    printed = capsys.readouterr()
    assert stop.value.code == USER_ERROR and printed.err.startswith(("error: run=", "error: sweep="))
    assert printed.err.count("\n") == 1


def test_a_log_that_cannot_be_written_is_one_line(capsys, tmp_path):
    (tmp_path / "train.log").mkdir()
    with pytest.raises(SystemExit) as stop:
        Folders().on_run_start(OmegaConf.create({"hydra": {"run": {"dir": str(tmp_path)}}}))
    assert stop.value.code == USER_ERROR
    assert capsys.readouterr().err.startswith(
        f"error: run={tmp_path / 'train.log'} cannot be written (it is no regular"
    )


@pytest.mark.parametrize("held", ["here", "here/none"])
def test_two_commands_do_not_train_in_one_folder(call, capsys, tmp_path, tiny_npz, held):
    (tmp_path / held).mkdir(parents=True)
    arms = ["run=here", "data=npz", f"data.path={tiny_npz}", "compare=[none]", "train.resume=true"]
    with locked(tmp_path / held):
        assert call("train", *arms, *SMALL) == USER_ERROR
    told = capsys.readouterr().err
    assert told.startswith(f"error: run={tmp_path / held} is being written by another process: let it end")
    assert not list(tmp_path.rglob("config.yaml")) and not list(tmp_path.rglob("metrics.jsonl"))


# ---------------------------------------------------------------------------------------- parts


@pytest.mark.parametrize(
    "overrides, message",
    [
        (["train.epochs=abc"], "train.epochs: Value 'abc' of type 'str' could not be converted to Integer"),
        (["train.resume=2"], "train.resume=2: give true or false"),
        (
            ["label=ornage"],
            "label of scene.meshes[0]: 'ornage' is not a class of the model: choose one, such as orange, apple, pear",
        ),
        (["data.path=???"], "data.path is not set: give data.path=..."),
        (["scene.projector=[]"], "scene.projector: Cannot merge DictConfig with ListConfig"),
        (["train=3"], "train: Merge error: int is not a subclass of TrainSettings. value: 3"),
    ],
)
def test_what_a_user_can_mend_is_one_line_and_status_2(tiny_config, tmp_path, capsys, overrides, message):
    @one_sentence_errors
    def command(config):
        settings = read_settings(ExperimentSettings, config)
        prepare(settings, load_data(settings), tmp_path)

    with pytest.raises(SystemExit) as stop:
        command(tiny_config(*overrides))
    assert stop.value.code == USER_ERROR
    assert capsys.readouterr() == ("", f"error: {message}\n")


def test_unset_and_unresolved_keys_are_one_line_too(tiny_config, capsys):
    for override, message in [
        ("data.path=???", "data.path is not set: give data.path=..."),
        ("data.path=${nowhere}", "data.path: Interpolation key 'nowhere' not found"),
    ]:
        with pytest.raises(SystemExit):
            one_sentence_errors(lambda config: config.data.path)(tiny_config(override))
        assert capsys.readouterr().err == f"error: {message}\n"


@pytest.mark.parametrize(
    "error, message",
    [
        (PermissionError(13, "Permission denied", "/a/b"), "/a/b cannot be read or written: Permission denied"),
        (OSError(28, "No space left on device"), "what was to be written found no room: No space left on device"),
        (
            RuntimeError("[/gloo/x.cc:1] Connection closed by peer"),
            "another process of this run has ended: ",
        ),
        (torch.distributed.DistBackendError("NCCL error"), "another process of this run has ended: mend what ended it"),
        (UnicodeEncodeError("utf-8", "a\udcffb", 1, 2, "no"), "'a\\udcffb' has letters that this system or library"),
    ],
)
def test_what_the_system_refuses_is_one_line_that_names_it(capsys, error, message):
    def refused():
        raise error

    with pytest.raises(SystemExit) as stop:
        one_sentence_errors(refused)()
    assert stop.value.code == USER_ERROR
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {message}") and printed.count("\n") == 1


def test_ctrl_c_outside_the_epochs_is_one_line_and_as_a_shell_says_it(monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["train"])
    with pytest.raises(SystemExit) as stop:
        run_command(one_sentence_errors(interrupted), "train")
    assert stop.value.code == 130 and capsys.readouterr() == ("", "ended by SIGINT\n")


def test_an_interrupt_that_a_library_makes_an_error_of_ends_in_one_line(monkeypatch, capsys):
    """As trimesh does, which keeps whatever is raised while its optional parts are imported."""

    def imported():
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise TypeError("unsupported operand type(s) for |") from None

    monkeypatch.setattr(sys, "argv", ["train"])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job has it ignored
    try:
        with pytest.raises(SystemExit) as stop:
            run_command(one_sentence_errors(imported), "train")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert stop.value.code == 130 and capsys.readouterr() == ("", "ended by SIGINT\n")


@pytest.mark.parametrize("script", ["attack.py", "evaluate_photos.py", "export_light.py", "lab.py", "publish.py"])
def test_an_interrupt_while_torch_is_imported_is_one_line(script):
    interrupted = """
import runpy, signal, sys
class Finder:
    def find_spec(name, *_):
        if name == "torch":
            signal.raise_signal(signal.SIGINT)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Finder)
runpy.run_path(sys.argv[1], run_name="__main__")
"""
    command = [sys.executable, "-c", interrupted, str(ROOT / "scripts" / script)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert ended.returncode == -signal.SIGINT and (ended.stdout, ended.stderr) == ("", "ended by SIGINT\n")


@given(st.text())
def test_quoted_text_is_read_as_it_is(text):
    """But for what means an interpolation."""
    (override,) = OverridesParser.create().parse_overrides([f"run={quoted(text)}"])
    assert str(override.value()) == text


@pytest.mark.parametrize(
    "argument, passed",
    [
        ("photos=2024", "photos='2024'"),
        ("evaluate.photos=1.10", "evaluate.photos='1.10'"),
        ("+data.path=1e3", "+data.path='1e3'"),
        ("out=true", "out='true'"),
        ("run=schäl", "run='schäl'"),
        ("run=a\udcff", "run='a\udcff'"),
        ("photos=it's", "photos='it\\'s'"),
        ("out=a;b", "out='a;b'"),
        ("photos=x,y", "photos='x,y'"),
        ("weights=null", "weights='null'"),
        *((same, same) for same in ["train.epochs=3", "photos=none", "photos=2024,2025", "run=a", "2024", "run='ä'"]),
    ],
)
def test_the_name_of_a_folder_stays_text_whatever_it_looks_like_to_hydra(monkeypatch, tmp_path, argument, passed):
    for there in ("x,y", "null"):
        (tmp_path / there).mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train", argument])
    run_command(lambda: None, "train")
    assert sys.argv[1:] == [passed]


@pytest.mark.parametrize("error", [MemoryError(), torch.OutOfMemoryError("x"), RuntimeError("can't allocate memory")])
def test_memory_that_runs_out_is_one_sentence(error):
    assert one_sentence(error).startswith("memory ran out: ask for fewer or smaller images")


def test_what_is_no_users_fault_keeps_its_traceback():
    def broken(config):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        one_sentence_errors(broken)(None)


def test_a_command_that_succeeds_is_left_alone(capsys):
    assert one_sentence_errors(lambda config: config + 1)(1) == 2
    run_command(lambda: print("done"), "train")
    assert capsys.readouterr() == ("done\n", "")


NEAREST = [
    ("train", ["train.epoch=3"], {"train.epoch": "train.epochs"}),
    ("train", ["agument=none"], {"agument": "augment"}),
    ("train", ["exeriment=paper"], {"exeriment": "experiment"}),
    ("train", ["data=npz", "data.pth=x"], {"data.pth": "data.path"}),
    ("train", ["experiment=paper", "data=npz", "data.pth=x"], {"data.pth": "data.path"}),
    ("train", ["-m", "seed=0,1", "data=npz,cifar100", "data.pth=x"], {"data.pth": "data.path"}),
    ("train", ["train.epoch=3", "sed=1"], {"train.epoch": "train.epochs", "sed": "seed"}),
    ("train", ["epochs=3", "batch_size=8"], {"epochs": "train.epochs", "batch_size": "train.batch_size"}),
    ("evaluate_photos", ["run=x", "photo=y"], {"photo": "photos"}),
    ("compare_runs", ["rusn=[a,b]"], {"rusn": "runs"}),
    # nothing to suggest: the key is right, is added, or is like no other
    ("train", ["experiment=papper"], {}),
    ("train", ["train.epochs=[1"], {}),
    ("train", ["data=[npz"], {}),
    ("train", ["hydra.verbose=true"], {}),
    ("train", ["+train.epoch=3", "--config-dir=x"], {}),
    ("train", ["qqqqqqqq=1", "word=1"], {}),
]


@pytest.mark.parametrize("config, arguments, nearest", NEAREST, ids=[" ".join(row[1]) for row in NEAREST])
def test_keys_that_hydra_rejects_get_the_nearest_one(monkeypatch, capsys, config, arguments, nearest):
    def refuse():
        raise HydraException("refused")

    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    with pytest.raises(SystemExit) as stop:
        run_command(refuse, config)
    assert stop.value.code == USER_ERROR
    said = capsys.readouterr().err.rstrip("\n").split("; ")
    assert said[0].startswith("error: ") and said[0].endswith("refused")
    assert said[1:] == [f"nearest valid key to {key!r}: {valid}" for key, valid in nearest.items()]


def test_an_error_of_the_users_input_is_not_followed_by_suggestions(monkeypatch, capsys):
    def main():
        raise InputError("said before")

    monkeypatch.setattr(sys, "argv", ["train", "train.epoch=3"])
    with pytest.raises(SystemExit) as stop:
        run_command(one_sentence_errors(main), "train")
    assert stop.value.code == USER_ERROR
    assert capsys.readouterr().err == "error: said before\n"


# ---------------------------------------------------------------------------------------- on pages


@pytest.mark.parametrize(
    "script, arguments, shown",
    [
        (
            "/home/me/scripts/clone/scripts/torture.py",
            ["out=docs/results.md"],
            "torture.py out=docs/results.md",
        ),
        (
            "scripts/paper/run_time.py",
            ["--meshes", "/me/a.glb:3", "../b.glb"],
            "paper/run_time.py --meshes a.glb:3 b.glb",
        ),
        (
            "scripts/attack.py",
            ["scene.meshes=[~/a.glb,{mesh:/me/b.glb,albedo_scale:3}]"],
            "attack.py 'scene.meshes=[a.glb,{mesh:b.glb,albedo_scale:3}]'",
        ),
        (
            "scripts/attack.py",
            ["data.path=./c d.npz", "train.device=cuda:0"],
            "attack.py 'data.path=c d.npz' train.device=cuda:0",
        ),
        ("scripts/report.py", [], "report.py"),
    ],
)
def test_a_page_shows_its_command_as_it_can_be_typed_without_the_machines_folders(
    monkeypatch, script, arguments, shown
):
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    assert command_line() == f"python scripts/{shown}"
