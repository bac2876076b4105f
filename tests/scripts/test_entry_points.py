"""What every command shares: typed settings, outputs tried before the work, and terminals of any kind."""

import io
import os
import signal
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

from train.command_line.entry_points import USER_ERROR
from train.networks import WideResNet
from train.run_folder.checkpoint import BEST, save
from train.run_folder.files import LOCK, sole_writer

CLASSES = ["fig", "lime", "orange"]


@pytest.fixture
def here(tmp_path) -> Path:
    """A folder with a network in 1.10 and photographs in 2024; what else is in it is in the way."""
    torch.manual_seed(0)
    architecture = {"classes": CLASSES, "depth": 10, "width": 1, "dropout": 0.0}
    network = WideResNet(len(CLASSES), 10, 1, 0.0)
    (tmp_path / "1.10").mkdir()
    save(tmp_path / "1.10" / BEST, {"model": network.state_dict(), "architecture": architecture})
    for name in ("2024/orange", "2024/other_\udcff"):
        (tmp_path / name).mkdir(parents=True)
        Image.new("RGB", (8, 8), "orange").save(tmp_path / name / "a.png")
    (tmp_path / "file").touch()
    return tmp_path


EVALUATE = ["evaluate_photos", "run=1.10", "photos=2024", "device=cpu", "precision=float32"]
EXPORT = ["export_light", "light=grace", "height=4"]


def test_folders_whose_names_look_like_numbers_or_have_no_utf_8_are_scored(call, here, capsys):
    assert call(*EVALUATE, "out=1e3") == 0
    assert "1 images of orange, 1 of other things" in capsys.readouterr().out
    assert {path.name for path in (here / "1e3").iterdir()} == {
        *("predictions.csv", "summary.json", "contact_sheet.png", "roc.csv", "roc.png", LOCK)
    }
    assert r"other_\udcff/a.png" in (here / "1e3" / "predictions.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", [EVALUATE, ["attack", "classifier=run:1.10"], ["lab"]], ids=lambda given: given[0])
def test_two_commands_do_not_write_in_one_folder(call, here, capsys, command):
    with sole_writer("out", here / "out"):
        assert call(*command, "out=out") == USER_ERROR
    assert capsys.readouterr().err.startswith("error: out=out is being written by another process: let it end, or ")
    assert not (here / "out").exists()


WRONG = [
    ([*EVALUATE, "size=abc"], "size: Value 'abc' of type 'str' could not be converted to Integer"),
    ([*EVALUATE, "size=0"], "size=0 must be at least 1 and at most 4096"),
    ([*EVALUATE, "size=1000000"], "size=1000000 must be at least 1 and at most 4096"),
    ([*EVALUATE, "skip_unreadable=maybe"], "skip_unreadable: Value 'maybe' is not a valid bool"),
    ([*EVALUATE, "photos=[a,b]"], "photos: "),
    ([*EVALUATE, "run={a:b}"], "run: "),
    (["compare_runs", "runs=[]"], "runs is empty"),
    (["compare_runs", "runs=runs/a"], "runs: give a list, as in [a,b]"),
    (["compare_runs", "runs=[a,b,./a]"], "runs names a twice, as if it were another seed: name each run once"),
    (["compare_runs", "runs=null"], "runs: "),
    (["compare_runs", "runs=[[a]]"], "runs[0]: give a plain value"),
    (["compare_runs", "runs=[a]", "exclude=[{a: b}]"], "exclude[0]: give a plain value"),
    (["compare_runs", "runs=[a]", "exclude=web"], "exclude: "),
    (["compare_runs", "runs=[2024]"], "2024 holds no finished run"),
    ([*EXPORT, "height=abc", "out=a.hdr"], "height: "),
    ([*EXPORT, "height=1000000000", "out=a.hdr"], "height=1000000000 must be at least 1 and at most 8192"),
    (["publish", "run=[a]", "out=out"], "run: "),
    (["fit_skylight", "zenith_degree=many", "out=a.safetensors"], "zenith_degree: "),
    (["fit_skylight", "out=photo.png"], "out=photo.png: name a .safetensors file"),
    (["attack", f"scene.width={10**400}"], "scene.width: int too large to convert to float"),
    (["attack", "target={a: 1}"], "target: give a class, least_likely, or a list of classes, one per view"),
    (["lab", "size=0", "out=a"], "size=0 must be at least 1"),
]


@pytest.mark.parametrize(("command", "message"), WRONG, ids=[" ".join([c[0], *c[-2:]]) for c, _ in WRONG])
def test_a_setting_of_another_type_or_beyond_its_range_is_one_line(call, here, capsys, command, message):
    before = sorted(here.rglob("*"))
    assert call(*command) == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith(f"error: {message}") and printed.err.count("\n") == 1
    assert sorted(here.rglob("*")) == before


@pytest.mark.parametrize(
    ("command", "out"),
    [(EXPORT, "/proc/none/out"), (EXPORT, "file/out"), (EXPORT, "x" * 300), (EVALUATE, "/dev/full/out"),
     (["publish", "run=1.10"], "file/out"), (["fit_skylight"], "file/out"),
     (["lab"], "file/out"),
     (["report", "a"], "x" * 300)],
)  # fmt: skip
def test_an_output_that_cannot_be_written_is_told_before_the_work(call, here, capsys, command, out, monkeypatch):
    def work(*arguments, **more):
        raise AssertionError("the work was begun")

    for name in ("train.photographs.scoring.evaluate_photographs", "train.run_folder.checkpoint.load",
                 "renderer.light.environment.to_map", "renderer.light.skylight.fit_polynomials"):  # fmt: skip
        monkeypatch.setattr(name, work)
    suffix = ".hdr" if command is EXPORT else ""
    assert call(*command, f"out={out}{suffix}") == USER_ERROR
    printed = capsys.readouterr()
    assert printed.err.startswith(f"error: out={out}{suffix} cannot be written") and printed.err.count("\n") == 1


def test_a_light_is_not_written_over_itself(call, here, capsys):
    assert call("export_light", "light=grace", "height=8", "out=a.npy") == 0
    (here / "b.npy").symlink_to("a.npy")
    whole = (here / "a.npy").read_bytes()
    assert call("export_light", "light=a.npy", "height=8", "out=b.npy") == USER_ERROR
    assert capsys.readouterr().err.startswith("error: out=b.npy is the light itself, which would be lost")
    assert (here / "a.npy").read_bytes() == whole


@pytest.mark.parametrize("out", ["/dev/full", "2024"])
def test_a_file_that_is_none_is_not_written_to(call, here, capsys, out):
    assert call("fit_skylight", f"out={out}") == USER_ERROR
    assert (
        capsys.readouterr().err == f"error: out={out} cannot be written (it is no regular file): choose another file\n"
    )


def test_a_folder_that_is_a_file_is_refused(call, here, capsys):
    assert call(*EVALUATE, "out=file") == USER_ERROR
    assert capsys.readouterr().err == "error: out=file cannot be written to (Not a directory): choose another folder\n"


# ---------------------------------------------------------------------------------------- terminals


def test_a_reader_that_has_gone_ends_a_command_in_silence(call, here, capsys, monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with monkeypatch.context() as patch, open(write, "w") as output:
        patch.setattr(sys, "stdout", output)
        assert call(*EXPORT, "out=a.hdr") == 128 + signal.SIGPIPE
        print("what Python may still hold at its end", flush=True)
    assert capsys.readouterr().err == "" and (here / "a.hdr").is_file()


def test_a_terminal_of_ascii_shows_other_letters_as_escapes(call, here, monkeypatch):
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")
    monkeypatch.setattr(sys, "stdout", terminal)
    assert call(*EXPORT, "out=a.hdr") == 0
    assert rb"8 \xd7 4 texels" in terminal.buffer.getvalue() and (here / "a.hdr").is_file()
