"""The command line: `trackwright COMMAND …`, also `python -m experiments`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from experiments.cli.runtime import set_flags
from experiments.cli.summaries import COMMANDS

FUNCTIONS = {
    "simulate": "simulate:station",
    "simulate-line": "simulate:line",
    "simulate-ranges": "simulate:ranges",
    "simulate-imu": "simulate:tool",
    "simulate-agv": "simulate:agv",
    "check": "check:check",
    "calibrate": "calibrate:calibrate_recordings",
    "track": "track:track",
    "evaluate": "evaluate:evaluate_tracks",
    "tune": "tune:tune",
    "sweep": "sweep:sweep",
    "study": "study:study",
    "report": "report:report",
    "truth": "truth:truth",
    "verify": "verify:verify",
}
"""The function of each command and its module in this package, which is imported for that command alone."""

NO_CACHE = "--no-cache"
ABOUT = f"""How accurate is this tracker, and with which noise levels?

Compiled programs are kept in your cache directory, or in $TRACKWRIGHT_CACHE; {NO_CACHE}, with any command, or
TRACKWRIGHT_CACHE=off neither reads nor writes them.
"""


def main() -> None:
    """Run one command. Exit code 0, 1 (a check failed) or 2 (unusable input, one line on standard error)."""
    try:
        code = _run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("trackwright: interrupted; files already written are complete", file=sys.stderr)
        code = 130
    except BrokenPipeError:
        # The reader closed the pipe: discard the rest of the output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 141
    sys.exit(code)


def _run() -> int:
    set_flags()
    import tyro

    from trackers.core.errors import UnusableInput

    arguments = [argument for argument in sys.argv[1:] if argument != NO_CACHE]
    if NO_CACHE in sys.argv:
        os.environ["TRACKWRIGHT_CACHE"] = "off"
    try:
        code: int | None = tyro.extras.subcommand_cli_from_dict(
            commands(arguments), args=arguments, prog="trackwright", description=ABOUT
        )
    except UnusableInput as problem:
        print(f"trackwright: {problem}", file=sys.stderr)
        code = 2
    return code or 0


def commands(arguments: Sequence[str]) -> dict[str, Callable[..., Any]]:
    """All commands by name, of which only the one that the arguments begin with can be run."""
    wanted = arguments[0] if arguments else ""
    return {name: function_of(name) if name == wanted else _named_only(name) for name in FUNCTIONS}


def function_of(command: str) -> Callable[..., Any]:
    """The function of a command, imported."""
    module, _, name = FUNCTIONS[command].partition(":")
    function: Callable[..., Any] = getattr(import_module(f"experiments.cli.{module}"), name)
    return function


def _named_only(command: str) -> Callable[[], None]:
    def function() -> None: ...

    function.__doc__ = COMMANDS[command]
    return function
