"""Linear trackers against conditioning: the joint normal distribution of all states and readings, no recursion.

    x  states            s  source: the first state's deviation and all noises, N(0, C)        L  readings by source
    F  ∂step/∂x          G  ∂step/∂w          H  ∂measure/∂x          R  noise of a reading     S = LCLᵀ + R

In NumPy and double precision, with difference quotients of `step` and `measure` in place of the filter's derivatives.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.conformance.contract import NotApplicable
from trackwright.trackers.conformance.differences import central_differences
from trackwright.trackers.conformance.worlds import World, row_of
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import matrix
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import AbstractCurved, component_names, coordinates, retract
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.tracker import Tracker

LINEAR = 1e-7
"""Relative difference of Jacobians at two states up to which a function counts as linear."""


class Conditioned(NamedTuple):
    """The log density of all readings, and mean (n,) and covariance (n, n) of the last state given them."""

    log_likelihood: float
    mean: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]


class _Affine(NamedTuple):
    """The value at the mean of the prior, and the Jacobian."""

    value: Float[np.ndarray, " m"]
    slope: Float[np.ndarray, "m n"]


def conditioned(world: World, number: int) -> Conditioned:
    """The last state of recording `number` given all its readings; raises NotApplicable unless the model is linear."""
    recording, prior = world.recordings[number], world.prior
    leaves = jax.tree_util.tree_leaves(prior.mean, is_leaf=lambda x: isinstance(x, AbstractCurved))
    if any(isinstance(x, AbstractCurved) for x in leaves):
        raise NotApplicable("the state has a curved field, so that the model is not linear")
    model: Tracker = freeze(as_dtype(world.tracker, jnp.zeros(0).dtype))
    batch, names = stack([recording]), component_names(prior.mean)
    n, q = len(names), model.motion.noise_dimension
    origin = np.array([float(x) for x in coordinates(prior.mean)[0]])
    rows = [row_of(batch, k) for k in range(len(batch.dt))]
    size = n + q * len(rows)
    C = np.eye(size)
    C[:n, :n] = np.asarray(matrix(prior.cov))
    # x = origin + mean + X s
    mean, X = np.zeros(n), np.eye(n, size)
    residuals, lines, noises = [], [], []
    of_step, of_sensors = _step(model, prior.mean), _sensors(model, prior.mean)
    for k, row in enumerate(rows):
        moved = _affine("step", lambda x, row=row: of_step(x, row), n + q)
        F, G = moved.slope[:, :n], moved.slope[:, n:]
        mean = moved.value + F @ mean
        X = F @ X
        X[:, n + q * k : n + q * (k + 1)] += G
        for name in model.sensors:
            predicted = _affine("measure", lambda x, row=row, name=name: of_sensors[name](x, row), n)
            whitening = _whitening(model, name, row)
            read = np.asarray(row.readings[name].seen, bool) & whitening.any(axis=0)
            W = whitening[whitening.any(axis=1)][:, read]
            z = np.asarray(row.readings[name].values, float)
            residuals.append((z - predicted.value - predicted.slope @ mean)[read])
            lines.append((predicted.slope @ X)[read])
            noises.append(np.linalg.inv(W.T @ W))
    r, L = np.concatenate(residuals), np.concatenate(lines)
    S = L @ C @ L.T
    at = 0
    for R in noises:
        S[at : at + len(R), at : at + len(R)] += R
        at += len(R)
    gain = np.linalg.solve(S, L @ C @ X.T).T
    log_det = float(np.linalg.slogdet(S)[1])
    log_likelihood = -0.5 * (float(r @ np.linalg.solve(S, r)) + log_det + len(r) * np.log(2 * np.pi))
    return Conditioned(log_likelihood, origin + mean + gain @ r, X @ C @ X.T - gain @ (L @ C @ X.T))


def _step(model: Tracker, state: Any) -> Any:
    """Changes (k, n + q) of state and noise to changes (k, n) of the state after a row's step."""
    n = len(component_names(state))

    def one(change: Float[Array, " all"], row: Row) -> Float[Array, " n"]:
        before = retract(state, list(change[:n]))
        after = model.motion.step(before, row.inputs, row.dt, Vector.of(change[n:]))
        return jnp.stack(coordinates(after)[0]) - jnp.stack(coordinates(state)[0])

    return jax.jit(jax.vmap(one, in_axes=(0, None)))


def _sensors(model: Tracker, state: Any) -> dict[str, Any]:
    """By sensor, changes (k, n) of the state to readings (k, m)."""

    def of(name: str) -> Any:
        def one(change: Float[Array, " n"], row: Row) -> Float[Array, " m"]:
            view = model.motion.view(retract(state, list(change)))
            return jnp.stack([jnp.asarray(z) for z in model.sensors[name].measure(view, row.inputs)])

        return jax.jit(jax.vmap(one, in_axes=(0, None)))

    return {name: of(name) for name in model.sensors}


def _affine(what: str, function: Any, n: int) -> _Affine:
    """The function as an affine one; raises NotApplicable where its Jacobian elsewhere is another."""
    slope = central_differences(what, function, n)
    away = np.cos(np.arange(n))
    elsewhere = central_differences(what, lambda x: function(x + away), n)
    if np.abs(elsewhere - slope).max() > max(LINEAR * np.abs(slope).max(), 1e-9):
        raise NotApplicable(f"the model is not linear: the derivative of `{what}` depends on the state")
    return _Affine(np.asarray(function(np.zeros((1, n))))[0], slope)


def _whitening(model: Tracker, name: str, row: Row) -> Float[np.ndarray, "m m"]:
    """The matrix that whitens the residual of a reading; raises NotApplicable for Student's t."""
    reading = row.readings[name]
    zeros = jnp.zeros(len(reading.values))

    def whitened(values: Float[Array, " m"]) -> Float[Array, " m"]:
        residual = model.sensors[name].residual(reading._replace(values=values), list(zeros))
        if residual.dof is not None:
            raise NotApplicable(f"the noise of '{name}' is Student's t, so that the readings are not jointly normal")
        return jnp.stack([jnp.asarray(x) for x in residual.whitened])

    return np.asarray(jax.jacfwd(whitened)(zeros), float)
