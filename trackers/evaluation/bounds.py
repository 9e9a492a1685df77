"""The posterior Cramér–Rao bound of a tracker's model (Tichavský, Muravchik and Nehorai 1998).

And the bound of the position errors on a recording, evaluated along its truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.core.data.recording import Batch, stack
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector, dense, densify
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import Kinematic
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Row
from trackwright.trackers.core.model.state import State, coordinates, local
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype, called
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerBatch

Tree = TypeVar("Tree")

MAX_RUNS = 256
"""Largest number of tags over which the information is averaged."""

AT_ONCE = 4096
"""Rows times trajectories whose Jacobians are computed at once."""

ROUNDING = 100.0
"""Relative difference of two equal Jacobians by rounding, in units of the resolution of the floating-point type."""


class NoBoundError(ValueError):
    """A motion for which the recursion gives no bound."""


def bounds_of(folder: RecordingFolder, batches: Sequence[TrackerBatch]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times (t,), s, and bounds (t, 3), m, on the standard deviation of a recording's positions, over the known truth.

    The information is averaged over the tags of the recording if they share their times, else it is the first
    tag's. True velocities are difference quotients of the truth. None without truth, and for a tracker without a bound:
    any but an extended Kalman filter of position and velocity at the times of its rows.
    """
    mine = [(b, t) for b in batches for t in b.trajectories if t.folder.name == folder.name][:MAX_RUNS]
    if not mine or mine[0][1].station:
        return None
    owner, first, tracker = mine[0][0], mine[0][1].recording, mine[0][0].tracker
    if not (isinstance(tracker, Tracker) and isinstance(tracker.filter, ExtendedKalman)) or tracker.latency is not None:
        return None
    known = first.truth["position"][1]
    if known.sum() < 3:
        return None
    begin, last = np.flatnonzero(known)[[0, -1]].tolist()
    rows = slice(begin, last + 1)
    recordings = [t.recording for b, t in mine if b is owner and np.array_equal(t.recording.times, first.times)]
    same = [r for r in recordings if np.array_equal(r.truth["position"][1], known)]
    batch = stack(same).rows(rows)
    velocities = _velocities(tracker, batch)
    if velocities is None:
        return None
    positions = np.stack([r.truth["position"][0][rows] for r in same], axis=-1)
    times = first.times[rows]
    dimensions = 2 if owner.planar else 3
    speeds = np.gradient(positions, axis=0) / np.maximum(np.gradient(times), 1e-3)[:, None, None]
    parts = ((positions, dimensions), (speeds, velocities))
    state = Kinematic(*(Vector.of(np.asarray(x[:, k], batch.dt.dtype) for k in range(n)) for x, n in parts))
    try:
        bound = posterior_bound(tracker, batch, state)[:, :dimensions]
    except NoBoundError:
        return None
    return times, np.pad(bound, ((0, 0), (0, 3 - dimensions)), constant_values=np.nan)


def _velocities(tracker: Tracker, batch: Batch) -> int | None:
    """The number of velocities in a state of position and velocity alone; None for another state."""
    first, start = jax.tree_util.tree_map(lambda x: x[0, ..., 0], _rows(batch)), tracker.start
    mean = jax.eval_shape(lambda row: start.belief(start.candidate(tracker.sensors, row), row).mean, first)
    return len(mean.velocity) if isinstance(mean, Kinematic) else None


def posterior_bound(tracker: Tracker, batch: Batch, states: State) -> Float[np.ndarray, "T n"]:
    """Lower bounds (T, n) on the standard deviations of the filtered state's components, averaged over the batch.

    `states`: the true states, leaves (T, B). The recursion starts at the first row with the covariance of the tracker's
    start; transitions are linearised at the state of the previous row. The information of later rows is the mean over
    the valid trajectories; masked channels carry none. Where transitions differ between trajectories, as for a
    nonlinear motion,

        J⁺ = D₂₂ − D₁₂ᵀ (J + D₁₁)⁻¹ D₁₂,    D₁₁ = E FᵀQ⁻¹F,    D₁₂ = −E FᵀQ⁻¹,    D₂₂ = E Q⁻¹ + E HᵀR⁻¹H

    Raises NoBoundError for a motion whose noise is not additive, which has another density, and where transitions
    differ while their noise does not reach every component of the state.
    """
    tracker = as_dtype(tracker, batch.dt.dtype)
    prior, F, Q, information, spread, change = _terms_of_rows(tracker, batch, states)
    limit = ROUNDING * float(jnp.finfo(batch.dt.dtype).eps)
    if np.any(change[1:] > limit):
        row = 1 + int(np.argmax(change[1:] > limit))
        raise NoBoundError(
            f"posterior_bound: row {row}: the noise of {type(tracker.motion).__name__} is not additive: its Jacobians "
            "depend on the noise draw; expected a motion f(state) + G·w with G the same in all states"
        )
    covs, unit = np.empty(F.shape), np.eye(len(prior))
    P = covs[0] = prior
    for k in range(1, len(F)):
        if spread[k] > limit:
            valid = np.asarray(batch.valid[k])
            each, noise = _transitions(tracker, _row(_rows(batch), k), _row(states, k - 1))
            P = _predicted(P, np.asarray(each, float)[valid], np.asarray(noise, float)[valid], k)
        else:
            P = F[k] @ P @ F[k].T + Q[k]
        P = P @ np.linalg.inv(unit + information[k] @ P)
        P = covs[k] = (P + P.T) / 2
    return np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 0))


def _terms_of_rows(tracker: Tracker, batch: Batch, states: State) -> tuple[Float[np.ndarray, "..."], ...]:
    """`_terms` of all rows in double precision, in blocks of rows: one program serves any number of rows."""
    before = jax.tree_util.tree_map(lambda x: np.concatenate([x[:1], x[:-1]]), states)
    rows = (_rows(batch), before, states)
    block = min(len(batch.dt), max(AT_ONCE // batch.size, 1))
    blocks = []
    for first in range(0, len(batch.dt), block):
        part = jax.tree_util.tree_map(lambda x, first=first: np.asarray(x[first : first + block]), rows)
        missing = block - len(part[0].dt)
        part = jax.tree_util.tree_map(lambda x, n=missing: np.pad(x, [(0, n)] + [(0, 0)] * (x.ndim - 1), "edge"), part)
        blocks.append([np.asarray(x, float) for x in called(_terms, tracker, jax.device_put(part))])
    priors, *of_rows = zip(*blocks, strict=True)
    return priors[0], *(np.concatenate(x)[: len(batch.dt)] for x in of_rows)


def _predicted(
    P: Float[np.ndarray, "n n"], F: Float[np.ndarray, "B n n"], G: Float[np.ndarray, "B n q"], row: int
) -> Float[np.ndarray, "n n"]:
    """The predicted bound from transitions F (B, n, n) and noise G (B, n, q) that differ between trajectories."""
    Q = G @ np.swapaxes(G, 1, 2)
    if np.any(np.linalg.matrix_rank(Q, hermitian=True) < len(P)):
        raise NoBoundError(
            f"posterior_bound: row {row}: transitions differ between trajectories, and their noise does not reach all "
            "components of the state; expected noise in each of them, or the same transition in all trajectories"
        )
    precision = np.linalg.inv(Q)
    cross = np.swapaxes(F, 1, 2) @ precision
    D11, D12, D22 = (np.mean(x, axis=0) for x in (cross @ F, -cross, precision))
    inverse: Float[np.ndarray, "n n"] = np.linalg.inv(D22 - D12.T @ np.linalg.inv(np.linalg.inv(P) + D11) @ D12)
    return inverse


@eqx.filter_jit
def _transitions(tracker: Tracker, row: Row, state: State) -> tuple[Float[Array, "B n n"], Float[Array, "B n q"]]:
    """F (B, n, n) and G (B, n, q) of one row."""
    return jax.vmap(lambda r, s: _jacobians(freeze(tracker), r, s, 0.0), in_axes=-1)(row, state)


def _row(tree: Tree, row: int) -> Tree:
    return jax.tree_util.tree_map(lambda x: x[row], tree)


def _rows(batch: Batch) -> Row:
    return Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, None)


def _jacobians(
    tracker: Tracker, row: Row, state: State, draw: float
) -> tuple[Float[Array, "n n"], Float[Array, "n q"]]:
    """F (n, n) and G (n, q) of one step of one trajectory, at a noise draw of `draw` in every component."""
    motion, (point, rebuild) = tracker.motion, coordinates(state)
    n, zero = len(point), jnp.zeros_like(point[0])
    w = [zero + draw] * motion.noise_dimension
    predicted = motion.step(state, row.inputs, row.dt, Vector.of(w))

    def step(*values: Scalar) -> list[Scalar]:
        return local(predicted, motion.step(rebuild(values[:n]), row.inputs, row.dt, Vector.of(values[n:])))

    jacobian = densify(linearise(step, [*point, *w])[1], n + len(w), zero)
    return jacobian[:, :n], jacobian[:, n:]


def _terms(tracker: Tracker, part: tuple[Row, State, State]) -> tuple[Array, ...]:
    """The start's covariance (n, n); per row the batch means of F, Q and information (T, n, n), and two checks (T,).

    `part`: rows, the true states at the previous rows, the true states at the rows. The start is at the first row. The
    checks: the range of F and Q over the batch and their change by a noise draw of 1, relative to their size.
    """
    tracker = freeze(tracker)
    rows, before, states = part

    def trajectory(row: Row, before: State, state: State) -> tuple[Array, ...]:
        point, rebuild = coordinates(state)
        n, motion = len(point), tracker.motion
        zero = jnp.zeros_like(point[0])
        F, G = _jacobians(tracker, row, before, 0.0)
        drawn = _jacobians(tracker, row, before, 1.0)
        change = jnp.maximum(_relative(jnp.abs(drawn[0] - F), F), _relative(jnp.abs(drawn[1] - G), G))
        information = jnp.zeros((n, n), zero.dtype)
        for name, sensor in tracker.sensors.items():
            exact = row.readings[name]._replace(values=sensor.measure(motion.view(state), row.inputs))

            def residual_of(*values: Scalar, sensor: AbstractSensor = sensor, exact: Reading = exact) -> list[Scalar]:
                result = sensor.residual(exact, list(sensor.measure(motion.view(rebuild(values)), row.inputs)))
                # The Fisher information of Student's t is (ν + 1)/(ν + 3) times the normal's.
                weight = 1.0 if result.dof is None else (result.dof + 1.0) / (result.dof + 3.0)
                return [*result.whitened, weight]

            (*_, weight), jacobian_rows = linearise(residual_of, point)
            H = densify(jacobian_rows[:-1], n, zero)
            information = information + weight * (H.T @ H)
        return F, G @ G.T, jnp.where(row.valid, information, 0.0), change

    def one_row(row: Row, before: State, state: State) -> tuple[Array, ...]:
        *each, change = jax.vmap(trajectory, in_axes=-1)(row, before, state)
        weight = jnp.where(row.valid, jnp.ones_like(row.dt), 0.0)
        weight = weight / jnp.maximum(jnp.sum(weight), 1.0)
        F, Q, information = (jnp.tensordot(weight, x, 1) for x in each)
        valid = row.valid[:, None, None]
        low, high = ([jnp.max(jnp.where(valid, sign * x, -jnp.inf), axis=0) for x in each[:2]] for sign in (-1.0, 1.0))
        spread = jnp.maximum(*(_relative(a + b, x) for a, b, x in zip(low, high, (F, Q), strict=True)))
        return F, Q, information, spread, jnp.max(jnp.where(row.valid, change, 0.0))

    first = jax.tree_util.tree_map(lambda x: x[0, ..., 0], rows)
    candidate = tracker.start.candidate(tracker.sensors, first)
    belief = tracker.start.belief(candidate, first)
    n = len(coordinates(belief.mean)[0])
    return dense(list(belief.cov), n), *jax.vmap(one_row)(rows, before, states)


def _relative(difference: Float[Array, "..."], size: Float[Array, "..."]) -> Float[Array, ""]:
    """The largest difference relative to the largest entry; 0 for a matrix of zeros."""
    largest = jnp.max(jnp.abs(size))
    return jnp.where(largest > 0, jnp.max(difference) / jnp.where(largest > 0, largest, 1.0), jnp.max(difference))
