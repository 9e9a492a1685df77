"""The posterior Cramér–Rao lower bound of a tracker's model (Tichavský, Muravchik and Nehorai 1998)."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, Vector, dense, densify
from trackers.core.chunks import as_dtype
from trackers.core.linearise import linearise
from trackers.core.recording import Batch, Row
from trackers.core.state import coordinates, local
from trackers.core.tracker import Tracker
from trackers.core.tunable import freeze


def posterior_bound(tracker: Tracker, batch: Batch, states: Any) -> np.ndarray:
    """Lower bounds (T, n) on the standard deviations of the filtered state's components, averaged over the batch.

    `states`: the true states, leaves (T, B). The recursion starts at the first row with the covariance of the tracker's
    start. Jacobians and information of later rows are means over the valid trajectories; masked channels carry no
    information.
    """
    prior, F, Q, information = (np.asarray(x, float) for x in _terms(as_dtype(tracker, batch.dt.dtype), batch, states))
    P, result = prior, [np.sqrt(np.diag(prior))]
    for k in range(1, len(F)):
        P = F[k] @ P @ F[k].T + Q[k]
        P = P @ np.linalg.inv(np.eye(len(P)) + information[k] @ P)
        P = (P + P.T) / 2
        result.append(np.sqrt(np.maximum(np.diag(P), 0)))
    return np.array(result)


@eqx.filter_jit
def _terms(tracker: Tracker, batch: Batch, states: Any) -> tuple[Any, ...]:
    """The start's covariance (n, n), and per row the batch means of F, Q and the information (T, n, n)."""
    tracker = freeze(tracker)
    rows = Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, None)

    def trajectory(row: Row, state: Any) -> tuple[Any, Any, Any]:
        point, rebuild = coordinates(state)
        n = len(point)
        zero = jnp.zeros_like(point[0])
        motion, q = tracker.motion, tracker.motion.noise_dimension
        predicted = motion.step(state, row.inputs, row.dt, Vector.of([zero] * q))

        def step(*values: Scalar) -> list[Scalar]:
            return local(predicted, motion.step(rebuild(values[:n]), row.inputs, row.dt, Vector.of(values[n:])))

        jacobian = densify(linearise(step, [*point, *[zero] * q])[1], n + q, zero)
        F, G = jacobian[:, :n], jacobian[:, n:]
        information = jnp.zeros((n, n), zero.dtype)
        for name, sensor in tracker.sensors.items():
            exact = row.readings[name]._replace(values=sensor.measure(motion.view(state), row.inputs))

            def residual_of(*values: Scalar, sensor: Any = sensor, exact: Any = exact) -> list[Scalar]:
                result = sensor.residual(exact, list(sensor.measure(motion.view(rebuild(values)), row.inputs)))
                # The Fisher information of Student's t is (ν + 1)/(ν + 3) times that of the normal.
                weight = 1.0 if result.dof is None else (result.dof + 1.0) / (result.dof + 3.0)
                return [*result.whitened, weight]

            (*_, weight), jacobian_rows = linearise(residual_of, point)
            H = densify(jacobian_rows[:-1], n, zero)
            information = information + weight * (H.T @ H)
        return F, G @ G.T, jnp.where(row.valid, information, 0.0)

    def one_row(row: Row, state: Any) -> tuple[Any, ...]:
        F, Q, information = jax.vmap(trajectory, in_axes=-1)(row, state)
        weight = jnp.where(row.valid, jnp.ones_like(row.dt), 0.0)
        weight = weight / jnp.maximum(jnp.sum(weight), 1.0)
        return tuple(jnp.tensordot(weight, x, 1) for x in (F, Q, information))

    first = jax.tree_util.tree_map(lambda x: jnp.asarray(x)[0, ..., 0], rows)
    candidate = tracker.start.candidate(tracker.sensors, first)
    belief = tracker.start.belief(candidate, first)
    n = len(coordinates(belief.mean)[0])
    return dense(list(belief.cov), n), *jax.lax.map(lambda x: one_row(*x), (rows, states))
