"""The chain starts at its stationary distribution, the paper's at a uniform one: the size of the difference."""

import jax.numpy as jnp
import pytest

from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.mhk.tracker import mhk_tracker


@pytest.mark.parametrize(("start", "moved_mm"), [("stationary", 0.101), ("uniform", 0.190)])
def test_a_first_displacement_of_3_cm_moves_the_prediction_by_a_tenth_of_a_millimetre_more_or_less(start, moved_mm):
    chain = mhk_tracker(rate=1.0).fusion.filter
    stationary = chain.sphere.blocks().probabilities
    weights = stationary if start == "stationary" else jnp.full_like(stationary, 1.0 / len(stationary))
    displacement, dt = Vector(*(jnp.asarray(x) for x in (0.03, 0.0, 0.0))), jnp.asarray(0.1)
    _, acceleration = chain.posterior(weights, displacement, dt)
    assert 1000 * 0.5 * float(next(iter(acceleration))) * 0.1**2 == pytest.approx(moved_mm, abs=0.001)
