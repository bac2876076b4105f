"""What a run found out, from the seconds that turns took; and the targets."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import median
from typing import Any

from train.fit.epoch import batch_count
from train.report.tables import shown
from train.run_folder.logs import PHASES
from train.studies.targets import Target
from train.studies.training_speed.arm import EPOCH
from train.studies.training_speed.peak import TRAINING

PLAIN, ADVERSARIAL, BASELINE, PRODUCTS = "augment=none", "augment=adversarial", "baseline", "matrix products"
REST = "everything else"
RUN = 150  # epochs, of the paper

Turn = Mapping[Any, float]  # what one took, by phase


@dataclass(frozen=True)
class Spread:
    """Median, least and most over rounds."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, values: Iterable[float]) -> "Spread":
        values = list(values)
        return cls(median(values), min(values), max(values))

    def __str__(self) -> str:
        return f"{shown(self.median)} [{shown(self.least)}, {shown(self.most)}]"


@dataclass(frozen=True)
class Workload:
    """Images of a whole epoch, and how many training steps a turn takes of it; None for all."""

    images: int
    validation: int
    renders: int
    batch_size: int
    steps: int | None

    def batches(self, name: str) -> int:
        """Of a whole epoch."""
        return batch_count(self.images + (self.renders if name == ADVERSARIAL else 0), self.batch_size)

    @property
    def trained(self) -> int:
        """Images that a turn of the plain arm or of the baseline trains on."""
        return self.images if self.steps is None else min(self.images, self.steps * self.batch_size)

    @property
    def beside_renders(self) -> int:
        """Images that the adversarial arm trains on beside its renders; if shortened, in the fewest steps."""
        batches = batch_count(self.renders + 1, self.batch_size)
        return self.images if self.steps is None else min(self.images, batches * self.batch_size - self.renders)

    @property
    def validated(self) -> int:
        """Images that a turn evaluates on: as few as it trains on, where it is shortened."""
        return self.validation if self.steps is None else min(self.validation, self.trained)


@dataclass(frozen=True)
class Findings:
    """What the turns of both arms, the baseline and the matrix products took; the first of each warmed up.

    device: its kind, cpu or cuda. precision: of the arms. multiply_adds: of one image's forward pass.
    """

    device: str
    precision: str
    multiply_adds: int
    workload: Workload
    turns: Mapping[str, Sequence[Turn]]

    def epochs(self, name: str) -> list[dict[str, float]]:
        """Seconds of a whole epoch by phase, in each round.

        Where turns are shortened, the adversarial arm trains and evaluates as fast as the plain one's median, since
        the noise of a few steps is larger than what the attack costs.
        """
        turns, work = self.turns[name][1:], self.workload
        if work.steps is None:
            return [_by_phase(turn) for turn in turns]
        scales = {
            "training": work.batches(name) / batch_count(work.trained, work.batch_size),
            "evaluation": work.validation / work.validated,
        }
        middle: Turn = {phase: median(turn[phase] for turn in self.turns[PLAIN][1:]) for phase in scales}
        measured = turns if name == PLAIN else [middle] * len(turns)
        return [
            _by_phase(turn) | {phase: scale * seconds[phase] for phase, scale in scales.items()}
            for turn, seconds in zip(turns, measured, strict=True)
        ]

    def totals(self, name: str) -> list[float]:
        """Seconds of a whole epoch, in each round."""
        return [sum(epoch.values()) for epoch in self.epochs(name)]

    def seconds(self, name: str) -> dict[str, Spread]:
        """Of a whole epoch by phase, over rounds."""
        epochs = self.epochs(name)
        return {phase: Spread.of(epoch[phase] for epoch in epochs) for phase in (*PHASES, REST)}

    def rate(self, name: str) -> Spread:
        """Images per second of the plain arm or the baseline, from stored images to updated weights."""
        return Spread.of(self.workload.trained / turn["training"] for turn in self.turns[name][1:])

    def operations(self, name: str) -> float:
        """Per second, two per multiply-add."""
        return TRAINING * 2 * self.multiply_adds * self.rate(name).median

    @cached_property
    def peaks(self) -> dict[str, tuple[float, int]]:
        """Of each precision, the most operations per second in matrix products, and at which size."""
        best: dict[str, tuple[float, int]] = {}
        for turn in self.turns[PRODUCTS]:
            for (precision, size), rate in turn.items():
                best[precision] = max(best.get(precision, (0.0, 0)), (rate, size))
        return best

    def share(self, name: str, precision: str) -> float:
        """Of the precision's peak."""
        return self.operations(name) / self.peaks[precision][0]

    @property
    def speedup(self) -> Spread:
        """Of the plain arm against the baseline, round by round."""
        rounds = zip(self.turns[PLAIN][1:], self.turns[BASELINE][1:], strict=True)
        return Spread.of(theirs["training"] / ours["training"] for ours, theirs in rounds)

    @property
    def longer(self) -> Spread:
        """By how much of the plain arm's median epoch the adversarial arm's are longer."""
        plain = median(self.totals(PLAIN))
        return Spread.of(adversarial / plain - 1 for adversarial in self.totals(ADVERSARIAL))

    @property
    def attack_steps(self) -> float:
        """That a render's attack took, on average."""
        return median(turn["steps"] for turn in self.turns[ADVERSARIAL][1:])

    def operators(self, name: str) -> float:
        """Seconds that building them took, once a run."""
        return self.turns[name][0].get("operators", 0.0)

    def warm_up(self, name: str) -> float:
        """Seconds by which the first turn was longer than the median of the others."""
        first, *others = (turn.get(EPOCH, turn["training"]) for turn in self.turns[name])
        return max(0.0, first - median(others))

    def whole_run(self, name: str) -> float:
        """Seconds of `RUN` epochs: operators and warm-up, and as many times the median epoch."""
        return self.operators(name) + self.warm_up(name) + RUN * median(self.totals(name))


def _by_phase(turn: Turn) -> dict[str, float]:
    """As measured, with what no phase counts."""
    phases = {phase: turn.get(phase, 0.0) for phase in PHASES}
    return phases | {REST: turn[EPOCH] - sum(phases.values())}


def targets(findings: Findings) -> list[Target]:
    """All of them; those of the other kind of device were not measured."""
    speed, share, longer = findings.speedup, findings.share(PLAIN, "bfloat16"), findings.longer
    run = findings.whole_run(ADVERSARIAL) / 60
    times = "images per second against the baseline's"
    rows = {
        "GPU": [
            Target(times, "at least 8×", f"{speed}×", speed.median >= 8),
            Target(f"{RUN} epochs, {ADVERSARIAL}", "at most 3 min on an H200", f"{shown(run)} min", run <= 3),
        ],
        "CPU": [
            Target(times, "at least 2.5×", f"{speed}×", speed.median >= 2.5),
            Target("share of the measured bf16 peak", "at least 50 %", f"{share:.0%}", share >= 0.5),
        ],
    }
    measured = "GPU" if findings.device == "cuda" else "CPU"
    asked = "at most 8 % longer"
    return [
        *(_on(kind, target, kind == measured) for kind, of_kind in rows.items() for target in of_kind),
        Target(f"{ADVERSARIAL} against {PLAIN}, an epoch", asked, _percents(longer), longer.median <= 0.08),
    ]


def _on(kind: str, target: Target, measured: bool) -> Target:
    found, passed = (target.found, target.passed) if measured else ("not measured here", None)
    return Target(f"{kind}: {target.what}", target.asked, found, passed)


def _percents(spread: Spread) -> str:
    return f"{spread.median:+.1%} [{spread.least:+.1%}, {spread.most:+.1%}]"
