"""The command line: `trackwright COMMAND …`, also `python -m experiments`."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any, NoReturn

from experiments.cli.runtime import set_flags
from experiments.cli.summaries import COMMANDS, FAMILIES

FUNCTIONS = {
    "plan": "cli.plan:plan",
    "import": "cli.import_source:import_source",
    "check": "cli.check:check",
    "calibrate": "cli.calibrate:calibrate_recordings",
    "track": "cli.track:track",
    "evaluate": "cli.evaluate:evaluate_tracks",
    "export": "cli.export:export",
    "report": "cli.report:report",
    "tune": "cli.tune:tune",
    "sweep": "cli.sweep:sweep",
    "trackers": "cli.trackers:trackers",
    "tunables": "cli.trackers:tunables",
    "simulate station": "cli.simulate:station",
    "simulate line": "cli.simulate:line",
    "simulate ranges": "cli.simulate:ranges",
    "simulate tool": "cli.simulate:tool",
    "simulate agv": "cli.simulate:agv",
    "study": "cli.study:study",
    "truth": "cli.truth:truth",
    "verify": "lab.verify.command:verify",
    "demo": "lab.demo:demo",
    "completion": "cli.completion:completion",
}
"""The function of each command and its module in `experiments`, which is imported for that command alone.

A new command is a line here and one in `summaries.COMMANDS`; its function's signature and docstring are its options and
help (`arguments.py`).
"""

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
"""Errors of a standard output that takes no more."""


def main() -> None:
    """Run one command. Exit code 0, 1 (a check failed) or 2 (unusable input, one line on standard error)."""
    plain_streams()
    try:
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
    """Characters that the encoding of a stream lacks, as that of a Windows pipe, are written as plain ones."""
    from experiments.cli.plain_text import ERRORS

    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=ERRORS)


def _run(words: list[str]) -> int:
    set_flags()
    from experiments.cli.arguments import parse
    from trackers.core.errors import UnusableInput

    try:
        command, rest = command_of([word for word in words if word not in SWITCHES])
        for word in words:
            SWITCHES.get(word, lambda: None)()
        helped = help_of(command, rest)
        if helped is not None:
            print(helped, end="")
            return 0
        function = function_of(command)
        positional, options = parse(function, command, rest)
        code: int | None = function(*positional, **options)
    except UnusableInput as problem:
        print(f"trackwright: {problem}", file=sys.stderr)
        code = 2
    except Exception:
        if not _lacks_device():
            raise
        asked = os.environ.get("JAX_PLATFORMS", "")
        print(f"trackwright: JAX_PLATFORMS={asked}: no such device here; leave it unset, or cpu", file=sys.stderr)
        code = 2
    return code or 0


def _lacks_device() -> bool:
    """Whether JAX_PLATFORMS names a device that is not there: jax fails somewhere, with an error of its own."""
    if not os.environ.get("JAX_PLATFORMS") or "jax" not in sys.modules:
        return False
    try:
        return not sys.modules["jax"].devices()
    except Exception:
        return True


def _without_cache() -> None:
    os.environ["TRACKWRIGHT_CACHE"] = "off"


def _quietly() -> None:
    from experiments.text.terminal import ERRORS

    ERRORS.quiet = True


SWITCHES: dict[str, Callable[[], None]] = {"--no-cache": _without_cache, "--quiet": _quietly, "-q": _quietly}
"""Options of the program, which may stand anywhere."""

HELP, VERSION = ("-h", "--help"), ("-V", "--version")


def command_of(words: list[str]) -> tuple[str, list[str]]:
    """The command that the words begin with, and the rest; empty where they begin with none.

    Raises UnusableInput for an unknown command.
    """
    if not words or words[0] in (*HELP, *VERSION):
        return "", words
    first, *rest = words
    if first in FAMILIES:
        if not rest or rest[0] in HELP:
            return first, [HELP[1]]
        first, rest = f"{first} {rest[0]}", rest[1:]
    if first not in FUNCTIONS:
        from trackers.core.errors import UnusableInput, near

        family, _, word = first.partition(" ")
        own = [name.partition(" ")[2] for name in FUNCTIONS if name.startswith(f"{family} ")]
        if own:
            raise UnusableInput(f"no command {first}{near(word, own)}; expected {', '.join(own[:-1])} or {own[-1]}")
        raise UnusableInput(f"no command {first}{near(first, FUNCTIONS)}; `trackwright --help` lists them")
    return first, rest


def help_of(command: str, words: list[str]) -> str | None:
    """The version or the help that the words ask for; None where they ask for neither."""
    from experiments.cli.help_text import command_help, family_help, program_help

    if not command and words and words[0] in VERSION:
        from trackwright import __version__

        return f"trackwright {__version__}\n"
    if not command:
        return program_help(COMMANDS, FAMILIES)
    if not {*HELP} & {*words}:
        return None
    if command in FAMILIES:
        return family_help(command, COMMANDS, FAMILIES[command])
    return command_help(function_of(command), f"trackwright {command}")


def function_of(command: str) -> Callable[..., Any]:
    """The function of a command, imported."""
    module, _, name = FUNCTIONS[command].partition(":")
    function: Callable[..., Any] = getattr(import_module(f"experiments.{module}"), name)
    return function


def run_alone(function: Callable[..., Any], program: str) -> NoReturn:
    """Run a function as a program of its own, as `python -m experiments.lab.bench`; exits with its code, or 2."""
    from experiments.cli.arguments import parse
    from experiments.cli.help_text import command_help
    from trackers.core.errors import UnusableInput

    words = sys.argv[1:]
    if {*HELP} & {*words}:
        print(command_help(function, program), end="")
        sys.exit(0)
    try:
        positional, named = parse(function, program, words)
        sys.exit(function(*positional, **named))
    except UnusableInput as problem:
        print(problem, file=sys.stderr)
        sys.exit(2)
