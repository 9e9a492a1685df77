"""Bad input for the trackers of ranges, through the command line: refused in one line, or tracked with a notice."""

from __future__ import annotations

from itertools import cycle

import numpy as np
import polars as pl
import pytest

from tests.faulty import then, with_table
from tests.in_process import PLAIN, assert_refused, assert_refused_last, trackwright

TRACKERS = ("uwb", "multilateration")


def _one_line(folder):
    rig = (folder / "rig.toml").read_text()
    for old, new in (("[6.0, 5.0, 0.4]", "[3.0, 0.01, 0.4]"), ("[0.0, 5.0, 2.9]", "[9.0, 0.0, 2.9]")):
        assert old in rig
        rig = rig.replace(old, new)
    (folder / "rig.toml").write_text(rig)
    return ""


def _one_place(folder):
    rig = (folder / "rig.toml").read_text()
    for place in ("[6.0, 0.0, 2.6]", "[6.0, 5.0, 0.4]", "[0.0, 5.0, 2.9]"):
        assert place in rig
        rig = rig.replace(place, "[0.0, 0.0, 0.3]")
    (folder / "rig.toml").write_text(rig)
    return ""


def _ranges(change):
    return with_table("ranges", change)


REFUSED = {
    "two anchors": (_ranges(lambda t: t.filter(pl.col("anchor").is_in(["A1", "A2"]))), "at least 3 anchors"),
    "three anchors and no height": (
        _ranges(lambda t: t.filter((pl.col("anchor") != "A4") & (pl.col("tag") == "T2"))),
        "4 where rig.toml gives it no height_m",
    ),
    "anchors on one line": (then(_one_line), "on one line"),
    "negative ranges alone": (_ranges(lambda t: t.with_columns(range_m=-pl.col("range_m"))), "found 0 at most"),
    "millimetres": (_ranges(lambda t: t.with_columns(range_m=1000.0 * pl.col("range_m"))), "millimetres?"),
    "no value at all": (_ranges(lambda t: t.with_columns(range_m=pl.lit(None, pl.Float64))), "found 0 at most"),
    "zeros": (_ranges(lambda t: t.with_columns(range_m=pl.lit(0.0))), "found 0 at most"),
    "one row": (_ranges(lambda t: t.head(1)), "found 1 at most"),
    "anchors at one place": (then(_one_place), "at one place"),
}


@pytest.mark.parametrize(("name", "tracker"), [*zip(REFUSED, cycle(TRACKERS))])
def test_unusable_ranges_are_refused_in_one_line(tmp_path, name, tracker):
    build, word = REFUSED[name]
    build(tmp_path / "recording")
    said = trackwright("track", tmp_path / "recording", "--tracker", tracker, "--force", "--out", tmp_path / "out")
    # Notices of anomalies come first, one line each, so do the errors of `check`, and progress on a busy machine.
    lines = said.err.splitlines(keepends=True)
    last = said._replace(err="".join(x for x in lines if not x.startswith(("notice: ", "track: "))))
    assert_refused(last, str(tmp_path / "recording"), f"tracker '{tracker}' needs", word)
    assert not (tmp_path / "out").exists()


def test_where_no_tracker_fits_the_nearest_and_what_it_lacks_are_named(tmp_path):
    build, word = REFUSED["two anchors"]
    folder = tmp_path / "recording"
    build(folder)
    for table in folder.glob("*.*"):
        if not table.name.startswith(("rig", "ranges")):
            table.unlink()
    rig = folder / "rig.toml"
    rig.write_text(rig.read_text().partition("[path]")[0])
    said = trackwright("track", folder, "--force", "--out", tmp_path / "out")
    last = said._replace(err="".join(x for x in said.err.splitlines(keepends=True) if not x.startswith("notice: ")))
    assert_refused(last, f"{folder}: no tracker fits; the nearest, 'uwb', needs ", word)
    build, word = REFUSED["no value at all"]
    build(tmp_path / "empty")
    for table in (tmp_path / "empty").glob("*.csv"):
        if table.name not in ("ranges.csv", "truth.csv"):
            table.unlink()
    said = trackwright("track", tmp_path / "empty", "--out", tmp_path / "out")
    assert_refused_last(said, "no tracker fits; the nearest, 'uwb', needs ", word)


def test_errors_of_the_check_stop_the_command_before_anything_is_written(tmp_path):
    folder = tmp_path / "recording"
    _ranges(lambda t: t.with_columns(range_m=pl.col("range_m") / 0.3048))(folder)
    assert_refused(trackwright("track", folder, "--out", tmp_path / "out"), "ranges are feet", "--force")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_errors_of_the_check_stop_whatever_is_fitted_to_a_recording(tmp_path):
    metres = pl.col("range_m")
    for name, changed in (("feet", metres / 0.3048), ("millimetres", 1000.0 * metres), ("late", metres + 3.0)):
        _ranges(lambda t, changed=changed: t.with_columns(range_m=changed))(tmp_path / name)
    few = ("--tracker", "uwb", "--tune", "sensors.ranges.sigma_r", "--steps", 1, "--starts", 1, *PLAIN)
    out = tmp_path / "out"
    for words in (
        ("tune", tmp_path / "feet", *few, "--out", out),
        ("tune", tmp_path / "late", *few, "--out", out),
        ("calibrate", tmp_path / "feet", "--out", out / "c.toml"),
        ("survey", tmp_path / "millimetres", "--out", out / "rig.toml"),
    ):
        said = trackwright(*words)
        assert_refused_last(said, f"{words[1]}: ranges: ")
        assert ("; --force takes it as it is" in said.err) == (words[0] != "tune")
    assert not [*out.glob("*")]
    # An antenna delay is what a calibration removes.
    said = trackwright("calibrate", tmp_path / "late", "--out", out / "c.toml")
    assert said.code == 0, said.err
    forced = trackwright("calibrate", tmp_path / "feet", "--force", "--out", out / "feet.toml")
    assert (forced.code, "ranges are feet" in forced.err) == (0, True), forced.err


def _outlying(table):
    """One range in twenty is negative, another one is kilometres long."""
    row = pl.int_range(pl.len())
    spoiled = pl.when(row % 20 == 7).then(-3.0).when(row % 20 == 13).then(4321.0).otherwise(pl.col("range_m"))
    return table.with_columns(range_m=spoiled)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """Notices of outlying ranges and of a tag without measurements, and the tracks; by the tracker's name."""
    folder = tmp_path_factory.mktemp("outlying-ranges")
    _ranges(_outlying)(folder / "recording")
    rig = folder / "recording" / "rig.toml"
    rig.write_text(rig.read_text().replace("[path]", "[tags.T9]\nheight_m = 1.0\n\n[path]"))
    found = {}
    for tracker in TRACKERS:
        said = trackwright("track", folder / "recording", "--tracker", tracker, *PLAIN, "--out", folder / tracker)
        assert said.code == 0, said
        found[tracker] = said.err, pl.read_parquet(folder / tracker / "tracks.parquet")
    truth = pl.read_csv(folder / "recording" / "truth.csv")
    return found, truth


def test_negative_ranges_and_kilometres_are_reported(tracked):
    for said, _ in tracked[0].values():
        assert "ranges: negative values of range_m: 20" in said
        assert "ranges: outliers of range_m" in said


@pytest.mark.parametrize("tracker", TRACKERS)
def test_negative_ranges_and_kilometres_move_no_track(tracked, tracker):
    tracks = tracked[0][tracker][1].filter(pl.col("tag") == "T1").join(tracked[1], on=["tag", "t_s"], suffix="_true")
    errors = np.hypot(tracks["x_m"] - tracks["x_m_true"], tracks["y_m"] - tracks["y_m_true"]).drop_nulls().to_numpy()
    # Four anchors, 3 cm of noise, a tag at 1 m/s; a row with one outlier of four ranges is the worst.
    assert len(errors) > 40
    assert np.sqrt(np.mean(errors[10:] ** 2)) < 0.3
    assert errors.max() < 2.0


def test_a_tag_observed_by_too_few_anchors_waits_while_the_other_is_tracked(tmp_path):
    few = (pl.col("tag") == "T1") | pl.col("anchor").is_in(["A1", "A2", "A3"])
    _ranges(lambda t: t.filter(few))(tmp_path / "recording")
    said = trackwright("track", tmp_path / "recording", "--tracker", "uwb", *PLAIN, "--out", tmp_path / "out")
    assert said.code == 0
    assert "1 ok" in said.out + said.err
    assert "too little data" in said.out + said.err
