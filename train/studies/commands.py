"""Commands of this project in processes of their own, as a user starts them, and how they end."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import train
from train.command_line.entry_points import USER_ERROR

ROOT = Path(train.__file__).parents[1]  # of the installation that runs


@dataclass(frozen=True)
class Ending:
    """status: as a shell says it; None where the command hung."""

    status: int | None
    errors: str
    output: str = ""

    @property
    def refusal(self) -> str | None:
        """The one sentence of a command that refused what it was given; None where it ended in another way."""
        lines = self.errors.splitlines()
        is_one = self.status == USER_ERROR and len(lines) == 1 and lines[0].startswith("error: ")
        return lines[0] if is_one else None


def start(
    arguments: Sequence[str], folder: Path, environment: dict[str, str] | None = None, **options: Any
) -> subprocess.Popen[str]:
    """`python` with `-m train ...` or a script of scripts/ and its own arguments, in a folder. options: of `Popen`."""
    usual = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    words = [str(ROOT / word) if word.startswith("scripts/") else word for word in arguments]
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env=os.environ | usual | (environment or {}),
        encoding="utf-8",
        errors="replace",
        **options,
    )


def finish(process: subprocess.Popen[str], patience: float) -> Ending:
    """Wait for the end, and kill what has hung for `patience` seconds."""
    try:
        output, errors = process.communicate(timeout=patience)
        return Ending(exit_status(process.returncode), errors or "", output or "")
    except subprocess.TimeoutExpired:
        return Ending(None, f"hung for {patience} s")
    finally:  # also where Ctrl-C ends the wait
        process.kill()
        process.wait()


def exit_status(code: int) -> int:
    """What a shell says of a process's end; the code is negative where a signal ended it."""
    return code if code >= 0 else 128 - code
