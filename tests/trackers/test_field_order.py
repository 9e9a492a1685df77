"""A state whose first field is not `position`: the same filter gives the same ellipses, NEES and coverage everywhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.baselines.switching import mirror_tracker
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.filters.ekf import Gaussian
from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.filters.imm import Mixture
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.linearise import covariance_of
from trackwright.trackers.core.model.motion import AbstractMotion, ConstantVelocity, Kinematic
from trackwright.trackers.core.model.state import Rotation
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.fixes import FIXES, PATIENT, CorrelatedFixSensor, FixStart
from trackwright.trackers.recordings.tracks import track
from trackwright.trackers.uwb_imu.inertial import with_yaw_variance

R = np.array([[0.09, -0.05, 0.0], [-0.05, 0.04, 0.0], [0.0, 0.0, 0.25]])
"""Covariance of the fixes, m²: correlated, so that cov_xy is not zero."""


class VelocityFirst(NamedTuple):
    velocity: Any
    position: Any


class VelocityFirstMotion(AbstractMotion):
    """Constant velocity of a state with the velocity before the position."""

    motion: ConstantVelocity

    @property
    def noise_dimension(self):
        return self.motion.noise_dimension

    def step(self, state, inputs, dt, w):
        moved = self.motion.step(Kinematic(state.position, state.velocity), inputs, dt, w)
        return VelocityFirst(moved.velocity, moved.position)


class VelocityFirstStart(AbstractStart):
    """The belief of a `FixStart`, whose components are independent, with the fields exchanged."""

    start: FixStart

    def can_start(self, row):
        return self.start.can_start(row)

    def candidate(self, sensors, row):
        return self.start.candidate(sensors, row)

    def belief(self, candidate, row):
        mean, cov = self.start.belief(candidate, row)
        return Gaussian(VelocityFirst(mean.velocity, mean.position), _permuted(cov, [3, 4, 5, 0, 1, 2]))


def _permuted(upper, order):
    """The upper triangle with rows and columns in another order."""
    n = len(order)
    at = {pair: k for k, pair in enumerate(zip(*np.triu_indices(n), strict=True))}
    pairs = [(order[i], order[j]) for i in range(n) for j in range(i, n)]
    return tuple(upper[at[min(pair), max(pair)]] for pair in pairs)


def _tracker(exchanged):
    motion, start = ConstantVelocity(0.5, 3), FixStart(Scale(0.5, "m"), Scale(1.0, "m/s"), False, 3)
    if exchanged:
        motion, start = VelocityFirstMotion(motion), VelocityFirstStart(start)
    return Tracker(motion, {FIXES: CorrelatedFixSensor(R)}, start, track_loss=PATIENT)


@pytest.fixture(scope="module")
def specs():
    return {
        name: replace(spec_of("fix-kf"), build=lambda trajectory, planar, e=exchanged: _tracker(e))
        for name, exchanged in (("usual", False), ("exchanged", True))
    }


@pytest.fixture(scope="module")
def folder():
    return tw.simulate.agv(n=3, seed=3, rows=40).folder()


def test_the_tables_and_their_evaluation_do_not_depend_on_the_order_of_the_fields(folder, specs):
    tracks = {name: track(spec.batches([folder], name)) for name, spec in specs.items()}
    usual, exchanged = (tracks[name].table for name in ("usual", "exchanged"))
    assert usual["cov_xy_m2"].min() < -0.005
    for name in usual.columns:
        if usual.schema[name].is_numeric():
            np.testing.assert_allclose(exchanged[name], usual[name], rtol=1e-7, atol=1e-9, err_msg=name)
    one, other = (tw.evaluate(tracks[name], folder) for name in ("usual", "exchanged"))
    assert other["nees_mean"] == pytest.approx(one["nees_mean"], rel=1e-7)
    assert other["coverage_95"] == one["coverage_95"]


def _random_cov(n, seed=0):
    A = np.random.default_rng(seed).normal(size=(n, n))
    return A @ A.T


def _upper(cov):
    return tuple(cov[np.triu_indices(len(cov))])


def test_the_covariance_of_a_quantity_is_that_of_its_jacobian():
    P, x = _random_cov(4), np.array([0.3, -0.4, 1.2, 2.0])
    state = VelocityFirst(Vector(*x[:2]), Vector(*x[2:]))

    def polar(s):
        px, py = s.position
        return (s.velocity[1], jnp.hypot(px, py), jnp.arctan2(py, px))

    J = np.array(jax.jacobian(lambda v: jnp.stack(polar(VelocityFirst((v[0], v[1]), (v[2], v[3])))))(x))
    found = covariance_of(state, _upper(P), polar)
    for (i, j), value in found.items():
        assert value == pytest.approx((J @ P @ J.T)[i, j], rel=1e-12)
    selected = covariance_of(state, _upper(P), lambda s: s.position)
    # The very entries: no operation is traced.
    assert (selected[0, 0], selected[0, 1], selected[1, 1]) == (P[2, 2], P[2, 3], P[3, 3])


def test_the_rate_of_crossing_the_plane_uses_the_variance_of_the_height():
    P, z, reach, plane = _random_cov(5), 1.3, 0.1, 2.0
    cov = jnp.asarray(_upper(P))
    state = VelocityFirst(Vector(0.1, 0.2), Vector(1.0, 2.0, z))
    models = mirror_tracker(rate=0.7).filter
    (rate,) = models.switching_rates(Mixture((Gaussian(state, tuple(cov)),), (0.0,)), {"plane": plane})
    assert float(rate) == pytest.approx(0.7 * np.exp(-0.5 * (z - plane) ** 2 / (P[4, 4] + reach**2)), rel=1e-12)


def test_a_yaw_variance_is_added_to_the_attitude():
    class AttitudeFirst(NamedTuple):
        attitude: Any
        position: Any

    P, axis = _random_cov(5), np.array([0.0, 0.6, 0.8])
    belief = Gaussian(AttitudeFirst(Rotation(1.0, 0.0, 0.0, 0.0), Vector(0.0, 0.0)), _upper(P))
    added = with_yaw_variance(belief, Vector(*axis), 2.0)
    expected = P + 2.0 * np.pad(np.outer(axis, axis), ((0, 2), (0, 2)))
    np.testing.assert_allclose(added.cov, _upper(expected), rtol=1e-12)
