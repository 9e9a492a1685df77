"""The command line: `trackwright COMMAND …`, also `python -m trackwright`."""

from __future__ import annotations

import codecs
import errno
import os
import sys
import unicodedata
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

from trackwright.experiments.cli.runtime import settle_memory

if TYPE_CHECKING:
    from cyclopts import App

# Our own modules and cyclopts are imported in functions, so that Ctrl-C is answered in a line from the beginning.

PLAIN = {
    "─": "-", "━": "-", "│": "|", "–": "-", "—": "-", "−": "-", "×": "x", "·": "*", "±": "+-", "→": "->", "≤": "<=",
    "≥": ">=", "≈": "~", "°": " deg", "√": "sqrt", "‘": "'", "’": "'", "“": '"', "”": '"', "Δ": "Delta", "α": "alpha",
    "β": "beta", "λ": "lambda", "μ": "mu", "µ": "u", "π": "pi", "ρ": "rho", "σ": "sigma", "τ": "tau", "χ": "chi",
    "ω": "omega",
}  # fmt: skip
"""Plain text for characters that an encoding may lack and that have no decomposition into ASCII ones."""

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)  # errors of a standard output that takes no more


def main() -> None:
    """Run one command. Exit code 0, 1 (a check failed), 2 (unusable input, one line) or 3 (recordings left out)."""
    try:
        plain_streams()
        settle_memory()
        code = _run(sys.argv[1:])
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("trackwright: interrupted; files already written are complete", file=sys.stderr)
        code = 130
    except BrokenPipeError:
        # The reader closed the pipe.
        code = 141
        _discard_output()
    except OSError as error:
        if error.errno not in FULL or error.filename is not None:
            raise
        print(f"trackwright: standard output cannot be written ({error.strerror}); free some space", file=sys.stderr)
        code = 2
        _discard_output()
    sys.exit(code)


def _discard_output() -> None:
    """Discard the rest of the output, which the interpreter would write at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def plain_streams() -> None:
    """Characters that the encoding of a stream lacks, as a Windows pipe's, are written as plain ones."""
    codecs.register_error("trackwright-plain", _plain)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="trackwright-plain")


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = "".join(map(_ascii_of, error.object[error.start : error.end]))
    return text, error.end


def _ascii_of(character: str) -> str:
    replacement = PLAIN.get(character) or unicodedata.normalize("NFKD", character)
    return "".join(x for x in replacement if x.isascii()) or "?"


def _run(words: list[str]) -> int:
    from trackwright.experiments.cli.commands import COMMANDS, application
    from trackwright.trackers.core.errors import UnusableInput

    try:
        app = application()
        if not {*words[:1]} & {*COMMANDS}:
            # The list of commands has the first lines of their docstrings.
            app.resolved_commands()
        return _answered(app.meta, words, "trackwright")
    except UnusableInput as problem:
        print(f"trackwright: {problem}", file=sys.stderr)
        return 2
    except Exception:
        if not _lacks_device():
            raise
        asked = os.environ.get("JAX_PLATFORMS", "")
        print(f"trackwright: JAX_PLATFORMS={asked}: no such device here; leave it unset, or cpu", file=sys.stderr)
        return 2


def _answered(app: App, words: list[str], program: str) -> int:
    """The exit code of the program for these words; raises UnusableInput where it does not take them."""
    from cyclopts import CycloptsError

    from trackwright.experiments.cli.arguments import refusal

    try:
        code: int | None = app(words)
    except CycloptsError as error:
        raise refusal(error, program) from error
    return code or 0


def _lacks_device() -> bool:
    """Whether JAX_PLATFORMS names a device that is not there: jax fails somewhere, with an error of its own."""
    if not os.environ.get("JAX_PLATFORMS") or "jax" not in sys.modules:
        return False
    try:
        return not sys.modules["jax"].devices()
    except Exception:
        return True


def run_alone(function: Callable[..., Any], program: str) -> NoReturn:
    """Run a function as a program of its own, as in trackwright.experiments.lab; exits with its code, or 2."""
    from trackwright.experiments.cli.arguments import new_app
    from trackwright.trackers.core.errors import UnusableInput

    app = new_app(program)
    app.default(function)
    try:
        sys.exit(_answered(app, sys.argv[1:], program))
    except UnusableInput as problem:
        print(problem, file=sys.stderr)
        sys.exit(2)
