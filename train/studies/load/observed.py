"""A command on a terminal of its own: how long it took, how much memory, whether it said how far it was."""

import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from train.studies.interruptions.small_run import ROOT

BAR = "%|"  # tqdm's
WAIT = 0.02  # seconds between two looks


@dataclass(frozen=True)
class Observed:
    """status: as a shell says it. seconds: by the clock; cpu: of a core; memory: bytes at the peak. after_signal,
    cpu_after: seconds from Ctrl-C to the end. said: the last line; progress: whether a bar was shown.
    """

    status: int
    seconds: float
    cpu: float
    memory: int
    after_signal: float
    cpu_after: float
    said: str
    progress: bool


def observe(command: Sequence[str], folder: Path, patience: float) -> Observed:
    """Of `python` with `-m train ...` or a script of scripts/, in a folder, by Ctrl-C after `patience` s of a core."""
    arguments = [str(ROOT / word) if word.startswith("scripts/") else word for word in command]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    terminal, end = pty.openpty()
    termios.tcsetwinsize(end, (24, 80))  # on one without a width tqdm draws no bar
    start = time.monotonic()
    process = subprocess.Popen([sys.executable, *arguments], cwd=folder, env=environment, stdout=end, stderr=end)
    os.close(end)
    signalled, cpu_before, memory, output = None, 0.0, 0, b""
    try:
        while True:
            output += _read(terminal)
            ended, code, used = os.wait4(process.pid, os.WNOHANG)
            now = time.monotonic()
            if ended:
                break
            memory = max(memory, _peak_memory(process.pid))
            if signalled is None and (cpu_before := _cpu(process.pid)) > patience:
                signalled = now
                process.send_signal(signal.SIGINT)
    except KeyboardInterrupt:  # of the study itself
        process.kill()
        process.wait()
        raise
    output += _read(terminal)
    os.close(terminal)
    process.returncode = status = os.waitstatus_to_exitcode(code)
    text = output.decode(errors="replace").replace("\r", "\n")
    cpu = used.ru_utime + used.ru_stime
    return Observed(
        status=status if status >= 0 else 128 - status,
        seconds=now - start,
        cpu=cpu,
        memory=memory,
        after_signal=now - (signalled or now),
        cpu_after=cpu - cpu_before if signalled else 0.0,
        said=next((line for line in reversed(text.splitlines()) if line.strip()), ""),
        progress=BAR in text,
    )


def _cpu(process: int) -> float:
    """Seconds of a core that a process has taken."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _peak_memory(process: int) -> int:
    """Bytes. What `wait4` tells begins with the peak of the process that started it."""
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
