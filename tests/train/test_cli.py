import errno
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
import yaml

from renderer.errors import InputError
from scripts.compare import main as compare
from train import checkpoints, console
from train.cli import USER_ERROR
from train.commands.experiment import logged_to
from train.data.sets import content_hash
from train.run_folder import LAST, locked, writable_folder
from train.settings import PHOTOGRAPHS_FIRST
from train.system import take_flag

ROOT = Path(__file__).parents[2]
SMALL = [
    *("experiment=paper", "model.depth=10", "model.width=1", "train.epochs=1"),
    *("train.precision=float32", "train.threads=1", "augment.examples=4"),
    *("augment.attack.max_steps=2", "scene.backgrounds=[0,1]", "renderer.rasterizer=numpy"),
    "renderer.samples=2",
]
RESUME = "train.resume=true"


@pytest.fixture
def two_methods(tiny_npz) -> list[str]:
    return ["data=npz", f"data.path={tiny_npz}", "compare=[none]"]


@pytest.mark.slow
def test_two_methods_end_with_their_table_and_the_command(
    call, capsys, tmp_path, two_methods, photos
):
    """It runs in the background of a shell, which ignores SIGINT."""
    overrides = [*two_methods, f"photos={photos}", *SMALL]
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert call("train", "out=here", *overrides) == 0
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    printed = capsys.readouterr()
    assert re.sub(r".* \.\.\.\n", "", printed.err) == ""  # Announcements end with dots.
    lines = printed.out.splitlines()
    assert len(lines) <= 15
    names = [line.split()[1] for line in lines if line.startswith("| ")]
    assert [name for name in names if name.isalpha()] == ["network", "none", "adversarial"]
    folder = tmp_path / "here"
    for run in (folder, folder / "none"):
        assert (run / LAST).is_file()
        assert (run / "photographs" / "contact_sheet.png").is_file()
    log = (folder / "train.log").read_text()
    assert set(lines) <= set(log.splitlines())
    assert "epoch 1/" in log
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert shlex.split(config["command"]) == ["python", "-m", "train", *overrides]
    assert config["working_folder"] == str(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


@pytest.mark.parametrize(
    ("arguments", "start"),
    [
        (["data=npz", "data.path=none.npz"], "data.path=none.npz does not exist"),
        (["out=file/run"], "out=PATH/file/run cannot be written to"),
        (["out=odd"], "PATH/odd/train.log cannot be read or written"),
        (["network=none"], "network=none"),
        (["photos=~/none"], "photos: HOME/none is not a folder"),
        (["meshes=[{mesh: ~/none.glb, label: orange}]"], "scene: HOME/none.glb does not exist"),
        (["meshes=[{mesh: Öl (1).glb}]"], "meshes=[{mesh: Öl (1).glb}] cannot be read: put"),
        (["--multirun", "launcher=slurm", "seed=0,1"], "launcher=slurm needs the command sbatch"),
        (["--multirun", "seed=0,0"], "the sweep has two runs with the same settings"),
        (["--multirun", "out=a", "seed=0,1"], "out="),
        ([RESUME], "out=PATH/runs/"),
        (["out=attack", RESUME], "out=PATH/attack holds no run"),
        (["out=damaged", RESUME], "PATH/damaged/config.yaml is damaged"),
    ],
    ids=str,
)
def test_a_mistake_is_an_error_in_one_line(call, capsys, monkeypatch, tmp_path, arguments, start):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("HOME", "HOME")
    (tmp_path / "file").touch()
    for name in ("attack", "damaged", "odd/train.log"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "attack" / "config.yaml").write_text("label: orange\nattack: {}")
    (tmp_path / "damaged" / "config.yaml").write_text("[")
    unchanged = "*" if RESUME in arguments else "config.yaml"
    before = sorted(tmp_path.rglob(unchanged))
    assert call("train", *arguments) == USER_ERROR
    error = capsys.readouterr().err.replace(str(tmp_path), "PATH")
    # A command that loads for seconds says so in a line before.
    lines = [line for line in error.splitlines() if not line.startswith("loading ")]
    assert len(lines) == 1
    assert lines[0].startswith(f"error: {start}")
    assert sorted(tmp_path.rglob(unchanged)) == before


def test_a_mistake_in_an_arm_stops_the_command_before_training(call, capsys, tmp_path, two_methods):
    assert call("train", "out=here", *two_methods, *SMALL, "meshes=[missing.glb]") == USER_ERROR
    assert "missing.glb" in capsys.readouterr().err
    assert not list(tmp_path.rglob(LAST))


def test_two_commands_do_not_train_in_one_folder(call, capsys, tmp_path, two_methods):
    busy = tmp_path / "here" / "none"
    with locked(busy):
        assert call("train", "out=here", *two_methods, *SMALL, "train.resume=true") == USER_ERROR
    assert capsys.readouterr().err.startswith(f"error: out={busy} is in use by another process")
    assert not list(tmp_path.rglob("config.yaml"))
    assert not list(tmp_path.rglob("metrics.jsonl"))


@pytest.mark.slow
def test_a_stopped_run_is_resumed_by_folder(call, capsys, no_report, tmp_path, two_methods, photos):
    """The folder was moved; only settings that do not affect the result may change."""
    folder = tmp_path / "begun"
    overrides = [*two_methods, f"photos={photos}", "seed=3", *SMALL, "train.epochs=2"]

    def save_and_stop(*arguments):
        patch.undo()
        torch.save(*arguments)
        signal.raise_signal(signal.SIGTERM)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "save", save_and_stop)
        assert call("train", f"out={folder}", *overrides) == 128 + signal.SIGTERM
    advice = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert advice[-5:] == [sys.executable, "-m", "train", f"out={folder}", "train.resume=true"]
    stopped = folder.rename(tmp_path / "moved")
    for other in ("seed=4", "augment=random"):
        assert call("train", f"out={stopped}", "train.resume=true", other) == USER_ERROR
    before = yaml.safe_load((stopped / "config.yaml").read_text())
    additional = "train.checkpoint_every=2"
    assert call("train", f"out={stopped}", "train.resume=true", additional) == 0
    config = yaml.safe_load((stopped / "config.yaml").read_text())
    assert config["command"] == f"{before['command']} {additional}"
    assert config["out"] == str(stopped)

    whole = tmp_path / "whole"
    _, _, _, *overrides = shlex.split(config["command"])
    assert call("train", f"out={whole}", *overrides) == 0
    for method in (".", "none"):
        resumed_state = torch.load(stopped / method / LAST, weights_only=True)
        whole_state = torch.load(whole / method / LAST, weights_only=True)
        assert resumed_state["epoch"] == 2
        assert content_hash(resumed_state["model"]) == content_hash(whole_state["model"])
        assert (stopped / method / "photographs" / "summary.json").is_file()


@pytest.mark.parametrize(
    ("function", "has_trained", "error", "code"),
    [
        ("inputs.load_data", False, KeyboardInterrupt(), 128 + signal.SIGINT),
        ("run.evaluate_photographs", True, KeyboardInterrupt(), 128 + signal.SIGINT),
        ("run.evaluate_photographs", True, SystemExit(143), 128 + signal.SIGTERM),
        ("run.evaluate_photographs", True, OSError(errno.ENOSPC, "full"), USER_ERROR),
    ],
)
def test_a_signal_and_a_full_disk_tell_how_to_resume_if_there_is_a_checkpoint(
    call, capsys, monkeypatch, tmp_path, tiny_npz, photos, function, has_trained, error, code
):
    monkeypatch.setattr(f"train.training.{function}", Mock(side_effect=error))
    data = "data=npz", f"data.path={tiny_npz}", f"photos={photos}"
    assert call("train", "out=here", *data, *SMALL) == code
    last_line = capsys.readouterr().out.splitlines()[-1]
    assert (tmp_path / "here" / LAST).is_file() == has_trained
    assert ("train.resume=true" in last_line) == has_trained


def follow_advice(call, capsys, folder: Path) -> None:
    """Run the command that the last printed line tells, which trains to the end."""
    words = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert call("train", *words[words.index("train") + 1 :]) == 0
    assert (folder / LAST).is_file()


def test_a_disk_full_before_the_first_checkpoint_tells_a_command_that_trains(
    call, capsys, no_report, tmp_path, tiny_npz
):
    def save_best_alone(path: Path, *state) -> None:
        if path.name == LAST:
            raise OSError(errno.ENOSPC, "full")
        save(path, *state)

    save = checkpoints.save
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoints, "save", save_best_alone)
        data = "data=npz", f"data.path={tiny_npz}", "photos=null"
        assert call("train", "out=here", *data, *SMALL) == USER_ERROR
    follow_advice(call, capsys, tmp_path / "here")


def test_a_signal_between_the_two_trainings_of_a_command_tells_one_that_goes_on(
    call, capsys, monkeypatch, no_report, tmp_path, tiny_npz
):
    def train_first(settings, _):
        first = Path(settings.out, PHOTOGRAPHS_FIRST)
        first.mkdir(exist_ok=True, parents=True)
        (first / LAST).touch()
        return replace(settings, photographs_first=False)

    data = "data.name=npz", f"data.path={tiny_npz}", "photos=null", "network=null"
    alone = [f"train.{name}_weight=0" for name in ("distillation", "ranking")]
    alone += ["train.eval_mode=null", "augment.mode=none"]
    monkeypatch.setattr("train.commands.experiment._train_on_photographs", train_first)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.training.inputs.load_data", Mock(side_effect=KeyboardInterrupt))
        words = "out=here", "photographs_first=true", *data, *alone, *SMALL[1:]
        assert call("train", *words) == 128 + signal.SIGINT
    follow_advice(call, capsys, tmp_path / "here")


def test_ctrl_c_is_one_line_even_if_a_library_turns_it_into_an_error(capsys):
    """trimesh does so while it imports optional parts."""
    with pytest.raises(SystemExit) as stop, compare.handle_errors():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise TypeError("unsupported operand type(s) for |") from None
    assert stop.value.code == 128 + signal.SIGINT
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "ended by SIGINT\n")


INTERRUPTED = """
import runpy, signal, sys
class Finder:
    def find_spec(name, *_):
        if name == "torch":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv[1:] = []
runpy.run_module("scripts.attack", run_name="__main__")
"""


def test_an_interrupt_while_torch_is_imported_is_one_line():
    command = [sys.executable, "-c", INTERRUPTED]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100, cwd=ROOT)
    assert ended.returncode == 128 + signal.SIGINT
    assert ended.stdout == ""
    assert ended.stderr == "ended by SIGINT\n"


def test_a_folder_that_was_deleted_is_one_line(tmp_path):
    code = f"import os, scripts.fit as fit; os.mkdir(gone := {str(tmp_path / 'gone')!r}); "
    code += "os.chdir(gone); os.rmdir(gone); fit.main()"
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100, cwd=ROOT)
    assert ended.returncode == USER_ERROR
    assert re.fullmatch(r"error: the current folder is gone .*\n", ended.stderr)


def test_a_command_may_print_if_the_shell_has_closed_its_outputs():
    code = "import sys; from train.system import set_up_process; set_up_process(); "
    code += "print(1); sys.stderr.write(str(sys.stderr.isatty()))"
    command = ["sh", "-c", '"$0" -c "$1" >&- 2>&-', sys.executable, code]
    assert subprocess.run(command, cwd=ROOT, timeout=100).returncode == 0


def test_a_closed_output_pipe_ends_a_command_silently(capsys, monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with monkeypatch.context() as patch, open(write, "w") as output:
        patch.setattr(sys, "stdout", output)
        with pytest.raises(SystemExit) as stop, compare.handle_errors():
            print("a table")
        assert stop.value.code == 128 + signal.SIGPIPE
        print("text that Python writes at its end", flush=True)
    assert capsys.readouterr().err == ""


def test_a_full_disk_is_noticed_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda dir: io.FileIO("/dev/full", "w"))
    with pytest.raises(InputError, match=rf"out={tmp_path} .*No space left on device"):
        writable_folder(tmp_path, "out")


def test_details_are_in_the_log_and_printed_if_asked_for(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "environ", dict(os.environ))
    for words, printed in (["seed=1"], "result\n"), (["-v", "seed=1"], "detail\nresult\n"):
        assert take_flag(words) == ["seed=1"]
        with logged_to(tmp_path / printed[0]):
            console.debug("detail")
            console.info("result")
        assert capsys.readouterr().out == printed
        assert (tmp_path / printed[0]).read_text() == "detail\nresult\n"
