"""Commands from start to end: their statuses, their single lines of error, and interrupts."""

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from renderer.errors import InputError
from train import cli
from train.checkpoint import LAST
from train.run_folder import locked

ROOT = Path(__file__).parents[2]
SMALL = [
    "model.depth=10", "model.width=1", "train.epochs=1", "train.precision=float32", "augment.examples=4",
    "scene.backgrounds=[0,1]", "renderer.rasterizer=numpy", "renderer.samples=2",
]  # fmt: skip


def test_a_command_trains_every_arm_and_ends_with_their_table(tmp_path, tiny_npz, photos):
    """From another folder than the repository's, in the background of a shell, which ignores SIGINT."""
    overrides = ["run=here", "data=npz", f"data.path={tiny_npz}", f"evaluate.photos={photos}", "compare=[none]"]
    command = [sys.executable, "-m", "train", *overrides, *SMALL]
    done = subprocess.run(
        ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", *command],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    rows = [line.split("|")[1].strip() for line in done.stdout.splitlines() if line.startswith("|")]
    assert [row for row in rows if row in ("augment", "none", "adversarial")] == ["augment", "none", "adversarial"] * 2
    for folder in (tmp_path / "here", tmp_path / "here" / "none"):
        assert (folder / LAST).is_file() and (folder / "photographs" / "contact_sheet.png").is_file()
    assert (tmp_path / "here" / "train.log").read_text() == done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["data=npz", "data.path=none.npz"], "data.path=none.npz does not exist: give the path of an .npz file"),
        (["run=file/run"], "run=file/run cannot be written to (Not a directory): choose another folder"),
        (["run=/proc/none"], "run=/proc/none cannot be written to"),
        (["run=odd"], "run=odd/train.log cannot be written (it is not a regular file)"),
        (["run=[a]"], "run: "),
        (["train.epoch=3"], "Could not override 'train.epoch'"),
        (["compare=[non]"], "compare: "),
        (["--multirun", "launcher=slurm", "seed=0,1"], "launcher=slurm needs Slurm's sbatch, which is missing"),
        (["--multirun", "seed=0,0"], "the sweep has a cell twice"),
        (["--multirun", "run=a", "seed=0,1"], "run= names the folder of a single run"),
        (["--multirun", "sweep=file/a", "seed=0,1"], "sweep=file/a cannot be written to (Not a directory)"),
        (["--multirun", "train.epoch=0,1"], "Could not override 'train.epoch'"),
    ],
    ids=lambda given: given[-1] if isinstance(given, list) else "",
)
def test_a_mistake_is_one_line_and_status_2(call, capsys, monkeypatch, tmp_path, arguments, sentence):
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "file").touch()
    (tmp_path / "odd" / "train.log").mkdir(parents=True)
    assert call("train", *arguments) == cli.USER_ERROR
    error = capsys.readouterr().err
    assert error.startswith(f"error: {sentence}") and error.count("\n") == 1
    assert not list(tmp_path.rglob("config.yaml"))


def test_a_mistake_in_any_arm_stops_the_command_before_the_first_arm_trains(call, capsys, tmp_path, tiny_npz):
    arms = ["run=here", "data=npz", f"data.path={tiny_npz}", "compare=[none]"]
    assert call("train", *arms, *SMALL, "scene.views=3") == cli.USER_ERROR
    assert "augment.examples=4 is not 2 meshes × 3 views × 2 backgrounds = 12" in capsys.readouterr().err
    assert not list(tmp_path.rglob(LAST))


@pytest.mark.parametrize("held", ["here", "here/none"])
def test_two_commands_do_not_train_in_one_folder(call, capsys, tmp_path, tiny_npz, held):
    arms = ["run=here", "data=npz", f"data.path={tiny_npz}", "compare=[none]", "train.resume=true"]
    with locked(tmp_path / held):
        assert call("train", *arms, *SMALL) == cli.USER_ERROR
    assert capsys.readouterr().err.startswith(f"error: run={tmp_path / held} is being written by another process")
    assert not list(tmp_path.rglob("config.yaml")) and not list(tmp_path.rglob("metrics.jsonl"))


def test_torchrun_starts_no_sweep(call, capsys, monkeypatch):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    assert call("train", "--multirun", "seed=0,1") == cli.USER_ERROR
    assert "start a sweep with python -m train --multirun" in capsys.readouterr().err


# ------------------------------------------------------------------------------------ errors and interrupts


def raise_error(error: BaseException) -> None:
    with cli.errors():
        raise error


def test_an_error_of_the_program_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        raise_error(ZeroDivisionError())


def test_an_error_of_the_user_is_one_line(capsys):
    with pytest.raises(SystemExit) as stop:
        raise_error(InputError("seed=a is not a number"))
    assert stop.value.code == cli.USER_ERROR and capsys.readouterr() == ("", "error: seed=a is not a number\n")


@pytest.mark.parametrize("swallowed", [False, True])
def test_ctrl_c_is_one_line_and_status_130_also_where_a_library_makes_an_error_of_it(capsys, swallowed):
    """As trimesh does, which keeps whatever is raised while its optional parts are imported."""
    before = signal.signal(signal.SIGINT, cli._interrupt)  # a background job has it ignored
    try:
        with pytest.raises(SystemExit) as stop, cli.errors():
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                if swallowed:
                    raise TypeError("unsupported operand type(s) for |") from None
                raise
    finally:
        signal.signal(signal.SIGINT, before)
    assert stop.value.code == 128 + signal.SIGINT and capsys.readouterr() == ("", "ended by SIGINT\n")


INTERRUPTED = """
import runpy, signal, sys
class Finder:
    def find_spec(name, *_):
        if name == "torch":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder)
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_path(sys.argv[1], run_name="__main__")
"""


@pytest.mark.parametrize("path", ["train/__main__.py", "scripts/attack.py", "scripts/fit_skylight.py"])
def test_an_interrupt_while_torch_is_imported_is_one_line(path):
    command = [sys.executable, "-c", INTERRUPTED, str(ROOT / path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert (ended.returncode, ended.stdout, ended.stderr) == (128 + signal.SIGINT, "", "ended by SIGINT\n")


def test_every_command_imports_the_handler_of_interrupts_first():
    for path in [ROOT / "train" / "__main__.py", *(ROOT / "scripts").glob("*.py")]:
        imports = [line for line in path.read_text().splitlines() if line.startswith(("import ", "from "))]
        modules = [line.split()[1].partition(".")[0] for line in imports]
        assert "from train import cli" in imports[modules.index("train")], path
        assert set(modules[: modules.index("train")]) <= sys.stdlib_module_names, path


def test_a_reader_that_has_gone_ends_a_command_in_silence(call, capsys, monkeypatch, tmp_path):
    read, write = os.pipe()
    os.close(read)
    with monkeypatch.context() as patch, open(write, "w") as output:
        patch.setattr(sys, "stdout", output)
        assert call("export_light", "light=grace", "height=4", "out=a.hdr") == 128 + signal.SIGPIPE
        print("what Python may still hold at its end", flush=True)
    assert capsys.readouterr().err == "" and (tmp_path / "a.hdr").is_file()


def test_a_terminal_of_ascii_shows_other_characters_as_escapes(call, monkeypatch):
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")
    monkeypatch.setattr(sys, "stdout", terminal)
    assert call("export_light", "light=grace", "height=4", "out=a.hdr") == 0
    assert rb"8 \xd7 4 texels" in terminal.buffer.getvalue()
