"""An archive most of whose recordings are broken at random: each costs its own lines, the good ones have their bits."""

from __future__ import annotations

import polars as pl
import pytest

from tests.experiments.cli.small_archive import write_archive
from tests.faults.recordings import broken_recording
from tests.in_process import PLAIN, trackwright

GOOD, SEED = 4, 7
ALONE = ("--tracker", "fix-kf", *PLAIN, "--out")


@pytest.mark.parametrize("broken", [3, pytest.param(150, marks=pytest.mark.slow)])
def test_broken_recordings_cost_their_own_lines_and_leave_the_good_ones_their_bits(broken, tmp_path):
    names = [path.name for path in write_archive(tmp_path / "good", GOOD)]
    assert trackwright("track", tmp_path / "good", *ALONE, tmp_path / "alone").code == 0
    write_archive(tmp_path / "archive", GOOD)
    for number in range(broken):
        place = tmp_path / "archive" / f"place-{number}"
        place.mkdir()
        broken_recording(SEED, number, place)
    for command in (("track", tmp_path / "archive", *ALONE, tmp_path / "out"), ("evaluate", tmp_path / "out")):
        done = trackwright(*command)
        assert done.code == 1 or (done.code == 0 and command[0] == "evaluate")
        assert "Traceback" not in done.err
        results = pl.read_csv(tmp_path / "out" / "results.csv")
        assert len(results) == GOOD + broken
        assert set(names) <= set(results.filter(pl.col("refused").is_null())["recording"])
        assert len(done.err.splitlines()) < 30
    mine = pl.read_parquet(tmp_path / "out" / "tracks.parquet").filter(pl.col("recording").is_in(names))
    alone = pl.read_parquet(tmp_path / "alone" / "tracks.parquet")
    assert mine.select(alone.columns).equals(alone)
