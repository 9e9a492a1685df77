"""The scorer against figures computed here, and what a submitted folder may be."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused, trackwright
from trackwright.experiments.lab.benchmark.declaration import DEVELOPMENT, ESTIMATORS, LEVELS
from trackwright.experiments.lab.benchmark.readings import CHANNELS
from trackwright.experiments.lab.benchmark.running import FAILED
from trackwright.experiments.lab.benchmark.scoring import cell, difference
from trackwright.experiments.lab.benchmark.worlds import WORLDS, simulated

NAME = "world-ranges-2d"


@pytest.fixture
def world():
    return simulated(NAME)


def _estimates(world, seed=1, size=0.1):
    """The truth with normal errors, and a covariance that is correct for them."""
    rng, truth = np.random.default_rng(seed), world.tables["truth"]
    errors = size * rng.standard_normal((len(truth), 2))
    table = truth.with_columns(
        x_m=truth["x_m"] + errors[:, 0], y_m=truth["y_m"] + errors[:, 1],
        std_x_m=pl.lit(size), std_y_m=pl.lit(size), cov_xy_m2=pl.lit(0.0), cpu_us=pl.lit(3.5),
    )  # fmt: skip
    return table, errors


def test_the_figures_of_a_table_are_those_computed_by_hand(world, tmp_path):
    table, errors = _estimates(world)
    table.write_parquet(tmp_path / f"{NAME}.parquet")
    one, sizes = cell(tmp_path / f"{NAME}.parquet", world), np.linalg.norm(errors, axis=1)
    assert one.rmse == pytest.approx(np.sqrt(np.mean(sizes**2)))
    assert (one.p75, one.p95) == pytest.approx(tuple(np.quantile(sizes, [0.75, 0.95])))
    squares = sizes**2 / 0.01
    assert one.inside == pytest.approx(np.mean(squares <= -2 * np.log(0.05)))
    assert one.nees == pytest.approx(np.mean(squares) / 2)
    assert (one.cpu, one.missing, one.failed) == (3.5, 0.0, "")


@pytest.mark.parametrize(
    ("kept", "missing"),
    [
        (pl.col("tag") == "1", 2 / 3),
        # Readings are 50 ms apart; those of the second after the last estimate are near it.
        (pl.col("t_s") < 3.0, 1 - 80 / 600),
        (pl.int_range(pl.len()) % 4 > 0, 0.0),
    ],
)
def test_readings_far_from_any_estimate_of_their_tag_are_missing(world, tmp_path, kept, missing):
    table, _ = _estimates(world)
    table.with_columns(x_m=pl.when(kept).then("x_m")).write_csv(tmp_path / f"{NAME}.csv")
    table.filter(kept).write_parquet(tmp_path / f"{NAME}.parquet")
    for suffix in ("csv", "parquet"):
        assert cell(tmp_path / f"{NAME}.{suffix}", world).missing == pytest.approx(missing)


def test_a_difference_has_the_sign_of_the_worse_and_an_interval_without_zero(world, tmp_path):
    for name, size in (("ours", 0.1), ("other", 0.13)):
        _estimates(world, size=size)[0].write_parquet(tmp_path / f"{name}.parquet")
    paired = difference(*(cell(tmp_path / f"{name}.parquet", world) for name in ("ours", "other")))
    assert 0.0 < paired.low < paired.value < paired.high
    assert paired.value == pytest.approx(0.03 * np.sqrt(2), rel=0.1)


def test_a_failure_is_its_reason(world, tmp_path):
    path = tmp_path / f"{NAME}{FAILED}"
    path.write_text("LinAlgError: singular\n", "utf-8")
    assert cell(path, world).failed == "LinAlgError: singular"


def test_estimates_that_are_all_nan_are_a_failure(world, tmp_path):
    table, _ = _estimates(world)
    table.with_columns(x_m=pl.lit(np.nan)).write_parquet(tmp_path / f"{NAME}.parquet")
    assert cell(tmp_path / f"{NAME}.parquet", world).failed == "none of 1800 rows has a finite estimate"


def test_a_submitted_folder_of_trajectories_is_scored(world, tmp_path):
    truth = world.tables["truth"].filter(tag="1")
    table, _ = _estimates(world)
    place = tmp_path / "estimates" / "my-filter"
    place.mkdir(parents=True)
    table.write_csv(place / f"{NAME}.csv")
    done = trackwright("benchmark", "--mine", tmp_path / "estimates", "--data", NAME)
    assert done.code == 0, done.err
    assert "my-filter" in done.out
    assert "0.141" in done.out or "0.14" in done.out
    poses = np.column_stack(
        [truth.select("t_s", "x_m", "y_m", "z_m").to_numpy(), np.tile([0, 0, 0, 1.0], (len(truth), 1))]
    )
    np.savetxt(tmp_path / f"{NAME}.tum", poses)
    assert_refused(trackwright("benchmark", "--mine", tmp_path / f"{NAME}.tum"), "names no tag", "add a column tag")
    table.write_parquet(place / f"{NAME}.parquet")
    assert_refused(trackwright("benchmark", "--mine", tmp_path / "estimates"), f"{NAME}.csv", f"{NAME}.parquet")


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        ({"cpu_us": pl.lit("fast")}, "cpu_us: 'fast'; expected a number"),
        ({"std_x_m": pl.lit(-0.1)}, "std_x_m: -0.1, expected a standard deviation above zero"),
        ({"t_s": pl.col("t_s").cast(pl.Duration)}, "column t_s has type"),
    ],
)
def test_a_column_that_is_not_of_numbers_is_named_with_its_file(world, tmp_path, changed, found):
    path = tmp_path / f"{NAME}.parquet"
    _estimates(world)[0].with_columns(**changed).write_parquet(path)
    assert_refused(trackwright("benchmark", "--mine", path), path.name, found)
    _estimates(world)[0].drop("x_m").write_parquet(path)
    assert_refused(trackwright("benchmark", "--mine", path), path.name, "no column x_m")
    _estimates(world)[0].drop("std_y_m").write_parquet(path)
    assert_refused(trackwright("benchmark", "--mine", path), path.name, "no column std_y_m; expected std_x_m with")
    _estimates(world)[0].with_columns(pl.col("t_s") + 1e6).write_parquet(path)
    assert_refused(trackwright("benchmark", "--mine", path), path.name, "no estimate lies inside a truth")


def test_an_unknown_processor_time_is_left_out(world, tmp_path):
    path = tmp_path / f"{NAME}.parquet"
    _estimates(world)[0].with_columns(cpu_us=None).write_parquet(path)
    assert cell(path, world).cpu is None


def test_what_cannot_be_scored_is_refused_in_a_line(tmp_path, monkeypatch):
    assert_refused(trackwright("benchmark", "--mine", tmp_path / "none"), "no such file or folder")
    assert_refused(trackwright("benchmark", "--mine", tmp_path), "no estimates")
    assert_refused(trackwright("benchmark", "--data", "nowhere"), "nowhere")
    assert_refused(trackwright("benchmark", "--estimator", "nobody"), "nobody")
    (tmp_path / "hall.tum").touch()
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(tmp_path / "none"))
    monkeypatch.delenv("TRACKWRIGHT_FLIGHTS", raising=False)
    mine = trackwright("benchmark", "--mine", tmp_path / "hall.tum")
    assert_refused(mine, "estimates of hall; expected data sets: world-", "name their folder in TRACKWRIGHT_RECORDINGS")


def test_the_declaration_is_complete():
    groups = {e.levels for e in ESTIMATORS.values() if e.levels}
    assert groups == set(LEVELS)
    assert all(set(of_kind) == set(CHANNELS) for of_kind in LEVELS.values())
    assert len(WORLDS) == 5
    assert set(DEVELOPMENT) == set(CHANNELS)
