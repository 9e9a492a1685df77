"""Range differences and an IMU: the filter against one in NumPy, rows, refusals, and recordings from the command line."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turn

from tests.known_start import NEVER_LOST
from tests.oracles import normal_log_density
from trackwright.sim import worlds
from trackwright.trackers.catalogue import TRACKERS, build, fitting
from trackwright.trackers.core.data.consistency import nees
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.algebra import Vector, triangle
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import retract
from trackwright.trackers.core.model.tunable import with_values
from trackwright.trackers.parts.drifting_biases import BiasDrift
from trackwright.trackers.uwb_imu.difference_rows import SHARED, correlations
from trackwright.trackers.uwb_imu.fusion import TDOA
from trackwright.trackers.uwb_imu.inertial import inertial_difference_tracker
from trackwright.trackers.uwb_imu.strapdown import ImuNoise
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter, with_yaw_added

ANCHORS = np.array([[0, 0, 0.2], [8, 0, 2.7], [8, 6, 0.3], [0, 6, 2.6]], float)
PAIRS = np.array([(1, 0), (2, 0), (3, 0)])
SIGMA, SIGMA_BIAS, LASTS = 0.1, 0.1, 0.5
NOISE = ImuNoise(0.2, 0.05, 0.01, 0.002, 1.0, 0.1, None)
GRAVITY = np.array([0.0, 0.0, 9.81])


def _added(x, error):
    """A state (position, velocity, attitude, biases of the IMU and of the anchors) with an error (19,) of its axes."""
    return SimpleNamespace(
        p=x.p + error[:3],
        v=x.v + error[3:6],
        R=x.R * Turn.from_rotvec(error[6:9]),
        ba=x.ba + error[9:12],
        bg=x.bg + error[12:15],
        b=x.b + error[15:],
    )


def _less(y, x):
    turned = (x.R.inv() * y.R).as_rotvec()
    return np.concatenate([y.p - x.p, y.v - x.v, turned, y.ba - x.ba, y.bg - x.bg, y.b - x.b])


def _stepped(x, accel, gyro, dt):
    """The mechanisation of Solà 2017, with the acceleration of the middle of the step."""
    rate, force = gyro - x.bg, accel - x.ba
    a = x.R.apply(force + 0.5 * dt * np.cross(rate, force)) - GRAVITY
    turned = x.R * Turn.from_rotvec(rate * dt)
    b = x.b * np.exp(-dt / LASTS)
    return SimpleNamespace(p=x.p + dt * x.v + 0.5 * dt**2 * a, v=x.v + dt * a, R=turned, ba=x.ba, bg=x.bg, b=b)


def _derivative(function, size, step=1e-6):
    return np.stack([(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(size)], axis=1)


def _noise(dt):
    q = np.repeat([0.2, 0.05, 0.01, 0.002], 3) ** 2 * dt
    Q = np.diag([*[0.0] * 3, *q, *[SIGMA_BIAS**2 * -np.expm1(-2 * dt / LASTS)] * 4])
    Q[:3, :3], Q[:3, 3:6] = np.eye(3) * 0.2**2 * dt**3 / 3, np.eye(3) * 0.2**2 * dt**2 / 2
    Q[3:6, :3] = Q[:3, 3:6]
    return Q


def _predicted(x):
    distances = np.linalg.norm(x.p - ANCHORS, axis=1) + x.b
    return distances[PAIRS[:, 0]] - distances[PAIRS[:, 1]]


def _filtered(x, P, times, accel, gyro, values, seen):
    """An error-state filter with numerical Jacobians and all differences of a row at once, with their covariance."""
    incidence = np.zeros((3, 4))
    incidence[np.arange(3)[:, None], PAIRS] = [1.0, -1.0]
    R = SIGMA**2 * (0.5 * SHARED * incidence @ incidence.T + (1 - SHARED) * np.eye(3))
    out = []
    for k, dt in enumerate(np.diff(times), 1):
        ahead = _stepped(x, accel[k], gyro[k], dt)
        F = _derivative(lambda e, x=x, a=ahead, k=k, dt=dt: _less(_stepped(_added(x, e), accel[k], gyro[k], dt), a), 19)
        x, P = ahead, F @ P @ F.T + _noise(dt)
        H = _derivative(lambda e, x=x: _predicted(_added(x, e)), 19)[seen[k]]
        innovation, S = (values[k] - _predicted(x))[seen[k]], H @ P @ H.T + R[np.ix_(seen[k], seen[k])]
        K = P @ H.T @ np.linalg.inv(S)
        x, P = _added(x, K @ innovation), P - K @ S @ K.T
        out.append((x, P, normal_log_density(innovation, S)))
    return out


@pytest.mark.slow
def test_moments_and_likelihood_are_those_of_a_filter_in_numpy():
    rng, rows = np.random.default_rng(4), 60
    times = np.cumsum(rng.uniform(0.005, 0.03, rows))
    gyro = 0.5 * np.column_stack([np.sin(3 * times), np.cos(2 * times), 1 + np.sin(times)])
    accel = GRAVITY + rng.normal(0, 1.0, (rows, 3))
    seen = (rng.random((rows, 3)) < 0.7) & (np.arange(rows) % 3 == 0)[:, None]
    place = np.array([3.0, 2.0, 1.2])
    start = SimpleNamespace(p=place, v=np.zeros(3), R=Turn.identity(), ba=np.zeros(3), bg=np.zeros(3), b=np.zeros(4))
    values = _predicted(start) + 0.3 * rng.normal(size=(rows, 3))
    inputs = {
        "pairs": np.tile(ANCHORS[PAIRS].ravel(), (rows, 1)),
        "pair": np.tile(PAIRS.ravel().astype(float), (rows, 1)),
        "nearby": np.tile([*place, 1.0], (rows, 1)),
        "rest": np.tile([*GRAVITY, 0.0, 0.0, 0.0, 0.0], (rows, 1)),
        "accel": accel,
        "gyro": gyro,
        "imu": np.ones((rows, 2)),
        "height": np.zeros(rows),
    }
    reported = np.concatenate([np.zeros((rows, 3)), correlations(np.tile(PAIRS, (rows, 1, 1)), seen)], axis=1)
    tracker = inertial_difference_tracker(4, 3, False, NOISE, SIGMA, 1e8, BiasDrift(SIGMA_BIAS, LASTS, 1e9))
    recording = Recording(times, {TDOA: Readings(values, seen, reported)}, inputs)
    found = replace(tracker, filter=YawMixtureFilter(count=1), track_loss=NEVER_LOST).run(recording)
    sigmas = [1.0, 1.0, 2.0, *[1.0] * 3, *[0.15] * 3, *[0.3] * 3, *[0.03] * 3, *[SIGMA_BIAS] * 4]
    P = np.diag(np.square(sigmas))
    P[8, 8] += 1.0  # the unknown yaw
    expected = _filtered(start, P, times, accel, gyro, np.where(seen, values, 0.0), seen)
    for k, (x, cov, density) in enumerate(expected, 1):
        mean = found.mean
        turn = Turn.from_quat([float(getattr(mean.attitude, q)[k]) for q in "xyzw"])
        parts = [np.array([float(a[k]) for a in part]) for part in (mean.position, mean.velocity)]
        biases = [np.array([float(a[k]) for a in part]) for part in (mean.accel_bias, mean.gyro_bias, mean.bias)]
        estimate = SimpleNamespace(p=parts[0], v=parts[1], R=turn, ba=biases[0], bg=biases[1], b=biases[2])
        sigma = np.sqrt(np.diag(cov))
        # In single precision, of a prior of metres: hundredths of a standard deviation.
        np.testing.assert_allclose(_less(estimate, x) / sigma, 0.0, atol=0.02)
        sigmas = np.outer(sigma, sigma)
        np.testing.assert_allclose(found.covariance[k] / sigmas, cov / sigmas, atol=0.01)
        np.testing.assert_allclose(found.log_likelihood[k], density, atol=0.02, rtol=0.01)


@pytest.fixture(scope="module")
def folder():
    return worlds.tdoa(n=2, seed=3, rows=40, imu=True).folder()


def test_rows_are_those_of_the_differences_and_of_the_samples_between(folder):
    alone, with_imu = (TRACKERS[name].trajectories(folder, False)[0].recording for name in ("tdoa", "tdoa-imu"))
    at = np.isin(with_imu.times, alone.times)
    assert at.sum() == len(alone.times)
    np.testing.assert_array_equal(with_imu.readings[TDOA].seen[at], alone.readings[TDOA].seen)
    np.testing.assert_array_equal(with_imu.inputs["pairs"][at], alone.inputs["pairs"])
    assert not with_imu.readings[TDOA].seen[~at].any()
    assert (with_imu.inputs["imu"] == 1.0).all()


def test_an_imu_is_used_on_request_and_its_absence_is_said(folder):
    assert fitting(folder) == "tdoa"
    without = replace(folder, tables={name: folder.tables[name] for name in ("tdoa", "truth")})
    with pytest.raises(UnusableInput, match="'tdoa-imu' needs an imu table, found no such table"):
        build("tdoa-imu", without)
    with pytest.raises(UnusableInput, match="a tdoa table with at least 4 anchors, found no such table"):
        build("tdoa-imu", replace(folder, tables={"imu": folder.tables["imu"]}))


def test_another_tag_of_the_body_may_have_the_imu(folder):
    tables = dict(folder.tables) | {"imu": folder.tables["imu"].filter(tag="0")}
    tags = {"0": Tag(offset=np.zeros(3)), "1": Tag(offset=np.array([0.1, 0.0, 0.0]))}
    shared = replace(folder, rig=replace(folder.rig, tags=tags, bodies={}), tables=tables)
    first, second = (t.recording for t in TRACKERS["tdoa-imu"].trajectories(shared, False))
    np.testing.assert_array_equal(second.inputs["accel"][20:], first.inputs["accel"][20:])
    np.testing.assert_array_equal(second.inputs["arm"][0], [0.1, 0.0, 0.0])


def _for_all(function):
    return jax.jit(jax.vmap(function, in_axes=-1, out_axes=-1))


def _drawn_states(prior, count, rng):
    """States drawn from beliefs, each turned to one of the filter's `count` yaws; trajectories last."""
    upper = np.stack([np.asarray(x) for x in prior.cov], axis=-1).astype(float)
    size = round((np.sqrt(8 * upper.shape[1] + 1) - 1) / 2)
    cov = np.zeros((len(upper), size, size))
    for k, (i, j) in enumerate(triangle(size)):
        cov[:, i, j] = cov[:, j, i] = upper[:, k]
    # By eigenvalues: a component that is known has the variance zero.
    values, vectors = np.linalg.eigh(cov)
    unit = np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=values.shape)
    steps = jnp.asarray(np.einsum("nij,nj->in", vectors, unit))
    states = _for_all(lambda mean, step: retract(mean, list(step)))(prior.mean, steps)
    return _for_all(with_yaw_added)(states, jnp.asarray(2 * np.pi / count * rng.integers(count, size=len(cov))))


def _own_world(tracker, recordings, seed, narrower):
    """The recordings with differences drawn from the tracker's model, the beliefs from which states are drawn, and these.

    Beliefs are those of the tracker's start with standard deviations `narrower` times as small.
    """
    rng, batch, motion, sensor = np.random.default_rng(seed), stack(recordings), tracker.motion, tracker.sensors[TDOA]
    readings, inputs = jax.tree_util.tree_map(lambda x: x[0], (batch.readings, dict(batch.inputs)))
    row = Row(batch.dt[0], batch.valid[0], readings, inputs, batch.key, jnp.zeros(batch.size, jnp.uint32))
    prior = _for_all(lambda row: tracker.start.belief(tracker.start.candidate(tracker.sensors, row), row))(row)
    prior = prior._replace(cov=tuple(x / narrower**2 for x in prior.cov))
    state, states, values = _drawn_states(prior, tracker.filter.count, rng), [], []
    step = _for_all(lambda state, inputs, dt, w: motion.step(state, inputs, dt, Vector.of(w)))
    measured = _for_all(lambda state, inputs: jnp.stack(sensor.measure(motion.view(state), inputs)))
    for k, dt in enumerate(batch.dt):
        inputs = {name: x[k] for name, x in batch.inputs.items()}
        if k:
            state = step(state, inputs, dt, jnp.asarray(rng.normal(size=(motion.noise_dimension, batch.size))))
        expected = np.asarray(measured(state, inputs))
        states.append(state)
        values.append(expected + float(sensor.sigma_d.value) * rng.standard_t(float(sensor.dof.value), expected.shape))
    priors = [jax.tree_util.tree_map(lambda x, k=k: x[..., k], prior) for k in range(batch.size)]
    redrawn = [
        replace(r, readings={TDOA: Readings(np.stack(values)[: len(r), :, k], r.readings[TDOA].seen, None)}, truth={})
        for k, r in enumerate(recordings)
    ]
    return redrawn, priors, jax.tree_util.tree_map(lambda *rows: np.stack(rows), *states)


@pytest.mark.slow
def test_covariances_are_those_of_the_errors_in_worlds_of_its_own_model():
    world = worlds.tdoa(n=60, seed=2, rows=30, imu=True).folder()
    (batch,) = build("tdoa-imu", world).batches(world)
    # With normal noise, and biases of the anchors that do not follow the speed, the filter is exact but for curvature.
    exact = {"sensors.tdoa.dof": 1e6, "motion.drift.length": 1e6}
    tracker = replace(with_values(batch.tracker, exact, "test"), track_loss=NEVER_LOST)
    recordings, priors, states = _own_world(tracker, [t.recording for t in batch.trajectories], 5, narrower=10.0)
    estimates = tracker.run(recordings, initial=priors)
    errors = np.stack([np.asarray(a) - b.T for a, b in zip(estimates.mean.position, states.position, strict=True)], -1)
    late = slice(200, None)
    squares = nees(errors[:, late].reshape(-1, 3), estimates.covariance[:, late, :3, :3].reshape(-1, 3, 3))
    means = squares.reshape(60, -1).mean(axis=1) / 3
    assert abs(means.mean() - 1.0) < 3.0 * means.std() / np.sqrt(60) + 0.05
    inside = nees(errors[:, late, :2].reshape(-1, 2), estimates.covariance[:, late, :2, :2].reshape(-1, 2, 2)) < 5.991
    assert 0.91 < inside.mean() < 0.98
