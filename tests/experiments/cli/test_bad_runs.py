"""Runs that cannot be evaluated or written: exit code 2, one line, older files unchanged."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest

from tests.faulty import good_tables, write_good
from tests.in_process import assert_refused, trackwright
from trackwright.experiments.cli import console
from trackwright.trackers.recordings import folder


def _contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda truth: truth.with_columns(pl.col("t_s") + 100.0), "no estimate lies inside a truth"),
        (lambda truth: truth.with_columns(x_m=pl.lit(None)), "no estimate lies inside a truth"),
    ],
)
def test_truth_without_an_estimate_inside_is_refused(tmp_path, beginnings, change, word):
    write_good(tmp_path / "other")
    change(good_tables()["truth"]).write_csv(tmp_path / "other" / "truth.csv")
    assert_refused(trackwright("evaluate", beginnings / "tracked", "--truth", tmp_path / "other"), word)


@pytest.fixture
def tracked_before(tmp_path, simulated):
    """A run folder with an older run in it."""
    assert trackwright("track", simulated, "--tracker", "das", "--out", tmp_path / "out").code == 0
    (tmp_path / "out" / "tracks.parquet").write_bytes(b"older")
    return tmp_path / "out"


def _full(*arguments):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("kilobytes", [1, 12])
def test_a_disk_that_fills_while_a_file_is_written_spoils_no_older_file(tracked_before, simulated, kilobytes):
    """The system refuses whatever grows beyond a limit: the table of tracks, or only a picture."""
    before, usual = _contents(tracked_before), resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * kilobytes, usual[1]))
    try:
        said = trackwright("track", simulated, "--tracker", "das", "--out", tracked_before)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        signal.signal(signal.SIGXFSZ, handler)
    assert said.code == 2
    assert said.err.startswith("trackwright: cannot write ")
    assert said.err.count("\n") == 1
    after = _contents(tracked_before)
    assert set(after) == set(before)
    # every file is the older one or a whole new one
    assert after["tracks.parquet"] == b"older" or pl.read_parquet(tracked_before / "tracks.parquet").height == 60
    assert all(after[name].endswith(b"IEND\xaeB`\x82") for name in after if name.endswith(".png"))


def test_a_disk_that_is_full_for_a_simulation_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "rename", _full)
    said = trackwright("simulate", "station", "--out", tmp_path / "out", "--n", 1, "--rows", 2)
    assert_refused(said, f"{tmp_path / 'out'}: cannot be written (No space left on device), nothing was kept")
    assert not list(tmp_path.iterdir())


def test_an_interrupted_command_prints_one_line(beginnings, monkeypatch):
    def interrupted(path):
        raise KeyboardInterrupt

    monkeypatch.setattr(folder, "read_recording", interrupted)
    said = trackwright("check", beginnings / "good")
    assert (said.code, said.out) == (130, "")
    assert said.err == "trackwright: interrupted; files already written are complete\n"


def test_a_closed_pipe_causes_no_traceback():
    pipe = f"{sys.executable} -m trackwright --help | true; echo ${{PIPESTATUS[0]}}"
    run = subprocess.run(["bash", "-c", pipe], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("141\n", "")


def test_a_fault_of_the_program_is_not_called_bad_input(beginnings, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(console, "read_recordings", broken)
    with pytest.raises(ZeroDivisionError):
        trackwright("track", beginnings / "good", "--out", beginnings / "never")
