"""`track --smooth`, and the events that a run writes."""

from __future__ import annotations

from functools import cache

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, trackwright
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.evaluation.events import off_the_path
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
