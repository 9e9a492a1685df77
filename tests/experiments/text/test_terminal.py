"""Progress on a terminal: a bar for each stage; results come after the bars, and none is lost where a command fails."""

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


def test_every_stage_has_a_row_of_its_own_with_what_was_done_and_results_come_after_the_bars(monkeypatch, capsys):
    screen = _Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(module, "ERRORS", Console(file=screen, force_terminal=True, width=100, color_system=None))

    def fail():
        with stages("tune") as begin:
            begin("reading")
            begin("step", 60)(3, "objective 1.5")
            time.sleep(0.2)
            print("a result")
            assert "a result" not in capsys.readouterr().out
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    shown = screen.getvalue()
    assert "step objective 1.5" in shown
    assert "3 of 60" in shown
    assert shown.index("reading") < shown.index("step")
    assert capsys.readouterr().out == "a result\n"
