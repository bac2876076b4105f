"""The progress of long work is shown on a terminal, and not in a log."""

import io
import sys
import time

import pytest

from augment import progress as progress_module
from augment.progress import progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


@pytest.fixture
def patience(monkeypatch) -> float:
    """Show progress after a tenth of a second."""
    monkeypatch.setattr(progress_module, "PATIENCE", 0.1)
    return 0.1


@pytest.fixture
def shown(monkeypatch, patience):
    """Return a function that works on items, and returns whether each saw progress shown."""

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
def test_progress_is_shown_after_a_while_even_before_the_first_item_is_done(shown, items):
    assert shown(Terminal(), 0.3, items) == [True] * len(items)


def test_no_progress_is_shown_of_short_work(shown):
    assert shown(Terminal(), 0.0, [1, 2]) == [False, False]


@pytest.mark.parametrize("items", [[1], [1, 2]], ids=["ends early", "ends"])
def test_nothing_is_left_on_a_terminal(shown, items):
    stream = Terminal()
    shown(stream, 0.3, items)
    assert stream.getvalue().rpartition("\r")[2].strip() == ""


def test_a_log_has_no_progress(shown):
    stream = io.StringIO()
    shown(stream, 0.3, [1, 2])
    assert stream.getvalue() == ""
