"""Progress: a bar and a time for each stage on a terminal, lines at intervals in a pipe, nothing where it is quiet."""

from __future__ import annotations

import io
import re
import sys
import time

import pytest
from rich.console import Console

from trackwright.experiments.text import terminal as module
from trackwright.experiments.text.terminal import Compilation, stages


class _Terminal(io.StringIO):
    def isatty(self):
        return True


def _on_terminal(monkeypatch):
    """Standard error as a terminal of 100 columns; to be called by a test, since capsys sets the streams anew."""
    screen = _Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(module, "ERRORS", Console(file=screen, force_terminal=True, width=100, color_system=None))
    return screen


def test_every_stage_has_a_row_of_its_own_with_what_was_done(monkeypatch, capsys):
    drawn = _on_terminal(monkeypatch)
    with stages("tune") as begin:
        begin("reading")
        advance = begin("step", 60)
        advance(3, "objective 1.5")
        time.sleep(0.2)
        print("a result")
        assert "a result" not in capsys.readouterr().out, "results come after the bars"
        begin("intervals")
        time.sleep(0.2)
    shown = drawn.getvalue()
    assert "step objective 1.5" in shown
    assert "3 of 60" in shown
    assert shown.index("reading") < shown.index("step") < shown.index("intervals")
    assert capsys.readouterr().out == "a result\n"


def test_a_pipe_gets_lines_at_intervals(monkeypatch, capsys):
    monkeypatch.setattr(module, "FIRST_LINE", 0.05)
    with stages("tune") as begin:
        begin("step", 60)(7, "objective 1.5")
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert 1 <= len(lines) <= 3, "the interval doubles"
    assert all(re.fullmatch(r"tune: step 7 of 60, \d+ s, objective 1.5", line) for line in lines)


def test_a_short_command_prints_nothing_in_a_pipe(capsys):
    with stages("track") as begin:
        begin("reading")
    assert capsys.readouterr() == ("", "")


def test_results_printed_before_a_failure_are_not_lost(monkeypatch, capsys):
    _on_terminal(monkeypatch)

    def fail():
        with stages("track") as begin:
            begin("reading")
            print("a result")
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    assert capsys.readouterr().out == "a result\n"


def test_compiling_is_said_while_it_lasts():
    compilation = Compilation()
    assert compilation.now() == ""
    compilation.heard("/jax/core/compile/jaxpr_to_mlir_module_duration", 0.1)
    assert compilation.now() == "compiling 0 s"
    compilation.heard("/jax/core/compile/backend_compile_duration", 2.5)
    assert compilation.now() == ""
    assert (compilation.done, compilation.seconds) == (1, 2.5)


def test_jax_reports_what_it_compiles():
    import jax
    import jax.numpy as jnp

    compilation = Compilation()
    compilation.listen()
    try:
        jax.jit(lambda x: jnp.sin(x) * 12345.0)(jnp.ones(3))
        assert compilation.done >= 1
        assert compilation.begun == []
    finally:
        jax.monitoring.unregister_event_duration_listener(compilation.heard)


def test_a_program_that_was_lowered_before_and_not_compiled_is_not_shown():
    module.COMPILATION.begun.append(time.monotonic() - 100)
    with stages("tune") as begin:
        begin("step")
        assert not module.COMPILATION.now()
