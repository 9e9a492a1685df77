"""Odometry of wheels: the motion against fine steps, the filter against dense conditioning, and what it finds."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.known_start import NEVER_LOST, KnownStart, recording
from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.experiments.monte_carlo.chunk import run_chunk
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.model.tunable import Real
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import DriftingBiases
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.body import HOLD_S, BodyState, TurningBody, Wheels, odometry_inputs

PLACE = DriftingBiases(0, 0.5, 0.5, 5.0, 0.1, 10.0, 5.0)
SLIP, YAW = 0.02, 0.05
DRIVEN = TurningBody(PLACE, 0.5, 1.0, Wheels(SLIP, YAW))


def _state(x):
    return BodyState(Vector(*x[:2]), Heading(x[2]), Vector(*x[3:5]), x[5], Vector(), Vector(0.0 * x[0]))


def _stepped(motion, x, odometry, arm, dt):
    inputs = {"odometry": np.array(odometry), "arm": np.array(arm)}
    after = motion.step(_state(x), inputs, dt, Vector(*[0.0] * motion.noise_dimension))
    return np.array([*after.position, after.attitude.angle, *after.velocity, after.rate], float)


@pytest.mark.parametrize(("speed", "rate"), [(0.5, 0.0), (0.8, -2.0), (0.0, 3.0)])
@pytest.mark.parametrize("stated", [0.4, 1.0])
def test_a_tag_beside_the_axle_moves_as_by_fine_steps(speed, rate, stated):
    """The lever arm is that of the rig and what a fit adds to it."""
    start, arm, dt, n = np.array([1.0, 2.0, 0.4, 0.0, 0.0, 0.0]), np.array([0.3, -0.2]), 0.5, 20_000
    headings = start[2] + rate * dt * (np.arange(n) + 0.5) / n
    axle = np.array([speed * dt * np.cos(headings).mean(), speed * dt * np.sin(headings).mean()])

    def tag(heading):
        turned = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        return turned @ arm, turned @ np.array([speed, 0.0])

    (before, _), (after, ahead) = tag(start[2]), tag(start[2] + rate * dt)
    expected = [*(start[:2] + axle + after - before), start[2] + rate * dt]
    expected += [*(ahead + rate * np.array([-after[1], after[0]])), rate]
    motion = eqx.tree_at(lambda m: m.wheels.arm, DRIVEN, Real((1.0 - stated) * arm, "m"))
    found = _stepped(motion, start, (speed, rate, 1.0), (*(stated * arm), 0.0), dt)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_body_whose_odometry_is_missing_moves_as_one_without_wheels():
    x = np.array([1.0, 2.0, 0.4, 0.3, 0.2, 0.5])
    free = _stepped(TurningBody(PLACE, 0.5, 1.0), x, (0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 0.5)
    np.testing.assert_array_equal(_stepped(DRIVEN, x, (9.0, 9.0, 0.0), (0.3, 0.0, 0.0), 0.5), free)
    np.testing.assert_array_equal(_stepped(DRIVEN, x, (9.0, 9.0, 1.0), (0.3, 0.0, 0.0), 0.0), x)


def test_a_reading_holds_until_the_next_and_no_longer_than_a_second():
    readings = np.array([[1.0, 0.1], [np.nan, 0.2], [3.0, 0.3]])
    rows = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.6 + HOLD_S])
    expected = [[0, 0, 0], [0, 0, 0], [1, 0.1, 1], [1, 0.1, 1], [3, 0.3, 1], [0, 0, 0]]
    np.testing.assert_array_equal(odometry_inputs(rows, np.array([0.5, 1.2, 1.5]), readings), expected)


@pytest.mark.slow
def test_filter_and_smoother_equal_dense_conditioning():
    """All errors of a short way at once by least squares in double precision, whose normal matrix is the information."""
    rng, n, dt, sigma_r, arm = np.random.default_rng(3), 12, 0.2, 0.05, np.array([0.3, -0.2])
    anchors = np.array([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.0, 8.0, 0.0], [0.0, 8.0, 0.0]])
    odometry = np.column_stack([0.6 + 0.2 * np.sin(np.arange(n)), np.cos(0.7 * np.arange(n)), np.ones(n)])
    mean, sigmas, number = np.array([3.0, 4.0, 0.5]), np.array([0.1, 0.1, 0.05]), np.arange(n) % 4

    def path(draws):
        x, places = mean + sigmas * draws[:3], []
        for k in range(n):
            if k:
                v, w, _ = odometry[k]
                middle, after = x[2] + 0.5 * w * dt, x[2] + w * dt + YAW * dt**0.5 * draws[3 * k + 2]
                chord = v * dt * np.sinc(w * dt / (2 * np.pi))
                lever = [np.array([[np.cos(h), -np.sin(h)], [np.sin(h), np.cos(h)]]) @ arm for h in (x[2], after)]
                moved = chord * np.array([np.cos(middle), np.sin(middle)]) + lever[1] - lever[0]
                x = np.array([*(x[:2] + moved + SLIP * dt**0.5 * draws[3 * k : 3 * k + 2]), after])
            places.append(x)
        return np.array(places)

    true = path(rng.normal(size=3 * n))
    ranges = np.linalg.norm(true[:, :2] - anchors[number, :2], axis=1) + sigma_r * rng.normal(size=n)

    def residuals(draws):
        away = np.linalg.norm(path(draws)[:, :2] - anchors[number, :2], axis=1)
        # The belief of a start is the one after its row.
        return np.concatenate([((ranges - away) / sigma_r)[1:], draws])

    fitted = least_squares(residuals, np.zeros(3 * n), xtol=1e-12)
    slopes = np.stack([(path(fitted.x + 1e-5 * e) - path(fitted.x - 1e-5 * e)) / 2e-5 for e in np.eye(3 * n)], axis=-1)
    cov = np.einsum("tik,kl,tjl->tij", slopes, np.linalg.inv(fitted.jac.T @ fitted.jac), slopes)

    inputs = {"odometry": odometry, "arm": np.tile([*arm, 0.0], (n, 1)), "height": np.zeros(n)}
    inputs |= {"anchors": anchors[number], "anchor": number[:, None] * 1.0}
    prior = np.diag([*sigmas**2, 1.0, 1.0, 1.0, 1e-8])
    rows = recording(
        np.arange(n) * dt, {"ranges": (ranges[:, None], np.ones((n, 1), bool))}, [*mean, 0, 0, 0], prior, inputs
    )
    sensor = RangeSensor(1, 0, sigma_r, 1.0, 1e6)
    tracker = Tracker(DRIVEN, {"ranges": sensor}, KnownStart(lambda x: _state(jnp.asarray(x))), track_loss=NEVER_LOST)
    for estimates, some in ((tracker.run(rows), [n - 1]), (Smoothed(tracker, None).run(rows), range(n))):
        found = np.stack(
            [*map(np.asarray, estimates.mean.position), np.asarray(estimates.mean.attitude.angle)], axis=-1
        )
        for k in some:
            sigma = np.sqrt(np.diagonal(cov[k]))
            np.testing.assert_allclose((found[k] - path(fitted.x)[k]) / sigma, 0.0, atol=0.05)
            np.testing.assert_allclose(
                np.asarray(estimates.covariance)[k, :3, :3] / np.outer(sigma, sigma),
                cov[k] / np.outer(sigma, sigma),
                atol=0.05,
            )


@pytest.mark.slow
def test_studies_count_bodies():
    worlds = {"body": World(WORLDS["body"], {"rows": 150, "tags": 2, "odometry": True, "hidden": 0.0, "lost": 0.0})}
    study = Study("body", "", worlds, {"body": TrackerConfig("body")}, runs=2, metrics=["rmse_m"])
    (arrays,) = run_chunk(study, study.conditions[0], np.arange(2), False)
    assert (arrays["sum n"] > 0).tolist() == [True, True]
