"""Folders that may not be written: as a process that may not override that, also where the tests are root's."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from train.studies.commands import Ending, finish, start
from train.studies.reliability.corpus import write_corpus
from train.studies.reliability.doors import BY_NAME

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1  # of Linux's prctl
TRAIN, EXPORT = BY_NAME["train data=npz"], BY_NAME["export_light.py"]
FRESH = "train.init_from=null"

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="root may write everywhere")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The corpus, and beside it a folder that nobody may write to."""
    folder = tmp_path_factory.mktemp("here") / "corpus"
    folder.mkdir()
    write_corpus(folder)
    locked = folder.with_name("locked")
    locked.mkdir(mode=0o555)
    return folder


def call(command: list[str], folder: Path) -> Ending:
    process = start(
        command,
        folder,
        {"MPLCONFIGDIR": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE) if os.geteuid() == 0 else None,
    )
    return finish(process, patience=600)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (TRAIN.command(FRESH, "run=../locked/run"), "run=../locked/run cannot be written to (Permission denied): "),
        (EXPORT.command("out=../locked/a.hdr"), "out=../locked/a.hdr cannot be written (Permission denied): "),
        (BY_NAME["lab.py"].command("out=../locked"), "out=../locked cannot be written to (Permission denied): "),
    ],
    ids=["run", "file", "folder"],
)
def test_an_output_that_is_read_only_is_refused_by_its_key(folder, command, said):
    done = call(command, folder)
    assert done.refusal and done.refusal.startswith(f"error: {said}")


def test_a_current_folder_that_is_read_only_is_refused_by_the_key_of_what_would_be_written(folder):
    done = call(["-m", "train"], folder.with_name("locked"))
    assert done.refusal and done.refusal.startswith("error: run=runs/")


def test_a_cache_that_is_read_only_stops_no_run(folder):
    done = call(TRAIN.command(FRESH, "renderer.cache=../locked/cache"), folder)
    assert done.status == 0, done.errors
    assert "not kept: [Errno 13] Permission denied: '../locked/cache'" in (folder / "out" / "train.log").read_text()
    assert not list(folder.with_name("locked").iterdir())
