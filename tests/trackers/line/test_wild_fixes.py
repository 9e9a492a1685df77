"""Wild fixes on a known path, against a grid filter with Student's t in NumPy; a tag carried to another place."""

import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import LineMotion, PathOutputMap
from trackwright.trackers.line.tracker import FloorFixes, line_grid_tracker, line_tracker
from trackwright.trackers.parts.fixes import FIXES

pytestmark = pytest.mark.slow

LENGTH, ROWS, DT, SIGMA, DOF = 20.0, 150, 0.1, 0.3, 4.0
TIMES = DT * np.arange(ROWS)
LINE = Polyline([[0.0, 0.0], [LENGTH, 0.0]])
STEADY = 0.5 + 0.02 * TIMES**2


def _fixes(arclength, seed=1):
    return np.stack([arclength, np.zeros(ROWS)], axis=-1) + 0.15 * np.random.default_rng(seed).normal(size=(ROWS, 2))


def _wild():
    """Kinds of wild fixes, by name."""
    rng = np.random.default_rng(2)
    angle, size = rng.uniform(0, 2 * np.pi, ROWS), rng.uniform(5, 50, ROWS)
    near, some = np.stack([size * np.cos(angle), size * np.sin(angle)], -1), rng.random(ROWS) < 0.1
    some[0] = False
    burst = np.isin(np.arange(ROWS), [40, 41, 42, 80, 81, 82])
    return {
        "one 500 m off": (np.arange(ROWS) == 70, [500.0, 500.0]),
        "one 1e6 m off": (np.arange(ROWS) == 70, [1e6, -1e6]),
        "a tenth 5 to 50 m off": (some, near + _fixes(STEADY)),
        "bursts of three 500 m off": (burst, [500.0, 500.0]),
        "bursts of three at one place on the path": (burst, [18.0, 0.0]),
        "twenty in a row 500 m off": ((np.arange(ROWS) >= 60) & (np.arange(ROWS) < 80), [500.0, 500.0]),
    }


KINDS = _wild()


def _with_wild(kind):
    rows, values = KINDS[kind]
    return np.where(rows[:, None], values, _fixes(STEADY))


def _exact(fixes, spacing=0.05, fastest=1.5, sigma_a=0.05):
    """Mean arclengths (ROWS,) by Bayes' rule on a grid in double precision: Student's t, a random walk of the speed."""
    along, fast = np.linspace(0, LENGTH, round(LENGTH / spacing) + 1), np.linspace(0, fastest, 64)
    step = fast[1]
    prior = np.exp(-2 * (along / LENGTH) ** 2)
    prior[0] = prior.sum() - 1
    p = prior[:, None] * np.exp(-0.5 * (fast / 0.1) ** 2)[None]
    # Half the variance of a step's change of speed, in grid steps, to either neighbour; below zero it is zero.
    q = 0.5 * sigma_a**2 * DT / step**2
    walk = np.eye(64) * (1 - 2 * q) + q * (np.eye(64, k=1) + np.eye(64, k=-1))
    walk[0, 0] += q
    walk[-1, -1] += q
    means = []
    for k, (x, y) in enumerate(fixes):
        if k:
            moved = np.zeros_like(p)
            for j, v in enumerate(fast):
                ends = np.minimum((along + v * DT) / spacing, len(along) - 1)
                low = np.minimum(ends.astype(int), len(along) - 2)
                np.add.at(moved[:, j], low, p[:, j] * (1 - (ends - low)))
                np.add.at(moved[:, j], low + 1, p[:, j] * (ends - low))
            p = moved @ walk
        squares = (((x - along) / SIGMA) ** 2, (y / SIGMA) ** 2)
        log = -0.5 * (DOF + 1) * sum(np.log1p(s / DOF) for s in squares)
        p = p * np.exp(log - log.max())[:, None]
        p /= p.sum()
        means.append(p.sum(axis=1) @ along)
    return np.array(means)


def _tracked(make, sensors, readings, inputs=None):
    """The estimates of each recording, in one run."""
    each = [Recording(TIMES, {name: Readings(z, np.ones(z.shape, bool)) for name, z in r.items()}, inputs or {})
            for r in readings]  # fmt: skip
    return make(LineMotion(LINE, 0.05), sensors).run(each)


def _rmse(along, truth=STEADY):
    return np.sqrt(np.mean((along - truth) ** 2))


@pytest.fixture(scope="module", params=[pytest.param(line_grid_tracker, marks=pytest.mark.slow), line_tracker])
def tracked(request):
    return _tracked(request.param, {FIXES: FloorFixes(SIGMA)}, [{FIXES: _with_wild(kind)} for kind in KINDS])


@pytest.mark.parametrize("kind", KINDS)
def test_wild_fixes_leave_a_track_where_the_exact_filter_has_it(tracked, kind):
    estimates = tracked[list(KINDS).index(kind)]
    assert _rmse(estimates.mean.position[0]) < 1.3 * _rmse(_exact(_with_wild(kind)))
    assert np.all(estimates.status == Status.OK)
    assert np.all(np.isfinite(estimates.log_likelihood))


CARRIED = {
    "forwards": np.where(TIMES < 7, 1 + 0.4 * TIMES, 10 + 0.4 * TIMES),
    "back": 9 + 0.4 * TIMES - 8 * (TIMES > 7),
}


@pytest.mark.parametrize("make", [pytest.param(line_grid_tracker, marks=pytest.mark.slow), line_tracker])
def test_a_tag_that_was_carried_to_another_place_on_the_path_is_found_within_a_second(make):
    estimates = _tracked(make, {FIXES: FloorFixes(SIGMA)}, [{FIXES: _fixes(s)} for s in CARRIED.values()])
    for k, truth in enumerate(CARRIED.values()):
        assert np.all(np.abs(estimates[k].mean.position[0] - truth)[(TIMES < 7) | (TIMES > 8)] < 0.5)


def test_a_wild_fix_with_normal_errors_leaves_the_grid_finite():
    estimates = _tracked(line_grid_tracker, {FIXES: FloorFixes(SIGMA, None)}, [{FIXES: _with_wild("one 500 m off")}])
    # That of a fix 500 m off in y and at least 480 m in x, over the standard deviation of 0.3 m.
    assert -0.5 * 2 * (500 / SIGMA) ** 2 < estimates.log_likelihood[0, 70] < -0.5 * (480**2 + 500**2) / SIGMA**2 + 10
    assert np.all(estimates.status[0] != Status.NON_FINITE)


def test_in_single_precision_no_probability_appears_at_the_end_of_the_path_or_at_other_speeds():
    grid = GridFilter(PathOutputMap(LINE, jnp.float32(0.02)), 201, 33, 1.5)
    rng = np.random.default_rng(0)
    mass = np.zeros((201, 33), np.float32)
    mass[20:60] = rng.random((40, 33))
    advanced = grid._advanced(jnp.asarray(mass / mass.sum()), jnp.linspace(0.0, 1.5, 33, dtype=jnp.float32))
    assert np.all(np.asarray(advanced)[65:] == 0.0)
    assert np.asarray(grid._speed_transition(jnp.float32(0.5)))[0, 20:].max() == 0.0
