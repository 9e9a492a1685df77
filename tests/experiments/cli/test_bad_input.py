"""Bad input through the command line: exit code 2, one line, no traceback, nothing half-written."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from tests.broken import ANOMALOUS, BROKEN
from tests.faulty import good_tables, write_good
from tests.in_process import PLAIN, assert_refused, assert_refused_last, trackwright
from trackwright.experiments.jobs import fits
from trackwright.tuning.checkpoint import save


def _contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


# All commands read with `read_recording`, with which tests/trackers/recordings tries each of BROKEN.
@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("folder does not exist", "track"),
        ("rig broken TOML", "check"),
        ("truncated Parquet", "tune"),
        ("text in a number", "evaluate"),
    ],
)
def test_a_broken_recording_is_refused_in_one_line(tmp_path, beginnings, name, command):
    word, out = BROKEN[name](tmp_path / "recording"), tmp_path / "out"
    arguments = {
        "track": ("track", tmp_path / "recording", "--out", out),
        "check": ("check", tmp_path / "recording"),
        "tune": ("tune", tmp_path / "recording", "--out", out),
        "evaluate": ("evaluate", beginnings / "tracked", "--truth", tmp_path / "recording"),
    }
    before = _contents(beginnings / "tracked")
    assert_refused(trackwright(*arguments[command]), word)
    assert not out.exists()
    assert _contents(beginnings / "tracked") == before


def test_a_broken_recording_beside_a_good_one_has_its_own_line_and_the_good_one_is_tracked(tmp_path, beginnings):
    word = BROKEN["infinite value"](tmp_path / "bad")
    out = tmp_path / "out"
    options = ("--tracker", "moving-average", *PLAIN, "--out", out)
    said = trackwright("track", beginnings / "good", tmp_path / "bad", *options)
    assert said.code == 3
    lines = [line for line in said.err.splitlines() if line.startswith("not tracked: ")]
    assert len(lines) == 1
    assert word in lines[0]
    assert (out / "recordings.txt").read_text().split() == [str(beginnings / "good")]


NEXT_TO_NOTHING = {
    "one row": lambda table: table[:1],
    "one time": lambda table: table.filter(pl.col("t_s") == 0),
    "not a value": lambda table: table.with_columns(pl.col("^phase_.*$") * None),
}


@pytest.mark.parametrize("name", NEXT_TO_NOTHING)
def test_a_recording_with_next_to_nothing_in_it_is_tracked(tmp_path, name):
    write_good(tmp_path / "recording")
    NEXT_TO_NOTHING[name](good_tables()["phases"]).write_csv(tmp_path / "recording" / "phases.csv")
    said = trackwright("track", tmp_path / "recording", "--tracker", "das", "--out", tmp_path / "out")
    assert said.code == 0, said
    assert (tmp_path / "out" / "manifest.json").exists()
    if name == "not a value":
        assert "4 tracks: 4 too little data" in said.out
        assert "notice: not evaluated: " in said.err
        assert pl.read_parquet(tmp_path / "out" / "tracks.parquet")["azimuth_rad"].null_count() == 200


def test_a_fit_that_ran_away_with_all_recordings_gives_no_numbers(tmp_path, simulated, monkeypatch):
    def ran_away(*arguments, **options):
        return SimpleNamespace(n_excluded=6, value=-34.5)

    monkeypatch.setattr(fits, "fit", ran_away)
    options = ("--tracker", "beam", "--objective", "nll", "--starts", 1)
    said = trackwright("tune", simulated, *options, "--out", tmp_path / "out")
    assert_refused(said, "nll -34.5", "no segment has finite gradients", "--bound")
    assert not list((tmp_path / "out").iterdir())


def test_unwrapped_phases_are_tracked_with_a_notice(tmp_path):
    ANOMALOUS["phases from 0 to 2 pi"](tmp_path / "recording")
    said = trackwright("track", tmp_path / "recording", "--tracker", "das", *PLAIN, "--out", tmp_path / "out")
    assert said.code == 0
    assert "not wrapped" in said.err
    write_good(tmp_path / "plain")
    trackwright("track", tmp_path / "plain", "--tracker", "das", *PLAIN, "--out", tmp_path / "plain-out")
    unwrapped, plain = (pl.read_parquet(tmp_path / name / "tracks.parquet") for name in ("out", "plain-out"))
    assert unwrapped["azimuth_rad"].equals(plain["azimuth_rad"])


def test_a_recording_that_no_tracker_fits_is_refused(tmp_path):
    write_good(tmp_path / "imu")
    for name in ("bearings", "phases", "fixes", "ranges"):
        (tmp_path / "imu" / f"{name}.csv").unlink()
    said = trackwright("track", tmp_path / "imu", "--out", tmp_path / "out")
    assert_refused(said, "no tracker fits; all need one of the tables bearings, fixes, phases, ranges", "imu, truth")


TUNED = {
    "missing file": (None, "cannot be read"),
    "empty": ("", "tunables is missing"),
    "not TOML": ("[tunables", "is not valid TOML"),
    "entry not a table": ('[tunables]\n"motion.sigma_a" = 0.3\n', "motion.sigma_a = 0.3, expected a table"),
    "value NaN": ('[tunables."motion.sigma_a"]\nvalue = nan\n', "motion.sigma_a.value = nan"),
    "value a text": ('[tunables."motion.sigma_a"]\nvalue = "0.3"\n', "motion.sigma_a.value = '0.3'"),
    "value beyond all numbers": (f'[tunables."motion.sigma_a"]\nvalue = {10**400}\n', "motion.sigma_a.value = 1000"),
    "ragged list": ('[tunables."motion.sigma_a"]\nvalue = [1.0, [2.0]]\n', "motion.sigma_a.value = [1.0, [2.0]]"),
    "negative sigma": ('[tunables."motion.sigma_a"]\nvalue = -0.3\n', "is positive and finite, found -0.3"),
    "unknown tunable": ('[tunables."motion.sigma_q"]\nvalue = 0.3\n', "this tracker has no 'motion.sigma_q'"),
    "number for a list": ('[tunables."sensors.*.offsets"]\nvalue = 0.1\n', "has shape ()"),
    "another unit": (
        '[tunables."motion.sigma_a"]\nvalue = 3e2\nunit = "mm/s^2"\n',
        "unit 'mm/s^2', expected 'rad/s^2'",
    ),
    "list too short": ('[tunables."sensors.*.offsets"]\nvalue = [0.1, 0.2]\n', "has shape (2,)"),
}


@pytest.mark.parametrize(("name", "option"), [*zip(TUNED, cycle(("--noise", "--start")))])
def test_broken_noise_levels_are_refused(tmp_path, simulated, name, option):
    content, word = TUNED[name]
    file = tmp_path / "tuned.toml"
    if content is not None:
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
    command = "track" if option == "--noise" else "tune"
    said = trackwright(command, simulated, "--tracker", "beam", option, file, "--out", tmp_path / "out")
    assert_refused(said, str(file), word)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("broken", [b"", b"no archive", None])
def test_a_checkpoint_of_something_else_is_refused_and_kept(tmp_path, simulated, broken):
    out = tmp_path / "out"
    out.mkdir()
    if broken is None:
        save(out, [np.zeros(2)], "another fit")
    else:
        (out / "checkpoint.npz").write_bytes(broken)
    before = (out / "checkpoint.npz").read_bytes()
    said = trackwright("tune", simulated, "--tracker", "beam", "--resume", "--out", out)
    assert_refused_last(said, "checkpoint.npz", "anew")
    assert (out / "checkpoint.npz").read_bytes() == before
