"""The process of a command: its start, signals, memory, verbosity, errors and command line.

This module imports neither torch nor NumPy, because --help would wait for them.
"""

import ctypes
import errno
import gc
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

import yaml

from renderer.errors import InputError, is_out_of_memory

INTERRUPTED = "ended by SIGINT"
# The loader of libyaml is ten times as fast, where it is installed.
YAML_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# The names of all installed commands begin with this text.
PREFIX = "pnb-"
# Options of the command line that ask for details.
VERBOSE_FLAGS = frozenset({"--verbose", "-v"})
# Environment variable that is set if commands print details.
VERBOSE = "PNB_VERBOSE"
# Largest number of lines about its result that a command prints without --verbose. Lines
# with the paths of written files may follow.
MAX_LINES = 12
# Number of a parameter of the function mallopt of the C library glibc: free memory above
# this number of bytes is returned to the system.
M_TRIM_THRESHOLD = -1
# Number of a parameter of mallopt: the memory of an array of at least this number of
# bytes is returned to the system as soon as the array is freed.
M_MMAP_THRESHOLD = -3
# Environment variables with which a user can set these parameters.
VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
# Largest array in bytes whose memory is reused. For larger arrays, the time to get new
# memory is small beside the time to fill it.
LARGEST_REUSED = 2**30
# Numbers of the system errors of a full disk, of an exceeded quota and of a file that
# is too large.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def take_flag(words: list[str]) -> list[str]:
    """Remove --verbose and -v from a command line, and make the process verbose if one is there."""
    if not VERBOSE_FLAGS.isdisjoint(words):
        os.environ[VERBOSE] = "1"
    return [word for word in words if word not in VERBOSE_FLAGS]


def is_verbose() -> bool:
    """Return whether commands of this process print details in addition to their result."""
    return VERBOSE in os.environ


def shortened(lines: Sequence[str], limit: int = MAX_LINES) -> list[str]:
    """Shorten a list of lines that a command prints, unless the command is verbose.

    The last line says how many were left out.
    """
    if is_verbose() or len(lines) <= limit:
        return list(lines)
    kept = limit - 1
    return [*lines[:kept], f"... {len(lines) - kept} more lines: -v shows them"]


def set_up_process() -> None:
    """Set environment variables, warnings, output streams and signals as all commands need them.

    This must happen before torch is imported.
    """
    # SIGTERM raises SystemExit, so that launchers end their child processes.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    # Hydra raises errors instead of printing them if this variable is set.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Threads of torch sleep while they wait if this variable is set. Otherwise they
    # slow down other processes.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    reuse_freed_memory()
    if Path(sys.argv[0]).stem.startswith(PREFIX):
        # Child processes would import a file train.py of the current folder instead
        # of this package if this variable were not set.
        os.environ["PYTHONSAFEPATH"] = "1"
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    warnings.simplefilter("once", UserWarning, append=True)
    # A stream is None if the shell has closed it (`>&-`).
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 (It stays open.)
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # Characters that the terminal cannot show are printed as escapes.
            stream.reconfigure(errors="backslashreplace")


def reuse_freed_memory() -> None:
    """Make the C library reuse the memory of large arrays instead of returning it to the system.

    By default, glibc returns the memory of an array above 32 MB when the array is
    freed. For the next array, Linux fills new memory with zeros, which takes
    longer than a depthwise convolution. Nothing changes if the user has set one
    of the environment variables VARIABLES, or if the C library is another one.
    """
    if sys.platform != "linux" or any(name in os.environ for name in VARIABLES):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_REUSED)
        mallopt(M_TRIM_THRESHOLD, LARGEST_REUSED)


def import_function(path: str) -> Callable[..., Any]:
    """Import a function by its path "module:function".

    Ctrl-C ends the process at once, since some modules catch KeyboardInterrupt while they are
    imported, and would continue.
    """
    is_torch_imported = "torch" in sys.modules
    # A job in the background of a shell ignores SIGINT, and must still do so.
    handler = signal.getsignal(signal.SIGINT)
    if handler is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_at_once)
    try:
        function = resolve_name(path)
    finally:
        signal.signal(signal.SIGINT, handler)
    if not is_torch_imported:
        skip_last_collection()
    return cast(Callable[..., Any], function)


def _end_at_once(number: int, frame: object) -> None:
    """Handle a signal: print a line and end the process without cleanup."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(128 + number)


def skip_last_collection() -> None:
    """Exclude all present objects from garbage collection, so that Python exits faster.

    At its exit, Python looks for reference cycles among all objects. This takes seconds after
    PyTorch is imported, and a fifth of the time of --help.
    """
    gc.freeze()


def program(name: str, as_called: bool = False) -> list[str]:
    """Return the start of a command line that runs a command in the way of this process.

    It is "pnb-NAME", or "python -m MODULE" if the package is not installed, after torchrun and its
    options if that started this process. `as_called` gives full paths.
    """
    called = Path(sys.argv[0])
    process_count = int(os.environ.get("WORLD_SIZE", "1"))
    installed_name = f"{PREFIX}{name}"
    is_installed = bool(sys.flags.safe_path) or called.stem.startswith(PREFIX)
    python = sys.executable if as_called else "python"
    # The module has a file of its own in scripts/, except pnb-train, which is `python -m train`.
    words = ["-m", "train" if name == "train" else f"scripts.{name}"]
    if is_installed:
        words = [str(called) if as_called and called.stem == installed_name else installed_name]
    if process_count == 1:
        return words if is_installed else [python, *words]
    torchrun = [python, "-m", "torch.distributed.run"] if as_called else ["torchrun"]
    # torchrun would otherwise start the installed command as a Python file.
    no_python = ["--no-python"] if is_installed else []
    return [*torchrun, f"--nproc_per_node={process_count}", *no_python, *words]


def command_line(name: str) -> str:
    """Return the command line of this process, as a user can type it again."""
    return shlex.join([*program(name), *sys.argv[1:]])


def user_message(error: BaseException) -> str | None:
    """Write a message for the user about an error that the user can fix.

    None if it is a fault of the program, or unknown.
    """
    match error:
        case InputError():
            return str(error)
        case OSError() if error.errno in NO_ROOM:
            fault = f"{error.filename or 'the output'} cannot be written ({error.strerror})"
            return f"{fault}: make room and try again"
        case OSError() if error.filename is not None:
            return f"{error.filename} cannot be read or written: {error.strerror}"
        # NCCL and Gloo connect processes. Gloo has no class of errors; its messages contain the
        # path of a source file.
        case RuntimeError() if type(error).__name__.startswith("Dist") or "/gloo/" in str(error):
            return "another process of this run has ended: continue with train.resume=true"
        case RuntimeError() | MemoryError() if is_out_of_memory(error):
            return "memory ran out: ask for fewer or smaller images, meshes, views or batches"
    return None
