"""The program: its help, its refusals, no more imports than needed, and streams that take no more or not all."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from typing import get_args

import pytest

from tests.in_process import trackwright
from trackwright.experiments.cli import options
from trackwright.experiments.cli.commands import COMMANDS, SECTIONS, application
from trackwright.sim import worlds
from trackwright.trackers.exchange import trajectories
from trackwright.trackers.recordings.folder import write_recording

MEMBERS = ("station", "line", "ranges", "tdoa", "fusion", "body", "tool", "agv")
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
    done, every = (trackwright(*command.split(), flag) for flag in ("--help", "--help-all"))
    assert (done.code, done.err, every.code) == (0, "", 0)
    assert done.out.startswith(f"usage: trackwright {command}")
    assert max(map(len, (done.out + every.out).splitlines())) <= 80
    app = application()
    for word in command.split():
        app = app[word]
    for argument in app.assemble_argument_collection(parse_docstring=True):
        if argument.show:
            assert argument.parameter.help, argument.name
            assert argument.name in done.out
            assert f"\n  {argument.name}" in every.out


def test_every_option_in_a_section_of_help_is_one_of_a_command():
    app = application()
    known = {
        argument.name
        for name in COMMANDS
        if name != "simulate"
        for argument in app[name].assemble_argument_collection()
    }
    assert {f"--{name}" for names in SECTIONS.values() for name in names.split()} <= known


def test_the_version_is_printed():
    assert trackwright("--version").out == f"trackwright {version('trackwright')}\n"


def _imported(lines):
    """The modules that a new process has imported after these lines, which call `run(words…)` for a command."""
    program = (
        "import sys\nfrom trackwright.experiments.cli.main import main\n"
        "def run(*words):\n    sys.argv = ['trackwright', *words]\n"
        "    try: main()\n    except SystemExit as end: return end.code\n"
        f"{lines}\nprint('\\nmodules:', *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("modules:")[2].split())


ARRAYS, ENGINE = {"numpy", "polars", "scipy"}, {"jax", "matplotlib"}


def test_help_lists_and_wrong_words_need_neither_arrays_nor_tables():
    lines = "\n".join(f"assert run(*{[*command.split(), '--help']!r}) == 0" for command in EVERY)
    lines += "\nassert run('--help') == run('trackers') == 0\nassert run('track', 'x') == 2"
    assert not _imported(lines) & {*ARRAYS, *ENGINE}


def test_a_check_an_evaluation_and_a_recording_that_is_not_there_need_no_jax(beginnings, tmp_path):
    good, tracked, out = (repr(str(x)) for x in (beginnings / "good", beginnings / "tracked", tmp_path / "c.toml"))
    lines = f"assert run('check', {good}) == run('evaluate', {tracked}) == 0"
    lines += f"\nassert {{run(name, 'nowhere', '--out', {out}) for name in ('track', 'tune', 'calibrate')}} == {{2}}"
    assert not _imported(lines) & ENGINE


def test_a_track_imports_its_own_system_and_nothing_of_studies_clusters_and_other_formats(tmp_path):
    fixes = worlds.agv(n=1, rows=20).folder()
    write_recording(replace(fixes, rig=replace(fixes.rig, path_knots=None)), tmp_path / "fixes")
    there, out = repr(str(tmp_path / "fixes")), repr(str(tmp_path / "out"))
    ours = {name for name in _imported(f"assert run('track', {there}, '--out', {out}) == 0") if "trackwright." in name}
    others = ("aoa", "line", "uwb_imu", "mhk", "exchange", "baselines.switching", "core.filters.particle")
    places = (*(f"trackers.{name}" for name in others), "sim", "experiments.monte_carlo", "experiments.jobs")
    assert not {name for name in ours if name.startswith(tuple(f"trackwright.{place}." for place in places))}


def _started(words, **environment):
    line = [sys.executable, "-m", "trackwright", *map(str, words)]
    return subprocess.run(line, env={**os.environ, **environment}, capture_output=True, timeout=120, check=False)


def test_a_code_page_without_our_characters_gets_marks_for_them(beginnings):
    done = _started(("evaluate", beginnings / "tracked"), PYTHONIOENCODING="cp1252")
    assert (done.returncode, done.stderr) == (0, b"")
    assert "???" in done.stdout.decode("cp1252")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("words", [("--help",), ("check", "GOOD")])
def test_a_full_output_is_one_line(beginnings, words):
    line = " ".join([sys.executable, "-m", "trackwright", *words]).replace("GOOD", str(beginnings / "good"))
    done = subprocess.run(f"{line} > /dev/full", shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("trackwright: standard output cannot be written (No space left on device)")
    assert done.stderr.count("\n") == 1


def test_a_device_that_is_not_there_is_one_line(simulated, tmp_path):
    done = _started(("track", simulated, "--tracker", "beam", "--out", tmp_path), JAX_PLATFORMS="cuda")
    assert done.returncode == 2
    assert done.stderr.decode().splitlines()[-1].startswith("trackwright: JAX_PLATFORMS=cuda: no such device here")
    assert b"Traceback" not in done.stderr


def test_choices_are_those_of_the_library_which_help_does_not_import():
    assert get_args(options.Alignment) == get_args(trajectories.Alignment)
