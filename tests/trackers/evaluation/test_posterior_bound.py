"""The posterior Cramér–Rao bound against dense information matrices and quadrature; of beams see tests of aoa."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import KnownStart, recording
from tests.oracles import van_loan
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantPosition, ConstantVelocity, Kinematic, Placed
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Residual
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


def test_on_a_linear_model_it_is_the_inverse_of_the_whole_paths_information():
    rng = np.random.default_rng(0)
    times = np.cumsum(np.concatenate([[0.0], rng.uniform(0.05, 0.4, ROWS - 1)]))
    seen = rng.random((ROWS, 1)) < 0.7
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


@pytest.mark.parametrize("dof", [1.0, 4.0, 30.0])
def test_a_heavy_tail_carries_the_information_of_its_density(dof):
    tracker = Tracker(ConstantPosition(0.2, 1), {"gauge": Gauge(dof)}, KnownStart(lambda x: Placed(Vector(x[0]))))
    batch = stack([recording(0.1 * np.arange(2), {"gauge": (np.zeros((2, 1)), np.ones((2, 1), bool))}, [0.0], [[1.0]])])
    first, second = posterior_bound(tracker, batch, Placed(Vector(np.zeros(batch.dt.shape))))[:, 0]
    x = np.linspace(-3000, 3000, 3_000_001)
    density = (1 + x * x / dof) ** (-0.5 * (dof + 1))
    score = -(dof + 1) * x / (dof + x * x)
    weight = np.trapezoid(score**2 * density, x) / np.trapezoid(density, x)
    assert first == 1.0
    # the Cauchy density beyond ±3000 has 2e-4 of its weight
    assert second == pytest.approx((1 / (1 + 0.2**2 * 0.1) + weight / SIGMA**2) ** -0.5, rel=3e-4)


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
