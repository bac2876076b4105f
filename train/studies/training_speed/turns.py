"""Contestants that take turns, so that a busy machine disturbs all alike."""

from collections.abc import Callable, Hashable, Mapping

Turn = Mapping[Hashable, float]
Contestant = Callable[[], Turn]


def take_turns(makers: Mapping[str, Callable[[], Contestant]], rounds: int) -> dict[str, list[Turn]]:
    """What each contestant's turns returned: a first one, which warms up, and one per round; all take turns."""
    contestants = {name: make() for name, make in makers.items()}
    turns = {name: [] for name in makers}
    for past in range(rounds + 1):
        print(f"{', '.join(makers)}: {f'round {past} of {rounds}' if past else 'warming up'}", flush=True)
        for name, contestant in contestants.items():
            turns[name].append(contestant())
    return turns
