"""What a file can be instead of itself: no file, damaged, or forged."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from train.studies.reliability.edits import Edit, content, flipped, instead, replaced
from train.studies.reliability.forgeries import EITHER, REFUSED


@dataclass(frozen=True)
class Damage:
    """kind: under which it is counted. refused: whether no other outcome is right."""

    kind: str
    name: str
    edit: Edit
    refused: bool = True


NO_FILE = {
    "missing": Path.unlink,
    "a folder": instead(Path.mkdir),
    "a pipe": instead(os.mkfifo),
    "a link to itself": instead(lambda path: path.symlink_to(path.name)),
}
DAMAGED = {
    "empty": content(b""),
    "zeros": replaced(lambda whole: bytes(len(whole))),
    "noise": replaced(lambda whole: np.random.default_rng(0).bytes(len(whole))),
    "a web page": content("<html>404 – nicht gefunden</html>\n"),
}
PERHAPS_DAMAGED = {  # not every byte counts in every format
    "its first half": replaced(lambda whole: whole[: len(whole) // 2]),
    "without its last byte": replaced(lambda whole: whole[:-1]),
    **{f"bytes flipped, draw {seed}": flipped(seed) for seed in range(3)},
}
MAY_BE_MISSING = ("photos.csv", "summary.json", "photographs.csv", "metrics.jsonl", "last.pt", "0.png", "4.jpg")


def damages(file: str) -> Iterator[Damage]:
    """All of a file of the corpus."""
    for name, edit in NO_FILE.items():
        yield Damage("no file", name, edit, not file.endswith(MAY_BE_MISSING))
    for name, edit in (DAMAGED | PERHAPS_DAMAGED).items():
        yield Damage("damaged", name, edit, name in DAMAGED and not file.endswith("photographs.csv"))
    for refused, forgeries in ((True, REFUSED), (False, EITHER)):
        for ending in filter(file.endswith, forgeries):
            yield from (Damage("forged", name, edit, refused) for name, edit in forgeries[ending].items())
