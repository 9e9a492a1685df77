"""Mirrored heights: two branches are the enumeration of both, and a floor tells which one it is."""

from itertools import pairwise, product

import equinox as eqx
import numpy as np
import pytest

from sim.agv import simulate_agv
from sim.fixes import correlated_noise, mirrored
from sim.tables.agv import simulated_agv
from tests.known_start import NEVER_LOST, KnownStart, recording
from tests.oracles import normal_log_density, van_loan
from trackers.baselines.rows import side_trajectories
from trackers.baselines.switching import SideSensor, mirror_tracker
from trackers.core.algebra import Vector
from trackers.core.checks import check_sensor
from trackers.core.imm import InteractingModels
from trackers.core.motion import GroundMotion, Kinematic
from trackers.core.recording import Readings, Recording, stack
from trackers.core.tunable import Real
from trackers.mhk.tracker import STILL
from trackers.parts.fixes import FIXES, FixTracker

PLANE, OFFSET, SHRINK, SIGMA, SIGMA_A, SIGMA_Z = 1.5, 0.3, 0.8, 0.15, 0.5, 0.4
MEAN, COV = np.array([0.1, 0.2, 1.2, 0.0, 0.0]), np.diag([1.0, 1.0, 0.6, 0.3, 0.3])


def _state(x):
    return Kinematic(Vector(*x[:3]), Vector(*x[3:]))


def _readings(rows):
    rng = np.random.default_rng(3)
    # From well under the plane through it to well over it; which side is never said.
    off = np.abs(np.linspace(-1.2, 1.0, rows)) * SHRINK + OFFSET + 0.05 * rng.normal(size=rows)
    values = np.stack([0.1 * rng.normal(size=rows), 0.1 * rng.normal(size=rows), off, np.zeros(rows)], axis=1)
    return np.arange(rows) * 0.2, values


def _estimates(rate, rows):
    sensor = SideSensor(SIGMA, SIGMA, OFFSET, SHRINK, None)
    # The floor so far below that it has no say: what is left is linear, so that enumeration is exact.
    sensor = eqx.tree_at(lambda s: s.floor, sensor, Real(-1000.0, "m"))
    times, values = _readings(rows)
    tracker = FixTracker(
        GroundMotion(SIGMA_A, SIGMA_Z),
        {FIXES: sensor},
        KnownStart(_state),
        InteractingModels(rate, [1.0, 1.0]),
        NEVER_LOST,
    )
    inputs = {"plane": np.full(rows, PLANE)}
    return tracker.run(recording(times, {FIXES: (values, np.ones(values.shape, bool))}, MEAN, COV, inputs))


def _enumerated(rate, rows):
    """The exact mean height and its variance at the last row, over every sequence of sides."""
    _, values = _readings(rows)
    A = np.zeros((5, 5))
    A[0, 3] = A[1, 4] = 1.0
    F, Q = van_loan(A, np.diag([0, 0, SIGMA_Z**2, SIGMA_A**2, SIGMA_A**2]), 0.2)
    kept = np.exp(-rate * 0.2)
    weights, means, covs = [], [], []
    for sides in product((-1.0, 1.0), repeat=rows - 1):
        # Only changes between rows with readings have a probability; the first row's side is even.
        chain = [0.5] + [0.5 * (1 - kept) + (kept if a == b else 0.0) for a, b in pairwise(sides)]
        m, C, ll = MEAN, COV, np.sum(np.log(np.maximum(chain, 1e-300)))
        for side, z in zip(sides, values[1:], strict=True):
            m, C = F @ m, F @ C @ F.T + Q
            H = np.eye(3, 5)
            H[2, 2] = SHRINK * side
            e = z[:3] - H @ m - np.array([0, 0, OFFSET - SHRINK * side * PLANE])
            S = H @ C @ H.T + SIGMA**2 * np.eye(3)
            ll += normal_log_density(e, S)
            K = C @ H.T @ np.linalg.inv(S)
            m, C = m + K @ e, C - K @ S @ K.T
        weights.append(ll)
        means.append(m[2])
        covs.append(C[2, 2])
    # What the floor's channel adds to every sequence alike.
    floor = (rows - 1) * (-0.5 * np.log(2 * np.pi) - np.log(0.3))
    evidence = np.logaddexp.reduce(weights)
    w = np.exp(np.array(weights) - evidence)
    mean = w @ means
    return mean, w @ (np.array(covs) + (np.array(means) - mean) ** 2), evidence + floor


def test_without_switching_the_mixture_is_the_enumeration_of_both_sides():
    estimates = _estimates(1e-9, 7)
    mean, variance, evidence = _enumerated(1e-9, 7)
    # Switching at 1e-9 per second is left out by neither; it weighs 1e-9.
    assert estimates.mean.position[2][-1] == pytest.approx(mean, abs=1e-7)
    assert estimates.covariance[-1, 2, 2] == pytest.approx(variance, rel=1e-6)
    assert estimates.log_likelihood.sum() == pytest.approx(evidence, abs=1e-6)


def test_with_switching_the_mixture_is_near_the_enumeration_of_all_128_sequences():
    estimates = _estimates(1.0, 8)
    mean, variance, evidence = _enumerated(1.0, 8)
    # Moments of merged branches are no exact ones: the method's error, a fraction of the spread it reports.
    assert abs(estimates.mean.position[2][-1] - mean) < 0.2 * np.sqrt(variance)
    assert estimates.covariance[-1, 2, 2] == pytest.approx(variance, rel=0.3)
    assert estimates.log_likelihood.sum() == pytest.approx(evidence, abs=0.5)


@pytest.mark.parametrize("mode", [0, 1])
def test_the_sensor_keeps_the_contract_in_both_modes(mode):
    sensor = SideSensor(0.1, 0.3, OFFSET, SHRINK, 4.0).in_mode(mode)
    check_sensor(sensor, Kinematic(Vector(1.0, -2.0, 0.5), Vector(0.3, -0.4)), {"plane": np.array(1.5)})


@pytest.fixture(scope="module")
def climbing():
    """A tag that rises through the anchors' plane to twice its height and beyond; fixes stay under it."""
    times = np.arange(0, 30, 0.1)
    z = np.clip(0.15 * times - 0.5, 0.2, 3.6)
    rng = np.random.default_rng(0)
    d = OFFSET + SHRINK * np.abs(z - PLANE) + 0.05 * rng.normal(size=len(times))
    xy = 0.05 * rng.normal(size=(len(times), 2))
    values = np.column_stack([xy, d, np.zeros(len(times))])
    readings = {FIXES: Readings(values, np.ones(values.shape, bool))}
    inputs = {"plane": np.full(len(times), PLANE), "shown": PLANE - d, "height": np.zeros(len(times))}
    world = Recording(times, readings, inputs)
    return times, z, mirror_tracker(offset=OFFSET, shrink=SHRINK).run(world)


def test_a_height_whose_mirror_image_is_under_the_floor_is_found_above_the_plane(climbing):
    _, z, estimates = climbing
    high = z > 2 * PLANE + 0.3
    assert np.abs(estimates.mean.position[2] - z)[high].max() < 0.3


def test_where_nothing_tells_the_sides_apart_both_lie_inside_the_reported_spread(climbing):
    _, z, estimates = climbing
    middle = (z > PLANE + 0.5) & (z < 2 * PLANE - 0.5)
    spread = estimates.sigmas["position.2"][middle]
    height = estimates.mean.position[2][middle]
    for side in (z[middle], 2 * PLANE - z[middle]):
        assert np.all(np.abs(height - side) < 2 * spread + 0.2)


def test_a_track_begins_on_the_side_that_its_first_fix_showed(climbing):
    _, z, estimates = climbing
    # Metres under the plane, where the mirror image is as good: the first fix alone speaks against it.
    assert np.abs(estimates.mean.position[2] - z)[5:30].max() < 0.6


@pytest.mark.slow
def test_heights_that_flip_for_seconds_do_not_take_a_track_with_them():
    errors = {"mirror": mirrored(2.5, 0.3, 3.0), "noise": correlated_noise(STILL)}
    world = simulate_agv([0, 1, 2], rows=400, height=1.2, errors=errors)
    assert not (world.fixes[:, 0, 2] > 2.5).any()  # every track begins on its own side
    trajectories = list(side_trajectories(simulated_agv(world, "flips"), True))
    tracker = mirror_tracker(offset=0.0, shrink=1.0, sigma_vertical=0.1, sigma_z=0.3)
    estimates = tracker.run(stack([trajectory.recording for trajectory in trajectories]))
    z = np.stack([estimates[k].mean.position[2] for k in range(3)])[:, 20:]
    # A third of the fixes is 2.6 m off; the other branch keeps a few percent of the belief.
    assert np.abs(world.fixes[:, 20:, 2] - 1.2).max() > 2.5
    assert np.abs(z - 1.2).max() < 0.5
