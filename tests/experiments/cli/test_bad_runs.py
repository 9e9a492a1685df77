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
from trackwright.trackers.recordings import atomic, folder


def _contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


# evaluation


def test_an_invalid_condition_is_refused(beginnings):
    said = trackwright("evaluate", beginnings / "tracked", "--fail-if", "p95 > 0.5")
    assert_refused(said, "trackwright: --fail-if", "no metric 'p95'")


@pytest.mark.parametrize("seconds", ["nan", "inf", "0", "-1"])
def test_an_invalid_interval_is_refused(beginnings, seconds):
    assert_refused(trackwright("evaluate", beginnings / "tracked", f"--every={seconds}"), "--every")


def _junk(folder):
    (folder / "tracks.parquet").write_bytes(bytes(range(256)))


def _no_rows(folder):
    pl.read_parquet(folder / "tracks.parquet").clear().write_parquet(folder / "tracks.parquet")


def _no_times(folder):
    pl.read_parquet(folder / "tracks.parquet").drop("t_s").write_parquet(folder / "tracks.parquet")


def _no_positions(folder):
    pl.read_parquet(folder / "tracks.parquet").drop("x_m").write_parquet(folder / "tracks.parquet")


def _nothing(folder):
    (folder / "tracks.parquet").write_bytes(b"")


def _no_sources(folder):
    (folder / "recordings.txt").unlink()


def _empty_sources(folder):
    (folder / "recordings.txt").write_text("\n")


def _junk_sources(folder):
    (folder / "recordings.txt").write_bytes(b"\xff\xfe\x80")


def _lost_sources(folder):
    (folder / "recordings.txt").write_text(str(folder / "gone"))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (_junk, "is not a complete Parquet file"),
        (_no_rows, "the table is empty"),
        (_no_times, "no column t_s"),
        (_no_positions, "tracks.parquet: no column x_m; expected the table of `trackwright track`; run it again"),
        (_nothing, "tracks.parquet: has 0 bytes; expected the table of `trackwright track`; run it again"),
        (_no_sources, "names no recording"),
        (_empty_sources, "names no recording"),
        (_junk_sources, "names no recording"),
        (_lost_sources, "gone does not exist; expected the recordings there; give --truth RECORDING"),
    ],
)
def test_a_run_folder_that_is_broken_is_refused(tmp_path, beginnings, change, word):
    for name, content in _contents(beginnings / "tracked").items():
        (tmp_path / name).write_bytes(content)
    change(tmp_path)
    before = _contents(tmp_path)
    assert_refused(trackwright("evaluate", tmp_path), word)
    assert_refused(trackwright("evaluate", tmp_path, "--from", "1"), word)
    assert _contents(tmp_path) == before


@pytest.mark.parametrize(
    ("folder", "words"),
    [
        ("good", "tracks.parquet: no such file"),
        ("nowhere", "nowhere: no such file; expected a folder with tracks.parquet"),
    ],
)
def test_a_folder_without_tracks_is_refused(beginnings, folder, words):
    assert_refused(trackwright("evaluate", beginnings / folder), words, "track")


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


def test_the_truth_of_another_recording_is_refused(beginnings, simulated):
    said = trackwright("evaluate", beginnings / "tracked", "--truth", simulated)
    assert_refused(said, "the tracks are of recording good, the truth is of simulated-hand-0")


def test_a_recording_without_truth_is_refused_as_truth(tmp_path, beginnings):
    write_good(tmp_path / "blind")
    (tmp_path / "blind" / "truth.csv").unlink()
    said = trackwright("evaluate", beginnings / "tracked", "--truth", tmp_path / "blind")
    assert_refused(said, str(tmp_path / "blind"), "no truth table")


# where it is written to


@pytest.mark.parametrize("command", ["track", "tune"])
def test_an_output_that_is_a_file_is_refused_and_kept(tmp_path, simulated, command):
    (tmp_path / "out").write_text("precious")
    said = trackwright(command, simulated, "--tracker", "beam", "--out", tmp_path / "out")
    assert_refused(said, f"--out {tmp_path / 'out'}", "choose another folder")
    assert (tmp_path / "out").read_text() == "precious"


@pytest.fixture
def tracked_before(tmp_path, simulated):
    """A run folder with an older run in it."""
    assert trackwright("track", simulated, "--tracker", "das", "--out", tmp_path / "out").code == 0
    (tmp_path / "out" / "tracks.parquet").write_bytes(b"older")
    return tmp_path / "out"


def _full(*arguments):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_disk_that_is_full_when_a_file_gets_its_name_spoils_no_older_file(tracked_before, simulated, monkeypatch):
    before = _contents(tracked_before)
    monkeypatch.setattr(atomic.os, "replace", _full)
    said = trackwright("track", simulated, "--tracker", "das", "--out", tracked_before)
    assert_refused(said, "cannot write", "tracks.parquet: No space left on device", "choose another folder")
    assert _contents(tracked_before) == before


@pytest.mark.parametrize("kilobytes", [1, 4, 12])
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
    pipe = f"{sys.executable} -m trackwright.experiments --help | true; echo ${{PIPESTATUS[0]}}"
    run = subprocess.run(["bash", "-c", pipe], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("141\n", "")


def test_a_fault_of_the_program_is_not_called_bad_input(beginnings, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(console, "read_recordings", broken)
    with pytest.raises(ZeroDivisionError):
        trackwright("track", beginnings / "good", "--out", beginnings / "never")
