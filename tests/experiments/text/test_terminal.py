"""Progress: a bar and a time for each stage on a terminal, lines at intervals in a pipe, nothing where it is quiet."""

from __future__ import annotations

import io
import sys
import time

import pytest
from rich.console import Console

from trackwright.experiments.text import terminal as module
from trackwright.experiments.text.terminal import stages


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
