"""One command in a process of its own: started as a user starts it, or forked where the libraries are imported."""

import atexit
import os
import resource
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from train.studies.commands import ROOT, Ending, exit_status, finish, start

PATIENCE = 60  # seconds after which a command that should have ended has hung
MEMORY = 12 * 2**30  # bytes of address space: what asks for more fails here, and not the machine
PRELOADED = ["train.studies.reliability.study", "train.studies.reliability.warm"]


@dataclass(frozen=True)
class Surroundings:
    """largest: bytes that no file of the command may exceed. output: where what it prints goes; None: nowhere."""

    largest: int | None = None
    output: str | None = None


USUAL = Surroundings()
Runner = Callable[[Sequence[str], Path, Surroundings, float], Ending]  # `started` or `forked`


def started(arguments: Sequence[str], folder: Path, around: Surroundings = USUAL, patience: float = PATIENCE) -> Ending:
    """A command as a user starts it; see `start`."""
    with open(around.output or os.devnull, "wb") as output:
        process = start(
            arguments,
            folder,
            {"HOME": str(folder)},
            stdout=output,
            stderr=subprocess.PIPE,
            preexec_fn=partial(_limit, around),
        )
        return finish(process, patience)


def forked(arguments: Sequence[str], folder: Path, around: Surroundings = USUAL, patience: float = PATIENCE) -> Ending:
    """The same, by a fork of a server that has imported the libraries once for all, which saves seconds."""
    context = get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    errors = folder.with_name(f"{folder.name}.errors")  # beside the folder, which the command may damage
    process = context.Process(target=_command, args=(list(arguments), folder, around, errors))
    process.start()
    try:
        process.join(patience)
        code = process.exitcode
    finally:  # also where Ctrl-C ends the wait
        process.kill()
        process.join()
    said = errors.read_text(encoding="utf-8", errors="replace") if errors.exists() else ""
    return Ending(None if code is None else exit_status(code), said)


def _limit(around: Surroundings) -> None:
    """What this process and those that it starts may take."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    if around.largest is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (around.largest, around.largest))


def _command(arguments: list[str], folder: Path, around: Surroundings, errors: Path) -> None:
    """In the fork, run as Python runs it."""
    for number, target in ((1, around.output or os.devnull), (2, errors)):
        os.dup2(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), number)
    os.environ["HOME"] = str(folder)
    os.chdir(folder)
    sys.path.insert(0, str(ROOT))
    _limit(around)
    try:
        if arguments[0] == "-m":
            sys.argv = arguments[1:]
            runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
        else:
            sys.argv = [str(ROOT / arguments[0]), *arguments[1:]]
            runpy.run_path(sys.argv[0], run_name="__main__")
    finally:
        atexit._run_exitfuncs()  # which a forked process leaves out
