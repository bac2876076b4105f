import pytest

from augment.utils import Phases


@pytest.fixture
def wait(monkeypatch):
    """A clock that only this moves."""
    now = [100.0]
    monkeypatch.setattr("augment.utils.time.perf_counter", lambda: now[0])

    def advance(seconds: float) -> None:
        now[0] += seconds

    return advance


def test_seconds_add_up_by_phase_and_nested_phases_count_in_both(wait):
    phases = Phases()
    for _ in range(2):
        with phases("attack"):
            wait(1)
            with phases("classifier"):
                wait(2)
    wait(50)
    with phases("training"):
        wait(4)
    assert phases.take() == {"attack": 6, "classifier": 4, "training": 4}


def test_taking_starts_again_from_zero(wait):
    phases = Phases()
    with phases("attack"):
        wait(1)
    phases.take()
    assert phases.take() == {}


def test_a_phase_that_fails_counts_too(wait):
    phases = Phases()
    with pytest.raises(RuntimeError), phases("attack"):
        wait(3)
        raise RuntimeError
    assert phases.take() == {"attack": 3}
