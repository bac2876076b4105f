"""Scalars and images of a run: TensorBoard, one JSON line per epoch, and a line on the console."""

import io
import json
import logging
import os
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image
from torch import Tensor

from augment.service import AttackExamples
from renderer.image import to_bytes
from train.run_folder.attack_examples import SUFFIX, write_attack_examples
from train.run_folder.files import read_numbers

METRICS = "metrics.jsonl"
PHASES = ("attack", "training", "evaluation", "input_output")  # of an epoch; others are parts of these, or once a run
console = logging.getLogger("train")
logging.raiseExceptions = False  # where a disk is full, train.log lacks lines, and the run's own error is all one sees


class RunLog:
    """Writes a run folder's metrics.jsonl, TensorBoard events and grids of renders.

    history: the epochs' lines of the checkpoint that a run goes on from. They replace what the file holds: later lines
    come again, and one that a crash cut short does not count. TensorBoard is told to forget what is later, too.

    OSError where the disk does not take it.
    """

    def __init__(self, folder: Path, history: Sequence[Mapping[str, float]] = ()):
        from tensorboard.compat.proto.event_pb2 import SessionLog  # half a second, which readers of metrics are spared

        self._metrics = folder / METRICS
        self._renders = folder / "renders"
        self._board = folder / f"events.out.tfevents.{time.time():010.0f}.{socket.gethostname()}.{os.getpid()}"
        self._epochs = len(history)
        self._metrics.unlink(missing_ok=True)  # a pipe of that name would be waited for
        self._metrics.write_text("".join(json.dumps(line) + "\n" for line in history))
        self._show(0, file_version="brain.Event:2")
        self._show(self._epochs + 1, session_log=SessionLog(status=SessionLog.START))

    def scalars(self, values: Mapping[str, float], epoch: int | None = None) -> None:
        """Log plain numbers; `group/name` keys become TensorBoard's groups. epoch: None for the final scores.

        TensorBoard shows those one step after the last epoch, where a resumed run replaces them.
        """
        from tensorboard.compat.proto.summary_pb2 import Summary

        line = values if epoch is None else {"epoch": epoch, **values}
        with open(self._metrics, "a") as file:
            file.write(json.dumps(line) + "\n")
        self._epochs = self._epochs if epoch is None else epoch
        shown = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        self._show(epoch or self._epochs + 1, summary=Summary(value=shown))

    def renders(self, images: Tensor, epoch: int) -> None:
        """The epoch's renders (E, 3, H, W) in [0, 1] as a grid in TensorBoard and in renders/."""
        from tensorboard.compat.proto.summary_pb2 import Summary
        from torchvision.utils import make_grid

        grid = to_bytes(make_grid(images.cpu(), nrow=20, padding=1, pad_value=1.0))
        png = io.BytesIO()
        Image.fromarray(grid.permute(1, 2, 0).numpy()).save(png, "PNG", compress_level=1)
        self._renders.mkdir(exist_ok=True)
        (self._renders / f"epoch_{epoch:03d}.png").write_bytes(png.getvalue())
        channels, height, width = grid.shape
        image = Summary.Image(height=height, width=width, colorspace=channels, encoded_image_string=png.getvalue())
        self._show(epoch, summary=Summary(value=[Summary.Value(tag="renders", image=image)]))

    def attack_examples(self, attack_examples: AttackExamples, classes: Sequence[str], epoch: int) -> None:
        """A few of the epoch's renders that fool, with what they were before, in renders/."""
        self._renders.mkdir(exist_ok=True)
        write_attack_examples(self._renders / f"epoch_{epoch:03d}{SUFFIX}", attack_examples, classes)

    def _show(self, step: int, **content: object) -> None:
        """Write an event for TensorBoard, at once; torch's SummaryWriter has a thread, whose errors nobody catches."""
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter

        with open(self._board, "ab") as file:
            RecordWriter(file).write(Event(wall_time=time.time(), step=step, **content).SerializeToString())


class NoLog:
    """In place of a `RunLog`, for processes of a run that write nothing."""

    def _nothing(self, *_: object, **__: object) -> None:
        pass

    scalars = renders = attack_examples = _nothing


Log = RunLog | NoLog


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """The lines of a run's metrics.jsonl, one per epoch and a last one with the final scores; [] without a file.

    A line that a crash cut short is passed over. InputError where the file is damaged.
    """
    path = folder / METRICS
    return read_numbers(path) if path.is_file() else []
