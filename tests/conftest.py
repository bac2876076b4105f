"""What tests of several packages look at."""

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
