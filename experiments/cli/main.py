"""The command line: `trackwright COMMAND …`, also `python -m trackwright`."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import sys
from collections.abc import Callable
from typing import Any, NoReturn

# Our own modules and cyclopts are imported in functions, so that Ctrl-C is answered in a line from the beginning.

COLLECT_AFTER = 500_000  # allocations between garbage collections: imports and tracing make 300,000 that last

BROKEN = {errno.EPIPE: 141, errno.ENOSPC: 2, errno.EDQUOT: 2, errno.EIO: 2}
"""Exit codes by the error of a standard output that takes no more."""


def main() -> None:
    """Run one command. Exit code 0, 1 (a check failed), 2 (unusable input, one line) or 3 (recordings left out)."""
    try:
        _settle()
        from trackwright.experiments.cli.commands import COMMANDS, application

        app = application()
        if not {*sys.argv[1:2]} & {*COMMANDS}:
            # The list of commands has the first lines of their docstrings.
            app.resolved_commands()
        code = _code(app, "trackwright")
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("trackwright: interrupted; files already written are complete", file=sys.stderr)
        code = 130
    except OSError as error:
        if error.errno not in BROKEN or error.filename is not None:
            raise
        code = BROKEN[error.errno]
        if code == 2:
            print(f"trackwright: standard output cannot be written ({error.strerror})", file=sys.stderr)
        # The interpreter would write the rest of the output at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


def _settle() -> None:
    """Collect garbage less often, keep alarms of XLA off the terminal, and small matrices on one core."""
    gc.set_threshold(COLLECT_AFTER, *gc.get_threshold()[1:])
    # What lives to the end needs no last collection, which took 0.6 s after jax was used.
    atexit.register(gc.freeze)
    # XLA reports a slow compilation as an error; those that fail reach us as exceptions.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # waiting threads took half of a survey; XLA has its own
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a Windows pipe lacks some of our characters


def _code(app: Any, program: str) -> int:
    """The exit code of an app for the words of this process."""
    from trackwright.experiments.cli.commands import answered
    from trackwright.trackers.core.errors import UnusableInput

    try:
        return answered(app, sys.argv[1:], program)
    except UnusableInput as problem:
        print(f"trackwright: {problem}", file=sys.stderr)
        return 2


def run_alone(function: Callable[..., Any], program: str) -> NoReturn:
    """Run a function as a program of its own, as in trackwright.experiments.lab; exits with its code, or 2."""
    from trackwright.experiments.cli.commands import new_app

    app = new_app(program)
    app.default(function)
    sys.exit(_code(app, program))
