"""`track --smooth`, and the events that a run writes."""

from __future__ import annotations

from functools import cache

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, assert_refused, trackwright
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.evaluation.events import events_of, off_the_path
from trackwright.trackers.recordings.folder import read_recording

OPTIONS = {"filtered": (), "smoothed": ("--smooth",), "lagged": ("--lag", 0.5)}


@pytest.fixture(scope="module")
def runs(tmp_path_factory, beginnings):
    """The tracks of one recording, filtered, smoothed, and smoothed with half a second to come; made when asked for."""
    folder = tmp_path_factory.mktemp("smoothed")

    @cache
    def run(name):
        line = ("track", beginnings / "good", "--tracker", "fix-kf", *OPTIONS[name])
        said = trackwright(*line, *PLAIN, "--out", folder / name)
        assert said.code == 0, said
        return pl.read_parquet(folder / name / "tracks.parquet")

    return run


@pytest.mark.parametrize("name", ["smoothed", pytest.param("lagged", marks=pytest.mark.slow)])
def test_smoothed_tracks_have_the_rows_columns_and_likelihoods_of_filtered_ones(runs, name):
    for column in ("t_s", "tag", "nis", "log_likelihood", "status"):
        assert runs(name)[column].equals(runs("filtered")[column])
    assert runs(name).columns == runs("filtered").columns


def test_rows_to_come_make_the_spread_smaller(runs):
    assert runs("filtered")["std_x_m"].mean() > runs("smoothed")["std_x_m"].mean()


@pytest.mark.slow
def test_a_lag_has_a_spread_between_that_of_all_rows_and_that_of_none(runs):
    spread = [runs(name)["std_x_m"].mean() for name in OPTIONS]
    assert spread[0] > spread[2] > spread[1]


def test_the_last_row_has_nothing_to_come(runs):
    assert runs("smoothed")["x_m"][-1] == runs("filtered")["x_m"][-1]


@pytest.mark.parametrize(("extra", "word"), [(("--lag", -1), "lag -1"), (("--smooth",), "Kalman filters")])
def test_what_can_not_be_smoothed_is_refused(tmp_path, simulated, extra, word):
    said = trackwright("track", simulated, "--tracker", "cascade", *extra, "--out", tmp_path / "out")
    assert_refused(said, word)
    assert not (tmp_path / "out").exists()


def test_events_are_the_turns_of_the_status_once_each():
    status = ["waiting", "ok", "ok", "lost", "lost", "restarted", "ok"]
    times = [float(t) for t in range(7)]
    tracks = pl.DataFrame({"tag": ["1"] * 7 + ["2"] * 7, "t_s": times * 2, "x_m": 0.0, "status": status * 2})
    tracks = tracks.with_columns(recording=pl.lit("a"))
    events = events_of(tracks, TRACKERS["bearings"], [])
    assert events.rows() == [
        ("a", tag, t, event, "") for tag in "12" for t, event in ((3.0, "lost"), (5.0, "found again"))
    ]


def test_a_tag_beside_its_prescribed_path_is_told_with_the_distance_and_the_way_back(beginnings):
    folder = read_recording(beginnings / "good")
    trajectory = next(iter(TRACKERS["bearings"].trajectories(folder, False)))
    times = np.arange(0.0, 12.0, 0.1)
    # The path runs along y = 1 m from x = 1 to 5 m; from 4 to 8 s the tag is 0.9 m beside it.
    beside = np.where((times >= 4) & (times < 8), 0.9, 0.0)
    tracks = pl.DataFrame({"t_s": times, "x_m": 1 + times / 3, "y_m": 1 - beside, "std_x_m": 0.05, "std_y_m": 0.05})
    (left, off, far), (back, on, _) = off_the_path(trajectory, tracks)
    assert (off, on) == ("off the prescribed path", "back on the path")
    assert left == pytest.approx(4.0, abs=0.11)
    assert 8.0 < back < 11.0
    assert far == "up to 0.90 m from it"
