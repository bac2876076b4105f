"""One command in a process of its own: started as a user starts it, or forked where the libraries are imported."""

import atexit
import io
import os
import resource
import runpy
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from subprocess import TimeoutExpired

from train.studies.interruptions.small_run import ROOT

PATIENCE = 60  # seconds after which a command that should have ended has hung
MEMORY = 12 * 2**30  # bytes of address space: what asks for more fails here, and not the machine
PRELOADED = ["train.studies.reliability.study", "train.studies.reliability.warm"]


@dataclass(frozen=True)
class Ending:
    """status: as a shell says it; None where the command hung."""

    status: int | None
    errors: str


@dataclass(frozen=True)
class Surroundings:
    """largest: bytes that no file of the command may exceed. output: where what it prints goes; None: to be read."""

    largest: int | None = None
    output: str | None = None


USUAL = Surroundings()


Runner = Callable[[Sequence[str], Path, Surroundings, float], Ending]  # `started` or `forked`


def started(arguments: Sequence[str], folder: Path, around: Surroundings = USUAL, patience: float = PATIENCE) -> Ending:
    """`python` with these arguments, `-m train ...` or a script of scripts/ and its own, in a folder."""
    command = [str(ROOT / word) if word.startswith("scripts/") else word for word in arguments]
    errors, code = _errors(folder), None
    with open(around.output or os.devnull, "wb") as output, errors.open("wb") as said, suppress(TimeoutExpired):
        code = subprocess.run(
            [sys.executable, *command],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT), "HOME": str(folder)},
            stdout=output,
            stderr=said,
            timeout=patience,
            preexec_fn=partial(_limit, around),
        ).returncode
    return _ending(code, errors)


def forked(arguments: Sequence[str], folder: Path, around: Surroundings = USUAL, patience: float = PATIENCE) -> Ending:
    """The same, by a fork of a server that has imported the libraries once for all, which saves seconds."""
    context = get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    errors = _errors(folder)
    process = context.Process(target=_command, args=(list(arguments), folder, around, errors))
    process.start()
    try:
        process.join(patience)
        hung = process.is_alive()
    finally:  # also where Ctrl-C ends the wait
        process.kill()
        process.join()
    return _ending(None if hung else process.exitcode, errors)


def _errors(folder: Path) -> Path:
    """Where what a command says is kept: beside its folder, which it may have damaged."""
    return folder.with_name(f"{folder.name}.errors")


def _ending(code: int | None, errors: Path) -> Ending:
    said = errors.read_text(encoding="utf-8", errors="replace") if errors.exists() else ""
    return Ending(None if code is None else abs(code) + 128 * (code < 0), said)


def _limit(around: Surroundings) -> None:
    """What this process and those that it starts may take."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    if around.largest is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (around.largest, around.largest))


def _command(arguments: list[str], folder: Path, around: Surroundings, errors: Path) -> None:
    for name, number, target in (("stdout", 1, around.output or os.devnull), ("stderr", 2, errors)):
        os.dup2(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), number)
        setattr(
            sys, name, io.TextIOWrapper(io.FileIO(number, "wb", closefd=False), encoding="utf-8", write_through=True)
        )
    os.environ["HOME"] = str(folder)
    os.chdir(folder)
    _limit(around)
    sys.exit(_status(arguments))


def _status(arguments: list[str]) -> int:
    """Of the command, run as Python runs it."""
    sys.path.insert(0, str(ROOT))
    try:
        if arguments[0] == "-m":
            sys.argv = arguments[1:]
            runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
        else:
            sys.argv = [str(ROOT / arguments[0]), *arguments[1:]]
            runpy.run_path(sys.argv[0], run_name="__main__")
        code: object = 0
    except SystemExit as stop:
        code = stop.code
    except BaseException:
        traceback.print_exc()
        code = 1
    atexit._run_exitfuncs()  # which a forked process leaves out
    if isinstance(code, str):
        print(code, file=sys.stderr)
    return code if isinstance(code, int) else int(code is not None)
