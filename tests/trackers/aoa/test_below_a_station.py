"""Tags that pass below a station, where an azimuth bends within the spread of the position."""

import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.aoa.rays import recent_points
from trackwright.trackers.core.model.rig import Station

STATIONS = {
    name: Station(np.array(place), np.array([0.5, 0.5, 0.5, 0.5]))
    for name, place in (("1", (0.0, 0.0, 2.5)), ("2", (10.0, 0.0, 2.5)), ("3", (5.0, 8.0, 2.5)))
}


def _line(offset, t):
    return np.stack([5.0 + offset + 0 * t, 8.0 + 0.2 * (t - 20.0)], axis=1)


def _circle(radius, t):
    return np.stack([5.0 + radius * np.cos(2 * t), 8.0 + radius * np.sin(2 * t)], axis=1)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("path", "size"), [(_line, 0.0), (_line, 0.03), (_line, 0.1), (_circle, 0.02), (_circle, 0.05)]
)
def test_below_a_station_errors_are_a_few_of_the_reported_standard_deviations(path, size, seed):
    t = np.arange(1200) / 30.0
    truth = np.column_stack([path(size, t), np.full(1200, 1.0)])
    names, rng = np.array(list("123"))[np.arange(1200) % 3], np.random.default_rng(seed)
    angles = np.stack([STATIONS[n].angles(p) for n, p in zip(names, truth, strict=True)])
    recording = tw.aoa.bearing_recording(t, angles + rng.normal(0, 0.03, (1200, 2)), list(names), STATIONS, height=1.0)
    levels = {"sigma_a": 0.6, "sigma_azimuth": 0.03, "sigma_elevation": 0.03, "sigma_bias": (0.003, 0.003)}
    estimates = bearing_tracker(3, True, **levels).run(recording)
    late = slice(60, None)
    errors = (np.stack(list(estimates.mean.position), axis=-1) - truth[:, :2])[late]
    P = estimates.marginal("position")[late]
    assert np.sqrt(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(P), errors).max()) < 5.5
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.12


def test_azimuths_alone_start_at_the_intersection_of_their_planes_at_a_known_height():
    place, seen = np.array([4.0, 5.0, 1.0]), np.array([[True, False]] * 3)
    axes = np.stack([s.world_from_array().T.ravel() for s in STATIONS.values()])
    origins = np.stack([s.position for s in STATIONS.values()])
    angles = np.stack([s.angles(place) for s in STATIONS.values()]) * seen
    twice = (np.tile(x, (2, 1)) for x in (origins, axes, angles, seen))
    found = recent_points(np.array([0, 6]), np.zeros(6), *twice, np.array([1.0]))
    np.testing.assert_allclose(found, np.tile([*place, 1.0], (6, 1)), atol=1e-6)
