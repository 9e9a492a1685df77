"""Bearings-only fusion: whitening, symmetry of space, and single precision where joint updates fail.

256 tags, each seen by three stations in turn to 0.05°, from a prior of 100 m about a position metres off.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.catalogue import CALIBRATED
from tests.known_start import NEVER_LOST, KnownStart, flat, recording
from trackwright.trackers.aoa.fusion import BearingSensor, bearing_inputs
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.calibration import StationCalibration

TAGS, ROWS, SIGMA = 256, 36, np.deg2rad(0.05)
TIMES = np.repeat(np.arange(ROWS / 3) * 0.1, 3)
SIGMAS = np.array([100.0, 100.0, 100.0, 3.0, 3.0, 3.0])


def _facing(position, target):
    """A station at `position` whose boresight points to `target`."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return _station(position, np.stack([x, np.cross(z, x), z], axis=1))


def _station(position, rotation):
    """A station from its rotation matrix, array frame to world frame."""
    return Station(np.asarray(position, float), Rotation.from_matrix(rotation).as_quat(scalar_first=True))


PLACES = np.array([[6.0, 0.0, 2.5], [-3.0, 5.0, 2.0], [-3.0, -5.0, 3.0]])
STATIONS = [_facing(place, np.array([0.0, 0.0, 1.0])) for place in PLACES]


def _kinematic(x):
    return Kinematic(Vector(*x[:3]), Vector(*x[3:]))


def _truth():
    rng = np.random.default_rng(0)
    start, velocity = rng.uniform(-2, 2, (TAGS, 1, 3)) + [0, 0, 1.0], rng.normal(size=(TAGS, 1, 3)) * 0.5
    return start + velocity * TIMES[:, None], rng


def _batch(dtype, rotation=None, shift=None):
    """The world, or the same world turned and shifted; readings are the same numbers."""
    rotation, shift = np.eye(3) if rotation is None else rotation, np.zeros(3) if shift is None else shift
    positions, rng = _truth()
    angles = np.stack([STATIONS[k % 3].angles(positions[:, k]) for k in range(ROWS)], axis=1)
    angles += SIGMA * rng.normal(size=angles.shape)
    seen = np.ones((TAGS, ROWS, 2), bool)
    seen[:, ROWS // 2 :] = rng.random((TAGS, ROWS - ROWS // 2, 2)) < 0.8
    means = np.concatenate([positions[:, 0] + rng.normal(size=(TAGS, 3)) * 0.5, np.zeros((TAGS, 3))], axis=1)
    means[:, :3] = means[:, :3] @ rotation.T + shift
    moved = [_station(rotation @ s.position + shift, rotation @ s.world_from_array()) for s in STATIONS]
    geometry = np.array([bearing_inputs(moved[k % 3]) for k in range(ROWS)])
    inputs = {"origin": geometry[:, :3], "axes": geometry[:, 3:]}
    return stack(
        [
            recording(TIMES, {"b": (a, s)}, m, np.diag(SIGMAS**2), inputs)
            for a, s, m in zip(angles, seen, means, strict=True)
        ],
        dtype=dtype,
    )


def _run(batch):
    # Student's t with many degrees of freedom: a reading that is off is not discounted, so nothing hides a bad update.
    sensors = {"b": BearingSensor(SIGMA, SIGMA, 100.0)}
    return Tracker(ConstantVelocity(0.5, 3), sensors, KnownStart(_kinematic), track_loss=NEVER_LOST).run(batch)


@pytest.fixture(scope="module")
def double():
    return _run(_batch(np.float64))


@pytest.fixture(scope="module")
def single():
    return _run(_batch(np.float32))


def test_in_single_precision_every_track_is_finite_with_a_proper_covariance(single):
    assert single.cov_upper.dtype == np.float32
    assert np.isfinite(flat(single.mean)).all()
    eigenvalues = np.linalg.eigvalsh(single.covariance.astype(float))
    assert np.all(eigenvalues[..., 0] > -1e-6 * eigenvalues[..., -1])


def test_in_single_precision_every_track_ends_where_double_precision_ends(single, double):
    apart = np.abs(flat(single.mean)[:, -1] - flat(double.mean)[:, -1])
    sigmas = np.stack([s[:, -1] for s in double.sigmas.values()], axis=1)
    # A hundredth of a standard deviation; positions of metres known to millimetres leave room for no less.
    assert np.max(apart / sigmas) < 0.01


@settings(max_examples=5, deadline=None)
@given(
    st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
    st.tuples(*[st.floats(-50, 50)] * 3),
)
def test_a_rotated_and_shifted_world_has_rotated_and_shifted_tracks(double, quaternion, shift):
    rotation = Station(np.zeros(3), np.array(quaternion)).world_from_array()
    moved = _run(_batch(np.float64, rotation, np.array(shift)))
    both = np.kron(np.eye(2), rotation)
    expected = flat(double.mean) @ both.T + np.concatenate([shift, np.zeros(3)])
    # The first rows stand on a prior of 1e4 m² against 1e-6 rad²: ten digits are lost of sixteen.
    np.testing.assert_allclose(flat(moved.mean), expected, atol=1e-5)
    np.testing.assert_allclose(moved.log_likelihood, double.log_likelihood, atol=1e-4)


SENSOR = BearingSensor(0.05, 0.08, 4.0)
GEOMETRY = {"origin": bearing_inputs(STATIONS[0])[:3], "axes": bearing_inputs(STATIONS[0])[3:]}


@pytest.mark.parametrize("seen", [(True, True), (True, False), (False, True)])
def test_whitening_with_a_reported_covariance_is_the_dense_one_of_what_was_seen(seen):
    reported = np.array([[0.02, 0.012], [0.012, 0.03]]) ** 1.0
    difference, kept = np.array([0.3, -0.2]), np.array(seen)
    covariance = (reported + np.diag([0.05**2, 0.08**2]))[np.ix_(kept, kept)]
    values = jnp.asarray(np.array([3.0, 0.4]) + difference)
    result = SENSOR.residual(
        Reading(values, jnp.asarray(kept), jnp.array([0.02, 0.012, 0.03])), [jnp.asarray(3.0), jnp.asarray(0.4)]
    )
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), difference[kept])
    np.testing.assert_allclose(np.array([float(w) for w in result.whitened])[kept], whitened, rtol=1e-12)
    scale = -0.5 * np.linalg.slogdet(covariance)[1]
    none = SENSOR.residual(Reading(values, jnp.asarray(kept), ()), [jnp.asarray(3.0), jnp.asarray(0.4)])
    alone = -0.5 * np.linalg.slogdet(np.diag([0.05**2, 0.08**2])[np.ix_(kept, kept)])[1]
    # What does not depend on the covariance cancels between a reported and an unreported one.
    assert float(result.log_scale - none.log_scale) == pytest.approx(scale - alone, rel=1e-12)
    assert float(result.nis_dof) == kept.sum()


def test_a_bearing_is_the_stations_angle_of_the_position():
    points = np.random.default_rng(1).normal(size=(50, 3)) * 3
    for point in points:
        measured = SENSOR.measure(Kinematic(Vector(*point), Vector(0.0, 0.0, 0.0)), GEOMETRY)
        np.testing.assert_allclose(np.array([float(m) for m in measured]), STATIONS[0].angles(point), atol=1e-12)


def test_a_calibrated_station_measures_as_its_calibration_does():
    station = StationCalibration(CALIBRATED[:8].reshape(2, 4), np.zeros((2, 4, 4)), CALIBRATED[8:].reshape(2, 2))
    # Points all around the station, many beyond the span of the calibration.
    for point in np.random.default_rng(2).normal(size=(50, 3)) * 4:
        view = Kinematic(Vector(*point), Vector(0.0, 0.0, 0.0))
        measured = SENSOR.measure(view, {**GEOMETRY, "calibration": CALIBRATED})
        expected = station.measured(STATIONS[0].angles(point))
        np.testing.assert_allclose(np.array([float(m) for m in measured]), expected, atol=1e-12)


def test_an_azimuth_beyond_half_a_turn_is_wrapped():
    predicted = [jnp.asarray(3.1), jnp.asarray(0.0)]
    result = SENSOR.residual(Reading(jnp.array([-3.1, 0.0]), jnp.ones(2, bool), ()), predicted)
    assert float(result.whitened[0]) * 0.05 == pytest.approx(2 * np.pi - 6.2, rel=1e-9)
