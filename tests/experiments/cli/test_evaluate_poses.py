"""`evaluate` of trajectory files and with alignment, against evo and the known errors of made-up tracks."""

from __future__ import annotations

import json
import math

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, assert_refused_last, trackwright
from tests.trackers.exchange.against_evo import evo_errors, evo_modules
from trackwright.trackers.exchange.trajectories import write_trajectory
from trackwright.trackers.recordings.files import write_whole


@pytest.fixture(scope="module")
def truth(beginnings):
    """The truth of tag T1 of the good recording."""
    return pl.read_csv(beginnings / "good" / "truth.csv").filter(pl.col("tag") == "T1")


@pytest.fixture(scope="module")
def there(beginnings, truth, tmp_path_factory):
    """A folder with `own.tum`: the true path of tag T1 turned by 90°, shifted, 0.2 s late and with noise of 5 cm."""
    folder = tmp_path_factory.mktemp("poses")
    x, y = truth["x_m"], truth["y_m"]
    noise = np.random.default_rng(1).normal(0, 0.05, (2, len(truth)))
    moved = truth.with_columns(x_m=-y + 3 + noise[0], y_m=x - 1 + noise[1], t_s=pl.col("t_s") + 0.2)
    write_trajectory(moved.drop("qw", "qx", "qy", "qz"), folder / "own.tum")
    write_trajectory(truth.drop("qw", "qx", "qy", "qz"), folder / "true.tum")
    return folder


def test_a_file_is_aligned_shifted_in_time_and_scored_with_all_figures(beginnings, there):
    arguments = ("--truth", beginnings / "good", "--tag", "T1", "--align", "se2", "--time-offset", -0.2)
    said = trackwright("evaluate", there / "own.tum", *arguments)
    assert said.code == 0, said.err
    assert "APE" in said.out
    assert "alignment se2" in said.out
    found = json.loads(trackwright("evaluate", there / "own.tum", *arguments, "--json").out)
    # Two axes with 5 cm each; the alignment takes three of a hundred numbers.
    assert found["overall"]["rmse_m"] == pytest.approx(0.05 * math.sqrt(2), rel=0.2)
    assert found["poses"]["tracks"][0]["ape_m"]["rmse"] == pytest.approx(found["overall"]["rmse_m"])


def test_a_table_with_standard_deviations_gets_its_nees(beginnings, truth, tmp_path):
    own = truth.select("t_s", pl.col("x_m") + 0.1, "y_m", "z_m", std_x_m=0.1, std_y_m=0.1, std_z_m=0.1)
    own.write_csv(tmp_path / "own.csv")
    said = trackwright("evaluate", tmp_path / "own.csv", "--truth", beginnings / "good", "--tag", "T1", "--json")
    overall = json.loads(said.out)["overall"]
    assert overall["nees_mean"] == pytest.approx(1.0)
    assert overall["rmse_m"] == pytest.approx(0.1)
    own.with_columns(std_x_m=-0.1, std_z_m=0.0).write_csv(tmp_path / "own.csv")
    said = trackwright("evaluate", tmp_path / "own.csv", "--truth", beginnings / "good", "--tag", "T1")
    assert_refused_last(said, "row 1 (line 2), column std_x_m: '-0.1', expected a standard deviation above zero")


@pytest.fixture
def run(truth, tmp_path):
    """The output folder of `track` of one tag, T7 of hall-1: the true path of T1, 0.3 s late, 4 cm beside it."""
    estimates = truth.select("t_s", "x_m", "y_m", "z_m").with_columns(
        pl.col("t_s") + 0.3, pl.col("x_m") + 0.04, recording=pl.lit("hall-1"), tag=pl.lit("T7")
    )
    (tmp_path / "run").mkdir()
    write_whole(tmp_path / "run" / "tracks.parquet", estimates)
    return tmp_path / "run"


def test_a_run_of_one_tag_is_scored_by_a_trajectory_file(run, there):
    said = trackwright("evaluate", run, "--truth", there / "true.tum", "--time-offset", "-0.3", "--json")
    assert said.code == 0, said.err
    (track,) = json.loads(said.out)["poses"]["tracks"]
    assert (track["recording"], track["tag"]) == ("hall-1", "T7")
    assert json.loads(said.out)["overall"]["rmse_m"] == pytest.approx(0.04, rel=1e-3)
    moved = pl.read_parquet(run / "tracks.parquet").with_columns(pl.col("t_s") + 1777896800.0)
    write_whole(run / "tracks.parquet", moved)
    shifted = trackwright("evaluate", run, "--truth", there / "true.tum", "--time-offset", "-1777896800.3")
    assert "time offset -1777896800.3 s" in " ".join(shifted.out.split())
    apart = trackwright("evaluate", run, "--truth", there / "true.tum")
    assert_refused_last(apart, "UTC, truth from 0 to", "a --time-offset: with -1777896800.3 both begin together")
    write_whole(run / "tracks.parquet", moved.with_columns(pl.col("t_s") - 1777896800.0))
    both = pl.concat([pl.read_parquet(run / "tracks.parquet").with_columns(tag=pl.lit(tag)) for tag in ("T7", "T8")])
    write_whole(run / "tracks.parquet", both)
    several = trackwright("evaluate", run, "--truth", there / "true.tum")
    assert_refused_last(several, "no track has a truth", "T7", "give the --truth of the same recording, or its --tag")
    assert trackwright("evaluate", run, "--truth", there / "true.tum", "--tag", "T8").code == 0


def test_what_track_writes_opens_in_evo_with_the_same_errors(shipped, tmp_path):
    evo_modules()
    folder = shipped / "labyrinth"
    options = ("--tracker", "multilateration", *PLAIN, "--out", tmp_path / "run")
    said = trackwright("track", folder, *options)
    assert said.code == 0, said.err
    own, true = tmp_path / "own.tum", tmp_path / "true.tum"
    assert trackwright("export", tmp_path / "run", "--format", "tum", "--out", own).code == 0
    assert trackwright("export", folder, "--format", "tum", "--out", true).code == 0
    ours = json.loads(trackwright("evaluate", tmp_path / "run", "--align", "none", "--json").out)["poses"]["tracks"][0]
    expected, poses = evo_errors(own, true)
    assert ours["pairs"] == poses
    for statistic, value in expected["ape"].items():
        assert ours["ape_m"][statistic] == pytest.approx(value, abs=1e-6)
