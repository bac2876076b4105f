"""What tests of several packages look at."""

import socket
from collections.abc import Iterator
from ipaddress import ip_address

import pytest

from renderer.visibility import Backend


@pytest.fixture
def rasterised(monkeypatch) -> list[int]:
    """The number of views of every call to a back end, in order."""
    calls = []
    rasterise = Backend.rasterise

    def counted(self, points, faces, resolution, closed=False):
        calls.append(len(points))
        return rasterise(self, points, faces, resolution, closed=closed)

    monkeypatch.setattr(Backend, "rasterise", counted)
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
