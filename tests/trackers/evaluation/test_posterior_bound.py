"""The posterior Cramér–Rao bound against dense information matrices, hand-derived Jacobians and quadrature."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import KnownStart, recording
from tests.oracles import beam_jacobian, beam_transition, cramer_rao, van_loan
from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.beam import Beam, BeamMotion
from trackwright.trackers.aoa.phases import PlanePhases
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantPosition, ConstantVelocity, Kinematic, Placed
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Residual
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.evaluation.bounds import posterior_bound

ROWS, SIGMA_A, SIGMA = 12, 0.4, 0.3


class Gauge(AbstractSensor):
    """Reads the position on a line with white noise `SIGMA`, of Student's t where there is a `dof`."""

    dof: float | None = eqx.field(static=True, default=None)

    @property
    def channels(self):
        return (Channel("x", "m"),)

    def measure(self, view: Any, inputs: Any):
        return [view.position[0]]

    def residual(self, reading, predicted):
        whitened = jnp.where(reading.seen[0], (reading.values[0] - predicted[0]) / SIGMA, 0.0)
        nis_dof = jnp.where(reading.seen[0], jnp.ones_like(whitened), 0.0)
        dof = None if self.dof is None else jnp.asarray(self.dof)
        return Residual([whitened], 0.0 * whitened, nis_dof, dof=dof)


def _times(rng):
    return np.cumsum(np.concatenate([[0.0], rng.uniform(0.05, 0.4, ROWS - 1)]))


def test_on_a_linear_model_it_is_the_inverse_of_the_whole_paths_information():
    rng = np.random.default_rng(0)
    times, seen = _times(rng), rng.random((ROWS, 1)) < 0.7
    start = np.array([[0.5, 0.1], [0.1, 0.2]])
    tracker = Tracker(
        ConstantVelocity(SIGMA_A, 1), {"gauge": Gauge()}, KnownStart(lambda x: Kinematic(Vector(x[0]), Vector(x[1])))
    )
    batch = stack([recording(times, {"gauge": (np.zeros((ROWS, 1)), seen)}, np.zeros(2), start)])
    states = Kinematic(Vector(rng.normal(size=(ROWS, 1))), Vector(rng.normal(size=(ROWS, 1))))
    bounds = posterior_bound(tracker, batch, states)

    # every state of the path is an unknown; the first row's reading has made the start and is not counted again
    whole = np.zeros((2 * ROWS, 2 * ROWS))
    whole[:2, :2] = np.linalg.inv(start)
    expected = [np.sqrt(np.diag(start))]
    for k, dt in enumerate(np.diff(times), start=1):
        F, Q = van_loan(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, SIGMA_A**2]), dt)
        step = np.hstack([-F, np.eye(2)])
        here = slice(2 * k - 2, 2 * k + 2)
        whole[here, here] += step.T @ np.linalg.inv(Q) @ step
        whole[2 * k, 2 * k] += seen[k, 0] / SIGMA**2
        upto = np.linalg.inv(whole[: 2 * k + 2, : 2 * k + 2])
        expected.append(np.sqrt(np.diag(upto)[-2:]))
    np.testing.assert_allclose(bounds, expected, rtol=1e-9)


def test_of_beams_it_is_the_recursion_with_hand_derived_jacobians():
    rng = np.random.default_rng(1)
    trajectories, spread, sigma_p = 5, np.array([0.1, 0.2, 0.05, 0.04]), 0.2
    station = work_station().stations["1"]
    times = _times(rng)
    angles = 0.4 * rng.normal(size=(2, ROWS, trajectories))
    seen = rng.random((trajectories, ROWS, 8)) < 0.6
    seen[:, 3], seen[:, 5, 1:] = False, False
    tracker = Tracker(BeamMotion(Scale(SIGMA_A)), {"1": PlanePhases(station, sigma_p)}, KnownStart(lambda x: Beam(*x)))
    phases = [recording(times, {"1": (np.zeros((ROWS, 8)), s)}, np.zeros(4), np.diag(spread**2)) for s in seen]
    bounds = posterior_bound(tracker, stack(phases), Beam(*angles, *np.zeros((2, ROWS, trajectories))))

    wavenumbers = 2 * np.pi / station.wavelength * np.asarray(station.antennas)
    information = np.zeros((ROWS, 4, 4))
    for row in range(ROWS):
        for trajectory in range(trajectories):
            k = wavenumbers[seen[trajectory, row]]
            if len(k) > 1:
                slope = beam_jacobian(k, *angles[:, row, trajectory])[1]
                slope = slope - slope.mean(axis=0)
                information[row, :2, :2] += slope.T @ slope / sigma_p**2 / trajectories
    transitions = [beam_transition(dt, SIGMA_A) for dt in np.diff(times)]
    expected = cramer_rao(transitions, information[1:], np.diag(spread**2))
    np.testing.assert_allclose(bounds[0], spread, rtol=1e-12)
    np.testing.assert_allclose(bounds[1:], np.sqrt(np.diagonal(expected, axis1=1, axis2=2)), rtol=1e-8)


def _on_the_line(sensor, recordings, rows=None):
    tracker = Tracker(ConstantPosition(0.2, 1), {"gauge": sensor}, KnownStart(lambda x: Placed(Vector(x[0]))))
    batch = stack(recordings, rows)
    return posterior_bound(tracker, batch, Placed(Vector(np.zeros(batch.dt.shape))))[:, 0]


def _reads(seen):
    return recording(0.1 * np.arange(len(seen)), {"gauge": (np.zeros((len(seen), 1)), seen[:, None])}, [0.0], [[1.0]])


@pytest.mark.parametrize("dof", [1.0, 4.0, 30.0])
def test_a_heavy_tail_carries_the_information_of_its_density(dof):
    first, second = _on_the_line(Gauge(dof), [_reads(np.ones(2, bool))])
    x = np.linspace(-3000, 3000, 3_000_001)
    density = (1 + x * x / dof) ** (-0.5 * (dof + 1))
    score = -(dof + 1) * x / (dof + x * x)
    weight = np.trapezoid(score**2 * density, x) / np.trapezoid(density, x)
    assert first == 1.0
    # the Cauchy density beyond ±3000 has 2e-4 of its weight
    assert second == pytest.approx((1 / (1 + 0.2**2 * 0.1) + weight / SIGMA**2) ** -0.5, rel=3e-4)


def test_recordings_that_have_ended_do_not_weigh():
    long, short = _reads(np.ones(6, bool)), _reads(np.ones(3, bool))
    np.testing.assert_allclose(_on_the_line(Gauge(), [long, short]), _on_the_line(Gauge(), [long]), rtol=1e-12)


class Falling(ConstantVelocity):
    """Motion with drag: nonlinear in the speed, and without noise of its own in the position."""

    def step(self, state, inputs, dt, w):
        kick = Vector(self.sigma_a.value * jnp.sqrt(dt) * w[0])
        drag = Vector(-state.velocity[0] * jnp.abs(state.velocity[0]) * dt)
        return Kinematic(state.position + state.velocity * dt + drag * dt, state.velocity + drag + kick)


def test_transitions_that_differ_between_trajectories_have_no_bound():
    start = KnownStart(lambda s: Kinematic(Vector(s[0]), Vector(s[1])))
    tracker = Tracker(Falling(0.3, 1), {"gauge": Gauge()}, start)
    seen = {"gauge": (np.zeros((4, 1)), np.ones((4, 1), bool))}
    batch = stack([recording(0.1 * np.arange(4), seen, [0.0, 0.0], np.eye(2))] * 3)
    speeds = np.random.default_rng(0).normal(size=(4, 3))
    with pytest.raises(ValueError, match="row 1: the transitions of Falling differ between trajectories"):
        posterior_bound(tracker, batch, Kinematic(Vector(speeds), Vector(speeds)))
