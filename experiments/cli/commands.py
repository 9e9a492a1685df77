"""The program: its commands, how cyclopts reads their arguments, refuses them in one line, and prints help.

A command is a typed function whose docstring is its help. Parameters before `*` are positional, `*names` any number of
words; those after it are options, and so are the fields of a dataclass decorated with `options.OPTIONS`. Of an option
given twice the last counts, lists are joined.
"""

from __future__ import annotations

import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import UNSET, App, CoercionError, CycloptsError, Group, Parameter, Token, convert

from trackwright.trackers.core.errors import UnusableInput

if TYPE_CHECKING:
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions

ABOUT = "Trackers for wireless indoor positioning: how accurate, with which noise levels?"

COMMANDS = {
    "import": "cli.import_source:import_source",
    "check": "cli.check:check",
    "survey": "cli.check:survey",
    "calibrate": "cli.check:calibrate_recordings",
    "track": "cli.track:track",
    "evaluate": "cli.track:evaluate_tracks",
    "export": "cli.export:export",
    "tune": "cli.track:tune",
    "sweep": "cli.track:sweep",
    "trackers": "cli.trackers:trackers",
    "simulate": "cli.simulate:simulate",
    "study": "cli.study:study",
    "demo": "lab.demo:demo",
}
"""Where each command is. All these modules are light: what a command computes with is imported when it runs."""

RARE, ALL = "Rarely needed", "--help-all"
SECTIONS = {
    "Input": "tag from to calibration truth held-out table columns mapping topic rig format header missing given",
    "Tracker": "tracker set noise fit smooth lag",
    "Fit": "objective tune freeze bound prior start over repeats",
    "Output": "out figures json fail-if check replace path align-truth transform",
    "Running": "runs seed until shard keep-going resume force",
    RARE: "average free-height side dimensions weigh starts optimiser steps piece-rows cluster "
    "time-tolerance separator decimal skip encoding thousands",
}
"""The options of each section of help; the last section is shown by `--help-all` alone."""

WIDTH = 80
COLUMNS = {"command": 16, "parameter": 24}  # where the texts on names begin
ANY_COMMAND = Parameter(group=Group("With any command", sort_key=9))


def application() -> App:
    """The program with its commands, each imported when it is used; `meta` has the options that go with any of them."""
    app = new_app("trackwright", ABOUT, _version)
    for name, place in COMMANDS.items():
        app.command(f"trackwright.experiments.{place}", name=name, sort_key=len(app._commands))

    @app.meta.default
    def launch(
        *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        quiet: Annotated[bool, ANY_COMMAND, Parameter(alias="-q")] = False,
        no_cache: Annotated[bool, ANY_COMMAND] = False,
    ) -> Any:
        """Run a command.

        Args:
            words: the command and its arguments.
            quiet: neither progress nor notices; results and errors alone.
            no_cache: neither read nor write compiled programs, which are kept in $TRACKWRIGHT_CACHE, by default your
                cache directory.
        """
        if no_cache:
            os.environ["TRACKWRIGHT_CACHE"] = "off"
        if quiet:
            from trackwright.experiments.text.terminal import ERRORS

            ERRORS.quiet = True
        return app(words)

    # Ctrl-C is answered in `main`.
    app.meta.suppress_keyboard_interrupt = False

    app.register_install_completion_command(group=ANY_COMMAND.group)
    return app


def _version() -> str:
    from trackwright import __version__

    return f"trackwright {__version__}"


def new_app(name: str, about: str | None = None, version: Callable[[], str] | None = None) -> App:
    """A program, or a family of commands, whose errors are left to the caller."""
    return App(
        name=name,
        help=about,
        version=version,
        version_flags=() if version is None else ("--version", "-V"),
        help_flags=("--help", "-h", ALL),
        help_format="plaintext",
        help_formatter=_Help(),
        default_parameter=Parameter(
            negative=(), consume_multiple=1, allow_repeating=True, show_default=_shown, converter=_read
        ),
        result_action="return_value",
        exit_on_error=False,
        print_error=False,
        suppress_keyboard_interrupt=False,
    )


def _read(kind: Any, tokens: Sequence[Token]) -> Any:
    """As `cyclopts.convert`, but 1.5 is no whole number and an empty text no path."""
    converted = convert(kind, tokens)
    for value, token in zip(converted if isinstance(converted, tuple) else (converted,), tokens, strict=False):
        whole = type(value) is not int or re.fullmatch(r"[+-]?[0-9_]+", token.value)
        if not whole or (isinstance(value, Path) and not token.value):
            raise CoercionError(token=token, target_type=int if not whole else Path)
    return converted


def _shown(default: Any) -> str | None:
    """A default in help: none for nothing, which the text on the option explains."""
    return None if default is None or default is False or default in ((), UNSET) else str(default)


class _Help:
    """Prints a help as plain text in two columns; not by rich, which ends a closed pipe in its own way."""

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        """Prints the usage, words not broken at their hyphens."""
        print(textwrap.fill(f"usage: {usage}", WIDTH, subsequent_indent="  ", break_on_hyphens=False))

    def render_description(self, console: Console, options: ConsoleOptions, description: Any) -> None:
        """Prints the docstring, its paragraphs filled."""
        for text in str(description.primary_renderable).split("\n\n"):
            print("\n" + textwrap.fill(" ".join(text.split()), WIDTH))

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Prints one group of arguments, options by their sections, or the list of commands."""
        own = str(panel.title)
        found: dict[str, list[tuple[str, str]]] = {title: [] for title in (own, *SECTIONS)}
        for entry in panel.entries:
            about = [str(entry.description.primary_renderable).rstrip(".")]
            about += [f"({', '.join(entry.choices)})"] if entry.choices else []
            about += ["(required)"] if entry.required else []
            about += [f"(default: {entry.default})"] if entry.default and "default:" not in about[0] else []
            name = entry.display_labels_with_metavar[0]
            of = (title for title, names in SECTIONS.items() if name.split()[0][2:] in names.split())
            section = next(of, own) if name.startswith("--") and own == "Parameters" else own
            found[section].append((", ".join(entry.display_labels_with_metavar), " ".join(about)))
        if (rare := found[RARE]) and ALL not in sys.argv:
            found[RARE] = [(ALL, "explains " + ", ".join(name.split()[0] for name, _ in rare))]
        for title, pairs in found.items():
            if pairs:
                print("\n".join([f"\n{title}:", *rows(pairs, COLUMNS[panel.format])]))


def rows(pairs: Iterable[tuple[str, str]], column: int) -> list[str]:
    """Names and texts in two columns of a terminal; a name that is too long has a line of its own."""
    lines = []
    for name, text in pairs:
        first, indent = f"  {name}", " " * column
        fits = len(first) + 2 <= column
        lines += [] if fits else [first]
        begin = f"{first:<{column}}" if fits else indent
        filled = textwrap.wrap(text, WIDTH, initial_indent=begin, subsequent_indent=indent, break_on_hyphens=False)
        lines += filled or [first][:fits]
    return lines


def answered(app: App, words: Sequence[str], program: str) -> int:
    """The exit code of the program for these words; raises UnusableInput, in one line, where it does not take them."""
    try:
        code: int | None = app(words)
    except CycloptsError as error:
        error.verbose = False
        line = str(getattr(error, "exception_message", ""))
        if not line.startswith("--"):
            line = f"{error} See `{' '.join((program, *(error.command_chain or ())))} --help`."
        line = re.sub(r'Command "(.*?)" parameter (\S+) requires an argument', r"\1 needs \2, and its value", line)
        line = re.sub(r"Unused Tokens: \[(.*)\]", r"found \1 beyond what it takes", line)
        raise UnusableInput(line) from error
    return code or 0
