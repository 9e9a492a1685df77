"""Maps of bearings' errors: kept where errors are bound to places, and not elsewhere; tracks get nearer with one."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.tuning.calibration_worlds import HEIGHT, RIG, STATIONS, lasting, walk
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.bearing_map import VISIT_M, runs_of
from trackwright.tuning.calibrating import calibrate
from trackwright.tuning.calibration_pairs import Pairs

SIGMAS = 0.1, 0.2
"""Standard deviations of the errors of azimuth and elevation, rad, as on real walks."""

LENGTH_M = 0.7
"""Way over which an error that is bound to places varies."""


def _of_place(rng, positions, sigma):
    """A smooth random function (T,) of the place, the same for equal generators."""
    waves, phases = rng.normal(size=(2, 100)) / LENGTH_M, rng.uniform(0.0, 2 * np.pi, 100)
    return sigma * np.sqrt(2.0 / 100) * np.cos(positions[:, :2] @ waves + phases).sum(axis=1)


def _walk(rng, name, field, seconds):
    """A walk whose errors are functions of the place, or, with `field` None, last along it."""
    times, positions = walk(rng, seconds)
    tables = []
    for number, (station, own) in enumerate(STATIONS.items()):
        errors = [
            lasting(rng, times, positions, sigma)
            if field is None
            else _of_place(np.random.default_rng([field, number, k]), positions, sigma)
            for k, sigma in enumerate(SIGMAS)
        ]
        angles = own.angles(positions) + np.stack(errors, axis=1) + 0.05 * rng.normal(size=(len(times), 2))
        columns = {"azimuth_rad": angles[:, 0], "elevation_rad": angles[:, 1]}
        tables.append(pl.DataFrame({"t_s": times, "tag": "1", "station": station, **columns}))
    x, y, z = positions.T
    truth = pl.DataFrame({"t_s": times, "tag": "1", "x_m": x, "y_m": y, "z_m": z})
    rig = replace(RIG, tags={"1": Tag(height=HEIGHT)})
    return RecordingFolder(name, None, rig, {"bearings": pl.concat(tables).sort("t_s"), "truth": truth})


def _site(seed, by_place, walks=5, seconds=120.0):
    rng = np.random.default_rng(seed)
    return [_walk(rng, f"walk {k + 1}", seed if by_place else None, seconds) for k in range(walks)]


@pytest.mark.slow
def test_a_map_is_kept_where_errors_return_with_the_place_and_tracks_get_nearer():
    before, after = [], []
    for seed in range(3):
        *others, last = _site(seed, by_place=True)
        calibration = calibrate(others)
        assert calibration.bearing_map.gain > 0.1
        for errors, known in ((before, replace(calibration, bearing_map=None)), (after, calibration)):
            calibrated = last.calibrated(known)
            estimates = build("bearings", calibrated).run(calibrated)
            errors.append(evaluate(estimates, calibrated).overall["rmse_m"])
    assert np.mean(after) < 0.85 * np.mean(before)


@pytest.mark.slow
def test_no_map_is_kept_of_errors_that_last_but_do_not_return():
    kept = [
        calibrate(_site(100 + seed, by_place=False, walks=3, seconds=60.0)).bearing_map is not None for seed in range(5)
    ]
    assert sum(kept) <= 1


def test_visits_are_runs_of_rows_near_their_first_one_by_recording_and_tag():
    x = np.array([0.0, 0.2, 0.4, 0.6, 0.7, 0.0, 0.1, 0.1])
    number, tag = np.array([0, 0, 0, 0, 0, 0, 0, 1]), np.array(["a"] * 6 + ["b", "a"])
    measured = np.column_stack([np.arange(8.0), np.zeros(8)])
    measured[1, 1] = np.nan
    rows = Pairs(
        np.zeros((8, 2)), measured, np.column_stack([x, x * 0, x * 0]), number, *[number] * 2, tag, np.arange(8.0),
        *[tag] * 2,
    )  # fmt: skip
    shuffled = np.random.default_rng(0).permutation(8)
    runs = runs_of(Pairs(*(column[shuffled] for column in rows)))
    assert VISIT_M == 0.5
    np.testing.assert_array_equal(runs.begins, [0, 2, 4, 5, 6])
    np.testing.assert_array_equal(runs.recording, [0, 0, 0, 0, 1])
    np.testing.assert_array_equal(runs.rows.measured[:, 0], [0, 2, 3, 4, 5, 6, 7])
