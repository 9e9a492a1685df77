"""The program: its help, no more imports than needed, and streams, disks and workers that take no more."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from typing import get_args, get_type_hints

import polars as pl
import pytest

from tests.in_process import trackwright
from trackwright.experiments.cli import console, options
from trackwright.experiments.cli.main import COMMANDS, application
from trackwright.sim import worlds
from trackwright.trackers.exchange import trajectories
from trackwright.trackers.recordings import folder
from trackwright.trackers.recordings.folder import write_recording

MEMBERS = ("station", "line", "ranges", "tdoa", "fusion", "body", "tool", "agv")
EVERY = (*(name for name in COMMANDS if name != "simulate"), *(f"simulate {name}" for name in MEMBERS))
MOST_OPTIONS, MOST_SHOWN = 103, 16


def test_the_help_lists_the_commands_and_the_version_is_printed():
    for words in ((), ("--help",), ("-h",)):
        done = trackwright(*words)
        assert (done.code, done.err) == (0, "")
        about = re.findall(r"^│ (\w+) +(\S+ .*\w.*)│$", done.out, re.MULTILINE)
        assert [name for name, _ in about] == list(COMMANDS)
    assert trackwright("--version").out == f"trackwright {version('trackwright')}\n"


def _arguments(command):
    app = application()
    for word in command.split():
        app = app[word]
    return app.assemble_argument_collection(parse_docstring=True)


@pytest.mark.parametrize("command", EVERY)
def test_the_help_of_each_command_explains_every_argument(command):
    done = trackwright(*command.split(), "--help")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(f"Usage: trackwright {command}")
    assert max(map(len, done.out.splitlines())) <= 80
    assert command != "import" or "nsecs*1e-9" in done.out  # no mark of emphasis
    for argument in _arguments(command):
        if argument.children:
            continue
        assert argument.parameter.help, argument.name
        assert bool(re.search(rf"^│ [* ]*{re.escape(argument.name)} ", done.out, re.MULTILINE)) == argument.show


def test_options_are_few_grouped_and_the_rare_ones_are_shown_by_help_all_alone():
    ours = [x.name for command in EVERY if " " not in command for x in _arguments(command) if not x.children]
    assert len([name for name in ours if name.startswith("--")]) <= MOST_OPTIONS
    own = trackwright("track", "--help").out
    assert len(re.findall(r"^│ [* ]* --", own, re.MULTILINE)) <= MOST_SHOWN
    assert re.findall(r"^╭─ (.*?) ─", own, re.MULTILINE) == ["Arguments", "Input", "Tracker", "Output", "Running"]
    line = [sys.executable, "-m", "trackwright", "track", "--help-all"]
    assert "--free-height" in subprocess.run(line, capture_output=True, text=True, check=True).stdout


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


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize(("end", "code"), [("> /dev/full", 2), ("| true; exit ${PIPESTATUS[0]}", 1)])
def test_an_output_that_takes_no_more_is_a_line_or_none(end, code):
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m trackwright --help {end}"], capture_output=True, text=True, check=False
    )
    assert done.returncode == code
    full = "trackwright: standard output cannot be written (No space left on device)\n"
    assert done.stderr == (full if code == 2 else "")


def test_choices_are_those_of_the_library_which_help_does_not_import():
    given = get_type_hints(options.EvaluateOptions)["align"]
    assert get_args(get_args(given)[0]) == get_args(trajectories.Alignment)


@pytest.mark.parametrize("kilobytes", [1, 12])
def test_a_disk_that_fills_while_a_file_is_written_spoils_no_older_file(tmp_path, simulated, kilobytes):
    """The system refuses whatever grows beyond a limit: the table of tracks, or only the page."""
    out, usual = tmp_path / "out", resource.getrlimit(resource.RLIMIT_FSIZE)
    assert trackwright("track", simulated, "--tracker", "das", "--out", out).code == 0
    (out / "tracks.parquet").write_bytes(b"older")
    before = {path.name for path in out.iterdir()}
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * kilobytes, usual[1]))
    try:
        said = trackwright("track", simulated, "--tracker", "das", "--out", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        signal.signal(signal.SIGXFSZ, handler)
    assert said.code == 2
    assert said.err.startswith("trackwright: cannot write ")
    assert said.err.count("\n") == 1
    assert {path.name for path in out.iterdir()} == before
    table = out / "tracks.parquet"
    assert table.read_bytes() == b"older" or pl.read_parquet(table).height == 60


def _raising(error):
    def raises(*arguments):
        raise error

    return raises


def test_an_interrupted_command_prints_one_line_and_a_fault_of_the_program_is_no_bad_input(beginnings, monkeypatch):
    monkeypatch.setattr(folder, "read_recording", _raising(KeyboardInterrupt))
    said = trackwright("check", beginnings / "good")
    assert (said.code, said.out) == (130, "")
    assert said.err == "trackwright: interrupted; files already written are complete\n"
    monkeypatch.setattr(console, "read_recordings", _raising(ZeroDivisionError("a bug")))
    with pytest.raises(ZeroDivisionError):
        trackwright("track", beginnings / "good", "--out", beginnings / "never")
