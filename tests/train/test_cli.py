"""Commands from start to end: their statuses, their single lines of error, and interrupts."""

import io
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
import yaml

from renderer.errors import InputError
from train import command
from train.command import USER_ERROR, Command
from train.command_settings import LightSettings
from train.help import HelpText
from train.runs.checkpoint import LAST
from train.runs.run_lock import locked
from train.system import user_errors as errors
from train.system.hashing import content_hash
from train.system.user_errors import one_sentence, writable_folder

ROOT = Path(__file__).parents[2]
SMALL = [
    "experiment=paper",
    "model.depth=10", "model.width=1", "train.epochs=1", "train.precision=float32", "augment.examples=4",
    "augment.attack.max_steps=2", "scene.backgrounds=[0,1]", "renderer.rasterizer=numpy", "renderer.samples=2",
    "train.threads=1",
]  # fmt: skip


@pytest.fixture
def no_report(monkeypatch) -> None:
    """Several trainings of a test write no pages, whose plots take longer."""
    monkeypatch.setattr("train.commands.experiment.report_of", lambda folders, out: "no report")


def test_a_command_trains_every_arm_and_ends_with_their_table(call, capsys, tmp_path, tiny_npz, photos):
    """From another folder than the repository's, in the background of a shell, which ignores SIGINT."""
    overrides = ["run=here", "data=npz", f"data.path={tiny_npz}", f"evaluate.photos={photos}", "compare=[none]"]
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert call("train", *overrides, *SMALL) == 0
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    printed = capsys.readouterr()
    assert re.sub(r".* \.\.\.\n", "", printed.err) == ""  # but for what took long
    rows = [line.split("|")[1].strip() for line in printed.out.splitlines() if line.startswith("|")]
    assert [row for row in rows if row in ("none", "adversarial")] == ["none", "adversarial"] * 2
    for folder in (tmp_path / "here", tmp_path / "here" / "none"):
        assert (folder / LAST).is_file() and (folder / "photographs" / "contact_sheet.png").is_file()
    assert (tmp_path / "here" / "train.log").read_text() == printed.out
    config = yaml.safe_load((tmp_path / "here" / "config.yaml").read_text())
    assert shlex.split(config["command"]) == ["python", "-m", "train", *overrides[1:], *SMALL]
    assert config["working_folder"] == str(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["data=npz", "data.path=none.npz"], "data.path=none.npz does not exist: give the path of an .npz file"),
        (["run=file/run"], "run=file/run cannot be written to (Not a directory): choose another folder"),
        (["run=odd"], "PATH/odd/train.log cannot be read or written: Is a directory"),
        (["train.epoch=3"], "train.epoch is not a setting: did you mean train.epochs?"),
        (["compare=[non]"], "compare: "),
        (["train.init_from=none"], "train.init_from=none holds neither best.pt nor model.safetensors"),
        (["train.init_from=timm:"], "train.init_from=timm: "),
        (["--multirun", "launcher=slurm", "seed=0,1"], "launcher=slurm needs Slurm's sbatch, which is missing"),
        (["--multirun", "seed=0,0"], "the sweep has a run twice"),
        (["--multirun", "run=a", "seed=0,1"], "run= names the folder of a single run"),
    ],
    ids=lambda given: given[-1] if isinstance(given, list) else "",
)
def test_a_mistake_is_one_line_and_status_2(call, capsys, monkeypatch, tmp_path, arguments, sentence):
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "file").touch()
    (tmp_path / "odd" / "train.log").mkdir(parents=True)
    assert call("train", *arguments) == USER_ERROR
    error = capsys.readouterr().err
    assert error.replace(str(tmp_path), "PATH").startswith(f"error: {sentence}") and error.count("\n") == 1
    assert not list(tmp_path.rglob("config.yaml"))


def test_a_mistake_in_any_arm_stops_the_command_before_the_first_arm_trains(call, capsys, tmp_path, tiny_npz):
    arms = ["run=here", "data=npz", f"data.path={tiny_npz}", "compare=[none]"]
    assert call("train", *arms, *SMALL, "scene.views=3") == USER_ERROR
    assert "augment.examples=4 is not 2 meshes × 3 views × 2 backgrounds" in capsys.readouterr().err
    assert not list(tmp_path.rglob(LAST))


@pytest.mark.parametrize("busy", ["here", "here/none"])
def test_two_commands_do_not_train_in_one_folder(call, capsys, tmp_path, tiny_npz, busy):
    arms = ["run=here", "data=npz", f"data.path={tiny_npz}", "compare=[none]", "train.resume=true"]
    with locked(tmp_path / busy):
        assert call("train", *arms, *SMALL) == USER_ERROR
    assert capsys.readouterr().err.startswith(f"error: run={tmp_path / busy} is being written by another process")
    assert not list(tmp_path.rglob("config.yaml")) and not list(tmp_path.rglob("metrics.jsonl"))


def test_torchrun_starts_no_sweep(call, capsys, monkeypatch):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    assert call("train", "--multirun", "seed=0,1") == USER_ERROR
    assert "start a sweep with pnb-train --multirun" in capsys.readouterr().err


@pytest.fixture
def stopped(call, capsys, no_report, tmp_path, tiny_npz, photos) -> Path:
    """A run of two arms with options of its own that SIGTERM ended, and that was then moved."""
    folder = tmp_path / "begun"
    data = ["data=npz", f"data.path={tiny_npz}", f"evaluate.photos={photos}", "compare=[none]", "seed=3"]
    with pytest.MonkeyPatch.context() as patch:

        def save_and_stop(*arguments):
            patch.undo()
            torch.save(*arguments)
            signal.raise_signal(signal.SIGTERM)

        patch.setattr(torch, "save", save_and_stop)
        assert call("train", f"run={folder}", *data, *SMALL, "train.epochs=2") == 128 + signal.SIGTERM
    command = shlex.split(capsys.readouterr().out.rpartition("to go on: ")[2])
    assert command == [sys.executable, "-m", "train", f"run={folder}", "train.resume=true"]
    return folder.rename(tmp_path / "moved")


def test_a_run_is_resumed_by_its_folder_alone(call, tmp_path, stopped):
    """Its arms, too, to the weights of a run that was not stopped; with further overrides, which are recorded."""
    before = yaml.safe_load((stopped / "config.yaml").read_text())
    assert call("train", f"run={stopped}", "train.resume=true", "train.checkpoint_every=2") == 0
    config = yaml.safe_load((stopped / "config.yaml").read_text())
    assert config["command"] == f"{before['command']} train.checkpoint_every=2" and config["run"] == str(stopped)
    begun, whole = shlex.split(config["command"])[3:], tmp_path / "whole"
    assert call("train", f"run={whole}", *begun) == 0
    for arm in (".", "none"):
        states = [torch.load(run / arm / LAST, weights_only=True) for run in (stopped, whole)]
        assert states[0]["epoch"] == 2 and content_hash(states[0]["model"]) == content_hash(states[1]["model"])
        assert (stopped / arm / "photographs" / "summary.json").is_file()
    assert call("train", f"run={stopped / 'none'}", "train.resume=true") == 0  # an arm by itself
    assert not (stopped / "none" / "none").exists()


@pytest.mark.parametrize(
    "overrides, sentence",
    [
        (["run=empty"], "run=empty holds no run to resume"),
        (["run=nowhere"], "run=nowhere holds no run to resume"),
        ([], "run=runs/"),
        (["run=attack"], "run=attack holds no run to resume"),
        (["run=damaged"], "damaged/config.yaml is damaged"),
    ],
    ids=str,
)
def test_nothing_is_written_to_a_folder_that_holds_no_run(call, capsys, tmp_path, overrides, sentence):
    for name, content in (("empty", ""), ("attack", "label: orange\nattack: {}"), ("damaged", "[")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text(content)
    (tmp_path / "empty" / "config.yaml").unlink()
    files = sorted(tmp_path.rglob("*"))
    assert call("train", *overrides, "train.resume=true") == USER_ERROR
    error = capsys.readouterr().err.replace(f"{tmp_path}/", "")
    assert error.startswith(f"error: {sentence}") and error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == files


@pytest.mark.parametrize("stage", ["commands.experiment.load_data", "training.run.evaluate_photographs"])
def test_ctrl_c_tells_how_to_go_on_from_a_checkpoint(call, capsys, monkeypatch, tmp_path, tiny_npz, photos, stage):
    monkeypatch.setattr(f"train.{stage}", Mock(side_effect=KeyboardInterrupt))
    arguments = "run=here", "data=npz", f"data.path={tiny_npz}", f"evaluate.photos={photos}", *SMALL
    assert call("train", *arguments) == 128 + signal.SIGINT
    advice = capsys.readouterr().out.splitlines()[-1]
    has_trained = stage != "commands.experiment.load_data"
    assert ("train.resume=true" in advice) == (tmp_path / "here" / LAST).is_file() == has_trained


def test_a_run_is_resumed_with_no_other_settings_that_decide_its_result(call, capsys, stopped):
    files = {path: path.stat().st_mtime_ns for path in stopped.rglob("*")}
    for override, key in (("seed=4", "seed=3, not 4"), ("augment=random", "was made with ")):
        assert call("train", f"run={stopped}", "train.resume=true", override) == USER_ERROR
        assert key in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in stopped.rglob("*")} == files


LIGHT = Command("light", LightSettings, "builtins:print", HelpText("Write a light."))


def test_a_librarys_warning_is_one_line_of_a_command():
    code = "from train.command import set_up_process\nimport warnings\nset_up_process()\nwarnings.warn('clamped')"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert (ended.returncode, ended.stderr) == (0, "warning: clamped\n")


def test_an_error_of_the_program_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError), LIGHT.one_line():
        raise ZeroDivisionError


@pytest.mark.parametrize("swallowed", [False, True])
def test_ctrl_c_is_one_line_and_status_130_even_if_a_library_turns_it_into_an_error(capsys, swallowed):
    """As trimesh does, which keeps whatever is raised while its optional parts are imported."""
    with pytest.raises(SystemExit) as stop, LIGHT.one_line():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            if swallowed:
                raise TypeError("unsupported operand type(s) for |") from None
            raise
    assert stop.value.code == 128 + signal.SIGINT and capsys.readouterr() == ("", "ended by SIGINT\n")


INTERRUPTED = """
import runpy, signal, sys
class Finder:
    def find_spec(name, *_):
        if name == "torch":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv[1:] = []
runpy.run_module("MODULE", run_name="__main__")
"""


@pytest.mark.parametrize("module", ["train", "scripts.attack"])
def test_an_interrupt_while_torch_is_imported_is_one_line(module):
    code = INTERRUPTED.replace("MODULE", module)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert (ended.returncode, ended.stdout, ended.stderr) == (128 + signal.SIGINT, "", "ended by SIGINT\n")


def test_slow_imports_are_announced(monkeypatch, tmp_path, capsys):
    (tmp_path / "slow.py").write_text("import time\ntime.sleep(0.2)\ndef work(): pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(command, "IMPORT_DELAY", 0.01)
    command.import_function("slow:work")()
    assert capsys.readouterr().err == "loading PyTorch and other libraries ...\n"


def test_a_closed_output_pipe_ends_a_command_silently(call, capsys, monkeypatch, tmp_path):
    read, write = os.pipe()
    os.close(read)
    with monkeypatch.context() as patch, open(write, "w") as output:
        patch.setattr(sys, "stdout", output)
        assert call("light", "light=grace", "height=4", "out=a.hdr") == 128 + signal.SIGPIPE
        print("what Python may still hold at its end", flush=True)
    assert capsys.readouterr().err == "" and (tmp_path / "a.hdr").is_file()


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (PermissionError(13, "Permission denied", "/a/b"), "/a/b cannot be read or written: Permission denied"),
        (OSError(28, "No space left on device"), "the output cannot be written (No space left on device): make room"),
        (OSError(28, "No space left", "/a/b"), "/a/b cannot be written (No space left): make room and start again"),
        (RuntimeError("[/gloo/x.cc:1] Connection closed by peer"), "another process of this run has ended: "),
        (torch.distributed.DistBackendError("NCCL error"), "another process of this run has ended: "),
        (UnicodeEncodeError("utf-8", "a\udcffb", 1, 2, "no"), r"'a\udcffb' has characters that this system"),
        (torch.OutOfMemoryError("x"), "memory ran out"),
        (RuntimeError("can't allocate memory"), "memory ran out"),
    ],
)
def test_an_error_is_one_sentence_where_the_user_can_fix_it(error, sentence):
    assert one_sentence(error).startswith(sentence) and "\n" not in one_sentence(error)


def test_trying_an_output_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in (".", "a/b", tmp_path / "c"):
        assert writable_folder(folder, "out") == Path(folder)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_noticed_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(errors.tempfile, "TemporaryFile", lambda dir: io.FileIO("/dev/full", "w"))
    with pytest.raises(InputError, match=rf"out={tmp_path} cannot be written to \(No space left on device\)"):
        writable_folder(tmp_path, "out")
