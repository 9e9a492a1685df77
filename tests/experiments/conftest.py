"""What the tests of bad input share."""

from __future__ import annotations

import polars as pl
import pytest

from tests.faulty import good_tables, write_good
from tests.in_process import trackwright


@pytest.fixture(scope="session")
def beginnings(tmp_path_factory):
    """What tests of bad input begin from: a recording, and tracks of it that nobody had to compute."""
    folder = tmp_path_factory.mktemp("bad-input")
    write_good(folder / "good")
    truth = good_tables()["truth"]
    tracks = truth.select(recording=pl.lit("good"), tag="tag", t_s="t_s", x_m=pl.col("x_m") + 0.1, y_m="y_m", z_m="z_m")
    (folder / "tracked").mkdir()
    tracks.with_columns(status=pl.lit("ok")).write_parquet(folder / "tracked" / "tracks.parquet")
    (folder / "tracked" / "recordings.txt").write_text(f"{folder / 'good'}\n")
    return folder


@pytest.fixture(scope="session")
def simulated(beginnings):
    """A simulated recording of two tags, for what only fails once a tracker is built."""
    assert trackwright("simulate", "--out", beginnings / "world", "--n", 2, "--rows", 10).code == 0
    return beginnings / "world"
