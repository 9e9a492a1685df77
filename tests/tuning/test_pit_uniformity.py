"""Objectives that judge covariances: against SciPy's distributions, random numbers and worlds made by the model."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.tuning.worlds import Gauge, line_tracker, walks
from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.beam import Beam
from trackwright.trackers.aoa.direct import direct_tracker
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.baselines.windows import MovingWindow
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import Kinematic
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.mhk.tracker import mhk_tracker
from trackwright.tuning.named_objectives import all_metrics
from trackwright.tuning.objectives import StateLogLikelihood
from trackwright.tuning.pit_uniformity import (
    PITUniformity,
    chi_square_cdf,
    legendre,
    student_t_dof_of,
    student_t_nis_cdf,
)

LANES = 50

# One by one, each operation would be compiled for itself.
student_t = jax.jit(student_t_nis_cdf)


@jax.jit
def _chi_square(x, dof):
    return jax.jvp(lambda x: chi_square_cdf(x, dof), (x,), (jnp.ones_like(x),))


@pytest.mark.parametrize("dof", [1, 2, 3, 7, 8, 32])
def test_the_chi_square_distribution_is_scipys(dof):
    x = np.geomspace(1e-6, 120.0, 400)
    found, slope = _chi_square(x, dof + 0.0 * x)
    # a finite series of positive terms in double precision
    np.testing.assert_allclose(found, stats.chi2.cdf(x, dof), atol=1e-13)
    np.testing.assert_allclose(slope, stats.chi2.pdf(x, dof), rtol=1e-9, atol=1e-13)


def test_beyond_the_series_the_cube_root_is_close():
    x = np.linspace(5.0, 120.0, 400)
    for dof in (33, 60):
        # Wilson and Hilferty's error at 33 degrees of freedom, measured 3.5e-4
        np.testing.assert_allclose(_chi_square(x, dof + 0.0 * x)[0], stats.chi2.cdf(x, dof), atol=5e-4)


@pytest.mark.parametrize("dof", [1.0, 3.0, 4.0, 30.0, 1e3])
def test_one_channel_of_students_t_has_its_distribution(dof):
    t = np.geomspace(1e-3, 40.0, 300)
    q = (dof + 1) * t**2 / (dof + t**2)
    found = student_t(q, np.ones(300), dof)
    # the rule leaves out the far end, where less than 1e-5 of the probability is
    np.testing.assert_allclose(found, 2 * stats.t.cdf(t, dof) - 1, atol=2e-5)


@pytest.mark.parametrize("channels", [2, 3])
@pytest.mark.parametrize(("dof", "off"), [(1.0, 0.036), (3.0, 0.020), (4.0, 0.019), (30.0, 0.005)])
def test_several_channels_have_it_nearly(channels, dof, off):
    squares = np.random.default_rng(0).standard_t(dof, (100_000, channels)) ** 2
    q = np.sort(((dof + 1) * squares / (dof + squares)).sum(axis=1))
    found = student_t(q, np.full(q.shape, float(channels)), dof)
    # 100,000 draws know a distribution to 0.004; `off`: what the module's head says of the approximation
    np.testing.assert_allclose(found, (np.arange(len(q)) + 0.5) / len(q), atol=off + 0.002)


def test_the_distribution_with_a_tail_has_derivatives_in_everything():
    point = np.array([1.7, 2.0, 4.0])
    slope = jax.jit(jax.jacfwd(lambda p: student_t_nis_cdf(*p)))(point)
    steps = 1e-6 * np.eye(3)
    numeric = [(student_t(*(point + s)) - student_t(*(point - s))) / 2e-6 for s in steps]
    np.testing.assert_allclose(slope, numeric, rtol=1e-6)


def test_the_polynomials_are_orthonormal_over_the_unit_interval():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    values = np.array(legendre(0.5 * (1 + nodes)))
    np.testing.assert_allclose(values @ np.diag(weights / 2) @ values.T, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(values @ weights, 0, atol=1e-14)


def _output(rng, mean, n):
    """A row of `LANES` tracks with random states and covariances; every seventh waits and has none."""
    roots = rng.normal(size=(LANES, n, n))
    covs = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(n)
    waiting = np.arange(LANES) % 7 == 0
    covs[waiting] = 0.0
    upper = tuple(jnp.asarray(covs[:, i, j]) for i in range(n) for j in range(i, n))
    zero = jnp.zeros(LANES)
    status = jnp.where(waiting, Status.WAITING, Status.OK).astype(jnp.int8)
    return Output(mean, upper, zero, zero, zero, zero, status), covs, ~waiting


@eqx.filter_jit
def _summed(judges, output, truth):
    """The sums of the terms of each objective."""
    return [[jnp.sum(x) for x in judge.terms(output, truth)] for judge in judges]


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_the_state_likelihood_and_the_nees_are_those_of_the_normal_distribution(dimensions):
    rng = np.random.default_rng(dimensions)
    place, speed, true = rng.normal(size=(3, 3, LANES))
    output, covs, counted = _output(rng, Kinematic(Vector(*place), Vector(*speed)), 6)
    known = rng.random(LANES) > 0.3
    counted &= known
    truth = {"position": (jnp.asarray(true), jnp.asarray(known))}
    errors, S = (place - true)[:dimensions].T, covs[:, :dimensions, :dimensions]
    density = [stats.multivariate_normal(cov=c).logpdf(e) for e, c in zip(errors[counted], S[counted], strict=True)]
    judges = StateLogLikelihood("position", dimensions), PITUniformity("nees", "position", dimensions)
    of_density, of_nees = _summed(judges, output, truth)
    np.testing.assert_allclose(of_density, [-np.sum(density), counted.sum()], rtol=1e-11)
    nees = np.array([e @ np.linalg.solve(c, e) for e, c in zip(errors[counted], S[counted], strict=True)])
    u = stats.chi2.cdf(nees, dimensions)
    expected = [np.sqrt(2 * k + 1) * np.polynomial.Legendre.basis(k)(2 * u - 1).sum() for k in (1, 2, 3, 4)]
    np.testing.assert_allclose(of_nees, [*expected, counted.sum()], rtol=1e-9, atol=1e-11)
    assert judges[1].value(np.array(of_nees)) == pytest.approx(np.sum((np.array(expected) / counted.sum()) ** 2))


def test_a_quantity_that_is_no_field_has_the_covariance_of_its_components():
    rng = np.random.default_rng(5)
    angles = rng.normal(0, 0.3, (4, LANES))
    output, covs, counted = _output(rng, Beam(*angles), 4)
    truth = {"direction": (jnp.zeros((2, LANES)), jnp.ones(LANES, bool))}
    density = [
        stats.multivariate_normal(cov=c[:2, :2]).logpdf(e)
        for e, c in zip(angles[:2].T[counted], covs[counted], strict=True)
    ]
    ((found, _),) = _summed([StateLogLikelihood("direction", 2)], output, truth)
    assert float(found) == pytest.approx(-np.sum(density))


def test_a_row_without_a_covariance_spoils_no_derivative():
    rng = np.random.default_rng(6)
    mean = Kinematic(Vector(*rng.normal(size=(2, LANES))), Vector(*rng.normal(size=(2, LANES))))
    output, _, _ = _output(rng, mean, 4)
    truth = {"position": (jnp.zeros((2, LANES)), jnp.ones(LANES, bool))}

    def figures(scale):
        scaled = output._replace(cov=tuple(scale * c for c in output.cov))
        judges = PITUniformity("nees"), StateLogLikelihood()
        return jnp.stack([j.value([jnp.sum(x) for x in j.terms(scaled, truth)]) for j in judges])

    value, slope = jax.jit(figures), jax.jit(jax.jacfwd(figures))(1.3)
    numeric = (value(1.3 + 1e-6) - value(1.3 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, numeric, rtol=1e-6)


@pytest.fixture(scope="module")
def figures():
    """All figures of the true model and of two that lie, over 12,800 rows of the model's own world."""
    world = stack(walks([200] * 64, 1))
    levels = {"true": (0.3, 0.2), "too sure": (0.3, 0.1), "wild": (3.0, 0.2)}
    return {k: all_metrics(line_tracker(*v), world, "position", 1) for k, v in levels.items()}


def test_only_the_true_model_has_the_right_shape(figures):
    shapes = {k: (f["nis-shape"], f["nees-shape"]) for k, f in figures.items()}
    # chi-square with four degrees of freedom over about 10,000 rows: beyond 3e-3 one in 10⁵; NEES values last
    assert max(shapes["true"]) < 3e-3
    assert min(shapes["too sure"]) > 0.1
    assert min(shapes["wild"]) > 0.02


def test_every_figure_is_best_for_the_true_model(figures):
    for name in ("nll", "rmse", "state-nll"):
        assert figures["true"][name] == min(f[name] for f in figures.values())
    assert np.isnan(figures["true"]["rmse-3d"])


def test_without_truth_what_needs_none_is_left(figures):
    silent = [r.__class__(r.times, r.readings, r.inputs) for r in walks([200] * 64, 1)]
    found = all_metrics(line_tracker(), stack(silent), "position", 1)
    assert {k for k, v in found.items() if np.isfinite(v)} == {"nll", "nis-shape"}
    assert found["nll"] == pytest.approx(figures["true"]["nll"], rel=1e-12)


def test_a_quantity_that_no_state_shows_has_no_figures(figures):
    trajectories = [
        Recording(r.times, r.readings, r.inputs, {"heading": r.truth["position"]}) for r in walks([200] * 64, 1)
    ]
    found = all_metrics(line_tracker(), stack(trajectories), "heading", 1)
    assert {k for k, v in found.items() if np.isfinite(v)} == {"nll", "nis-shape"}
    assert found["nll"] == pytest.approx(figures["true"]["nll"], rel=1e-12)


def test_what_makes_the_nis_says_its_tail():
    assert float(student_t_dof_of(bearing_tracker(4, dof=5.0))) == pytest.approx(5.0)
    assert student_t_dof_of(line_tracker()) is None
    assert float(student_t_dof_of(fix_tracker(dof=7.0))) == pytest.approx(7.0)
    # the NIS of a smoothed tracker is its filter's, and that of MH-K is its fusion's
    assert float(student_t_dof_of(Smoothed(fix_tracker(dof=7.0)))) == pytest.approx(7.0)
    assert student_t_dof_of(mhk_tracker()) is None
    assert student_t_dof_of(MovingWindow(5, False)) is None


class Heavy(Gauge):
    """A gauge whose noise is of Student's t, by a number of another name."""

    tail_weight: Any = eqx.field(default_factory=lambda: Scale(6.0))

    def residual(self, reading, predicted):
        return super().residual(reading, predicted)._replace(dof=self.tail_weight.value)


def test_the_degrees_of_freedom_are_those_of_the_residuals_whatever_the_field_is_called():
    whole = line_tracker()
    gauge = whole.sensors["gauge"]
    heavy = Heavy(gauge.sigma, gauge.offset, gauge.bias)
    own = Tracker(whole.motion, {"gauge": heavy}, whole.start, track_loss=whole.track_loss)
    assert float(student_t_dof_of(own)) == pytest.approx(6.0)
    both = Tracker(whole.motion, {"gauge": heavy, "other": gauge}, whole.start, track_loss=whole.track_loss)
    with pytest.raises(ValueError, match="2 sensors, 1 of them with Student's t"):
        student_t_dof_of(both)
    # The NEES has its distribution all the same.
    assert PITUniformity("nees").for_tracker(both).student_t_dof is None


def test_the_shape_of_the_nis_needs_the_tracker():
    assert student_t_dof_of(direct_tracker(work_station().stations)) is None
    with pytest.raises(ValueError, match="for_tracker"):
        PITUniformity("nis").terms(_output(np.random.default_rng(0), Beam(*np.zeros((4, LANES))), 4)[0], {})
