"""Estimates: shapes and names for any state, verdicts in one sentence, and statuses row by row."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, recording
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import AbstractMotion, ConstantPosition, Placed
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, independent
from trackwright.trackers.core.run.tracker import Tracker


class Place(NamedTuple):
    position: Any


class Drift(AbstractMotion):
    """A random walk of a state that is one array, not a vector of scalars."""

    @property
    def noise_dimension(self):
        return 2

    def step(self, state, inputs, dt, w):
        return Place(state.position + jnp.stack(list(w)) * (0.4 * jnp.sqrt(dt)))

    def view(self, state):
        return state


class Fix(AbstractSensor):
    @property
    def channels(self):
        return Channel("x", "m"), Channel("y", "m")

    def measure(self, view, inputs):
        return list(view.position)

    def residual(self, reading, predicted):
        return independent([z - p for z, p in zip(reading.values, predicted, strict=True)], [0.1, 0.2], reading.seen)


def _array_state(x):
    return Place(jnp.stack(x))


def _vector_state(x):
    return Placed(Vector(*x))


@pytest.fixture(scope="module")
def both_states():
    rng, recordings = np.random.default_rng(0), []
    for rows in (7, 5, 6):
        z = rng.normal(size=(rows, 2)), rng.random((rows, 2)) > 0.3
        recordings.append(recording(np.cumsum(rng.uniform(0.1, 1.0, rows)), {"fix": z}, [0.5, -0.5], np.eye(2)))
    pairs = ((Drift(), _array_state), (ConstantPosition(0.4, 2), _vector_state))
    return [Tracker(m, {"fix": Fix()}, KnownStart(b), track_loss=NEVER_LOST).run(stack(recordings)) for m, b in pairs]


def test_a_state_that_holds_an_array_is_filtered_like_one_of_scalars(both_states):
    array, scalars = both_states
    assert array.mean.position.shape == (3, 7, 2)
    np.testing.assert_allclose(array.mean.position, np.stack(list(scalars.mean.position), axis=-1), rtol=1e-13)
    np.testing.assert_allclose(array.covariance, scalars.covariance, rtol=1e-13)


def test_sigmas_are_named_roots_of_the_covariances_diagonal(both_states):
    for estimates in both_states:
        assert list(estimates.sigmas) == ["position.0", "position.1"]
        diagonal = np.sqrt(np.diagonal(estimates.covariance, axis1=-2, axis2=-1))
        np.testing.assert_array_equal(np.stack(list(estimates.sigmas.values()), axis=-1), diagonal)
