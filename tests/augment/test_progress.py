import io
import sys
import time

import pytest

from augment import progress as progress_module
from augment.progress import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def shown(monkeypatch):
    """Return a function that works on items, and returns whether each saw progress shown."""
    monkeypatch.setattr(progress_module, "PATIENCE", 0.03)

    def work(stream: io.StringIO, seconds: float, items: list[int]) -> list[bool]:
        monkeypatch.setattr(sys, "stderr", stream)
        is_shown = []
        for item in progress([1, 2], "attack"):
            time.sleep(seconds)
            is_shown.append("attack" in stream.getvalue())
            if item == items[-1]:
                break
        return is_shown

    return work


@pytest.mark.parametrize("items", [[1], [1, 2]], ids=["ends early", "ends"])
def test_progress_is_shown_before_the_first_item_is_done_and_nothing_of_it_is_left(shown, items):
    stream = Terminal()
    assert shown(stream, 0.2, items) == [True] * len(items)
    assert stream.getvalue().rpartition("\r")[2].strip() == ""


def test_a_log_has_no_progress(shown):
    stream = io.StringIO()
    shown(stream, 0.1, [1, 2])
    assert stream.getvalue() == ""
