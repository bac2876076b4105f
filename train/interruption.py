"""Ending a run between two steps when the system or the user asks for it: SIGTERM or SIGINT."""

import signal
import threading

from train.distributed import any_process

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Interrupted(SystemExit):
    """A run ended before its time, with its checkpoint written; exits as a shell says it of a signal: 128 + number."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class Interruption:
    """Notes the first SIGTERM or SIGINT while it is entered; a second one acts as it would without.

    So does one that nobody asked for any more when it is left without an error.

    Signals reach a process's main thread alone: in another one, none is noted.
    """

    def __init__(self):
        self._number: int | None = None
        self._before = {}

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, error: type | None, *rest) -> None:
        self._restore()
        if error is None and self._number is not None:
            signal.raise_signal(self._number)

    def requested(self) -> bool:
        """Whether to stop now; the same in all processes of a run."""
        return any_process(self._number is not None)

    def stop(self) -> None:
        """Raise `Interrupted`."""
        raise Interrupted(self._number or signal.SIGTERM)  # the signal may have reached another process alone

    def _note(self, number: int, frame) -> None:
        self._number = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
