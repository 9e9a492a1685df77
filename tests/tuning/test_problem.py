"""The objective as a function of vectors: rows of lost tracks count, priors weigh in proportion in a subset."""

import equinox as eqx
import numpy as np
import pytest
from scipy import stats

from tests.tuning.worlds import LineStart, line_tracker, walks
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.priors import Prior
from trackwright.tuning.problem import Problem

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")


@pytest.fixture(scope="module")
def with_prior():
    """Ten walks in chunks of four, four and two, a prior on one level, and a vector away from its centre."""
    tracker = line_tracker()
    parameters = select_parameters(tracker, LEVELS)
    prior = Prior("sensors.gauge.sigma", 0.35, factor=1.5)
    problem = Problem(tracker, [stack(walks([8] * 10, 2))], NegativeLogLikelihood(), parameters, 4, [prior])
    return problem, flatten(parameters)


def test_subsets_of_the_trajectories_carry_the_prior_in_proportion(with_prior):
    problem, vector = with_prior
    # The prior of log σ is normal about log 0.35 with deviation log 1.5; the level stands at 0.2 m.
    centre, deviation = np.log(0.35), np.log(1.5)
    nats = 0.5 * ((np.log(0.2) - centre) / deviation) ** 2
    nll, prior = (np.array([problem.terms(vector)[0, 0].sum()]), stats.norm(centre, deviation))
    assert prior.logpdf(centre) - prior.logpdf(np.log(0.2)) == pytest.approx(nats)
    found = [problem.evaluate(vector, subset=subset) for subset in ([0, 1, 2], [0], [1], [2], [2, 0])]
    for evaluation, share in zip(found, (1.0, 0.4, 0.4, 0.2, 0.6), strict=True):
        expected = evaluation.terms[0, 0].sum() + share * nats
        assert evaluation.values[0] * evaluation.sums[0, 1] == pytest.approx(expected, rel=1e-9)
    # In nats, value and gradient of the parts add up to those of the whole.
    whole, parts = found[0], found[1:4]
    assert whole.values[0] * whole.sums[0, 1] == pytest.approx(float(nll[0]) + nats, rel=1e-9)
    gradients = sum(part.gradients[0] * part.sums[0, 1] for part in parts)
    np.testing.assert_allclose(gradients, whole.gradients[0] * whole.sums[0, 1], rtol=1e-9)


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
