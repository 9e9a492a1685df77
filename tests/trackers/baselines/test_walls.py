"""Walls: which moves cross one, which particles are removed, and the effect on the likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import LinearSensor
from trackwright.trackers.baselines.floor import Walls
from trackwright.trackers.core.filters.particle.filter import ParticleFilter, Particles
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantPosition, Placed
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.tunable import Constant

CORNER = [[0.0, -2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]]  # two walls that meet at the origin


def _crosses(walls, start, end):
    weight = Walls(walls).log_weight(Placed(Vector(*map(jnp.asarray, start))), Placed(Vector(*map(jnp.asarray, end))))
    assert weight in (0.0, LOG_ZERO)
    return bool(weight == LOG_ZERO)


@pytest.mark.parametrize(
    ("start", "end", "crosses"),
    [
        ((-1.0, -1.0), (1.0, -1.0), True),
        ((1.0, -1.0), (-1.0, -1.0), True),
        ((1.0, -1.0), (1.0, 1.0), True),
        ((-1.0, -1.0), (-1.0, 1.0), False),
        ((-1.0, 1.0), (1.0, 1.0), False),
        ((-1.0, -3.0), (1.0, -3.0), False),
        ((1.0, -1.0), (1.0, -1.0), False),
        ((0.5, -0.5), (1.5, -1.5), False),
        # Through the very corner that both share: there is no gap.
        ((1.0, -1.0), (-1.0, 1.0), True),
    ],
)
def test_a_move_crosses_a_wall_or_passes_beside_it(start, end, crosses):
    assert _crosses(CORNER, start, end) == crosses


def test_no_straight_move_leaves_a_closed_room():
    rng = np.random.default_rng(0)
    corners = np.array([[0, 0], [3, 0.5], [2.5, 2], [1, 2.5], [-0.5, 1]])
    room = np.hstack([corners, np.roll(corners, -1, axis=0)])
    inside = corners.mean(axis=0) + rng.uniform(-0.5, 0.5, (200, 2))
    angle = rng.uniform(0, 2 * np.pi, 200)
    outside = inside + 9 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # Straight at the corners too.
    outside[:5] = inside[:5] + 9 * (corners - inside[:5])
    walls = Walls(room)
    each = jax.jit(jax.vmap(lambda a, b: walls.log_weight(Placed(Vector(a[0], a[1])), Placed(Vector(b[0], b[1])))))
    assert np.all(each(inside, outside) == LOG_ZERO)
    assert np.all(each(inside, np.roll(inside, 1, axis=0)) == 0)


def test_the_log_likelihood_of_a_row_without_measurement_is_that_of_crossing_no_wall():
    n, wall = 4096, 0.5
    key = jax.random.key_data(jax.random.key(3))
    belief = Particles(Placed(Vector(jnp.zeros(n), jnp.zeros(n))), jnp.full(n, -np.log(n)), key)
    filter = ParticleFilter(n, potential=Walls([[wall, -100.0, wall, 100.0]]))
    motion = ConstantPosition(Constant(1.0), 2)

    @jax.jit
    def row(belief):
        moved = filter.predict(belief, motion, {}, jnp.asarray(1.0))
        return filter.update(
            moved, motion, LinearSensor(np.eye(1, 2), [1.0], 1), Reading(jnp.zeros(1), jnp.array([False]), ()), {}
        )

    after, innovation = row(belief)
    # Φ(0.5), with the binomial's four standard errors.
    assert np.exp(innovation.log_likelihood) == pytest.approx(0.69146, abs=4 * np.sqrt(0.69 * 0.31 / n))
    assert np.all(after.states.position[0][after.log_weights > 0.5 * LOG_ZERO] <= wall)
    np.testing.assert_allclose(np.exp(after.log_weights).sum(), 1.0, rtol=1e-9)
    assert innovation.nis == 0.0
