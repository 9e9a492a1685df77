"""How sure a fit is: against closed forms and repeated experiments on normal numbers, of which everything is known."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.tunable import Covariance, Fraction, Real, Scale
from trackwright.tuning.fit_warnings import identifiability_issues
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.parameters import Parameter, Prior, flatten, select_parameters
from trackwright.tuning.problem import Evaluation, Problem
from trackwright.tuning.uncertainty import Uncertainty, flat_components, kept_at_start, optimum, uncertainty_at

TYPICAL = 0.5


def _uncertainty(problem, vector):
    """That of the optimum at a vector."""
    return uncertainty_at(problem, optimum(problem, vector))


@dataclass
class Numbers:
    """The negative log-likelihood of numbers `y` (n, m) from N(μ, σ²), n trajectories, as a problem of a fit.

    log σ = `logs` · v and μ = `means` · v of an unconstrained vector v.
    """

    y: np.ndarray
    parameters: list[Parameter]
    logs: np.ndarray
    means: np.ndarray
    stochastic: bool = False
    own_weights: np.ndarray | None = None
    objective: NegativeLogLikelihood = field(default_factory=NegativeLogLikelihood)
    discount: float = 1.0
    prior: Prior | None = None

    def __post_init__(self):
        self.prior = self.prior or Prior.of(self.parameters, "flat")

    def nats_per_unit(self, sums):
        """As that of a problem."""
        return self.discount * self.objective.nats_per_unit(sums)

    def prior_penalty(self, vectors, sums):
        """As that of a problem."""
        nats, scale = self.prior.penalty(vectors), 1 / self.nats_per_unit(sums[0])
        return SimpleNamespace(values=nats.values * scale, gradients=nats.gradients * scale)

    def evaluate(self, vectors, weights=None):
        vectors = np.atleast_2d(vectors)
        n, m = self.y.shape
        log_sigma, mu = vectors @ self.logs, vectors @ self.means
        r = self.y[None] - mu[:, None, None]
        inverse = np.exp(-2 * log_sigma)[:, None]
        nll = m * (log_sigma[:, None] + 0.5 * np.log(2 * np.pi)) + 0.5 * inverse * (r**2).sum(-1)
        gradient = (m - inverse * (r**2).sum(-1))[:, None] * self.logs[:, None]
        gradient = gradient - (inverse * r.sum(-1))[:, None] * self.means[:, None]
        nll, gradient, numbers = nll * self.weights, gradient * self.weights, np.full_like(nll, m) * self.weights
        terms = np.stack([nll, numbers], axis=1)
        term_gradients = np.stack([gradient, np.zeros_like(gradient)], axis=1)
        w = np.ones(n) if weights is None else np.atleast_2d(weights)
        sums, gradient_sums = (
            (terms * w[..., None, :]).sum(-1) if np.ndim(w) > 1 else (terms @ w),
            ((gradient * w[..., None, :]).sum(-1) if np.ndim(w) > 1 else gradient @ w),
        )
        return Evaluation(
            values=sums[:, 0] / sums[:, 1],
            gradients=gradient_sums / sums[:, 1:],
            sums=sums,
            terms=terms,
            term_gradients=term_gradients,
            used=np.ones((len(vectors), n), bool),
        )

    @property
    def valid(self):
        """All trajectories."""
        return np.ones(len(self.y), bool)

    @property
    def weights(self):
        """The weight of each trajectory."""
        return np.ones(len(self.y)) if self.own_weights is None else self.own_weights

    def values_over(self, count, vectors, terms):
        """The objective from terms over the trajectories in `count`."""
        sums = np.einsum("sn,skn->sk", count, terms)
        return sums[:, 0] / sums[:, 1]


def _sigma_and_mu(y, weights=None):
    """The problem of σ and μ, and its optimum, which has a closed form."""
    parameters = [Parameter(("sigma",), Scale(1.0), "sigma"), Parameter(("mu",), Real(0.0, typical=TYPICAL), "mu")]
    problem = Numbers(y, parameters, np.array([1.0, 0.0]), np.array([0.0, TYPICAL]), own_weights=weights)
    mean = np.average(y.mean(axis=1), weights=weights)
    variance = np.average(((y - mean) ** 2).mean(axis=1), weights=weights)
    return problem, np.array([0.5 * np.log(variance), mean / TYPICAL])


@pytest.fixture(scope="module")
def numbers():
    return np.random.default_rng(0).normal(0.3, 0.7, (40, 25))


def test_the_observed_information_is_the_closed_form(numbers):
    problem, best = _sigma_and_mu(numbers)
    found = _uncertainty(problem, best)
    total = numbers.size
    # of log σ: 1/(2N); of μ: σ²/N. Differences over 2 % of a level are off by (2 %)²·2/3
    errors = found.standard_errors("curvature")
    assert errors["sigma"] == pytest.approx(numbers.std() / np.sqrt(2 * total), rel=1e-3)
    assert errors["mu"] == pytest.approx(numbers.std() / np.sqrt(total), rel=1e-3)
    low, high = found.intervals(by="curvature")["sigma"]
    assert high / low == pytest.approx(np.exp(2 * 1.96 / np.sqrt(2 * total)), rel=1e-3)
    assert low * high == pytest.approx(numbers.var())
    assert identifiability_issues(found, problem.evaluate(best).term_gradients) == []


def test_the_sandwich_is_right_where_trajectories_differ_and_the_information_is_not():
    rng = np.random.default_rng(1)
    fits, observed, sandwich = [], [], []
    for _ in range(200):
        # recordings with individual noise levels, which the model lacks
        levels = np.exp(rng.normal(0, 0.4, (60, 1)))
        problem, best = _sigma_and_mu(rng.normal(0, levels, (60, 25)))
        found = _uncertainty(problem, best)
        fits.append(best[0])
        observed.append(found.observed[0, 0])
        sandwich.append(found.sandwich[0, 0])
    # 200 repetitions determine a variance to 10 %; that of few and skewed clusters is lower still
    assert np.mean(sandwich) / np.var(fits) == pytest.approx(1.0, abs=0.25)
    assert np.mean(observed) / np.var(fits) < 0.2


def test_the_posterior_is_the_closed_form(numbers):
    """Of a mean with a normal prior and known noise, a fifth of whose numbers count."""
    problem, best = _sigma_and_mu(numbers[:4])
    deviation, centre = 0.1, -0.5
    problem.discount = 0.2
    problem.prior = Prior(np.array([0.0, centre / TYPICAL]), np.array([0.0, (deviation / TYPICAL) ** -2]), 1e12)
    sigma, precision = np.exp(best[0]), 0.2 * 100 / np.exp(2 * best[0])
    mean = (precision * TYPICAL * best[1] + centre / deviation**2) / (precision + deviation**-2)
    found = uncertainty_at(problem, optimum(problem, np.array([best[0], mean / TYPICAL])), np.array([True, False]))
    assert found.distance_to_optimum < 1e-6
    assert found.standard_errors()["mu"] == pytest.approx((precision + deviation**-2) ** -0.5, rel=1e-3)
    assert sigma > 0.5


def test_numbers_that_only_the_prior_determines_are_named(numbers):
    problem, at = _product(numbers, [1, -1])
    problem.prior = Prior(at, np.full(2, 0.7**-2), 1e12)
    found = _uncertainty(problem, at)
    issues = identifiability_issues(found, problem.evaluate(at).term_gradients)
    assert [j.text for j in issues] == ["a, b: not determined one by one"]
    # along a × b it is the prior's
    assert found.standard_errors()["a"] / np.exp(at[0]) == pytest.approx(0.7 / np.sqrt(2), rel=1e-2)


@pytest.mark.slow
def test_intervals_of_trajectories_with_weights_have_their_nominal_coverage():
    rng, weights = np.random.default_rng(8), np.geomspace(0.1, 5.0, 40)
    intervals = {"curvature": [], "scatter": []}
    for _ in range(200):
        problem, best = _sigma_and_mu(rng.normal(0.3, 0.7, (40, 10)), weights)
        problem.discount = weights.sum() / (weights**2).sum()
        found = _uncertainty(problem, best)
        for by in ("curvature", "scatter"):
            ends = found.intervals(by=by)
            intervals[by].append([ends["sigma"], ends["mu"]])
    # σ √(Σ w²) / Σ w and not σ / √(Σ w), which is a quarter narrower here
    expected = 2 * 1.96 * 0.7 / np.sqrt(10) * np.sqrt(np.sum(weights**2)) / weights.sum()
    # 200 repetitions determine 95 % to 1.5 %; the heaviest trajectories are few for a scatter
    for by, least, rel in (("curvature", 0.91, 0.03), ("scatter", 0.88, 0.12)):
        low, high = np.moveaxis(intervals[by], -1, 0)
        assert np.all(np.mean((low < [0.7, 0.3]) & (high > [0.7, 0.3]), axis=0) > least), by
        assert np.median((high - low)[:, 1]) == pytest.approx(expected, rel=rel), by


def test_the_scatter_of_a_mean_is_the_textbook_interval_of_few_clusters():
    y = np.random.default_rng(3).normal(0.3, 0.7, (20, 25))
    found = _uncertainty(*_sigma_and_mu(y))
    # The mean of twenty means: their standard deviation with n − 1, and Student's t with 19 degrees of freedom.
    expected = stats.sem(y.mean(axis=1))
    assert found.standard_errors("scatter")["mu"] == pytest.approx(expected, rel=1e-3)
    low, high = found.intervals(level=0.9, by="scatter")["mu"]
    np.testing.assert_allclose([low, high], stats.t.interval(0.9, 19, y.mean(), expected), rtol=1e-3)
    # The likelihood's curvature has no degrees of freedom: normal quantiles.
    low, high = found.intervals(level=0.9, by="curvature")["mu"]
    assert high - low == pytest.approx(2 * 1.6449 * found.standard_errors("curvature")["mu"], rel=1e-4)


def test_intervals_are_in_physical_units_of_every_kind():
    parameters = [
        Parameter(("share",), Fraction(0.3), "share"),
        Parameter(("matrix",), Covariance(np.diag([1.0, 4.0])), "matrix"),
    ]
    vector = np.concatenate([np.ravel(p.example.raw) for p in parameters])
    found = SimpleNamespace(vector=vector, hessian=np.eye(5), nats_per_unit=1.0)
    cov, none = 0.01 * np.eye(5), np.zeros(5, bool)
    every = Uncertainty(parameters, found, cov, cov, none, none, 25, 0.0, none).intervals(by="curvature")
    odds = np.array([x / (1 - x) for x in every["share"]])
    np.testing.assert_allclose(np.log(odds), np.log(0.3 / 0.7) + np.array([-0.196, 0.196]), atol=1e-4)
    # a variance of 4 m² whose log root is known to 0.1: ± 1.96 · 2 · 0.1 · 4
    np.testing.assert_allclose([every["matrix"][k][1, 1] for k in (0, 1)], [4 - 1.568, 4 + 1.568], atol=1e-3)
    open_ = Uncertainty(parameters, found, cov, cov, np.array([True] + [False] * 4), none, 25, 0.0, none).intervals()
    assert [float(x) for x in open_["share"]] == [0.0, 1.0]


def _product(y, weights):
    """A problem that depends on several levels only through a·b^w…"""
    labels = "abc"[: len(weights)]
    parameters = [Parameter((k,), Scale(1.0), k) for k in labels]
    problem = Numbers(y, parameters, np.array(weights, float), np.zeros(len(weights)))
    start = np.array(weights) * np.log(np.sqrt(np.mean(y**2))) / np.dot(weights, weights)
    return problem, start


@pytest.mark.parametrize(
    ("weights", "sentence"),
    [
        ([1, 1], "a, b: not determined one by one"),
        ([1, -1], "a, b: not determined one by one"),
        ([1, 0], "b: no effect on the objective"),
    ],
)
def test_undetermined_parameters_are_described_in_words(numbers, weights, sentence):
    problem, start = _product(numbers, weights)
    found = _uncertainty(problem, start)
    issues = identifiability_issues(found, problem.evaluate(start).term_gradients)
    texts = [j.text for j in issues]
    assert len(texts) == 1
    assert texts[0] == sentence
    undetermined = [k for k, e in found.standard_errors().items() if np.isnan(e)]
    assert set(undetermined) == set(issues[0].names)
    low, high = found.intervals()[undetermined[0]]
    assert low == 0
    assert high == np.inf


def test_a_flat_number_keeps_its_starting_value_and_the_others_are_fitted_with_it(numbers):
    """b^0.002 is hardly seen: at 1e-6 it has the likelihood of its starting value with another a."""
    problem, at = _product(numbers, [1, 0.002])
    away = at + np.array([0.002 * 13.8, -13.8])
    start = np.array([0.5, 0.0])
    found = uncertainty_at(problem, optimum(problem, away))
    assert flat_components(found) == [1]
    kept, at_start = kept_at_start(problem, found, start, 1.0)
    assert at_start.tolist() == [False, True]
    assert kept[1] == 0.0
    assert kept[0] == pytest.approx(at @ [1, 0.002], abs=1e-4), "σ, as b^0.002 is 1"
    again = uncertainty_at(problem, optimum(problem, kept), None, at_start)
    issues = identifiability_issues(again, problem.evaluate(kept).term_gradients)
    assert [j.text for j in issues] == ["b: kept at the starting value, which the objective does not determine"]
    assert np.isnan(again.standard_errors()["b"])
    assert again.standard_errors()["a"] > 0.0


def test_a_parameter_at_its_bound_is_named_and_the_others_are_conditional_on_it(numbers):
    problem, best = _sigma_and_mu(numbers)
    # with the level fixed too high, the uncertainty of the mean is that for this level
    high = best + [0.5, 0.0]
    found = uncertainty_at(problem, optimum(problem, high), np.array([True, False]))
    assert [j.text for j in identifiability_issues(found, problem.evaluate(high).term_gradients)] == [
        "sigma: at the bound, the optimum is lower"
    ]
    assert np.isnan(found.intervals()["sigma"]).all()
    expected = np.exp(high[0]) / np.sqrt(numbers.size)
    assert found.standard_errors("curvature")["mu"] == pytest.approx(expected, rel=1e-3)


def test_a_point_away_from_the_optimum_has_no_interval(numbers):
    problem, best = _sigma_and_mu(numbers)
    sigma = 1 / np.sqrt(2 * numbers.size)
    near, far = (_uncertainty(problem, best + [k * sigma, 0.0]) for k in (0.5, 3.0))
    assert near.at_optimum
    assert near.distance_to_optimum == pytest.approx(0.5, rel=0.1)
    assert far.distance_to_optimum == pytest.approx(3.0, rel=0.2)
    assert all(np.isnan(ends).all() for ends in far.intervals().values())
    text = identifiability_issues(far, problem.evaluate(best).term_gradients)[0].text
    assert text.startswith("the values are 3")


def test_an_interval_is_the_wider_of_curvature_and_scatter(numbers):
    problem, best = _sigma_and_mu(numbers)
    found = _uncertainty(problem, best)
    # where every trajectory's score vanishes, so does the scatter
    flat = replace(found, sandwich=1e-9 * found.observed)
    one, other = flat.intervals(by="curvature"), flat.intervals(by="scatter")
    assert float(np.diff(other["mu"])[0]) < 1e-3 * float(np.diff(one["mu"])[0])
    np.testing.assert_array_equal(flat.intervals()["mu"], one["mu"])
    assert flat.standard_errors()["mu"] == flat.standard_errors("curvature")["mu"]


@pytest.fixture(scope="module")
def line():
    tracker = line_tracker()
    world = stack(walks([60] * 24, 11))
    parameters = select_parameters(tracker, ("motion.sigma_v", "sensors.gauge.sigma"))
    return Problem(tracker, [world], RootMeanSquareError(dimensions=1), parameters), flatten(parameters)


def test_the_influence_of_a_trajectory_is_the_derivative_by_its_weight(line):
    problem, vector = line
    found = optimum(problem, vector)
    eps = 1e-5
    for n in (0, 7):
        up, down = np.ones((2, len(problem.valid)))
        up[n], down[n] = 1 + eps, 1 - eps
        slopes = [problem.evaluate(vector, w).gradients[0] for w in (up, down)]
        # rounding / step
        np.testing.assert_allclose(found.influence[n], (slopes[0] - slopes[1]) / (2 * eps), rtol=1e-6, atol=1e-10)
