"""Progress of long work on a terminal and in a log."""

import io
import re
import sys
import time

import pytest

from augment import progress as progress_module
from augment.progress import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
@pytest.mark.parametrize("seconds, ends", [(0.3, True), (0.3, False), (0.0, True)])
def test_progress_is_shown_after_a_while_even_before_the_first_item_is_done(
    monkeypatch, stream, seconds, ends
):
    """And leaves nothing on a terminal, also where the loop ends early."""
    monkeypatch.setattr(progress_module, "PATIENCE", 0.1)
    monkeypatch.setattr(sys, "stderr", stream())
    done = []
    for item in progress([1, 2], "attack"):
        time.sleep(seconds)
        done.append((item, "attack" in sys.stderr.getvalue()))
        if not ends:
            break
    assert done == [(item, seconds > 0) for item in ([1, 2] if ends else [1])]
    if stream is io.StringIO:
        lines = sys.stderr.getvalue().splitlines()
        assert (
            lines[:1] == (["attack ..."] if seconds else []) and len(lines) < 5
        )  # at 0.1, 0.3, 0.7 seconds ...
    else:
        assert sys.stderr.getvalue().rpartition("\r")[2].strip() == ""


def test_lines_of_progress_say_how_much_time_is_left(monkeypatch):
    monkeypatch.setattr(progress_module, "PATIENCE", 0.4)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    for _ in progress([1, 2, 3], "attack", 1000, 10):
        time.sleep(0.3)
    (minutes, seconds), *_ = re.findall(r"11 of 1000\D* (\d+):(\d+) left", sys.stderr.getvalue())
    assert 0.3 * 989 <= 60 * int(minutes) + int(seconds) < 0.6 * 989
