"""What an interrupted run left, beside what an undisturbed one did: bit for bit, apart from the seconds."""

import logging
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from renderer.errors import InputError
from train.report.write import IMAGES
from train.run_folder import checkpoint
from train.run_folder.logs import METRICS, read_metrics

SECONDS = "seconds/"
logging.getLogger("tensorboard").setLevel(logging.ERROR)  # it says of every resumed run that it was


def differences(run: Path, reference: Path) -> Iterator[str]:
    """In words, each by the file or tag that differs."""
    yield from checkpoint_differences(run, reference)
    yield from metric_differences(run, reference)
    yield from board_differences(run, reference)
    yield from file_differences(run, reference)


def checkpoint_differences(run: Path, reference: Path) -> Iterator[str]:
    """In every tensor and value of last.pt and best.pt; previous.pt must be whole, and nothing half-written left."""
    for name in (checkpoint.LAST, checkpoint.BEST, checkpoint.PREVIOUS):
        try:
            found = checkpoint.load(run / name)
        except InputError as error:
            yield str(error)
        else:
            expected = found if name == checkpoint.PREVIOUS else checkpoint.load(reference / name)  # PREVIOUS is older
            parts = found.keys() | expected.keys()
            yield from (f"{name}: {part}" for part in parts if _hash(found.get(part)) != _hash(expected.get(part)))
    yield from (f"{path.name} is left over" for path in run.glob("*.tmp"))


def _hash(value: Any) -> str:
    return checkpoint.content_hash(_timeless(value))


def _timeless(value: Any) -> Any:
    """Nested mappings and sequences without the seconds."""
    if isinstance(value, Mapping):
        return {key: _timeless(part) for key, part in value.items() if not str(key).startswith(SECONDS)}
    return [_timeless(part) for part in value] if isinstance(value, list | tuple) else value


def metric_differences(run: Path, reference: Path) -> Iterator[str]:
    """Lines of metrics.jsonl that are lost, doubled, cut short or otherwise than the reference's."""
    text, lines, expected = (run / METRICS).read_text(), read_metrics(run), read_metrics(reference)
    if text.count("\n") != len(text.splitlines()):
        yield f"{METRICS}: the last line is cut short"
    found, wanted = (Counter(line.get("epoch", "scores") for line in each) for each in (lines, expected))
    yield from (f"{METRICS}: epoch {epoch} is lost" for epoch in wanted - found)
    yield from (f"{METRICS}: epoch {epoch} is doubled" for epoch in found - wanted)
    if found == wanted and _timeless(lines) != _timeless(expected):
        yield f"{METRICS}: other values"


def board_differences(run: Path, reference: Path) -> Iterator[str]:
    """Scalars and images that TensorBoard shows at other steps or with other values; seconds that are doubled."""
    found, expected = board(run), board(reference)
    for tag in sorted(found.keys() | expected.keys()):
        shown, wanted = found.get(tag, []), expected.get(tag, [])
        steps = [step for step, _ in shown]
        if steps != sorted(set(steps)) if tag.startswith(SECONDS) else steps != [step for step, _ in wanted]:
            yield f"TensorBoard: {tag} at steps {steps}"
        elif shown != wanted and not tag.startswith(SECONDS):
            yield f"TensorBoard: {tag} has other values"


def board(run: Path) -> dict[str, list[tuple[int, float | bytes]]]:
    """(step, value) of every tag, as TensorBoard reads them from all event files of a run."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0, "images": 0}).Reload()
    scalars = {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    images = {
        tag: [(event.step, event.encoded_image_string) for event in events.Images(tag)]
        for tag in events.Tags()["images"]
    }
    return scalars | images


def file_differences(run: Path, reference: Path) -> Iterator[str]:
    """Images of renders, and files of the photographs' scores, that are missing, too many or of other bytes.

    The report's images are left out: they show the seconds.
    """
    found, expected = (
        {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.glob("*/*")
            if path.parent.name != IMAGES
        }
        for folder in (run, reference)
    )
    yield from sorted(name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name))
