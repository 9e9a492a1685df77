"""The program: its commands, how cyclopts reads their arguments, and refuses them in one line.

A command is a typed function whose docstring is its help. Parameters before `*` are positional, `*names` any number of
words; those after it are options, and so are the fields of the dataclasses in `options`. Of an option given twice the
last counts, lists are joined.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cyclopts import App, CoercionError, CycloptsError, Parameter, Token, convert

from trackwright import __version__
from trackwright.trackers.core.errors import UnusableInput

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


def application() -> App:
    """The program with its commands, each imported when it is used."""
    app = new_app("trackwright", ABOUT, f"trackwright {__version__}")
    for name, place in COMMANDS.items():
        app.command(f"trackwright.experiments.{place}", name=name, sort_key=len(app._commands))
    return app


def new_app(name: str, about: str | None = None, version: str | None = None) -> App:
    """A program, or a family of commands, whose errors are left to the caller."""
    options = Parameter(negative=(), consume_multiple=1, allow_repeating=True, show_default=False, converter=_read)
    return App(
        name=name, help=about, help_flags=("--help", "-h", "--help-all"), help_format="markdown", version=version,
        version_flags=() if version is None else ("--version", "-V"), default_parameter=options, print_error=False,
        result_action="return_value", exit_on_error=False, suppress_keyboard_interrupt=False, help_epilogue=EPILOGUE,
    )  # fmt: skip


def _read(kind: Any, tokens: Sequence[Token]) -> Any:
    """As `cyclopts.convert`, but 1.5 is no whole number and an empty text no path."""
    converted = convert(kind, tokens)
    for value, token in zip(converted if isinstance(converted, tuple) else (converted,), tokens, strict=False):
        whole = type(value) is not int or re.fullmatch(r"[+-]?[0-9_]+", token.value)
        if not whole or (isinstance(value, Path) and not token.value):
            raise CoercionError(token=token, target_type=type(value))
    return converted


def answered(app: App, words: Sequence[str], program: str) -> int:
    """The exit code of the program for these words; raises UnusableInput, in one line, where it does not take them."""
    try:
        code: int | None = app(words)
    except CycloptsError as error:
        error.verbose = False
        said = str(error).replace("Unused Tokens", "words beyond what it takes")
        raise UnusableInput(f"{said} See `{' '.join((program, *(error.command_chain or ())))} --help`.") from error
    return code or 0
