"""Ask for a great deal of everything, to the end and ended by Ctrl-C, and write the page."""

import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from renderer.errors import require_range
from train.command_line.entry_points import USER_ERROR, command_line
from train.command_line.outputs import writable_file
from train.interruption import heed_interrupts
from train.report.tables import markdown
from train.studies.load import loads
from train.studies.load.observed import Observed, observe
from train.studies.page import filled, joined, machine, wrapped, write
from train.studies.reliability.study import prepare

HEADER = ["asked for", "ended", "s of a core", "memory, MB", "bar", "s from Ctrl-C to the end"]
SIGNALLED = 130  # as a shell says it of Ctrl-C


@dataclass
class LoadSettings:
    """conf/check_load.yaml."""

    out: str
    renders: int
    views: int
    faces: int
    jpegs: int
    runs: int
    patience: int

    def __post_init__(self) -> None:
        for name, count in self.counts.items():
            require_range(name, count, 2, 10**7)
        require_range("patience", self.patience, 1, 10**5)

    @property
    def counts(self) -> dict[str, int]:
        return {name: count for name, count in asdict(self).items() if name not in ("out", "patience")}


def run(settings: LoadSettings) -> list[str]:
    """Print the page and write it; what did not end as it should, in words. Ctrl-C ends it before its time."""
    heed_interrupts()
    out, described = writable_file(settings.out, "out"), machine(torch.device("cpu"))
    idle, rows, refusals, failures = 0, [], [], []
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder, suppress(KeyboardInterrupt):
        corpus = prepare(Path(folder))
        idle = observe(["-m", "train", "seed=-1"], corpus, settings.patience).memory
        for name, count in settings.counts.items():
            asked = f"{count:,} {name}"
            whole, ended = _both(name, count, corpus, settings.patience)
            if whole.status == USER_ERROR:
                refusals.append(f"- {asked}: `{whole.said}`")
            elif whole.status not in (0, SIGNALLED) or ended.status != SIGNALLED:
                failures.append(f"{asked} ended with {whole.status} ({whole.said}), by Ctrl-C with {ended.status}")
            rows.append(_row(asked, whole, ended))
    introduction = filled(
        __file__, command=command_line(), machine=described, patience=settings.patience, idle=idle / 1e6
    )
    write(out, joined([wrapped(introduction), markdown(HEADER, rows), "\n".join(refusals)]))
    return failures


def _both(name: str, count: int, corpus: Path, patience: float) -> tuple[Observed, Observed]:
    """To its end, if it comes, and ended by Ctrl-C, which may be the same, in a copy of the corpus."""
    folder = corpus.with_name(name)
    shutil.copytree(corpus, folder, copy_function=shutil.copy)
    command = getattr(loads, name)(folder, count)
    whole = ended = observe(command, folder, patience)
    if whole.status != SIGNALLED:
        shutil.rmtree(folder / "out", ignore_errors=True)
        shutil.rmtree(folder / "cache", ignore_errors=True)
        ended = observe(command, folder, whole.cpu / 2)
    shutil.rmtree(folder)
    return whole, ended


def _row(asked: str, whole: Observed, ended: Observed) -> list[str]:
    fate = {0: "as asked", USER_ERROR: "refused", SIGNALLED: "by Ctrl-C"}.get(whole.status, f"status {whole.status}")
    memory, bar = f"{whole.memory / 1e6:,.0f}", "yes" if whole.progress else "no"
    return [asked, fate, f"{whole.cpu:.0f}", memory, bar, f"{ended.after_signal:.1f}"]
