import signal

import pytest

from train.interruption import Interrupted, Interruption

NUMBERS = (signal.SIGTERM, signal.SIGINT)


def handlers() -> dict:
    return {number: signal.getsignal(number) for number in NUMBERS}


@pytest.fixture
def before() -> dict:
    """The handlers of each test's start: when this file is imported, a background job still ignores SIGINT."""
    return handlers()


@pytest.mark.parametrize("number", NUMBERS)
def test_a_signal_is_noted_and_ends_the_run_where_it_is_asked_for(before, number):
    with pytest.raises(Interrupted) as stopped, Interruption() as interruption:
        assert not interruption.requested()
        signal.raise_signal(number)
        assert interruption.requested()
        interruption.stop()
    assert stopped.value.code == 128 + number and handlers() == before


def test_a_signal_that_comes_after_the_last_question_is_not_swallowed(before):
    with pytest.raises(KeyboardInterrupt), Interruption():
        signal.raise_signal(signal.SIGINT)
    assert handlers() == before


def test_an_error_is_not_hidden_by_a_signal_that_came_before_it():
    with pytest.raises(ZeroDivisionError), Interruption():
        signal.raise_signal(signal.SIGINT)
        raise ZeroDivisionError
