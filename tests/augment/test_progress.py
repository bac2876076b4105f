import io
import sys
import time

import pytest

from augment import progress as progress_module
from augment.progress import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [Terminal(), io.StringIO()], ids=["terminal", "log"])
def test_progress_is_shown_on_a_terminal_before_the_first_item_then_removed(monkeypatch, stream):
    monkeypatch.setattr(progress_module, "PATIENCE", 0.03)
    monkeypatch.setattr(sys, "stderr", stream)
    for _ in progress([1, 2], "attack"):
        time.sleep(0.1)
        assert ("attack" in stream.getvalue()) == stream.isatty()
        break
    assert stream.getvalue().rpartition("\r")[2].strip() == ""
