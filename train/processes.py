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

# Signal that submitit (a launcher of Slurm jobs) sends before the time of a job is over. None on
# Windows, which lacks this signal.
BATCH_SYSTEM = getattr(signal, "SIGUSR2", None)
# Signals at which a training run writes a checkpoint and stops.
SIGNALS = tuple(filter(None, (signal.SIGTERM, signal.SIGINT, BATCH_SYSTEM)))


@contextmanager
def process_group() -> Iterator[None]:
    """Connect the processes that torchrun started for one run, until the block ends.

    If torchrun did not start this process, nothing happens.
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
    """Run the block in the first process, and then in the other processes of a run.

    If the block downloads or caches a file, the other processes find the complete file.
    """
    if distributed.rank() > 0:
        dist.barrier()
    yield
    if distributed.rank() == 0 and distributed.world_size() > 1:
        dist.barrier()


def broadcast(value: str) -> str:
    """Send a text from the first process of a run to all other processes."""
    values = [value]
    if distributed.world_size() > 1:
        dist.broadcast_object_list(values, src=0)
    return values[0]


def all_reduce_sum(values: Tensor) -> Tensor:
    """Replace a tensor by its sum over all processes of a run, in place."""
    if distributed.world_size() > 1:
        dist.all_reduce(values)
    return values


def wrap_ddp(model: nn.Module) -> nn.Module:
    """Wrap a model so that its gradients are averaged over all processes of a run.

    On GPUs, layers of batch normalization are replaced in `model` by layers that compute their
    statistics over the batch of all processes. On CPUs, each process has its own statistics. A
    single process returns the model itself.
    """
    if distributed.world_size() == 1:
        return model
    if next(model.parameters()).is_cuda:
        nn.SyncBatchNorm.convert_sync_batchnorm(model)
    return DistributedDataParallel(model)


class Interrupted(SystemExit):
    """Exit of the program after a signal, when the run has written its checkpoint.

    The exit status is 128 plus the number of the signal, as in a shell.

    Args:
        number: Number of the signal.
    """

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class SignalHandler:
    """Context manager that lets a process write a checkpoint when a signal should end it.

    The first signal in the block is only noted. The block asks for it with `requested`, writes a
    checkpoint, and ends the process with `stop`. If it does not, the noted signal takes effect at
    the end of the block. A second signal ends the process at once. Signals that the process
    ignores stay ignored. Only the main thread can receive signals.
    """

    def __init__(self) -> None:
        """Create the context manager. It handles signals when its block begins."""
        # Number of the first signal. None if there was no signal yet.
        self._number: int | None = None
        # The last call of `requested` began to count the processes with a signal. These are the
        # operation, which may still run, and the tensor that receives the count.
        self._last_sum: tuple[dist.Work, Tensor] | None = None
        # Handlers that the signals had before the block.
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "SignalHandler":
        """Replace the handlers of all signals in SIGNALS, except of those that are ignored."""
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._handlers[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, error: type[BaseException] | None, *rest: object) -> None:
        """Restore the handlers, and let a noted signal take effect unless an error is raised."""
        self._restore()
        if error is None and self._number is not None:
            signal.raise_signal(self._number)

    def requested(self) -> bool:
        """Return whether the run should stop, because one of its processes got a signal.

        With several processes, each call starts to count the processes with a
        signal, and returns whether the count that the previous call started is
        above 0. Processes then hardly wait for each other, and all of them stop
        after the same number of calls.
        """
        has_signal = self._number is not None
        if distributed.world_size() == 1:
            return has_signal
        previous_sum = self._last_sum
        # A tensor on the CPU does not wait for computations on a GPU.
        count = torch.tensor(float(has_signal))
        self._last_sum = dist.all_reduce(count, async_op=True), count
        if previous_sum is None:
            return False
        work, previous_count = previous_sum
        return work.wait() and bool(previous_count)

    def stop(self) -> None:
        """Raise `Interrupted`, which ends the process with the status of the signal.

        If a batch system sent the signal and has installed a handler for it, this handler is
        called first. It may put the job into the queue again and end the process.
        """
        # `_number` is None if other processes of the run got a signal, but not this process.
        # This process then ends as if it got SIGTERM.
        number = self._number or signal.SIGTERM
        if number == BATCH_SYSTEM and callable(signal.getsignal(number)):
            signal.raise_signal(number)
        raise Interrupted(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Handle the first signal: note its number, so that the next signal ends the process."""
        self._number = number
        self._restore()

    def _restore(self) -> None:
        """Restore the handlers that the signals had before the block."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}
