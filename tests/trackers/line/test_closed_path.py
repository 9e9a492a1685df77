"""A closed path: equivalent to an open one with its laps one after another, far from either end."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, recording
from trackwright.trackers.core.filters.particle.filter import ParticleFilter
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import HaltingMotion, HaltingState, LineMotion, PathOutputMap, PathState
from trackwright.trackers.line.tracker import FloorFixes
from trackwright.trackers.parts.fixes import FIXES

CORNERS = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]]
LOOP, LAPS = Polyline([*CORNERS, CORNERS[0]]), Polyline([*CORNERS, *CORNERS, *CORNERS, CORNERS[0]])
ROWS, DT = 40, 0.5


def _fixes():
    """Fixes of a tag that crosses the first knot twice and rests there once."""
    rng, times = np.random.default_rng(4), DT * np.arange(ROWS)
    arclength = np.interp(times, [0.0, 4.0, 7.0, 19.5], [4.5, 6.0, 6.0, 12.4])
    positions = np.stack([np.asarray(x) for x in LOOP.position(jnp.asarray(arclength))], axis=-1)
    return times, arclength, positions + 0.2 * rng.normal(size=(ROWS, 2))


def _run(kind, line, filter, first):
    times, _, values = _fixes()
    if kind == "plain":
        motion, build, start, sigmas = LineMotion(line, 0.3), lambda x: PathState(x[0], x[1]), [first, 0.4], [0.3, 0.2]
    else:
        motion = HaltingMotion(line, 0.3, halting=0.6, rest=2.0)
        build, start, sigmas = lambda x: HaltingState(*x), [first, 0.4, 0.0], [0.3, 0.2, 0.0]
    tracker = Tracker(motion, {FIXES: FloorFixes(0.2, None)}, KnownStart(build), filter, NEVER_LOST)
    return tracker.run(recording(times, {FIXES: (values, np.ones((ROWS, 2), bool))}, start, np.diag(sigmas) ** 2))


def _filter(kind, line):
    report = PathOutputMap(line, Scale(1e-3, "m"))
    if kind == "particles":
        return ParticleFilter(500, output_map=report)
    return GridFilter(report, round(line.length / 0.02) + (0 if line.closed else 1), 41, 1.6)


@pytest.mark.slow
@pytest.mark.parametrize("filter", ["particles", "grid"])
@pytest.mark.parametrize("motion", ["plain", "halting"])
def test_a_closed_path_is_equivalent_to_its_laps_one_after_another(motion, filter):
    # The prior is so near the first knot that it extends beyond it.
    closed = _run(motion, LOOP, _filter(filter, LOOP), -0.1)
    laid_out = _run(motion, LAPS, _filter(filter, LAPS), 5.9)
    for ours, theirs in zip([*closed.mean.position, *closed.mean.velocity, *closed.covariance],
                            [*laid_out.mean.position, *laid_out.mean.velocity, *laid_out.covariance], strict=True):  # fmt: skip
        np.testing.assert_allclose(ours, theirs, atol=1e-8)
    np.testing.assert_allclose(closed.log_likelihood, laid_out.log_likelihood, rtol=1e-9)


def test_arclengths_a_lap_apart_have_the_same_position_and_direction():
    for d in (-0.3, 0.0, 1.7, 2.0, 5.999, 6.0, 13.1):
        for of in (LOOP.position, LOOP.direction):
            np.testing.assert_allclose(
                list(of(jnp.asarray(d + 1e-9))), list(of(jnp.asarray(d + 6.0 + 1e-9))), atol=1e-7
            )


def test_means_of_arclengths_on_both_sides_of_the_first_knot_are_between_them():
    gathered = LOOP.gathered(jnp.asarray([5.9, 0.1, 5.8]), jnp.asarray([0.5, 0.25, 0.25]))
    assert float(jnp.sum(gathered * jnp.asarray([0.5, 0.25, 0.25]))) == pytest.approx(-0.075)
    np.testing.assert_allclose(LOOP.position(jnp.asarray(-0.075)), [0.0, 0.075], atol=1e-9)
