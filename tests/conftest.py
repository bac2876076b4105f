"""What tests of several packages use."""

import logging
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from ipaddress import ip_address

import pytest
import torch
from threadpoolctl import threadpool_limits

from renderer.visibility.rasterizers import Rasterizer


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Computes with one thread, here and in the processes that tests start.

    Images and networks are so small that threads would wait for each other. The last bits of a factorization by NumPy
    or SciPy also depend on the number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch, threadpool_limits(1, user_api="blas"):
        patch.setenv("OMP_NUM_THREADS", "1")
        yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True, scope="session")
def interrupts() -> None:
    """SIGINT reaches the processes that tests start, even if the tests run in the background of a shell."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def cache_home(tmp_path_factory) -> Iterator[None]:
    """Not the user's; commands that tests start inherit it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("caches")))
        yield


@pytest.fixture
def call(monkeypatch, tmp_path) -> Iterator[Callable[..., int]]:
    """`python -m train`, or another command, within this process, from another folder: the exit status."""
    handlers = logging.root.handlers[:]

    def command(name: str, *arguments: str) -> int:
        module = "train.__main__" if name == "train" else f"scripts.{name}"
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        try:
            import_module(module).main()
        except SystemExit as stop:
            return stop.code
        return 0

    yield command
    for handler in logging.root.handlers:  # Hydra's write to what was the output here
        if handler not in handlers:
            handler.close()
    logging.root.handlers[:] = handlers


@pytest.fixture
def rasterized(monkeypatch) -> list[int]:
    """The number of views of every call to a back end, in order."""
    calls = []
    rasterize = Rasterizer.rasterize

    def counted(self, points, faces, resolution, closed=False):
        calls.append(len(points))
        return rasterize(self, points, faces, resolution, closed=closed)

    monkeypatch.setattr(Rasterizer, "rasterize", counted)
    return calls


@pytest.fixture(autouse=True, scope="session")
def no_network() -> Iterator[None]:
    """Nothing that a test does within this process reaches beyond the machine."""
    connect = socket.socket.connect

    def refuse(self, address):
        local = self.family == socket.AF_UNIX or address[0] == "localhost" or ip_address(address[0]).is_loopback
        assert local, f"{address} was asked for without the user's word"
        return connect(self, address)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", refuse)
        yield
