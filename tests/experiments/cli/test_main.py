"""The table of commands: lines of help that are held equal to what they summarise, and no more imports than needed."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

from experiments.cli import summaries
from experiments.cli.main import FUNCTIONS, function_of
from tests.in_process import trackwright
from trackers.catalogue import TRACKERS


def test_the_help_lists_each_command_by_the_first_line_of_its_docstring():
    assert {name: inspect.getdoc(function_of(name)).splitlines()[0] for name in FUNCTIONS} == summaries.COMMANDS


def test_the_help_of_track_lists_the_catalogue():
    assert {name: f"{spec.about} ({spec.table})" for name, spec in TRACKERS.items()} == summaries.TRACKERS


def test_the_help_of_a_command_shows_its_options():
    done = trackwright("tune", "--help")
    assert done.code == 0
    assert "--held-out" in done.out


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--help",), 0),
        (("track", "--help"), 0),
        (("tune", "--help"), 0),
        (("calibrate", "--help"), 0),
        (("check", "GOOD"), 0),
        (("track", "nowhere", "--out", "out"), 2),
        (("tune", "nowhere", "--out", "out"), 2),
        (("calibrate", "nowhere", "--out", "calibration.toml"), 2),
        (("track", "GOOD"), 2),
    ],
)
def test_help_a_check_and_a_refusal_import_no_jax(beginnings, tmp_path, arguments, code):
    words = [str(beginnings / "good") if word == "GOOD" else word for word in arguments]
    program = (
        "import sys\nfrom experiments.cli.main import main\n"
        f"sys.argv = ['trackwright', *{words!r}]\n"
        "try: main()\n"
        "except SystemExit as end: assert end.code == int(sys.stdin.read()), end.code\n"
        "print('heavy:', [name for name in ('jax', 'scipy', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], input=str(code), capture_output=True, text=True, check=True)
    assert done.stdout.endswith("heavy: []\n"), done.stdout
