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

from augment import distributed

# submitit sends this signal before the time of a job is over. Windows does not have it.
BATCH_SYSTEM = getattr(signal, "SIGUSR2", None)
SIGNALS = tuple(filter(None, (signal.SIGTERM, signal.SIGINT, BATCH_SYSTEM)))


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that torchrun started while the block runs.

    A run by itself has none to join.
    """
    if int(os.environ.get("WORLD_SIZE", 1)) == 1:
        yield
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend)
    try:
        yield
    finally:
        dist.destroy_process_group()


@contextmanager
def main_process_first() -> Iterator[None]:
    """Let the first process run the block before the others.

    The other processes then find a download or a cached file that is complete.
    """
    if distributed.rank() > 0:
        dist.barrier()
    yield
    if distributed.rank() == 0 and distributed.world_size() > 1:
        dist.barrier()


def broadcast(value: str) -> str:
    """Return the value of the first process, for which the others wait.

    Args:
        value: The value of this process.

    Returns:
        The value of the first process.
    """
    values = [value]
    if distributed.world_size() > 1:
        dist.broadcast_object_list(values, src=0)
    return values[0]


def all_reduce_sum(values: Tensor) -> Tensor:
    """Add up values over all processes, in place.

    Args:
        values: The values of this process, of any shape.

    Returns:
        The same tensor.
    """
    if distributed.world_size() > 1:
        dist.all_reduce(values)
    return values


def wrap_ddp(model: nn.Module) -> nn.Module:
    """Wrap a model so that its gradients are averaged over all processes.

    Batch normalization takes its statistics over the whole batch on GPUs, and over each process's
    part of it on CPUs.

    Args:
        model: The model, whose layers of batch normalization may be replaced.

    Returns:
        The wrapped model, or the model itself if there is one process.
    """
    if distributed.world_size() == 1:
        return model
    if next(model.parameters()).is_cuda:
        nn.SyncBatchNorm.convert_sync_batchnorm(model)
    return DistributedDataParallel(model)


class Interrupted(SystemExit):
    """A signal ended a run early, after its checkpoint was written.

    The exit status is the one that a shell gives: 128 plus the number of the signal.

    Args:
        number: The number of the signal.
    """

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class SignalHandler:
    """Notes the first of `SIGNALS` while its block runs.

    A second signal acts as it would without the block. So does the first one if nobody asks for
    it before the block ends. Signals that the process ignored before stay ignored. Only the main
    thread gets signals.
    """

    def __init__(self) -> None:
        self._number: int | None = None
        # Sum of the signals of all processes at the last call of `requested`, which
        # may still be under way.
        self._asked: tuple[dist.Work, Tensor] | None = None
        # Handlers of the signals before the block.
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "SignalHandler":
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._handlers[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, error: type[BaseException] | None, *rest: object) -> None:
        self._restore()
        if error is None and self._number is not None:
            signal.raise_signal(self._number)

    def requested(self) -> bool:
        """Return whether to stop now because a process of the run got a signal.

        With several processes, a call starts a sum over the processes and
        returns the result of the sum that the call before has started. Processes
        therefore seldom wait for each other, and all stop after the same call.
        """
        has_signal = self._number is not None
        if distributed.world_size() == 1:
            return has_signal
        before = self._asked
        # The tensor is on the CPU, so that no GPU has to catch up.
        noted = torch.tensor(float(has_signal))
        self._asked = dist.all_reduce(noted, async_op=True), noted
        if before is None:
            return False
        work, noted_before = before
        return work.wait() and bool(noted_before)

    def stop(self) -> None:
        """Raise `Interrupted`.

        A batch system's own handler is called before. It may queue the job again and exit.
        """
        # The signal may have reached only another process.
        number = self._number or signal.SIGTERM
        if number == BATCH_SYSTEM and callable(signal.getsignal(number)):
            signal.raise_signal(number)
        raise Interrupted(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Note a signal, and let the next one act as it would without the block."""
        self._number = number
        self._restore()

    def _restore(self) -> None:
        """Put the handlers back that were there before the block."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}
