"""All that is done to runs."""

import signal
from collections.abc import Callable
from functools import partial

from numpy.random import Generator

from train.studies.interruptions.bench import Bench, Outcome
from train.studies.interruptions.damages import DAMAGES, LIMITS, both_damaged, damaged, limited
from train.studies.interruptions.disturbances import ask, ask_then_kill, disk_filled, interrupted, kill

Case = Callable[[Bench, Generator], Outcome]


def all_cases(kills: int, signals: int, draws: int, jobs: int) -> list[Case]:
    """kills: in as many parts as there are jobs. signals: of each kind. draws: of each damage and each full disk."""
    shares = [kills // jobs + (job < kills % jobs) for job in range(jobs)]
    return [
        *(partial(interrupted, "SIGKILL", kill, share) for share in shares),
        partial(interrupted, "SIGKILL after the last epoch", kill, signals, since=("scoring",)),
        *(partial(interrupted, n.name, partial(ask, n), signals) for n in (signal.SIGTERM, signal.SIGINT)),
        partial(interrupted, "SIGTERM, then SIGKILL", ask_then_kill, signals),
        partial(disk_filled, "disk filled", signals),
        *(partial(limited, case, limit, draws) for case, limit in LIMITS.items()),
        *(partial(damaged, case, damage, draws) for case, damage in DAMAGES.items()),
        partial(both_damaged, "both checkpoints damaged"),
    ]
