"""On linear models the smoothed rows are those of dense conditioning on all rows, or on those of the next seconds."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, LinearSensor, flat, recording
from tests.oracles import joint_conditioning, van_loan
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import AbstractMotion, ConstantPosition, ConstantVelocity, Kinematic, Placed
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import Tracker

LANES, ROWS, LAG, SIGMA_A = 4, 12, 0.9, 0.7
FEW, MANY = 1, 16  # copies of the lanes: covariances as matrices, and as scalars that are smoothed in two blocks


def _state(x):
    return Kinematic(Vector(*x[:2]), Vector(*x[2:]))


class HalfSteps(AbstractMotion):
    """Half a step of straight motion, a change of velocity, the other half: the noise passes through a later stage."""

    noise_dimension = 2

    def step(self, state, inputs, dt, w):
        for stage in self.stages:
            state = stage(state, inputs, dt, w)
        return state

    @property
    def stages(self):
        return self.coast, self.kick, self.coast

    def coast(self, state, inputs, dt, w):
        return state._replace(position=state.position + state.velocity * (0.5 * dt))

    def kick(self, state, inputs, dt, w):
        return state._replace(velocity=state.velocity + w * (SIGMA_A * jnp.sqrt(dt)))


def _constant_velocity(dt):
    A = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2))
    return van_loan(A, np.kron([[0.0, 0.0], [0.0, SIGMA_A**2]], np.eye(2)), dt)


def _half_steps(dt):
    gain = np.kron([[0.5 * dt], [1.0]], np.eye(2)) * SIGMA_A * np.sqrt(dt)
    return np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2)), gain @ gain.T


class World:
    """Sparse readings of a linear model at irregular times, ragged, and a tracker of it."""

    def __init__(self, motion=None, transition=_constant_velocity):
        self.motion, self.transition = motion or ConstantVelocity(SIGMA_A, 2), transition
        rng = np.random.default_rng(5)
        self.H, self.sigmas = rng.normal(size=(3, 4)), rng.uniform(0.1, 0.5, 3)
        factor = rng.normal(size=(4, 4))
        self.mean, self.cov = rng.normal(size=4), factor @ factor.T + np.eye(4)
        self.tracker = self.with_loss(NEVER_LOST)
        self.trajectories = []
        for trajectory in range(LANES):
            # A quarter of the rows share their time with the row before.
            steps = rng.exponential(0.4, ROWS - trajectory) * (rng.random(ROWS - trajectory) > 0.25)
            values, seen = rng.normal(size=(len(steps), 3)) * 3, rng.random((len(steps), 3)) > 0.4
            self.trajectories.append((np.cumsum(steps), values, seen))
        self.batch = self.stacked()

    def with_loss(self, loss):
        sensors = {"z": LinearSensor(self.H, self.sigmas, 3)}
        return Tracker(self.motion, sensors, KnownStart(_state), track_loss=loss)

    def stacked(self, copies=1):
        return stack([recording(t, {"z": (z, s)}, self.mean, self.cov) for t, z, s in self.trajectories * copies])

    def oracle(self, trajectory, lag):
        times, values, seen = self.trajectories[trajectory]
        transitions = [self.transition(dt) for dt in np.diff(times)]
        until = None if lag is None else [int(np.sum(times[1:] <= t + lag + 1e-12)) - 1 for t in times[1:]]
        R = np.diag(self.sigmas**2)
        return joint_conditioning(transitions, self.H, R, values[1:], seen[1:], self.mean, self.cov, until)[:2]


@pytest.fixture(scope="module")
def world():
    return World()


@pytest.mark.parametrize("copies", [FEW, MANY], ids=["few", "many"])
@pytest.mark.parametrize("lag", [None, LAG], ids=["fixed interval", "fixed lag"])
def test_smoothed_rows_are_those_of_dense_conditioning(world, lag, copies):
    estimates = Smoothed(world.tracker, lag).run(world.stacked(copies=copies))
    expected = [world.oracle(lane, np.inf if lag is None else lag) for lane in range(LANES)]
    for trajectory in range(LANES * copies):
        rows = slice(1, len(world.trajectories[trajectory % LANES][0]))
        means, covs = expected[trajectory % LANES]
        # Both sides invert matrices with condition numbers of about 1e4.
        np.testing.assert_allclose(flat(estimates[trajectory].mean)[rows], means, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(estimates[trajectory].covariance[rows], covs, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("gap", [86400.0, 1.7e9])
def test_in_single_precision_a_fixed_lag_is_as_long_after_a_long_gap(world, gap):
    rng, rows = np.random.default_rng(1), 60
    values, times = rng.normal(size=(rows, 3)), np.arange(rows) * 0.01
    readings = {"z": (values, np.ones((rows, 3), bool))}
    before = {"z": (np.zeros((rows + 1, 3)), np.arange(rows + 1)[:, None] > 0 * np.ones((1, 3)))}
    before["z"][0][1:] = values
    # The track starts again after the gap, with the same belief.
    short = TrackLossPolicy(nis_limit=np.inf, nis_window=1.0, max_gap=1.0)
    tracker = Smoothed(world.with_loss(short), 0.2)
    one, other = (
        tracker.run(stack([recording(*rows_, world.mean, world.cov)], rows=rows + 1, dtype=np.float32))
        for rows_ in ((times, readings), (np.append(-gap, times), before))
    )
    np.testing.assert_allclose(flat(other.mean)[0, 1:], flat(one.mean)[0, :-1], atol=1e-5)


def test_noise_of_an_early_stage_passes_through_the_later_ones():
    world = World(HalfSteps(), _half_steps)
    estimates = Smoothed(world.tracker).run(world.batch)
    for trajectory in range(LANES):
        rows = slice(1, len(world.trajectories[trajectory][0]))
        means, covs = world.oracle(trajectory, np.inf)
        np.testing.assert_allclose(flat(estimates[trajectory].mean)[rows], means, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(estimates[trajectory].covariance[rows], covs, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(
    ("lag", "copies"),
    [
        pytest.param(None, FEW, id="few"),
        pytest.param(LAG, MANY, id="many with a fixed lag"),
        pytest.param(LAG, FEW, id="few with a fixed lag", marks=pytest.mark.slow),
        pytest.param(None, MANY, id="many", marks=pytest.mark.slow),
    ],
)
def test_with_lasting_errors_variances_bound_those_of_any_correlation(world, lag, copies):
    """The smoothed error is M e + r, e the filter's: with a correlation of one the standard deviations add up."""
    batch = world.stacked(copies=copies)
    lasting = Smoothed(dataclasses.replace(world.tracker, lasting_errors=True), lag).run(batch)
    np.testing.assert_array_equal(flat(lasting.mean), flat(Smoothed(world.tracker, lag).run(batch).mean))
    # Conditioned on the rows up to each, and on those to come.
    expected = [[world.oracle(lane, seconds)[1] for seconds in (None, lag or np.inf)] for lane in range(LANES)]
    at_most = 0
    for trajectory in range(LANES * copies):
        rows = slice(1, len(world.trajectories[trajectory % LANES][0]))
        before, P = expected[trajectory % LANES]
        M = P @ np.linalg.inv(before)
        of_filter = np.einsum("tij,tjk,tik->ti", M, before, M)
        model = np.einsum("tii->ti", P)
        added_up = (np.sqrt(of_filter) + np.sqrt(np.maximum(model - of_filter, 0.0))) ** 2
        reported = lasting[trajectory].covariance[rows]
        variances = np.einsum("tii->ti", reported)
        assert np.all(variances > added_up * (1 - 1e-6))
        assert np.all(variances < 2 * model * (1 + 1e-6))
        at_most += np.sum(variances > 2 * model * (1 - 1e-6))
        correlations = [x / np.sqrt(np.einsum("ti,tj->tij", d, d)) for x, d in ((reported, variances), (P, model))]
        np.testing.assert_allclose(*correlations, atol=1e-6)
        np.testing.assert_allclose(variances[-1], model[-1], rtol=1e-6)
    assert at_most > 20 * copies


def test_one_component_alone_has_the_variance_of_errors_with_a_correlation_of_one():
    """Filter and later readings as two estimates of the place, weighed as the smoother does; half-way it is 2 Pˢ."""
    rng, times, R, start = np.random.default_rng(3), np.arange(15) * 0.4, 2.0, 9.0 * np.eye(1)
    readings = rng.normal(size=(len(times), 1)), np.ones((len(times), 1), bool)
    sensors = {"z": LinearSensor(np.eye(1), np.array([np.sqrt(R)]), 1)}
    tracker = Tracker(
        ConstantPosition(SIGMA_A, 1),
        sensors,
        KnownStart(lambda x: Placed(Vector(*x))),
        track_loss=NEVER_LOST,
        lasting_errors=True,
    )
    reported = Smoothed(tracker).run(recording(times, {"z": readings}, np.zeros(1), start)).covariance[:, 0, 0]
    steps = [(np.eye(1), SIGMA_A**2 * dt * np.eye(1)) for dt in np.diff(times)]
    every = [len(steps) - 1] * len(steps)
    model = steps, np.eye(1), R * np.eye(1), readings[0][1:], readings[1][1:], np.zeros(1), start
    filtered, smoothed = (joint_conditioning(*model, until)[1][:-1, 0, 0] for until in (None, every))
    later = 1 / (1 / smoothed - 1 / filtered)
    weight = smoothed / filtered
    added_up = (weight * np.sqrt(filtered) + (1 - weight) * np.sqrt(later)) ** 2
    assert 3 < np.sum(weight > 0.5) < len(weight)
    expected = np.where(weight > 0.5, added_up, 2 * smoothed)
    np.testing.assert_allclose(reported[1:-1], expected, rtol=1e-6)


@pytest.mark.parametrize("copies", [FEW, MANY])
def test_rows_at_one_time_have_one_estimate_wherever_they_are(world, copies):
    """Trajectories side by side with rows at other times: each row at the time of the next one has its estimate."""
    estimates = Smoothed(world.tracker).run(world.stacked(copies=copies))
    for trajectory, (times, _, _) in enumerate(world.trajectories * copies):
        means = flat(estimates[trajectory].mean)[: len(times)]
        same = np.flatnonzero(np.diff(times) == 0)
        np.testing.assert_array_equal(means[same], means[same + 1])
        other = np.flatnonzero(np.diff(times) != 0)
        assert np.all(np.any(means[other] != means[other + 1], axis=1))


def test_what_the_filter_said_and_its_last_row_stay(world):
    filtered, smoothed = world.tracker.run(world.batch), Smoothed(world.tracker).run(world.batch)
    np.testing.assert_array_equal(filtered.log_likelihood, smoothed.log_likelihood)
    np.testing.assert_array_equal(filtered.status, smoothed.status)
    for trajectory in range(LANES):
        last = len(world.trajectories[trajectory][0]) - 1
        np.testing.assert_array_equal(flat(filtered[trajectory].mean)[last], flat(smoothed[trajectory].mean)[last])


def test_nothing_reaches_back_over_a_new_start(world):
    # A NIS beyond the limit ends the track, and the next row starts a new one.
    fragile = world.with_loss(TrackLossPolicy(nis_limit=3.0, nis_window=1.0, max_gap=np.inf))
    filtered, smoothed = fragile.run(world.batch), Smoothed(fragile).run(world.batch)
    before = np.argwhere(filtered.status[:, 1:] == Status.RESTARTED)
    assert len(before) > 3
    for trajectory, row in before:
        np.testing.assert_array_equal(flat(filtered[trajectory].mean)[row], flat(smoothed[trajectory].mean)[row])


def _still_tags(variance):
    """Smoothed in single and in double precision: 2 s of readings of 1 mm at 100 Hz after a start this uncertain, m²."""
    rng, shape = np.random.default_rng(2), (200, 2)
    sensors = {"z": LinearSensor(np.eye(2, 4), np.full(2, 1e-3), 2)}
    tracker = Smoothed(Tracker(ConstantVelocity(1e-2, 2), sensors, KnownStart(_state), track_loss=NEVER_LOST))
    cov = np.diag([variance, variance, 1.0, 1.0])
    every = [{"z": (rng.normal(size=shape) * 1e-3, np.ones(shape, bool))} for _ in range(16)]
    trajectories = [recording(np.arange(shape[0]) * 0.01, readings, np.zeros(4), cov) for readings in every]
    return tuple(tracker.run(stack(trajectories, dtype=dtype)) for dtype in (np.float32, np.float64))


@pytest.mark.slow
def test_in_single_precision_covariances_stay_proper_after_a_diffuse_start():
    single, _ = _still_tags(1e4)
    assert np.all(np.isfinite(flat(single.mean)))
    assert np.all(np.linalg.eigvalsh(single.covariance.astype(float)) > 0)


def test_single_precision_smooths_as_double_precision_does():
    single, double = _still_tags(1e-2)
    sigma = np.sqrt(np.einsum("...ii->...i", double.covariance))
    # Rounding of 200 rows there and back, in units of what is known: a hundredth changes no decision.
    assert np.max(np.abs(flat(single.mean) - flat(double.mean)) / sigma) < 0.01
    np.testing.assert_allclose(np.sqrt(np.einsum("...ii->...i", single.covariance)), sigma, rtol=0.01)
