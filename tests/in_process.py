"""The command line run within the process of the tests, which share their compiled programs."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import jax

from trackwright.experiments.cli.main import main
from trackwright.experiments.pages import chart as style
from trackwright.experiments.text import terminal
from trackwright.trackers.core import programs

PLAIN = ("--figures", "none")  # options of a command whose pictures and pages a test does not look at


class CommandResult(NamedTuple):
    """What a command left: its exit code, standard output and standard error."""

    code: int
    out: str
    err: str


def trackwright(*arguments: str | Path | float) -> CommandResult:
    """Run `trackwright ARGUMENTS`, with plots of few pixels, which are faster to draw."""
    jax.devices()  # the flags that `main` sets have no effect once devices exist
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["trackwright", *map(str, arguments)]),
        mock.patch.dict(os.environ),
        mock.patch.object(terminal.ERRORS, "quiet", False),
        mock.patch.dict(style.STYLE, {"savefig.dpi": 40}),
        # Tests replace functions of ours, of which a program that is not traced knows nothing.
        mock.patch.object(programs.ProgramStore, "program", return_value=None),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            return CommandResult(end.code, out.getvalue(), err.getvalue())
    raise AssertionError("main() returned without an exit code")


def assert_refused(result: CommandResult, *words: str) -> None:
    """Exit code 2, one line on standard error that contains the words, and nothing on standard output."""
    assert result.code == 2, result
    assert result.err.startswith("trackwright: ")
    assert result.err.count("\n") == 1, result.err
    assert result.err.endswith("\n")
    assert result.out == ""
    for word in words:
        assert word in result.err


def assert_refused_last(result: CommandResult, *words: str) -> None:
    """As `assert_refused`, after notices and lines of progress."""
    assert_refused(result._replace(err=result.err.splitlines()[-1] + "\n"), *words)
