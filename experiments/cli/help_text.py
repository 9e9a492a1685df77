"""Help as text of 80 columns: of the program, of a family of commands such as `simulate`, and of one command."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from experiments.cli.arguments import Argument, arguments_of

WIDTH = 80
COMMAND_COLUMN, SWITCH_COLUMN, OPTION_COLUMN = 14, 16, 24

ABOUT = """usage: trackwright COMMAND ...

Trackers for wireless indoor positioning: how accurate, with which noise levels?
"""

GLOBAL = (
    ("-h, --help", "help of the program or of a command"),
    ("-V, --version", "the version"),
    ("-q, --quiet", "neither progress nor notices; results and errors alone"),
    ("--no-cache", "neither read nor write compiled programs, which are kept in"),
    ("", "$TRACKWRIGHT_CACHE, by default your cache directory"),
)
"""Options of the program, which go with any command."""


def program_help(commands: Mapping[str, str], families: Mapping[str, str]) -> str:
    """The help of the program: a line for each command or family of commands, and the options of all."""
    lines = {}
    for name, about in commands.items():
        first = name.partition(" ")[0]
        lines[first] = f"{families[first]}: {', '.join(_members(first, commands))}" if first in families else about
    listed = [*rows(lines.items(), COMMAND_COLUMN), "", *rows(GLOBAL, SWITCH_COLUMN)]
    end = "\nA command's options: trackwright COMMAND --help\n"
    return f"{ABOUT}\n" + "\n".join(listed) + "\n" + end


def family_help(family: str, commands: Mapping[str, str], about: str) -> str:
    """The help of a family of commands."""
    lines = {name: commands[f"{family} {name}"] for name in _members(family, commands)}
    head = f"usage: trackwright {family} {'|'.join(lines)} ...\n\n{about}.\n\n"
    return head + "\n".join(rows(lines.items(), COMMAND_COLUMN)) + "\n"


def _members(family: str, commands: Iterable[str]) -> list[str]:
    return [name.partition(" ")[2] for name in commands if name.startswith(f"{family} ")]


def command_help(function: Callable[..., Any], program: str) -> str:
    """The help of one command: usage, what it does, its arguments."""
    arguments = arguments_of(function)
    positional, options = [a for a in arguments if a.positional], [a for a in arguments if not a.positional]
    needed = " ".join(
        a.shown if a.required or a.many else f"[{a.shown}]"
        for a in (*positional, *options)
        if a.required or a.positional
    )
    optional = "[options]" if any(not a.required for a in options) else ""
    words = " ".join(part for part in (program, needed, optional) if part)
    usage = textwrap.fill(f"usage: {words}", WIDTH, subsequent_indent="  ", break_on_hyphens=False)
    text = (inspect.getdoc(function) or "").partition("\nArgs:\n")[0].strip()
    paragraphs = [
        textwrap.fill(" ".join(part.split()), WIDTH) if "\n    " not in part else part for part in text.split("\n\n")
    ]
    listed = [*rows([(a.shown, a.about.rstrip(".")) for a in positional], OPTION_COLUMN)]
    listed += ["", *rows([(a.shown, _about(a)) for a in options], OPTION_COLUMN)] if options else []
    return "\n\n".join([usage, *paragraphs, "\n".join(listed).strip("\n")]) + "\n"


def _about(option: Argument) -> str:
    """The explanation with the default, unless that is nothing or named there."""
    about = option.about.rstrip(".")
    if option.required:
        return f"{about} (required)"
    plain = isinstance(option.default, int | float | str) and not isinstance(option.default, bool)
    return f"{about} (default: {option.default})" if plain and "default" not in about else about


def rows(pairs: Iterable[tuple[str, str]], column: int) -> list[str]:
    """Names and texts in two columns; a name that is too long has a line of its own."""
    lines = []
    for name, text in pairs:
        wrapped = textwrap.wrap(text, WIDTH - column) or [""]
        first = f"  {name}"
        if len(first) + 2 > column:
            lines.append(first)
        else:
            wrapped[0] = f"{first:<{column}}{wrapped[0]}"
        start = 0 if len(first) + 2 > column else 1
        lines += [wrapped[0]] if start else []
        lines += [" " * column + line for line in wrapped[start:]]
    return [line.rstrip() for line in lines]
