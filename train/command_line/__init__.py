"""The entry points: configurations composed and read, errors in one sentence, outputs tried before the work.

Imported first, so that Ctrl-C while the rest is imported, which takes seconds, ends a command with one line, too.
"""

import sys
from types import TracebackType

INTERRUPTED = "ended by SIGINT"


def _report(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        print(INTERRUPTED, file=sys.stderr)
    else:
        _reported(kind, error, traceback)


_reported, sys.excepthook = sys.excepthook, _report
