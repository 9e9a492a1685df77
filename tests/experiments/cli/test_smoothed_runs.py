"""`track --smooth`, and the events that a run writes."""

from __future__ import annotations

from functools import cache

import polars as pl
import pytest

from tests.in_process import PLAIN, trackwright

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
