"""How cyclopts reads the arguments of all commands, refuses them in one line, and prints help in two columns.

A command is a typed function whose docstring is its help. Parameters before `*` are positional, `*names` any number of
words; those after it are options, and so are the fields of a dataclass decorated with `options.OPTIONS`. Of an option
given twice the last counts, lists are joined.
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from cyclopts import (
    UNSET,
    App,
    Argument,
    CoercionError,
    CycloptsError,
    MissingArgumentError,
    Parameter,
    Token,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
    convert,
)

from trackwright.trackers.core.errors import UnusableInput, near

if TYPE_CHECKING:
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions

EXPECTED: Mapping[Any, str] = {int: "a whole number", float: "a number", bool: "no value"}
"""What a value of each type is, in words."""

WIDTH = 80

SECTIONS = {
    "Input": "tag from to calibration truth held-out table columns mapping topic rig format origin header missing "
    "given",
    "Tracker": "tracker set noise fit smooth lag",
    "Fit": "objective tune freeze bound prior start over repeats",
    "Output": "out figures json fail-if check replace path align-truth transform",
    "Running": "runs seed until shard cluster keep-going resume force",
    "Rarely needed": "average free-height side dimensions weigh starts optimiser steps piece-rows all-pairs "
    "time-tolerance separator decimal skip encoding thousands messages interval skip-bad-lines",
}
"""The options of each section of help; the last section is shown by `--help-all` alone."""

RARE, ALL = "Rarely needed", "--help-all"

COLUMNS = {"command": 16, "parameter": 24}  # where the texts on names begin


def _read(kind: Any, tokens: Sequence[Token]) -> Any:
    """As `cyclopts.convert`, but 1.5 is no whole number and an empty text no path."""
    converted = convert(kind, tokens)
    for value, token in zip(converted if isinstance(converted, tuple) else (converted,), tokens, strict=False):
        if type(value) is int and not re.fullmatch(r"[+-]?[0-9_]+", token.value):
            raise CoercionError(token=token, target_type=int)
        if isinstance(value, Path) and not token.value:
            raise CoercionError(token=token, target_type=Path)
    return converted


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


def refusal(error: CycloptsError, program: str) -> UnusableInput:
    """What cyclopts refuses, in one line: what, where, found, expected, usual fix."""
    chain = error.command_chain or ()
    where = f"{' '.join(chain)}: " if chain else ""
    # The line on a wrong value has all that the help has on it.
    see = "" if isinstance(error, CoercionError) else f"; see `{' '.join((program, *chain))} --help`"
    return UnusableInput(f"{where}{_sentence(error)}{see}")


def _sentence(error: CycloptsError) -> str:
    match error:
        case UnknownCommandError(unused_tokens=[word, *_], app=App() as app):
            names = [name for name in app if not name.startswith("-")]
            known = "" if len(names) > 8 else f"; expected {', '.join(names[:-1])} or {names[-1]}"
            return f"no command {word}{near(word, names)}{known}"
        case UnknownOptionError(token=token, argument_collection=known):
            word = (token.keyword or token.value).partition("=")[0]
            return f"no option {word}{near(word, [name for arg in known for name in arg.names if name[0] == '-'])}"
        case MissingArgumentError(argument=Argument() as argument, keyword=None, app=App() as app):
            about = {
                arg.name: arg.parameter.help or "" for arg in app.assemble_argument_collection(parse_docstring=True)
            }
            shown = "" if argument.index is not None else f"{_with_value(argument)}, "
            return f"no {argument.name} given; expected {shown}{about[argument.name].rstrip('.')}"
        case MissingArgumentError(argument=Argument() as argument, keyword=name, tokens_so_far=values):
            return f"{name}: found {' '.join(values) or 'nothing'}; expected {_with_value(argument)}"
        case CoercionError(token=Token() as token, argument=Argument() as argument):
            given = f"{token.keyword or argument.name} {token.value or repr('')}"
            return f"{given}: expected {_expected(error, token.value, argument)}"
        case UnusedCliTokensError(unused_tokens=[*words]):
            return f"found {' '.join(map(repr, words))} beyond what it takes"
    error.verbose = False
    return str(error)


def _with_value(argument: Argument) -> str:
    """An option as it is written with its value."""
    count, _ = argument.token_count()
    choices = get_args(argument.resolved_hint) if get_origin(argument.resolved_hint) is Literal else ()
    word = "|".join(map(str, choices)) or ("VALUE" if count < 2 else f"with {count} values")
    return f"{argument.name} {argument.parameter.metavar or word}"


def _expected(error: CoercionError, word: str, argument: Argument) -> str:
    if get_origin(error.target_type) is Literal:
        choices = [str(choice) for choice in get_args(error.target_type)]
        many = "one of " * (len(choices) > 2)
        return f"{many}{(', ' if many else ' or ').join(choices)}{near(word, choices)}"
    if error.target_type is Path:
        return f"{argument.parameter.metavar or 'a path'}, found an empty name"
    return EXPECTED.get(error.target_type, _with_value(argument))
