"""Fixtures of tests of several packages."""

import gc
import logging
import re
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from ipaddress import ip_address
from pathlib import Path

import pytest
import torch
from hypothesis import settings
from threadpoolctl import threadpool_limits

from tests import shapes

# Property tests draw the same examples everywhere. With `-m slow`, they draw 30 times as many, and
# others in each run.
settings.register_profile("same", derandomize=True, max_examples=40, deadline=None)
settings.register_profile("search", max_examples=1200, deadline=None)
# Modules and tests stay until the end. Looking for garbage among them takes a tenth of the time of
# their collection.
gc.disable()
# Other conftest.py, which are read after this one, already import the packages.
shapes.install()


def pytest_configure(config: pytest.Config) -> None:
    """Choose how property tests draw their examples."""
    settings.load_profile("search" if config.option.markexpr == "slow" else "same")


def pytest_collection_finish() -> None:
    """Look for garbage among what the tests make, and not among what was collected."""
    gc.freeze()
    gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files whose tests are all deselected, since they import large libraries."""
    if collection_path.suffix == ".py":
        text = collection_path.read_text()
        marks = re.search(r"^pytestmark = \[?\s*pytest\.mark\.(\w+)", text, re.M)
        if marks and f"not {marks[1]}" in config.option.markexpr:
            return True
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Select the property tests for `-m slow`, too."""
    if config.option.markexpr == "slow":
        for item in items:
            if getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
                item.add_marker("slow")


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Compute with one thread, here and in the processes that tests start.

    Images and networks are so small that threads would wait for each other. The last bits of a
    factorization by NumPy or SciPy also depend on the number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch, threadpool_limits(1, user_api="blas"):
        patch.setenv("OMP_NUM_THREADS", "1")
        yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True, scope="session")
def interrupts() -> None:
    """Let SIGINT reach the processes that tests start, also from a shell that ignores it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def cache_home(tmp_path_factory) -> Iterator[None]:
    """Keep caches apart from the user's, also in commands that tests start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("caches")))
        yield


@pytest.fixture(autouse=True, scope="session")
def small_maps() -> Iterator[None]:
    """Write small environment maps beside adversaries, since those of users take half a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("augment.attacks.adversary.MAP_HEIGHT", 64)
        yield


@pytest.fixture(autouse=True, scope="session")
def no_network() -> Iterator[None]:
    """Refuse connections of this process to other machines."""
    connect = socket.socket.connect

    def refuse(self, address):
        is_local = self.family == socket.AF_UNIX or address[0] == "localhost"
        assert is_local or ip_address(address[0]).is_loopback, f"a test connects to {address}"
        return connect(self, address)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", refuse)
        yield


@pytest.fixture(autouse=True)
def warnings_of_this_test() -> None:
    """Forget which warnings earlier tests have shown."""
    from renderer.io.mesh_file import warn_once

    warn_once.cache_clear()


@pytest.fixture
def call(monkeypatch, tmp_path) -> Iterator[Callable[..., int]]:
    """Return a function that runs a command here, in the test's folder; it returns the status."""
    handlers = logging.root.handlers[:]
    # Hydra composes the settings a first time to read its mode, which no file sets.
    monkeypatch.setattr("hydra._internal.hydra.Hydra.get_mode", lambda *_, **__: None)

    def command(name: str, *arguments: str) -> int:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        try:
            import_module("train.__main__" if name == "train" else f"scripts.{name}").main()
        except SystemExit as stop:
            return stop.code
        return 0

    yield command
    # Hydra's handlers write to a stream that pytest closes after the test.
    for handler in logging.root.handlers:
        if handler not in handlers:
            handler.close()
    logging.root.handlers[:] = handlers


@pytest.fixture
def rasterized(monkeypatch) -> list[int]:
    """Return a list that grows by the number of views with each rasterization."""
    from renderer.visibility import Rasterizer

    view_counts = []
    rasterize = Rasterizer.rasterize

    def counted(self, points, faces, resolution, closed=False):
        view_counts.append(len(points))
        return rasterize(self, points, faces, resolution, closed=closed)

    monkeypatch.setattr(Rasterizer, "rasterize", counted)
    return view_counts
