"""Folders that may not be written, for a process that may not override that even if the tests run as root."""

import ctypes
import os
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest

from .conftest import ROOT, TRAINING, end, start_command

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1  # of Linux's prctl
LIGHT, LAB = (str(ROOT / "scripts" / name) for name in ("light.py", "lab.py"))
TRAIN = ("-m", "train", "train.epochs=1", *TRAINING)

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="root may write everywhere")]


@pytest.fixture
def folder(data, tmp_path) -> Path:
    """What training reads, and beside it a folder that nobody may write to."""
    (tmp_path / "locked").mkdir(mode=0o555)
    return shutil.copytree(data, tmp_path / "data")


def call(*command: str, folder: Path) -> tuple[int, str]:
    """Status and errors."""
    drop = partial(ctypes.CDLL(None).prctl, PR_CAPBSET_DROP, CAP_DAC_OVERRIDE) if os.geteuid() == 0 else lambda: None
    status, _, errors = end(start_command(*command, folder=folder, limit=drop, MPLCONFIGDIR=str(folder)))
    return status, errors


@pytest.mark.parametrize(
    "command, reported",
    [
        ((*TRAIN, "run=../locked/run"), "run=../locked/run cannot be written to (Permission denied)"),
        ((LIGHT, "light=grace", "out=../locked/a.hdr"), "out: environment map ../locked/a.hdr cannot be written"),
        ((LAB, "out=../locked"), "out=../locked cannot be written to (Permission denied)"),
    ],
    ids=["run", "file", "folder"],
)
def test_an_output_that_is_read_only_is_refused_by_its_key(folder, command, reported):
    status, errors = call(*command, folder=folder)
    assert status == 2 and errors.startswith(f"error: {reported}") and errors.count("\n") == 1
