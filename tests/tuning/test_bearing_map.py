"""Maps of bearings' errors: by the equations, kept where errors return with the place alone, and used at known heights."""

from dataclasses import replace

import numpy as np
import pytest

from tests.catalogue import of_a_map
from tests.tuning.calibration_worlds import HEIGHT, world
from trackwright.trackers.aoa.mapped_bearings import MappedBearingSensor
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.filters.quadrature import QuadratureKalman
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.calibration import UNCALIBRATED, UNKNOWN, floor_grid, predicted
from trackwright.tuning.calibrating import Pairs, calibrate, visits_of

RNG = np.random.default_rng(0)
VISITS = np.column_stack([RNG.uniform(0.0, 4.0, (40, 2)), RNG.normal(0.0, [0.1, 0.2], (40, 2))])


def _by_equations(places):
    sources, columns = VISITS[:, :2], []
    among, across = (np.exp(-np.linalg.norm(a[:, None] - sources, axis=-1) / 0.6) for a in (sources, places))
    for errors, place, visit in ((VISITS[:, 2], 0.1, 0.06), (VISITS[:, 3], 0.2, 0.15)):
        K, k = place**2 * among + visit**2 * np.eye(len(VISITS)), place**2 * across
        variances = place**2 + visit**2 - np.diag(k @ np.linalg.solve(K, k.T))
        columns.append([k @ np.linalg.solve(K, errors), np.sqrt(variances)])
    return np.concatenate(np.swapaxes(columns, 0, 1)).T


def test_a_map_is_a_gaussian_process_bilinear_between_the_nodes_of_a_grid_and_unknown_off_it():
    places = RNG.uniform(-1.0, 5.0, (25, 2))
    np.testing.assert_allclose(predicted(VISITS, places), _by_equations(places), rtol=1e-10, atol=1e-13)
    grid = floor_grid({"A": VISITS}, ["none", "A"], (100.0, -50.0))
    sensor, station = MappedBearingSensor(grid, 0.1, 0.2, 4.0), {"station": np.array(1.0)}
    nodes = grid[1] + grid[2] * RNG.integers(0, np.array(grid[0].shape[1:3]) - 1, (25, 2))
    middles = [_by_equations(nodes + [100.0 + 0.1 * i, -50.0 + 0.1 * j]) for i in (0, 1) for j in (0, 1)]
    found = np.stack(sensor.errors_at(station, *(nodes + 0.05).T), axis=1)
    np.testing.assert_allclose(found, np.mean(middles, axis=0), rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(np.stack(sensor.errors_at(station, *np.full((2, 1), 1e3)), axis=1), [UNKNOWN])
    np.testing.assert_allclose(grid[0][0], np.broadcast_to(UNKNOWN, grid[0][0].shape))


def test_visits_are_runs_of_rows_near_their_first_one_by_recording_and_tag():
    x = np.array([0.0, 0.2, 0.4, 0.6, 0.7, 0.0, 0.1, 0.1])
    number, tag = np.array([0, 0, 0, 0, 0, 0, 0, 1]), np.array(["a"] * 6 + ["b", "a"])
    measured = np.column_stack([0.1 * np.arange(8.0), [0.0, np.nan, *[0.0] * 6]])
    positions = np.column_stack([x, x * 0, x * 0])
    rows = Pairs(np.zeros((8, 2)), measured, positions, number, number, number, tag, np.arange(8.0), x)
    shuffled = RNG.permutation(8)
    visits, recording = visits_of(Pairs(*(column[shuffled] for column in rows)), UNCALIBRATED)
    np.testing.assert_allclose(visits[:, 0], [0.2, 0.65, 0.0, 0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(visits[:, 2], [0.1, 0.35, 0.5, 0.6, 0.7], atol=1e-12)
    np.testing.assert_array_equal(recording, [0, 0, 0, 0, 1])


def test_tags_of_known_height_have_the_map_and_others_are_tracked_without_it_with_a_notice():
    known, free = build("bearings", of_a_map()), build("bearings", of_a_map(), free_height=True)
    assert [isinstance(one.tracker.filter, QuadratureKalman) for one in (known, free)] == [True, False]
    assert known.made_for[1][0].notices == ()
    (notice,) = free.made_for[1][0].notices
    assert "bearings: the calibration's map of errors over the floor is not used" in notice


@pytest.mark.slow
@pytest.mark.parametrize("by_place", [True, False])
def test_a_map_is_kept_where_errors_return_with_the_place_and_tracks_get_nearer(by_place):
    _, (*others, last) = world(3, recordings=5, by_place=by_place, seconds=120.0)
    calibration = calibrate(others)
    assert bool(calibration.bearing_map) == by_place
    if by_place:
        last = replace(last, rig=replace(last.rig, tags={"1": Tag(height=HEIGHT)}))
        folders = [last.calibrated(known) for known in (replace(calibration, bearing_map={}), calibration)]
        before, after = (evaluate(build("bearings", f).run(f), f).overall["rmse_m"] for f in folders)
        assert after < 0.85 * before
