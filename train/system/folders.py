"""Folders of functions that write files only if the caller asks for them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from renderer.validation import as_folder


@contextmanager
def folder_or_temporary(out: str | Path | None) -> Iterator[Path]:
    """Give the folder that a caller named, or a temporary one until the block ends.

    Args:
        out: The folder, which need not exist. None for a temporary one.

    Yields:
        The folder.

    Raises:
        InputError: If `out` is no path, or a file.
    """
    if out is not None:
        yield as_folder("out", out)
        return
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield Path(folder)
