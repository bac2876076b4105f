"""What tests of several packages use."""

import logging
import runpy
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from copy import deepcopy
from ipaddress import ip_address
from pathlib import Path

import pytest
import torch
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from threadpoolctl import threadpool_limits

from renderer.rasterizer import Rasterizer

ROOT = Path(__file__).parents[1]


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


@pytest.fixture(autouse=True, scope="session")
def composed_once() -> Iterator[None]:
    """Hydra parses each file of conf/ once, and merges the files of a command's choices once, and not again at every
    composition; it then sets the values of the overrides."""
    Plugins.instance()  # which defines the class of these sources anew
    source = SourcesRegistry.instance().resolve("pkg")
    load, merge, files, merged = source.load_config, ConfigLoaderImpl._compose_config_from_defaults_list, {}, {}

    def load_once(self, config_path):
        key = self.path, config_path
        if key not in files:
            files[key] = load(self, config_path)
        return deepcopy(files[key])

    def merge_once(self, defaults, repo):
        if {"train", "attack"}.isdisjoint(default.config_path for default in defaults):  # commands without a file
            return merge(self, defaults, repo)
        key = repr(defaults)
        if key not in merged:
            merged[key] = merge(self, defaults, repo)
        return deepcopy(merged[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(source, "load_config", load_once)
        patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", merge_once)
        yield


@pytest.fixture
def call(monkeypatch, tmp_path) -> Iterator[Callable[..., int]]:
    """`python -m train`, or a script, within this process, from another folder: the exit status."""
    handlers = logging.root.handlers[:]

    def command(name: str, *arguments: str) -> int:
        path = ROOT / ("train/__main__.py" if name == "train" else f"scripts/{name}.py")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(path), *arguments])
        try:
            runpy.run_path(str(path), run_name="__main__")
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
