"""The objective as a function of vectors: rows of lost tracks count, priors are added in nats."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.known_start import NEVER_LOST, recording
from tests.tuning.worlds import SIGMA_START, LineStart, line_tracker, walks
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.motion import ConstantPosition
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, independent
from trackwright.trackers.core.model.tunable import Real, Scale
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.optimisation import AbstractOptimiser, MultiStart
from trackwright.tuning.parameters import Prior, flatten, select_parameters
from trackwright.tuning.problem import Problem

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")


@pytest.fixture(scope="module")
def with_prior():
    """Ten walks in chunks of four, four and two, a prior on one level that counts double, and a vector away from it."""
    tracker = line_tracker()
    parameters = select_parameters(tracker, LEVELS)
    problem = Problem(tracker, [stack(walks([8] * 10, 2))], NegativeLogLikelihood(), parameters, 4)
    problem.prior = Prior(np.array([0.0, np.log(0.35)]), np.array([0.0, np.log(1.5) ** -2]), 1e12)
    problem.discount = 0.5
    return problem, flatten(parameters)


def test_a_prior_is_added_to_the_likelihood_in_nats(with_prior):
    problem, vector = with_prior
    # The prior of log σ is normal about log 0.35 with deviation log 1.5; the level stands at 0.2 m.
    centre, deviation = np.log(0.35), np.log(1.5)
    prior = stats.norm(centre, deviation)
    evaluation = problem.evaluate(vector)
    nats = evaluation.terms[0, 0].sum() + 2.0 * (prior.logpdf(centre) - prior.logpdf(np.log(0.2)))
    assert evaluation.values[0] * evaluation.sums[0, 1] == pytest.approx(nats, rel=1e-9)
    without = evaluation.term_gradients[0, 0].sum(axis=-1)
    slope = [0.0, 2.0 * (np.log(0.2) - centre) / deviation**2]
    np.testing.assert_allclose(evaluation.gradients[0] * evaluation.sums[0, 1], without + slope, rtol=1e-9)


class SignalledStart(LineStart):
    """Starts only on rows with the input `may_start`."""

    def can_start(self, row):
        return row.inputs["may_start"][0] > 0.5


def test_an_error_objective_counts_the_rows_of_a_lost_track():
    tracker = eqx.tree_at(lambda t: t.start, line_tracker(), SignalledStart())
    tracker = eqx.tree_at(lambda t: t.track_loss, tracker, TrackLossPolicy(nis_limit=np.inf, max_gap=0.5))
    (walk,) = walks([30], 4, missing=0.0)
    # No reading from row 10 on: lost after half a second, started again at row 25.
    seen = (np.arange(30) < 10)[:, None]
    may_start = np.isin(np.arange(30), [0, 25])[:, None].astype(float)
    gauge = Readings(np.where(seen, walk.readings["gauge"].values, 0.0), seen)
    walk = Recording(walk.times, {"gauge": gauge}, {**walk.inputs, "may_start": may_start}, walk.truth)
    estimates = tracker.run(walk)
    lost = np.asarray(estimates.status) == Status.LOST
    assert 5 < lost.sum() < 20
    squares = (np.ravel(estimates.mean.position[0]) - walk.truth["position"][0][:, 0]) ** 2
    parameters = select_parameters(tracker, LEVELS)
    problem = Problem(tracker, [stack([walk])], RootMeanSquareError(dimensions=1), parameters)
    np.testing.assert_allclose(problem.terms(flatten(parameters))[0, :, 0], [squares.sum(), 30], rtol=1e-9)


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


@pytest.mark.parametrize("objective", [NegativeLogLikelihood(), RootMeanSquareError(dimensions=1)])
def test_the_gradient_is_that_of_the_value_where_one_trajectory_has_a_gradient_without_bound(objective):
    problem, vector = _problem(objective, [0.0] * 6 + [1.0])
    step = 1e-5
    shifts = step * np.eye(len(vector))
    found = problem.evaluate(np.concatenate([vector[None], vector + shifts, vector - shifts]))
    assert found.used.sum(axis=1).tolist() == [6] * 7
    up, down = np.split(found.values[1:], 2)
    np.testing.assert_allclose(found.gradients[0], (up - down) / (2 * step), rtol=1e-6, atol=1e-9)


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
