"""Ending a run between two steps when the system or the user asks for it by a signal."""

import signal
import threading
from types import FrameType
from typing import Any

from train.distributed import any_process

BATCH_SYSTEM = getattr(signal, "SIGUSR2", None)  # submitit's, before a job's time is over; Windows has none
SIGNALS = tuple(filter(None, (signal.SIGTERM, signal.SIGINT, BATCH_SYSTEM)))


class Interrupted(SystemExit):
    """A run ended before its time, with its checkpoint written; exits as a shell says it of a signal: 128 + number."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class Interruption:
    """Notes the first of `SIGNALS` while it is entered; a second one acts as it would without.

    So does the first where nobody asks for it until it is left. Signals that the process was started to ignore stay
    ignored, and they reach its main thread alone: in another one, none is noted.
    """

    def __init__(self) -> None:
        self._number: int | None = None
        self._before: dict[int, Any] = {}  # their handlers

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            heeded = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._note) for number in heeded}
        return self

    def __exit__(self, error: type[BaseException] | None, *rest: object) -> None:
        self._restore()
        if error is None and self._number is not None:
            signal.raise_signal(self._number)

    def requested(self) -> bool:
        """Whether to stop now; the same in all processes of a run."""
        return any_process(self._number is not None)

    def stop(self) -> None:
        """Raise `Interrupted`, after a batch system's own handler, which may queue the job again and exit."""
        number = self._number or signal.SIGTERM  # the signal may have reached another process alone
        if number == BATCH_SYSTEM and callable(signal.getsignal(number)):
            signal.raise_signal(number)
        raise Interrupted(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._number = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}


def heed_interrupts() -> None:
    """Let Ctrl-C end this process and those that it starts: a shell has what runs in the background ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
