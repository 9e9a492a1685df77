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
from trackwright.experiments.cli import tuning_job as tune_command
from trackwright.trackers.core.errors import UnusableInput
from trackwright.tuning.checkpoint import save
from trackwright.tuning.intervals import require_possible
from trackwright.tuning.objectives import NegativeLogLikelihood


def _contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


# recordings that have to be refused


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
    assert said.code == 1
    lines = [line for line in said.err.splitlines() if line.startswith("not tracked: ")]
    assert len(lines) == 1
    assert word in lines[0]
    assert (out / "recordings.txt").read_text().split() == [str(beginnings / "good")]


@pytest.mark.parametrize("command", ["track", "tune"])
def test_two_recordings_of_one_name_are_refused(tmp_path, beginnings, command):
    write_good(tmp_path / "copy")
    said = trackwright(command, beginnings / "good", tmp_path / "copy", "--out", tmp_path / "out")
    assert_refused(said, "both named 'good'", "rename")


@pytest.mark.parametrize("command", ["track", "tune"])
def test_a_recording_given_twice_is_refused(tmp_path, beginnings, command):
    good = beginnings / "good"
    again = good.parent / "." / "tracked" / ".." / "good"
    assert_refused(trackwright(command, good, again, "--out", tmp_path / "out"), "given more than once")


def test_results_are_not_written_into_a_recording_folder(tmp_path, simulated):
    before = _contents(simulated)
    for command in ("track", "tune"):
        said = trackwright(command, simulated, "--tracker", "beam", "--out", simulated)
        assert_refused(said, f"--out {simulated}: is a recording folder")
    assert _contents(simulated) == before


@pytest.mark.parametrize("command", [("track", "--out", "out"), ("tune", "--out", "out"), ("check",)])
def test_an_empty_list_of_recordings_is_refused(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    assert_refused(trackwright(*command), "no RECORDINGS given; expected recording folders")
    assert not list(tmp_path.iterdir())


# recordings with anomalies


# `tests/trackers/recordings/checks/test_check.py` has the notice and the check of each.
@pytest.mark.parametrize("name", ["rows out of order", "unknown tag", "angles in degrees"])
def test_a_recording_with_an_anomaly_is_tracked_with_a_notice_and_reported_by_check(tmp_path, name):
    folder, out = tmp_path / "recording", tmp_path / "out"
    word = ANOMALOUS[name](folder)
    options = ("--tracker", "bearings", "--free-height", "--force", "--no-figures", "--out", out)
    said = trackwright("track", folder, *options)
    assert said.code == 0, said
    assert any(line.startswith(f"notice: {folder}: ") and word in line for line in said.err.splitlines())
    tracks = pl.read_parquet(out / "tracks.parquet")
    assert set(tracks["tag"]) == {"T1", "T2"}
    assert np.isfinite(tracks["x_m"].drop_nulls().to_numpy()).all()
    found = trackwright("check", folder)
    assert word in found.out
    assert found.code == int("error  " in found.out)


def test_tags_with_and_without_reported_standard_deviations_are_tracked_together(tmp_path):
    write_good(tmp_path / "half")
    known = pl.when(pl.col("tag") == "T2").then(0.1)
    table = good_tables()["bearings"].with_columns(azimuth_std_rad=known, elevation_std_rad=known)
    table.write_csv(tmp_path / "half" / "bearings.csv")
    options = ("--tracker", "bearings", "--free-height", *PLAIN, "--out", tmp_path / "out")
    said = trackwright("track", tmp_path / "half", *options)
    assert said.code == 0, said


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


def test_a_fit_that_cannot_begin_says_why(tmp_path, simulated, monkeypatch):
    def nothing_scored(*arguments, **options):
        raise FloatingPointError("the objective is not finite at the start (nan): no row is scored")

    monkeypatch.setattr(tune_command, "fit", nothing_scored)
    options = "--tracker", "beam", "--objective", "nll", "--starts", 1
    said = trackwright("tune", simulated, *options, "--out", tmp_path / "out")
    assert_refused_last(said, "the objective is not finite at the start", "trackwright check")


def test_a_fit_that_ran_away_with_all_recordings_gives_no_numbers(tmp_path, simulated, monkeypatch):
    def ran_away(*arguments, **options):
        return SimpleNamespace(n_excluded=6, value=-34.5)

    monkeypatch.setattr(tune_command, "fit", ran_away)
    options = ("--tracker", "beam", "--objective", "nll", "--starts", 1)
    said = trackwright("tune", simulated, *options, "--out", tmp_path / "out")
    assert_refused(said, "nll -34.5", "no segment of the recordings has finite gradients", "--bound")
    assert not list((tmp_path / "out").iterdir())


def test_intervals_of_too_few_segments_are_refused_before_the_fit():
    with pytest.raises(UnusableInput, match="found 4 segments of recordings, expected 5 or more"):
        require_possible("bootstrap", NegativeLogLikelihood(), 4)
    require_possible("bootstrap", NegativeLogLikelihood(), 5)


def test_unwrapped_phases_are_tracked_with_a_notice(tmp_path):
    ANOMALOUS["phases from 0 to 2 pi"](tmp_path / "recording")
    said = trackwright("track", tmp_path / "recording", "--tracker", "das", *PLAIN, "--out", tmp_path / "out")
    assert said.code == 0
    assert "not wrapped" in said.err
    write_good(tmp_path / "plain")
    trackwright("track", tmp_path / "plain", "--tracker", "das", *PLAIN, "--out", tmp_path / "plain-out")
    unwrapped, plain = (pl.read_parquet(tmp_path / name / "tracks.parquet") for name in ("out", "plain-out"))
    assert unwrapped["azimuth_rad"].equals(plain["azimuth_rad"])


# trackers and tunables


def test_an_unknown_tracker_is_refused_with_the_known_ones(tmp_path, beginnings):
    for command in ("track", "tune"):
        said = trackwright(command, beginnings / "good", "--tracker", "kalman", "--out", tmp_path / "out")
        assert_refused(said, "tracker kalman: unknown", "direct, cascade, beam, das")
    for command, name, words in (
        ("track", "MHK", "tracker MHK: unknown (did you mean mhk?)"),
        ("track", "mhk,", "--tracker mhk,: a name is empty; expected names with commas, without blanks"),
        ("tune", "mhk,imm", "tracker mhk,imm: found 2 names; expected one; `track` compares several"),
    ):
        said = trackwright(command, beginnings / "good", "--tracker", name, "--out", tmp_path / "out")
        assert_refused(said, words)


def test_a_tracker_without_its_table_is_refused(tmp_path, simulated):
    said = trackwright("track", simulated, "--tracker", "bearings", "--out", tmp_path / "out")
    assert_refused(said, str(simulated), "'bearings' needs a bearings table", "phases, truth")


def test_a_recording_that_no_tracker_fits_is_refused(tmp_path):
    write_good(tmp_path / "imu")
    for name in ("bearings", "phases", "fixes", "ranges"):
        (tmp_path / "imu" / f"{name}.csv").unlink()
    said = trackwright("track", tmp_path / "imu", "--out", tmp_path / "out")
    assert_refused(said, "no tracker fits; all need one of the tables bearings, fixes, phases, ranges", "imu, truth")


TUNED = {
    "missing file": (None, "cannot be read"),
    "empty": ("", "found no [tunables]"),
    "not TOML": ("[tunables", "is not valid TOML"),
    "binary": (b"\xff\xfe\x00" * 9, "is not valid TOML"),
    "another TOML": ("[project]\nname = 'x'\n", "found no [tunables]"),
    "tunables not a table": ("tunables = 3\n", "found no [tunables]"),
    "entry not a table": ('[tunables]\n"motion.sigma_a" = 0.3\n', "motion.sigma_a.value = None"),
    "value missing": ('[tunables."motion.sigma_a"]\nunit = "rad/s^2"\n', "motion.sigma_a.value = None"),
    "value NaN": ('[tunables."motion.sigma_a"]\nvalue = nan\n', "motion.sigma_a.value = nan"),
    "value infinite": ('[tunables."motion.sigma_a"]\nvalue = inf\n', "motion.sigma_a.value = inf"),
    "value a text": ('[tunables."motion.sigma_a"]\nvalue = "0.3"\n', "motion.sigma_a.value = '0.3'"),
    "value a truth": ('[tunables."motion.sigma_a"]\nvalue = true\n', "motion.sigma_a.value = True"),
    "value a date": ('[tunables."motion.sigma_a"]\nvalue = 2020-01-01\n', "motion.sigma_a.value ="),
    "value beyond all numbers": (f'[tunables."motion.sigma_a"]\nvalue = {10**400}\n', "motion.sigma_a.value = 1000"),
    "ragged list": ('[tunables."motion.sigma_a"]\nvalue = [1.0, [2.0]]\n', "motion.sigma_a.value = [1.0, [2.0]]"),
    "negative sigma": ('[tunables."motion.sigma_a"]\nvalue = -0.3\n', "is positive and finite, found -0.3"),
    "zero sigma": ('[tunables."sensors.*.sigma_p"]\nvalue = 0\n', "is positive and finite, found 0"),
    "unknown tunable": ('[tunables."motion.sigma_q"]\nvalue = 0.3\n', "this tracker has no 'motion.sigma_q'"),
    "list for a number": ('[tunables."motion.sigma_a"]\nvalue = [0.3, 0.4]\n', "has 2 numbers, separated by commas"),
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


@pytest.mark.parametrize(
    ("patterns", "word"),
    [
        (
            ("motion.sigma_q",),
            "'motion.sigma_q' matches no tunable (did you mean motion.sigma_a?); this tracker has: motion.sigma_a",
        ),
        (("motion.*", "tied:nothing.*"), "'nothing.*' matches no tunable"),
        (("tied:*",), "ties tunables of different units or shapes"),
        ((), "found nothing"),
    ],
)
def test_patterns_that_name_nothing_are_refused(tmp_path, simulated, patterns, word):
    said = trackwright("tune", simulated, "--tracker", "beam", "--out", tmp_path / "out", "--tune", *patterns)
    assert_refused(said, "--tune", word)
    assert not (tmp_path / "out").exists()


def test_a_tracker_without_tunables_cannot_be_tuned(tmp_path, simulated):
    said = trackwright("tune", simulated, "--tracker", "das", "--out", tmp_path / "out")
    assert_refused(said, "no noise level of motion or sensors to tune", "it has: no tunable")


def test_the_least_error_cannot_be_found_without_truth(tmp_path, simulated):
    blind = tmp_path / "blind"
    blind.mkdir()
    for name in ("rig.toml", "phases.parquet"):
        (blind / name).write_bytes((simulated / name).read_bytes())
    said = trackwright("tune", blind, "--tracker", "beam", "--objective", "rmse", "--out", tmp_path / "out")
    assert_refused(said, "objective rmse needs truth", "nll")
    assert not (tmp_path / "out").exists()


def test_tags_of_known_and_of_unknown_height_are_not_tuned_together(tmp_path, beginnings):
    said = trackwright("tune", beginnings / "good", "--tracker", "bearings", "--out", tmp_path / "out")
    assert_refused(said, "2 different 'bearings' trackers", "free_height")


# numbers on the command line


@pytest.mark.parametrize("antenna", [(1, 0), (1, 9), (7, 1)])
def test_an_antenna_that_is_not_there_cannot_be_masked(tmp_path, antenna):
    said = trackwright("simulate", "station", "--out", tmp_path / "out", "--masked-antenna", *antenna)
    assert_refused(said, "--masked-antenna")


def test_a_world_is_not_written_over_something(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious").write_text("x")
    assert_refused(
        trackwright("simulate", "station", "--out", tmp_path / "out", "--n", 1, "--rows", 2), "folder is not empty"
    )
    assert _contents(tmp_path / "out") == {"precious": b"x"}


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--bound", "motion.sigma_a=low:high"), "PATTERN=LOWEST:HIGHEST"),
        (("--bound", "nothing.*=1:2"), "no tuned number matches"),
        (("--bound", "motion.sigma_a=2:1"), "is not below"),
        (("--bound", "motion.sigma_a=100:200"), "motion.sigma_a begins outside, at "),
        (("--bound", "motion.sigma_a=0.01:2", "motion.sigma_a=0.1:1"), "duplicate bound"),
        (("--intervals", "profile", "--objective", "rmse"), "a profile is of a likelihood"),
        (("--prior", "motion.sigma_a=often"), "is no prior"),
        (("--prior", "nothing.*=0.2x2"), "matches nothing that is tuned"),
        (("--prior", "motion.sigma_a=0.2x2", "--objective", "rmse"), "weighed against a likelihood"),
        (("--freeze", "*"), "nothing to tune"),
        (("--objective", "nll+best"), "is no objective"),
    ],
)
def test_options_of_a_fit_that_nothing_can_follow_are_refused(tmp_path, simulated, options, word):
    said = trackwright("tune", simulated, "--tracker", "beam", *options, "--out", tmp_path / "out")
    assert_refused(said, options[0].removeprefix("--"), word)
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
    assert_refused(said, "checkpoint.npz", "anew")
    assert (out / "checkpoint.npz").read_bytes() == before
