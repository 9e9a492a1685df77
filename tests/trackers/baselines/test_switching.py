"""Mirrored heights: the IMM of both sides against enumeration, and the floor that resolves the ambiguity."""

from itertools import pairwise, product

import equinox as eqx
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, recording
from tests.oracles import normal_log_density, van_loan
from trackwright.trackers.baselines.switching import MirrorSensor, mirror_tracker
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.filters.imm import InteractingModels
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import GroundMotion, Kinematic
from trackwright.trackers.core.model.tunable import Real
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.fixes import FIXES

pytestmark = pytest.mark.slow

PLANE, OFFSET, SHRINK, SIGMA, SIGMA_A, SIGMA_Z = 1.5, 0.3, 0.8, 0.15, 0.5, 0.4
MEAN, COV = np.array([0.1, 0.2, 1.2, 0.0, 0.0]), np.diag([1.0, 1.0, 0.6, 0.3, 0.3])


def _state(x):
    return Kinematic(Vector(*x[:3]), Vector(*x[3:]))


def _readings(rows):
    rng = np.random.default_rng(3)
    # From well below the plane to well above it; the measurements do not contain the side.
    off = np.abs(np.linspace(-1.2, 1.0, rows)) * SHRINK + OFFSET + 0.05 * rng.normal(size=rows)
    values = np.stack([0.1 * rng.normal(size=rows), 0.1 * rng.normal(size=rows), off, np.zeros(rows)], axis=1)
    return np.arange(rows) * 0.2, values


def _estimates(rate, rows):
    sensor = MirrorSensor(SIGMA, SIGMA, OFFSET, SHRINK, None)
    # With the floor far below, the model is linear and enumeration is exact.
    sensor = eqx.tree_at(lambda s: s.floor, sensor, Real(-1000.0, "m"))
    times, values = _readings(rows)
    tracker = Tracker(
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
        # Only switches between rows with measurements have a probability; both sides are equally likely at first.
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
    # The contribution of the floor's channel, the same for all sequences.
    floor = (rows - 1) * (-0.5 * np.log(2 * np.pi) - np.log(0.3))
    evidence = np.logaddexp.reduce(weights)
    w = np.exp(np.array(weights) - evidence)
    mean = w @ means
    return mean, w @ (np.array(covs) + (np.array(means) - mean) ** 2), evidence + floor


def test_without_switching_the_mixture_is_the_enumeration_of_both_sides():
    estimates = _estimates(1e-9, 7)
    mean, variance, evidence = _enumerated(1e-9, 7)
    # Both include switching at 1e-9 per second, a contribution of 1e-9.
    assert estimates.mean.position[2][-1] == pytest.approx(mean, abs=1e-7)
    assert estimates.covariance[-1, 2, 2] == pytest.approx(variance, rel=1e-6)
    assert estimates.log_likelihood.sum() == pytest.approx(evidence, abs=1e-6)


def test_with_switching_the_mixture_is_near_the_enumeration_of_all_128_sequences():
    estimates = _estimates(1.0, 8)
    mean, variance, evidence = _enumerated(1.0, 8)
    # Moment matching is approximate; its error is a fraction of the reported standard deviation.
    assert abs(estimates.mean.position[2][-1] - mean) < 0.2 * np.sqrt(variance)
    assert estimates.covariance[-1, 2, 2] == pytest.approx(variance, rel=0.3)
    assert estimates.log_likelihood.sum() == pytest.approx(evidence, abs=0.5)


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
    inputs = {"plane": np.full(len(times), PLANE), "fix_z": PLANE - d, "height": np.zeros(len(times))}
    world, tracker = Recording(times, readings, inputs), mirror_tracker(offset=OFFSET, shrink=SHRINK)
    return z, tracker.run(world), Smoothed(tracker).run(world)


def test_a_height_whose_mirror_image_is_below_the_floor_is_resolved(climbing):
    z, estimates, _ = climbing
    high = z > 2 * PLANE + 0.3
    assert np.abs(estimates.mean.position[2] - z)[high].max() < 0.3


def test_where_the_side_is_ambiguous_both_lie_within_the_reported_covariance(climbing):
    z, estimates, _ = climbing
    middle = (z > PLANE + 0.5) & (z < 2 * PLANE - 0.5)
    sigma = estimates.sigmas["position.2"][middle]
    height = estimates.mean.position[2][middle]
    for side in (z[middle], 2 * PLANE - z[middle]):
        assert np.all(np.abs(height - side) < 2 * sigma + 0.2)


def test_later_fixes_resolve_the_side_where_filtered_heights_are_ambiguous(climbing):
    z, filtered, smoothed = climbing
    middle = (z > PLANE + 0.5) & (z < 2 * PLANE - 0.5)
    errors = [np.abs(e.mean.position[2] - z)[middle].mean() for e in (filtered, smoothed)]
    assert errors[1] < 0.5 * errors[0]


def test_a_track_starts_on_the_side_of_its_first_fix(climbing):
    z, estimates, _ = climbing
    # Metres below the plane the mirror image fits equally well; only the first fix favours the true side.
    assert np.abs(estimates.mean.position[2] - z)[5:30].max() < 0.6
