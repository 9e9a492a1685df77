"""The program: its help, its refusals, no more imports than needed, and streams that take no more or not all."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest

from tests.in_process import assert_refused, trackwright
from trackwright.experiments.cli.commands import COMMANDS, application

MEMBERS = ("station", "line", "ranges", "tool", "agv")
EVERY = (*(name for name in COMMANDS if name != "simulate"), *(f"simulate {name}" for name in MEMBERS))


def test_the_help_has_a_line_for_each_command_and_fits_a_terminal():
    for words in ((), ("--help",), ("-h",)):
        done = trackwright(*words)
        assert (done.code, done.err) == (0, "")
        lines = done.out.splitlines()
        assert len(lines) <= 40
        assert max(map(len, lines)) <= 80
        about = {line.split()[0]: line.split()[1:] for line in lines if re.match(r"  \w", line)}
        assert list(about) == list(COMMANDS)
        assert all(len(words) > 2 for words in about.values())


@pytest.mark.parametrize("command", EVERY)
def test_the_help_of_each_command_explains_every_argument_in_80_columns(command):
    done = trackwright(*command.split(), "--help")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(f"usage: trackwright {command}")
    assert max(map(len, done.out.splitlines())) <= 80
    app = application()
    for word in command.split():
        app = app[word]
    for argument in app.assemble_argument_collection(parse_docstring=True):
        if argument.show:
            assert argument.parameter.help, argument.name
            assert argument.name in done.out


def test_the_version_is_printed():
    assert trackwright("--version").out == f"trackwright {version('trackwright')}\n"


def test_a_family_of_commands_lists_its_members():
    for words in (("simulate",), ("simulate", "--help")):
        done = trackwright(*words)
        assert done.code == 0
        assert all(f"  {name} " in done.out for name in MEMBERS)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("trak", "x"), "no command trak (did you mean track?)"),
        (("simulate-line",), "did you mean simulate?"),
        (("simulate", "lines"), "simulate: no command lines (did you mean line?)"),
        (("simulate", "walk"), "simulate: no command walk; expected station, line, ranges, tool or agv"),
        (("track", "x", "--out", "o", "--nose", "f"), "no option --nose (did you mean --noise?)"),
        (("track", "x"), "no --out given; expected --out FOLDER, the folder to write to"),
        (("track", "x", "--out", ""), "--out '': expected FOLDER, found an empty name"),
        (("track", "x", "--out", "/"), "--out /: is the root of the file system"),
        (("tune", "x", "--out", "o", "--steps", "0"), "--steps 0: expected at least 1"),
        (("tune", "x", "--out", "o", "--optimiser", "adamm"), "expected auto or lbfgs or adam (did you mean adam?)"),
        (("track", "x", "--out", "o", "--lag", "0"), "--lag 0: expected seconds above zero"),
        (("track", "x", "--out", "o", "--set", "sigma"), "--set sigma: expected NAME=VALUE"),
        (("track", "x", "--out", "o", "--from", "9", "--to", "3"), "--from 9 --to 3: expected the first below"),
        (("track", "x", "--out", "o", "--every", "0"), "--every 0: expected seconds above zero"),
        (("track", "x", "--out", "o", "--noise", "nowhere.toml"), "nowhere.toml: cannot be read"),
        (("evaluate", "a", "b"), "evaluate: found 'b' beyond what it takes"),
        (("sweep", "x", "--out", "o", "--over", "a=0:1:5:log"), "expected START above zero"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_option_before_anything_is_read(words, expected):
    assert_refused(trackwright(*words), expected)


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
        (("simulate", "--help"), 0),
        (("simulate", "line", "--help"), 0),
        (("study", "--help"), 0),
        (("check", "GOOD"), 0),
        (("track", "nowhere", "--out", "out"), 2),
        (("tune", "nowhere", "--out", "out"), 2),
        (("calibrate", "nowhere", "--out", "calibration.toml"), 2),
        (("track", "GOOD"), 2),
    ],
)
def test_help_a_check_and_a_refusal_import_no_jax(beginnings, tmp_path, arguments, code):
    words = [str(beginnings / "good") if word == "GOOD" else word for word in arguments]
    # Help and a wrong argument need neither arrays nor tables.
    heavy = [
        "jax",
        "matplotlib",
        *(["scipy"] if words[0] != "check" else []),  # the phases are random: their errors are looked into
        *(["numpy", "polars"] if "--help" in words or words == ["track", words[1]] else []),
    ]
    program = (
        "import sys\nfrom trackwright.experiments.cli.main import main\n"
        f"sys.argv = ['trackwright', *{words!r}]\n"
        "try: main()\n"
        "except SystemExit as end: assert end.code == int(sys.stdin.read()), end.code\n"
        f"print('heavy:', [name for name in {heavy!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], input=str(code), capture_output=True, text=True, check=True)
    assert done.stdout.endswith("heavy: []\n"), done.stdout


def _started(words, **environment):
    line = [sys.executable, "-m", "trackwright.experiments", *map(str, words)]
    return subprocess.run(line, env={**os.environ, **environment}, capture_output=True, timeout=120, check=False)


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_a_code_page_without_our_characters_gets_plain_ones(beginnings, encoding):
    done = _started(("evaluate", beginnings / "tracked"), PYTHONIOENCODING=encoding)
    assert done.returncode == 0, done.stderr
    assert done.stderr == b""
    assert "---" in done.stdout.decode(encoding)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("words", [("--help",), ("check", "GOOD")])
def test_a_full_output_is_one_line(beginnings, words):
    line = " ".join([sys.executable, "-m", "trackwright.experiments", *words]).replace("GOOD", str(beginnings / "good"))
    done = subprocess.run(f"{line} > /dev/full", shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("trackwright: standard output cannot be written (No space left on device)")
    assert done.stderr.count("\n") == 1


def test_a_device_that_is_not_there_is_one_line(simulated, tmp_path):
    done = _started(("track", simulated, "--tracker", "beam", "--out", tmp_path), JAX_PLATFORMS="cuda")
    assert done.returncode == 2
    assert done.stderr.decode().splitlines()[-1].startswith("trackwright: JAX_PLATFORMS=cuda: no such device here")
    assert b"Traceback" not in done.stderr
