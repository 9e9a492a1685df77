"""The posterior Cramér–Rao bound of a tracker with linear motion (Tichavský, Muravchik and Nehorai 1998)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import Vector, dense
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Row
from trackwright.trackers.core.model.state import State, coordinates, local
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype, called
from trackwright.trackers.core.run.tracker import Tracker

ROUNDING = 100.0  # relative difference of equal Jacobians, in units of the resolution of the floating-point type


def posterior_bound(tracker: Tracker, batch: Batch, states: State) -> Float[np.ndarray, "T n"]:
    """Lower bounds (T, n) on the standard deviations of the filtered state's components, averaged over the batch.

    `states`: the true states, leaves (T, B). The recursion starts at the first row with the covariance of the tracker's
    start. The information of later rows is the mean over the valid trajectories; masked channels carry none. Raises
    ValueError where transitions differ between trajectories.
    """
    tracker = as_dtype(tracker, batch.dt.dtype)
    before = jax.tree_util.tree_map(lambda x: np.concatenate([x[:1], x[:-1]]), states)
    rows = Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, None)
    found = called(_terms, tracker, jax.device_put((rows, before, states)))
    P, F, Q, information, spread = (np.asarray(x, float) for x in found)
    unlike = np.flatnonzero(spread[1:] > ROUNDING * float(jnp.finfo(batch.dt.dtype).eps))
    if len(unlike):
        raise ValueError(
            f"posterior_bound: row {1 + unlike[0]}: the transitions of {type(tracker.motion).__name__} differ between "
            "trajectories; expected a motion F·state + G·w with F and G the same for all"
        )
    covs, unit = [P], np.eye(len(P))
    for k in range(1, len(F)):
        P = F[k] @ P @ F[k].T + Q[k]
        P = P @ np.linalg.inv(unit + information[k] @ P)
        covs.append(P := (P + P.T) / 2)
    return np.sqrt(np.maximum(np.diagonal(np.stack(covs), axis1=1, axis2=2), 0))


def _terms(tracker: Tracker, part: tuple[Row, State, State]) -> tuple[Array, ...]:
    """The start's covariance (n, n); per row the batch means of F, Q and information (T, n, n), and a check (T,).

    `part`: rows, the true states at the previous rows, the true states at the rows. The check: the largest relative
    difference of F and Q between trajectories.
    """
    tracker = freeze(tracker)
    motion = tracker.motion

    def trajectory(row: Row, before: State, state: State) -> tuple[Array, ...]:
        (at, remade), (point, rebuild) = coordinates(before), coordinates(state)
        n, still = len(at), [jnp.zeros_like(at[0])] * motion.noise_dimension
        predicted = motion.step(before, row.inputs, row.dt, Vector.of(still))

        def step(x: Array) -> Array:
            after = motion.step(remade([*x[:n]]), row.inputs, row.dt, Vector.of([*x[n:]]))
            return jnp.stack(local(predicted, after))

        jacobian = jax.jacfwd(step)(jnp.stack([*at, *still]))
        information = jnp.zeros((n, n), jacobian.dtype)
        for name, sensor in tracker.sensors.items():
            exact = row.readings[name]._replace(values=sensor.measure(motion.view(state), row.inputs))

            def whitened(x: Array, sensor: AbstractSensor = sensor, exact: Reading = exact) -> Array:
                result = sensor.residual(exact, list(sensor.measure(motion.view(rebuild([*x])), row.inputs)))
                # The Fisher information of Student's t is (ν + 1)/(ν + 3) times the normal's.
                weight = 1.0 if result.dof is None else (result.dof + 1.0) / (result.dof + 3.0)
                return weight**0.5 * jnp.stack(result.whitened)

            H = jax.jacfwd(whitened)(jnp.stack(point))
            information = information + H.T @ H
        return jacobian[:, :n], jacobian[:, n:] @ jacobian[:, n:].T, jnp.where(row.valid, information, 0.0)

    def one_row(of: tuple[Row, State, State]) -> tuple[Array, ...]:
        valid = of[0].valid
        each, weight = jax.vmap(trajectory, in_axes=-1)(*of), jnp.where(valid, jnp.ones_like(of[0].dt), 0.0)
        means = [jnp.tensordot(weight / jnp.maximum(weight.sum(), 1.0), x, 1) for x in each]
        away = (jnp.abs(x - m[None]) for x, m in zip(each, means, strict=True))
        apart = [jnp.max(jnp.where(valid[:, None, None], one, 0.0)) for one in away]
        largest = [jnp.maximum(jnp.max(jnp.abs(m)), jnp.finfo(weight.dtype).tiny) for m in means]
        return *means, jnp.maximum(apart[0] / largest[0], apart[1] / largest[1])

    first = jax.tree_util.tree_map(lambda x: x[0, ..., 0], part[0])
    belief = tracker.start.belief(tracker.start.candidate(tracker.sensors, first), first)
    return dense(list(belief.cov), len(coordinates(belief.mean)[0])), *jax.lax.map(one_row, part)
