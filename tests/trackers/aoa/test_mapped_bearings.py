"""Bearings with a map: what the sensor looks up, and which recordings get its tracker."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.catalogue import CASES, RIG, folder
from trackwright.trackers.aoa.mapped_bearings import MappedBearingSensor
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.filters.quadrature import QuadratureKalman
from trackwright.trackers.recordings.bearing_map import BearingMap
from trackwright.trackers.recordings.calibration import UNCALIBRATED, Calibration

RNG = np.random.default_rng(0)
VISITS = {
    name: np.column_stack([RNG.uniform(0.5, 3.5, (30, 2)), RNG.normal(0.0, [0.1, 0.2], (30, 2))])
    for name in RIG.stations
}
MAP = BearingMap(0.3, VISITS)
CALIBRATION = Calibration(dict.fromkeys(RIG.stations, UNCALIBRATED), bearing_map=MAP)


def test_errors_are_bilinear_between_nodes_and_unknown_off_the_grid():
    grid = MAP.grid(["S1", "S2"])
    sensor = MappedBearingSensor(grid, 0.1, 0.2, 4.0)
    for station in (0, 1):
        for _ in range(10):
            at = RNG.uniform(0.0, np.array(grid.values.shape[1:3]) - 1.0)
            (i, j), (u, v) = at.astype(int), at % 1.0
            T = grid.values[station]
            expected = (T[i, j] * (1 - u) + T[i + 1, j] * u) * (1 - v) + (
                T[i, j + 1] * (1 - u) + T[i + 1, j + 1] * u
            ) * v
            x, y = grid.corner + grid.step * at
            found = sensor.errors_at({"station": jnp.asarray(float(station))}, jnp.asarray(x), jnp.asarray(y))
            np.testing.assert_allclose(found, expected, rtol=1e-9)
    x = jnp.asarray([grid.corner[0] - 0.01, 1e3])
    found = sensor.errors_at({"station": jnp.asarray(0.0)}, x, jnp.asarray([2.0, 2.0]))
    np.testing.assert_array_equal(np.stack(found, axis=1), [grid.unknown] * 2)
    slope = jax.grad(lambda x: sensor.errors_at({"station": jnp.asarray(0.0)}, x, jnp.asarray(2.0))[0])
    assert float(slope(jnp.asarray(1e3))) == 0.0


def test_tags_of_known_height_have_the_map_and_others_are_tracked_without_it_with_a_notice():
    calibrated = folder().calibrated(CALIBRATION)
    with_map, free = build("bearings", calibrated), build("bearings", calibrated, free_height=True)
    assert isinstance(with_map.tracker.filter, QuadratureKalman)
    assert not isinstance(free.tracker.filter, QuadratureKalman)
    assert with_map.made_for[1][0].notices == ()
    (notice,) = free.made_for[1][0].notices
    assert notice.startswith("catalogue: bearings: the calibration's map of errors over the floor is not used")
    # Noise levels fitted without a map fit a tracker with one.
    assert with_map.tunables.keys() == free.tunables.keys()


def test_recordings_with_different_maps_have_trackers_of_their_own():
    other = replace(CALIBRATION, bearing_map=BearingMap(0.3, {"S1": VISITS["S1"]}))
    one, two = folder().calibrated(CALIBRATION), replace(folder(), name="other").calibrated(other)
    assert len(build("bearings", [one, two]).batches([one, two])) == 2
    twin = replace(folder(), name="other").calibrated(CALIBRATION)
    assert len(build("bearings", [one, twin]).batches([one, twin])) == 1


def test_a_station_that_has_moved_has_no_map():
    stations = {"S1": replace(UNCALIBRATED, mounted=RIG.stations["S2"]), "S2": UNCALIBRATED}
    calibrated = folder().calibrated(replace(CALIBRATION, stations=stations))
    assert list(calibrated.calibration.bearing_map.stations) == ["S2"]


@pytest.mark.slow
def test_single_precision_tracks_as_double_does():
    case = CASES["bearings with a map"]
    tracker, recordings = case.tracker(), case.recordings()
    double = tracker.run(recordings)
    with jax.enable_x64(False):
        single = tracker.run(recordings)
    ok = np.asarray(double.status) == 0
    for a, b in zip(single.mean.position, double.mean.position, strict=True):
        np.testing.assert_allclose(np.asarray(a)[ok], np.asarray(b)[ok], atol=1e-3)
