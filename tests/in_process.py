"""The command line run inside the test's own process, so that what one test compiled serves the next."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import jax

from experiments.cli.main import main
from experiments.plots import style


class StepInfo(NamedTuple):
    """What a command left: its exit code, standard output and standard error."""

    code: int
    out: str
    err: str


def trackwright(*arguments: str | Path | float) -> StepInfo:
    """Run `trackwright ARGUMENTS`; figures are drawn with few pixels, which is most of their time."""
    jax.devices()  # once there are devices, the flags that `main` sets change nothing
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["trackwright", *map(str, arguments)]),
        mock.patch.dict(os.environ),
        mock.patch.dict(style.STYLE, {"savefig.dpi": 40}),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            return StepInfo(end.code, out.getvalue(), err.getvalue())
    raise AssertionError("main() came back without an exit code")


def assert_refused(said: StepInfo, *words: str) -> None:
    """Exit code 2 and one line on standard error that holds the words; nothing on standard output."""
    assert said.code == 2, said
    assert said.err.startswith("trackwright: ")
    assert said.err.count("\n") == 1, said.err
    assert said.err.endswith("\n")
    assert said.out == ""
    for word in words:
        assert word in said.err
