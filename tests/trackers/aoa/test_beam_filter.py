"""The beam filter against the paper's pseudo-inverse form, its own statistics and the Cramér–Rao bound.

One set of 1,000 runs serves all: true beams drawn from the motion itself, plane waves, white phase noise, antennas
missing row by row down to none at all.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, flat, recording
from tests.oracles import beam_jacobian, beam_transition, cramer_rao, paper_beam_filter
from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.beam import Beam, BeamMotion
from trackwright.trackers.aoa.phases import PlanePhases
from trackwright.trackers.core.data.consistency import consistency, nees
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.evaluation.bounds import posterior_bound

RUNS, ROWS, SIGMA_A, SIGMA_P = 1000, 40, 0.3, 0.2
# A prior for which no phase difference is off by half a turn; beyond, an ambiguous lobe is equally valid.
MEAN, SIGMAS = np.array([0.1, -0.2, 0.0, 0.0]), np.array([0.02, 0.02, 0.05, 0.05])
STATION = work_station().stations["1"]
ANTENNAS, WAVENUMBERS = len(STATION.antennas), 2 * np.pi / STATION.wavelength * STATION.antennas


class Truth:
    """True beams (RUNS, ROWS, 4) and what the array read of them."""

    def __init__(self):
        rng = np.random.default_rng(0)
        self.dts = np.concatenate([[0.0], rng.uniform(0.02, 0.1, ROWS - 1)])
        self.seen = rng.random((ROWS, ANTENNAS)) < 0.75
        self.seen[7], self.seen[11], self.seen[12] = False, np.arange(8) == 3, np.arange(8) < 2
        start = MEAN + SIGMAS * rng.normal(size=(RUNS, 4))
        kicks = rng.normal(size=(ROWS, 2, RUNS))
        motion = BeamMotion(Scale(SIGMA_A, "rad/s^2"))

        def step(beam, row):
            beam = motion.step(beam, None, row[0], Vector(*row[1]))
            return beam, jnp.stack(beam)

        _, beams = jax.lax.scan(step, Beam(*jnp.asarray(start.T)), (jnp.asarray(self.dts), jnp.asarray(kicks)))
        self.beams = np.moveaxis(np.asarray(beams), -1, 0)
        x = np.sin(self.beams[..., 0]) * np.cos(self.beams[..., 1])
        plane = np.stack([x, np.sin(self.beams[..., 1])], axis=-1) @ WAVENUMBERS.T
        common = rng.uniform(-np.pi, np.pi, (RUNS, ROWS, 1))
        self.phases = np.angle(np.exp(1j * (plane + common + SIGMA_P * rng.normal(size=plane.shape))))

    def batch(self, trajectories):
        cov, times = np.diag(SIGMAS**2), np.cumsum(self.dts)
        return stack([recording(times, {"1": (phases, self.seen)}, MEAN, cov) for phases in self.phases[:trajectories]])


def _tracker(paper_form=False):
    sensor = PlanePhases(STATION, SIGMA_P, paper_form)
    start = KnownStart(lambda x: Beam(*x))
    return Tracker(BeamMotion(Scale(SIGMA_A, "rad/s^2")), {"1": sensor}, start, track_loss=NEVER_LOST)


@pytest.fixture(scope="module")
def truth():
    return Truth()


@pytest.fixture(scope="module")
def estimates(truth):
    return _tracker().run(truth.batch(RUNS))


@pytest.fixture(scope="module")
def both_forms(estimates, truth):
    return {"default": estimates[:16], "paper": _tracker(paper_form=True).run(truth.batch(16))}


@pytest.mark.parametrize("form", ["default", "paper"])
def test_it_is_the_papers_pseudo_inverse_filter_while_nothing_wraps(both_forms, truth, form):
    mine = both_forms[form]
    assert not mine.wrapped.any()
    seen = truth.seen[1:]
    for trajectory in range(16):
        means, covs, log_likelihoods = paper_beam_filter(
            WAVENUMBERS, SIGMA_A, SIGMA_P, truth.dts[1:], truth.phases[trajectory, 1:], seen, MEAN, np.diag(SIGMAS**2)
        )
        np.testing.assert_allclose(flat(mine[trajectory].mean)[1:], means, atol=1e-10)
        np.testing.assert_allclose(mine[trajectory].covariance[1:], covs, atol=1e-10)
        # n(n − 1)/2 differences are measured by another stick than n − 1: pdet(DDᵀ) = nⁿ⁻¹ against n. A constant.
        n = np.maximum(seen.sum(axis=1), 1)
        stick = np.where(n > 1, -0.5 * (n - 2) * np.log(n), 0.0)
        np.testing.assert_allclose(mine[trajectory].log_likelihood[1:] + stick, log_likelihoods, atol=1e-9)


def test_rows_with_no_antenna_or_one_carry_no_information(estimates, truth):
    np.testing.assert_array_equal(estimates.nis_dof[:, [7, 11]], 0)
    np.testing.assert_array_equal(estimates.nis[:, [7, 11]], 0)
    np.testing.assert_array_equal(estimates.log_likelihood[:, [7, 11]], 0)
    np.testing.assert_array_equal(estimates.nis_dof[0, 1:], np.maximum(truth.seen[1:].sum(axis=1) - 1, 0))


def _errors(estimates, truth):
    return flat(estimates.mean) - truth.beams


def test_the_nees_is_inside_its_95_percent_interval(estimates, truth):
    errors, covs = _errors(estimates, truth), estimates.covariance
    last = consistency(nees(errors[:, -1], covs[:, -1]), 4)
    assert last.low <= last.mean <= last.high
    # Rows of one run are correlated: over all rows the interval comes from the scatter of the runs' own means.
    means = nees(errors.reshape(-1, 4), covs.reshape(-1, 4, 4)).reshape(RUNS, ROWS).mean(axis=1)
    assert abs(means.mean() - 4) < 1.96 * means.std() / np.sqrt(RUNS)


def test_the_nis_is_inside_its_95_percent_interval(estimates):
    metric = consistency(estimates.nis[:, 1:].ravel(), estimates.nis_dof[:, 1:].ravel())
    assert metric.low <= metric.mean <= metric.high


def _bounds(truth, trajectories=RUNS):
    wavenumbers = 2 * np.pi / STATION.wavelength * STATION.antennas
    information = np.zeros((ROWS, 4, 4))
    for row in range(1, ROWS):
        k = wavenumbers[truth.seen[row]]
        if len(k) > 1:
            centre = np.eye(len(k)) - 1.0 / len(k)
            slopes = [centre @ beam_jacobian(k, *beam[:2])[1] for beam in truth.beams[:trajectories, row]]
            information[row, :2, :2] = np.mean([G.T @ G for G in slopes], axis=0) / SIGMA_P**2
    transitions = [beam_transition(dt, SIGMA_A) for dt in truth.dts]
    return cramer_rao(transitions, information, np.diag(SIGMAS**2))


@pytest.mark.parametrize(("name", "components"), [("angles", slice(0, 2)), ("rates", slice(2, 4))])
def test_the_error_is_at_the_cramer_rao_bound(estimates, truth, name, components):
    square = np.mean(_errors(estimates, truth)[:, 1:, components] ** 2, axis=0).sum()
    bound = sum(np.trace(b[components, components]) for b in _bounds(truth)[1:])
    # The RMSE of 1,000 runs is accurate to about 1 %; below the bound by more would mean a wrong bound.
    assert 0.97 < np.sqrt(square / bound) < 1.05


def test_the_librarys_own_bound_is_the_one_of_hand_derived_jacobians(truth):
    # Beams as the truth has them: leaves (rows, trajectories).
    states = Beam(*np.moveaxis(truth.beams[:32], -1, 0).swapaxes(1, 2))
    mine = posterior_bound(_tracker(), truth.batch(32), states)
    expected = np.sqrt(np.diagonal(_bounds(truth, 32), axis1=1, axis2=2))
    np.testing.assert_allclose(mine, expected, rtol=1e-8)
