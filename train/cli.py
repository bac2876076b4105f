"""How commands start: Ctrl-C in one line, errors in one sentence with exit status 2, settings, --help.

Commands import this module before all others, which take seconds to import; no other module imports it.
"""

import gc
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import FrameType

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: threads that wait do not spin on a busy machine
USER_ERROR = 2
INTERRUPTED = "ended by SIGINT"
HELP = {"-h", "--help"}
PREFIX = "pnb-"  # of the installed commands
_started = False  # whether a command runs, after all imports
_interrupted = False


def _interrupt(number: int, frame: FrameType | None) -> None:
    """End at once while modules are imported, since some swallow KeyboardInterrupt; raise it later."""
    global _interrupted
    _interrupted = True
    if not _started:
        os.write(2, f"{INTERRUPTED}\n".encode())
        os._exit(128 + signal.SIGINT)
    raise KeyboardInterrupt


if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell's background jobs ignore SIGINT
    signal.signal(signal.SIGINT, _interrupt)


def _answer_at_once() -> None:
    """Print --help or complete words for a shell, and end: the imports that follow take longer than anyone waits."""
    import hydra

    from train.command_help import CONF, format_help

    name = Path(sys.argv[0]).stem.removeprefix(PREFIX).replace("__main__", "train")
    if not HELP.isdisjoint(sys.argv):
        with handled_errors():
            print(format_help(name, sys.argv[1:]))
        sys.exit()
    if (CONF / f"{name}.yaml").exists():
        hydra.main(version_base="1.3", config_path="pkg://conf", config_name=name)(lambda config: None)()
        sys.exit()


_loaded = threading.Event()


def _await_imports() -> None:
    waited, wait = 0, 5
    while not _loaded.wait(wait):
        waited, wait = waited + wait, 2 * wait
        print(f"loading PyTorch and other libraries: {waited} s ...", file=sys.stderr, flush=True)
    gc.freeze()  # or Python looks for cycles among all that was imported, for seconds at its end


@contextmanager
def handled_errors() -> Iterator[None]:
    """Print what the user can fix as one line, without a traceback, and exit with status 2.

    Warnings are one line, too. Ctrl-C ends in one line and status 130. A reader of the output who has gone ends the
    command in silence with status 141. Characters that the terminal lacks are printed as escapes.
    """
    global _started, _interrupted
    _started, _interrupted = True, False
    if Path(sys.argv[0]).stem.startswith(PREFIX):  # in further processes, train is no train.py of the current folder
        os.environ["PYTHONSAFEPATH"] = "1"
    _loaded.set()
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    warnings.simplefilter("once", UserWarning, append=True)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        yield
        print(end="", flush=True)  # a closed pipe is met here
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes at its end
        sys.exit(128 + signal.SIGPIPE)
    except (Exception, KeyboardInterrupt) as error:
        if _interrupted or isinstance(error, KeyboardInterrupt):
            print(INTERRUPTED, file=sys.stderr)
            sys.exit(128 + signal.SIGINT)
        from train.errors import one_sentence  # with PyTorch, which --help does without

        sentence = one_sentence(error)
        if sentence is None:
            raise
        print(f"error: {sentence}", file=sys.stderr)
        sys.exit(USER_ERROR)


def command(as_overrides: Callable[[list[str]], list[str]] = list) -> Callable[..., Callable[[], None]]:
    """Decorator of a script's `main(settings)`, which then takes its settings from the command line.

    Their defaults are in conf/SCRIPT.yaml or, without such a file, in the dataclass that annotates them.
    as_overrides: puts the command line into Hydra's form.
    """

    def decorate(main: Callable[..., object]) -> Callable[[], None]:
        @wraps(main)
        def start() -> None:
            with handled_errors():
                from hydra.core.config_store import ConfigStore

                from renderer.errors import InputError
                from train.command_help import CONF
                from train.settings import compose, read_settings

                name, settings = Path(main.__globals__["__file__"]).stem, main.__annotations__["settings"]
                if not (CONF / f"{name}.yaml").exists():
                    ConfigStore.instance().store(name, settings)
                arguments = as_overrides(sys.argv[1:])
                if unknown := next((argument for argument in arguments if argument.startswith("-")), None):
                    raise InputError(f"{unknown} is not an option: give settings as key=value; --help shows them")
                main(read_settings(settings, compose(name, arguments)))

        return start

    return decorate


if not ({*HELP, "-sc", "--shell-completion"}).isdisjoint(sys.argv):
    _answer_at_once()
if "torch" not in sys.modules:
    threading.Thread(target=_await_imports, daemon=True).start()
