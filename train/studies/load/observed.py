"""A command on a terminal of its own: how long it took, how much memory, whether it said how far it was."""

import os
import pty
import re
import resource
import select
import signal
import termios
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from train.studies.commands import exit_status, start

BAR = "%|"  # tqdm's
WAIT = 0.02  # seconds between two looks


@dataclass(frozen=True)
class Observed:
    """status: as a shell says it. cpu: seconds of a core; memory: bytes at the peak. after_signal: seconds by the clock
    from Ctrl-C to the end. said: the last line; progress: whether a bar was shown.
    """

    status: int
    cpu: float
    memory: int
    after_signal: float
    said: str
    progress: bool


def observe(command: Sequence[str], folder: Path, patience: float) -> Observed:
    """A command (see `start`) to its end, which Ctrl-C brings after `patience` seconds of a core."""
    terminal, end = pty.openpty()
    termios.tcsetwinsize(end, (24, 80))  # on one without a width tqdm draws no bar
    before, signalled, memory, output = _cpu_of_children(), None, 0, b""
    process = start(command, folder, stdout=end, stderr=end)
    os.close(end)
    try:
        while process.poll() is None:
            output += _read(terminal)
            memory = max(memory, _peak_memory(process.pid))
            if signalled is None and _cpu(process.pid) > patience:
                signalled = time.monotonic()
                process.send_signal(signal.SIGINT)
        now = time.monotonic()
    finally:  # also where Ctrl-C ends the study
        process.kill()
        process.wait()
    output += _read(terminal)
    os.close(terminal)
    text = output.decode(errors="replace").replace("\r", "\n")
    return Observed(
        status=exit_status(process.returncode),
        cpu=_cpu_of_children() - before,
        memory=memory,
        after_signal=now - (signalled or now),
        said=next((line for line in reversed(text.splitlines()) if line.strip()), ""),
        progress=BAR in text,
    )


def _cpu_of_children() -> float:
    """Seconds of a core that all those have taken that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _cpu(process: int) -> float:
    """Seconds of a core that a process has taken that may have ended, but that nobody has waited for."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _peak_memory(process: int) -> int:
    """Bytes. What `getrusage` tells begins with the peak of the process that started it."""
    status = Path(f"/proc/{process}/status").read_text()
    return 1024 * int(found[1]) if (found := re.search(r"VmHWM:\s+(\d+) kB", status)) else 0  # none once it has ended


def _read(terminal: int) -> bytes:
    """What has been printed since the last time, after a short wait for it."""
    if not select.select([terminal], [], [], WAIT)[0]:
        return b""
    try:
        return os.read(terminal, 2**20)
    except OSError:  # nobody writes any more
        time.sleep(WAIT)
        return b""
