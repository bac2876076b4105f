"""Folders of functions that write files only if the caller asks for them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from renderer.validation import as_folder


@contextmanager
def folder_or_temporary(out: str | Path | None) -> Iterator[Path]:
    """Yield a folder for files: the folder of the caller, or a temporary folder.

    A temporary folder is removed at the end of the block.
    """
    if out is not None:
        yield as_folder("out", out)
        return
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield Path(folder)
