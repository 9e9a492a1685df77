"""The first steps from a normal prior with half its speeds below zero: particles and grid against quadrature."""

import numpy as np
import pytest
from scipy.stats import norm

from tests.known_start import NEVER_LOST, KnownStart, recording
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.filters.particle.filter import ParticleFilter
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import HaltingMotion, HaltingState, LineMotion, PathOutputMap, PathState
from trackwright.trackers.line.tracker import FloorFixes
from trackwright.trackers.parts.fixes import FIXES

LINE, CORNER = Polyline([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]]), 2.0
DT, SIGMA_A, SIGMA_FIX, HALTING = 1.0, 0.1, 0.2, 0.6
MEAN, SPREAD = (1.6, 0.0), (0.1, 0.5)
PLACES = np.array([1.6, 2.0, 2.3])
"""Arclengths at which the fixes are taken, m: the tag passes the corner or halts there."""

KEYS, MAP = 64, PathOutputMap(LINE, Scale(1e-3, "m"))
FILTERS = {"particles": ParticleFilter(2000, output_map=MAP), "grid": GridFilter(MAP, 1001, 151, 3.0)}


def _floor(arclength):
    """Positions (..., 2) m on the path."""
    return np.stack([np.minimum(arclength, CORNER), np.maximum(arclength - CORNER, 0.0)], axis=-1)


def _density(arclength, row):
    """The density of a row's fix at these arclengths."""
    return norm.pdf(_floor(PLACES[row]) - _floor(arclength), scale=SIGMA_FIX).prod(axis=-1)


def _quadrature(halting):
    """The log-likelihood of the second and third fix, and the initial mean speed, by midpoint sums over all draws.

    The initial speed is max(0, normal), as every later one. A rest lasts beyond the third fix: its place is the corner.
    """
    start = MEAN[0] + SPREAD[0] * norm.ppf((np.arange(200) + 0.5) / 200)[:, None, None]
    speed = np.maximum(0.0, MEAN[1] + SPREAD[1] * norm.ppf((np.arange(1000) + 0.5) / 1000))[None, :, None]
    change = SIGMA_A * np.sqrt(DT) * norm.ppf((np.arange(100) + 0.5) / 100)[None, None, :]
    there = start + speed * DT
    later = there + np.maximum(0.0, speed + change) * DT
    corner = [_density(np.array(CORNER), row) for row in range(3)]
    first, second = np.where(there >= CORNER, halting, 0.0), np.where((there < CORNER) & (later >= CORNER), halting, 0)
    halts_second = second * corner[2] + (1 - second) * _density(later, 2)
    fixes = first * corner[1] * corner[2] + (1 - first) * _density(there, 1) * halts_second
    return np.log(fixes.mean()), speed.mean()


def _run(kind, filter, keys):
    rest = 0.0 if kind == "halting" else None
    motion = LineMotion(LINE, SIGMA_A) if rest is None else HaltingMotion(LINE, SIGMA_A, halting=HALTING, rest=1e6)
    mean, spread = list(MEAN), list(SPREAD)
    if rest is not None:
        mean, spread = [*mean, rest], [*spread, 0.0]
    start = KnownStart((lambda x: PathState(*x)) if rest is None else (lambda x: HaltingState(*x)))
    tracker = Tracker(motion, {FIXES: FloorFixes(SIGMA_FIX, None)}, start, filter, NEVER_LOST)
    values = _floor(PLACES)
    one = {FIXES: (values, np.ones_like(values, bool))}
    cov = np.diag(spread) ** 2
    return tracker.run(stack([recording(DT * np.arange(3), one, mean, cov, name=f"key {k}") for k in range(keys)]))


@pytest.mark.slow
@pytest.mark.parametrize("filter", ["grid", "particles"])
@pytest.mark.parametrize("kind", ["plain", "halting"])
def test_no_tag_begins_with_a_negative_speed(kind, filter):
    keys = KEYS if filter == "particles" else 1
    estimates = _run(kind, FILTERS[filter], keys)
    log_likelihood, speed = _quadrature(HALTING if kind == "halting" else 0.0)
    likelihoods = np.exp(estimates.log_likelihood.sum(axis=1))
    # The grid's own likelihood is right to 2e-4.
    error = 3 * likelihoods.std() / np.sqrt(keys) / likelihoods.mean() + 0.001
    assert np.log(likelihoods.mean()) == pytest.approx(log_likelihood, abs=error)
    at_first = np.hypot(*estimates.mean.velocity)[:, 0]
    assert at_first.mean() == pytest.approx(speed, abs=3 * at_first.std() / np.sqrt(keys) + 0.001)
