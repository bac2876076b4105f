"""The processes that torchrun starts for one run, and the signals that end it."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from augment import utils

BATCH_SYSTEM = getattr(signal, "SIGUSR2", None)  # submitit's, before a job's time is over; Windows has none
SIGNALS = tuple(filter(None, (signal.SIGTERM, signal.SIGINT, BATCH_SYSTEM)))


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that torchrun started; a run by itself has none to join."""
    if int(os.environ.get("WORLD_SIZE", 1)) == 1:
        yield
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


@contextmanager
def first_process_first() -> Iterator[None]:
    """Let the first process do alone what the others then find done, such as a download."""
    if utils.rank() > 0:
        dist.barrier()
    yield
    if utils.rank() == 0 and utils.world_size() > 1:
        dist.barrier()


def broadcast(value: str) -> str:
    """The first process's value, which the others wait for."""
    values = [value]
    if utils.world_size() > 1:
        dist.broadcast_object_list(values, src=0)
    return values[0]


def summed(values: Tensor) -> Tensor:
    """The sum over all processes, in place."""
    if utils.world_size() > 1:
        dist.all_reduce(values)
    return values


def replicated(model: nn.Module) -> nn.Module:
    """The model whose gradients are averaged over all processes; itself where there is but one.

    Batch normalization takes its statistics over the whole batch on GPUs, over each process's part on CPUs.
    """
    if utils.world_size() == 1:
        return model
    if next(model.parameters()).is_cuda:
        nn.SyncBatchNorm.convert_sync_batchnorm(model)  # replaces the norms inside
    return DistributedDataParallel(model)


class Interrupted(SystemExit):
    """A run ended early by a signal, with its checkpoint written; its exit status is the shell's: 128 + number."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class Interruption:
    """Notes the first of `SIGNALS` while it is entered, in the main thread, which alone gets them; a second one acts as
    it would without, as does the first where nobody asks for it. Those that the process was to ignore stay ignored."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._asked: tuple[dist.Work, Tensor] | None = None  # what all processes noted by the last question
        self._handlers: dict[int, Any] = {}  # before it was entered

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            heeded = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
            self._handlers = {number: signal.signal(number, self._note) for number in heeded}
        return self

    def __exit__(self, error: type[BaseException] | None, *rest: object) -> None:
        self._restore()
        if error is None and self._number is not None:
            signal.raise_signal(self._number)

    def requested(self) -> bool:
        """Whether to stop now, since any process of the run got a signal before it was asked: or, of several processes,
        which tell each other meanwhile and do not wait, before it was asked the last time."""
        if utils.world_size() == 1:
            return self._number is not None
        asked, noted = self._asked, torch.tensor(float(self._number is not None))  # on the CPU: no device catches up
        self._asked = dist.all_reduce(noted, async_op=True), noted
        return asked is not None and asked[0].wait() and bool(asked[1])

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
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}
