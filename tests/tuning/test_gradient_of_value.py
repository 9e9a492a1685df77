"""The objective and its gradient are one function: a trajectory counts in both or in neither."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, recording
from tests.tuning.worlds import SIGMA_START, LineStart
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.model.motion import ConstantPosition
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, independent
from trackwright.trackers.core.model.tunable import Real, Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.optimisation import MultiStart
from trackwright.tuning.optimisers import AbstractOptimiser
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

STEEP = 1e12
FENCE = 0.1


class RippledGauge(AbstractSensor):
    """A gauge with an offset; trajectories with the input `ripple` add a ripple of it, 1 mm high, 1e9 m per m steep.

    Beyond the fence alone where the input is 2.
    """

    sigma: Any
    offset: Any

    @property
    def channels(self):
        return (Channel("x", "m"),)

    def measure(self, view, inputs):
        beyond = jnp.maximum(self.offset.value - FENCE, 0.0)
        phase = STEEP * jnp.where(inputs["ripple"] > 1.5, beyond, self.offset.value)
        return [view.position[0] + self.offset.value + jnp.where(inputs["ripple"] > 0.5, 1e-3 * jnp.sin(phase), 0.0)]

    def residual(self, reading, predicted):
        return independent([reading.values[0] - predicted[0]], [self.sigma.value], reading.seen)


class UpTheOffset(AbstractOptimiser):
    """Proposes to raise the last number by 0.2."""

    monotone: ClassVar[bool] = True

    def init(self, vectors):
        return np.zeros(len(vectors))

    def propose(self, state, vectors, gradients):
        step = np.zeros_like(vectors)
        step[:, -1] = 2.0
        return step, state


def _recordings(ripples, error=0.0):
    """Walks on a line read every 0.1 s, those with a ripple `error` m off."""
    rng, made = np.random.default_rng(0), []
    for ripple in ripples:
        place = SIGMA_START * rng.normal() + np.cumsum(0.1 * rng.normal(size=30))
        values = (place + 0.2 * rng.normal(size=30) + (error if ripple else 0.0))[:, None]
        row = recording(0.1 * np.arange(30), {"gauge": (values, np.ones((30, 1), bool))}, [0.0], [[SIGMA_START**2]])
        truth = {"position": (place[:, None], np.ones(30, bool))}
        made.append(Recording(row.times, row.readings, row.inputs | {"ripple": np.full(30, ripple)}, truth))
    return made


def _problem(objective, ripples, offset=0.05, error=0.0):
    gauge = RippledGauge(Scale(0.25, "m"), Real(offset, "m", typical=0.1))
    tracker = Tracker(ConstantPosition(0.3, 1), {"gauge": gauge}, LineStart(), track_loss=NEVER_LOST)
    parameters = select_parameters(tracker, ("motion.*", "sensors.gauge.*"))
    return Problem(tracker, [stack(_recordings(ripples, error))], objective, parameters), flatten(parameters)


@pytest.mark.parametrize(
    "objective", [NegativeLogLikelihood(), pytest.param(RootMeanSquareError(dimensions=1), marks=pytest.mark.slow)]
)
def test_the_gradient_is_that_of_the_value_where_one_trajectory_has_a_gradient_without_bound(objective):
    problem, vector = _problem(objective, [0.0] * 6 + [1.0])
    step = 1e-5
    shifts = step * np.eye(len(vector))
    found = problem.evaluate(np.concatenate([vector[None], vector + shifts, vector - shifts]))
    assert problem.n_excluded(found) == 1
    assert found.used.sum(axis=1).tolist() == [6] * 7
    up, down = np.split(found.values[1:], 2)
    np.testing.assert_allclose(found.gradients[0], (up - down) / (2 * step), rtol=1e-6, atol=1e-9)


def test_the_value_without_derivatives_leaves_out_nothing_that_is_finite():
    problem, vector = _problem(NegativeLogLikelihood(), [0.0] * 6 + [1.0], error=1.0)
    terms = problem.terms(vector)[0].sum(axis=-1)
    assert problem.values(vector)[0] == pytest.approx(terms[0] / terms[1], rel=1e-12)
    assert problem.evaluate(vector).values[0] < problem.values(vector)[0]
    plain, vector = _problem(NegativeLogLikelihood(), [0.0] * 6)
    assert plain.evaluate(vector).values[0] == pytest.approx(plain.values(vector)[0], rel=1e-12)


def test_a_step_gains_nothing_by_making_a_bad_trajectory_unusable():
    # 5 m off, unusable beyond the fence; the others are best described by an offset of zero
    problem, vector = _problem(NegativeLogLikelihood(), [0.0] * 6 + [2.0], offset=0.08, error=-5.0)
    raised = vector + np.array([0.0, 0.0, 2.0])
    before, after = problem.evaluate(vector), problem.evaluate(raised)
    assert after.values[0] < before.values[0], "over different trajectories"
    driver = MultiStart(problem, UpTheOffset(), 1, np.full(3, -np.inf), np.full(3, np.inf))
    state = driver.step(driver.init(vector))
    np.testing.assert_array_equal(state.vectors[0], vector)
    both = before.used & after.used
    old, new = (problem.values_over(both, v, e.terms) for v, e in ((vector, before), (raised, after)))
    assert new[0] > old[0], "over the same trajectories"
