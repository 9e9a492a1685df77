"""The command line: `trackwright COMMAND …`, also `python -m trackwright`.

A command is a typed function whose docstring is its help. Parameters before `*` are positional, `*names` any number of
words; those after it are options, and so are the fields of the dataclasses in `options`. Of an option given twice the
last counts, lists are joined. cyclopts reads the words; what it refuses is told in one line.
"""

from __future__ import annotations

import atexit
import errno
import gc
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from cyclopts import App, Token

# Our own modules and cyclopts are imported in functions, so that Ctrl-C is answered in a line from the beginning.

COLLECT_AFTER = 500_000  # allocations between garbage collections: imports and tracing make 300,000 that last

BROKEN = {errno.EPIPE: 141, errno.ENOSPC: 2, errno.EDQUOT: 2, errno.EIO: 2}
"""Exit codes by the error of a standard output that takes no more."""

ABOUT = "Trackers for wireless indoor positioning: how accurate, with which noise levels?"
EPILOGUE = "COMMAND --help-all has the options that are rarely needed, too."

COMMANDS = {
    "import": "cli.exchange:import_source",
    "check": "cli.check:check",
    "survey": "cli.check:survey",
    "calibrate": "cli.check:calibrate_recordings",
    "track": "cli.track:track",
    "evaluate": "cli.track:evaluate_tracks",
    "export": "cli.exchange:export",
    "tune": "cli.track:tune",
    "sweep": "cli.track:sweep",
    "trackers": "cli.check:trackers",
    "simulate": "cli.simulate:simulate",
    "study": "cli.study:study",
    "demo": "lab.demo:demo",
}
"""Where each command is. All these modules are light: what a command computes with is imported when it runs."""


def main() -> None:
    """Run one command. Exit code 0, 1 (a check failed), 2 (unusable input, one line) or 3 (recordings left out)."""
    try:
        _settle()
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
    """The exit code of an app for the words of this process, 2 and a line where it does not take them."""
    from cyclopts import CycloptsError

    from trackwright.trackers.core.errors import UnusableInput

    try:
        code: int | None = app(sys.argv[1:])
        return code or 0
    except CycloptsError as error:
        error.verbose = False
        said = str(error).replace("Unused Tokens", "words beyond what it takes")
        problem = f"{said} See `{' '.join((program, *(error.command_chain or ())))} --help`."
    except UnusableInput as error:
        problem = str(error)
    print(f"trackwright: {problem}", file=sys.stderr)
    return 2


def run_alone(function: Callable[..., Any], program: str) -> NoReturn:
    """Run a function as a program of its own, as in trackwright.experiments.lab; exits with its code, or 2."""
    app = new_app(program)
    app.default(function)
    sys.exit(_code(app, program))


def application() -> App:
    """The program with its commands, each imported when it is used."""
    from trackwright import __version__

    app = new_app("trackwright", ABOUT, f"trackwright {__version__}")
    for name, place in COMMANDS.items():
        app.command(f"trackwright.experiments.{place}", name=name, sort_key=len(app._commands))
    return app


def new_app(name: str, about: str | None = None, version: str | None = None) -> App:
    """A program, or a family of commands, whose errors are left to the caller."""
    from cyclopts import App, Parameter

    options = Parameter(negative=(), consume_multiple=1, allow_repeating=True, show_default=False, converter=_read)
    return App(
        name=name, help=about, help_flags=("--help", "-h", "--help-all"), help_format="markdown", version=version,
        version_flags=() if version is None else ("--version", "-V"), default_parameter=options, print_error=False,
        result_action="return_value", exit_on_error=False, suppress_keyboard_interrupt=False, help_epilogue=EPILOGUE,
    )  # fmt: skip


def _read(kind: Any, tokens: Sequence[Token]) -> Any:
    """As `cyclopts.convert`, but 1.5 is no whole number and an empty text no path."""
    from cyclopts import CoercionError, convert

    converted = convert(kind, tokens)
    for value, token in zip(converted if isinstance(converted, tuple) else (converted,), tokens, strict=False):
        whole = type(value) is not int or re.fullmatch(r"[+-]?[0-9_]+", token.value)
        if not whole or (isinstance(value, Path) and not token.value):
            raise CoercionError(token=token, target_type=type(value))
    return converted
