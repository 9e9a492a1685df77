"""The posterior Cramér–Rao bound of a tracker with linear motion (Tichavský, Muravchik and Nehorai 1998)."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.core.data.recording import Batch, stack
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Vector, dense
from trackwright.trackers.core.model.motion import Kinematic
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Row
from trackwright.trackers.core.model.state import State, coordinates, local
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype, called
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerBatch

MAX_RUNS = 256
"""Largest number of tags over which the information is averaged."""

ROUNDING = 100.0
"""Relative difference of two equal Jacobians by rounding, in units of the resolution of the floating-point type."""


class NoBoundError(ValueError):
    """A motion for which the recursion gives no bound."""


def bounds_of(folder: RecordingFolder, batches: Sequence[TrackerBatch]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times (t,), s, and bounds (t, 3), m, on the standard deviation of a recording's positions, over the known truth.

    The information is averaged over the tags whose truth has the times of the first. True velocities are difference
    quotients. None without truth, and for any tracker but an extended Kalman filter of position and velocity with
    linear motion, at the times of its rows.
    """
    mine = [(b, t) for b in batches for t in b.trajectories if t.folder.name == folder.name][:MAX_RUNS]
    if not mine or mine[0][1].station:
        return None
    owner, first, tracker = mine[0][0], mine[0][1].recording, mine[0][0].tracker
    known = first.truth["position"][1]
    if not isinstance(tracker, Tracker) or not isinstance(tracker.filter, ExtendedKalman) or known.sum() < 3:
        return None
    recordings = [t.recording for b, t in mine if b is owner and np.array_equal(t.recording.times, first.times)]
    recordings = [r for r in recordings if np.array_equal(r.truth["position"][1], known)]
    rows, start = slice(np.argmax(known), len(known) - np.argmax(known[::-1])), tracker.start
    batch, times = stack(recordings).rows(rows), first.times[rows]
    row = jax.tree_util.tree_map(lambda x: x[0, ..., 0], _rows(batch))
    mean = jax.eval_shape(lambda row: start.belief(start.candidate(tracker.sensors, row), row).mean, row)
    if tracker.latency is not None or not isinstance(mean, Kinematic):
        return None
    positions = np.stack([r.truth["position"][0][rows] for r in recordings], axis=-1)
    speeds = np.gradient(positions, axis=0) / np.maximum(np.gradient(times), 1e-3)[:, None, None]
    parts = ((positions, len(mean.position)), (speeds, len(mean.velocity)))
    state = Kinematic(*(Vector.of(np.asarray(x[:, k], batch.dt.dtype) for k in range(n)) for x, n in parts))
    try:
        bound = posterior_bound(tracker, batch, state)[:, : parts[0][1]]
    except NoBoundError:
        return None
    return times, np.pad(bound, ((0, 0), (0, 3 - bound.shape[1])), constant_values=np.nan)


def posterior_bound(tracker: Tracker, batch: Batch, states: State) -> Float[np.ndarray, "T n"]:
    """Lower bounds (T, n) on the standard deviations of the filtered state's components, averaged over the batch.

    `states`: the true states, leaves (T, B). The recursion starts at the first row with the covariance of the tracker's
    start. The information of later rows is the mean over the valid trajectories; masked channels carry none. Raises
    NoBoundError where transitions depend on the trajectory or on the noise draw.
    """
    tracker = as_dtype(tracker, batch.dt.dtype)
    before = jax.tree_util.tree_map(lambda x: np.concatenate([x[:1], x[:-1]]), states)
    found = called(_terms, tracker, jax.device_put((_rows(batch), before, states)))
    P, F, Q, information, spread = (np.asarray(x, float) for x in found)
    unlike = np.flatnonzero(spread[1:] > ROUNDING * float(jnp.finfo(batch.dt.dtype).eps))
    if len(unlike):
        raise NoBoundError(
            f"posterior_bound: row {1 + unlike[0]}: the transitions of {type(tracker.motion).__name__} differ between "
            "trajectories or noise draws; expected a motion F·state + G·w with F and G the same for all"
        )
    covs, unit = [P], np.eye(len(P))
    for k in range(1, len(F)):
        P = F[k] @ P @ F[k].T + Q[k]
        P = P @ np.linalg.inv(unit + information[k] @ P)
        covs.append(P := (P + P.T) / 2)
    return np.sqrt(np.maximum(np.diagonal(np.stack(covs), axis1=1, axis2=2), 0))


def _rows(batch: Batch) -> Row:
    return Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, None)


def _terms(tracker: Tracker, part: tuple[Row, State, State]) -> tuple[Array, ...]:
    """The start's covariance (n, n); per row the batch means of F, Q and information (T, n, n), and a check (T,).

    `part`: rows, the true states at the previous rows, the true states at the rows. The check: the largest relative
    difference of F and Q between trajectories, or by a noise draw of 1.
    """
    tracker = freeze(tracker)
    motion = tracker.motion

    def trajectory(row: Row, before: State, state: State) -> tuple[Array, ...]:
        (at, remade), (point, rebuild) = coordinates(before), coordinates(state)

        def transition(draw: Array) -> tuple[Array, Array]:
            w = jnp.full(motion.noise_dimension, draw)
            predicted = motion.step(before, row.inputs, row.dt, Vector.of([*w]))

            def step(x: Array, w: Array) -> Array:
                return jnp.stack(local(predicted, motion.step(remade([*x]), row.inputs, row.dt, Vector.of([*w]))))

            F, G = jax.jacfwd(step, (0, 1))(jnp.stack(at), w)
            return F, G @ G.T

        information = jnp.zeros((len(point), len(point)), point[0].dtype)
        for name, sensor in tracker.sensors.items():
            exact = row.readings[name]._replace(values=sensor.measure(motion.view(state), row.inputs))

            def whitened(x: Array, sensor: AbstractSensor = sensor, exact: Reading = exact) -> Array:
                result = sensor.residual(exact, list(sensor.measure(motion.view(rebuild([*x])), row.inputs)))
                # The Fisher information of Student's t is (ν + 1)/(ν + 3) times the normal's.
                weight = 1.0 if result.dof is None else (result.dof + 1.0) / (result.dof + 3.0)
                return weight**0.5 * jnp.stack(result.whitened)

            H = jax.jacfwd(whitened)(jnp.stack(point))
            information = information + H.T @ H
        return *jax.vmap(transition)(jnp.arange(2, dtype=point[0].dtype)), jnp.where(row.valid, information, 0.0)

    def one_row(of: tuple[Row, State, State]) -> tuple[Array, ...]:
        valid = of[0].valid[:, None, None]
        weight = jnp.where(of[0].valid, jnp.ones_like(of[0].dt), 0.0)
        F, Q, information = jax.vmap(trajectory, in_axes=-1)(*of)
        weight = weight / jnp.maximum(weight.sum(), 1.0)
        means = [jnp.tensordot(weight, x, 1) for x in (F[:, 0], Q[:, 0], information)]
        spread = jnp.zeros_like(weight[0])
        for each, mean in ((F[:, 0], means[0]), (F[:, 1], means[0]), (Q[:, 0], means[1]), (Q[:, 1], means[1])):
            apart = jnp.max(jnp.where(valid, jnp.abs(each - mean[None]), 0.0))
            spread = jnp.maximum(spread, apart / jnp.maximum(jnp.max(jnp.abs(mean)), jnp.finfo(weight.dtype).tiny))
        return *means, spread

    first = jax.tree_util.tree_map(lambda x: x[0, ..., 0], part[0])
    belief = tracker.start.belief(tracker.start.candidate(tracker.sensors, first), first)
    return dense(list(belief.cov), len(coordinates(belief.mean)[0])), *jax.lax.map(one_row, part)
