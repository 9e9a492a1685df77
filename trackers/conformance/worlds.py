"""A world drawn from a tracker's own model: states by its motion, readings by its sensors, at a recording's rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from trackwright.trackers.conformance.contract import NotApplicable
from trackwright.trackers.core.data.estimates import Estimates, Status
from trackwright.trackers.core.data.recording import Batch, Readings, Recording, stack
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.filters.imm import InteractingModels
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian, matrix
from trackwright.trackers.core.model.inputs import Input, Need
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Row
from trackwright.trackers.core.model.state import State, component_names, local, retract
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.recordings.trajectories import cut

ROWS = 32
"""Rows of a world."""


@dataclass(frozen=True)
class World:
    """Recordings drawn from the model of a tracker, which begin with the belief `prior`.

    `tracker`: without track loss, with estimates at the times of rows. `states`: the true states, leaves (T, n) for n
    recordings. `normal`: no reading has the noise of Student's t.
    """

    tracker: Tracker
    prior: Gaussian
    recordings: list[Recording]
    states: State
    normal: bool

    def errors(self, mean: State, row: int) -> Float[np.ndarray, "n d"]:
        """The small steps from estimates, leaves (n, T), to the true states in one row."""
        estimated = jax.tree_util.tree_map(lambda x: jnp.asarray(x[:, row]), mean)
        true = jax.tree_util.tree_map(lambda x: jnp.asarray(x[row]), self.states)
        return np.asarray(jax.vmap(lambda a, b: jnp.stack(local(a, b)))(estimated, true))


def drawn_world(tracker: AbstractTracker, recording: Recording, estimates: Estimates, n: int, seed: int) -> World:
    """A world at the later rows of a recording, which begins with the tracker's estimate in the middle of it.

    In double precision, under `jax.enable_x64`. Raises NotApplicable for a tracker without a motion and sensors, and
    for one without covariances of its whole state.
    """
    if not isinstance(tracker, Tracker):
        raise NotApplicable(f"a {type(tracker).__name__} has no motion and sensors to draw a world from")
    if isinstance(tracker.filter, InteractingModels):
        raise NotApplicable("the filter switches between models, none of which is that of the world")
    inert = replace(tracker, track_loss=TrackLossPolicy(np.inf, max_gap=np.inf), latency_of=None)
    if tracker.position_alone:
        raise NotApplicable("estimates have the covariance of positions alone: position_alone")
    running = np.flatnonzero(estimates.status == Status.OK)
    if not len(running):
        raise NotApplicable("no row with a running track, whose belief the world could begin with")
    row = int(running[len(running) // 2])
    mean = jax.tree_util.tree_map(lambda x: jnp.asarray(x[row], float), estimates.mean)
    try:
        tracker.motion.view(mean)
    except AttributeError as error:  # of a filter on a path: its estimates are positions, its state is not
        raise NotApplicable("estimates are not states of the motion, with which the world could begin") from error
    prior = Gaussian(mean, tuple(jnp.asarray(x, float) for x in estimates.cov_upper[:, row]))
    return _world(inert, cut(recording, row, min(row + ROWS, len(recording))), prior, n, seed)


def own_recordings(tracker: AbstractTracker, n: int, seed: int) -> list[Recording]:
    """Recordings drawn from the model of a tracker that reads no inputs, from the belief of its start.

    Raises UnusableInput for another tracker, which needs recordings.
    """
    fix = "usual fix: check_tracker(mine, recordings)"
    if not isinstance(tracker, Tracker):
        raise UnusableInput(f"check_tracker: found a {type(tracker).__name__}; expected recordings with it; {fix}")
    parts: tuple[Any, ...] = (tracker.motion, tracker.start, tracker.filter, *tracker.sensors.values())
    inputs: list[Input] = [one for part in parts for one in part.inputs if one.need is not Need.IF_GIVEN]
    if inputs:
        names = listed(dict.fromkeys(one.name for one in inputs))
        raise UnusableInput(
            f"check_tracker: the tracker reads the inputs {names}; expected recordings with them; {fix}"
        )
    rng = np.random.default_rng(seed)
    times, readings = np.cumsum(rng.uniform(0.05, 0.15, 2 * ROWS)), {}
    for name, sensor in tracker.sensors.items():
        zeros = np.zeros((len(times), len(sensor.channels)))
        readings[name] = Readings(zeros, zeros == 0)
    template = Recording(times, readings)
    with jax.enable_x64(True):
        model = freeze(as_dtype(tracker, jnp.zeros(0).dtype))
        first = row_of(stack([template]), 0)
        prior = model.start.belief(model.start.candidate(model.sensors, first), first)
        return _world(tracker, template, prior, n, seed).recordings


def row_of(batch: Batch, row: int) -> Row:
    """One row of the first trajectory of a batch."""
    arrays = (batch.dt, batch.valid, batch.readings, dict(batch.inputs))
    dt, valid, readings, inputs = jax.tree_util.tree_map(lambda x: jnp.asarray(x[row, ..., 0]), arrays)
    return Row(dt, valid, readings, inputs, jnp.asarray(batch.key[:, 0]), jnp.asarray(row, jnp.uint32))


def _world(tracker: Tracker, recording: Recording, prior: Gaussian, n: int, seed: int) -> World:
    batch = stack([recording])
    model = freeze(as_dtype(tracker, jnp.zeros(0).dtype))
    size, keys = len(component_names(prior.mean)), jax.random.split(jax.random.key(seed), (n, len(batch.dt) + 1))
    rows = jax.tree_util.tree_map(lambda x: jnp.asarray(x[..., 0]), (batch.dt, batch.readings, batch.inputs))
    factor = np.linalg.cholesky(np.asarray(matrix(prior.cov)) + 1e-12 * np.eye(size))

    def trajectory(keys: Array) -> tuple[State, Mapping[str, tuple[Array, Array, Array]]]:
        first = retract(prior.mean, list(jnp.asarray(factor) @ jax.random.normal(keys[0], (size,))))

        def row(state: State, given: Any) -> Any:
            key, (dt, readings, inputs) = given
            w = jax.random.normal(key, (model.motion.noise_dimension,))
            state = model.motion.step(state, inputs, dt, Vector.of(w))
            view = model.motion.view(state)
            values = {
                name: _reading(sensor, view, inputs, readings[name], jax.random.fold_in(key, k))
                for k, (name, sensor) in enumerate(model.sensors.items())
            }
            return state, (state, values)

        return jax.lax.scan(row, first, (keys[1:], rows))[1]

    states, drawn = jax.jit(jax.vmap(trajectory, out_axes=1))(keys)
    values = {name: x for name, (x, _, _) in drawn.items()}
    for name, (_, fits, _) in drawn.items():
        # Angles far out wrap.
        if np.mean(fits) < 0.99:
            raise NotApplicable(
                f"the whitened residual of '{name}' is not linear in the reading, as of noise to one side"
            )
    recordings = [
        replace(
            recording,
            readings={
                name: replace(recording.readings[name], values=np.asarray(x[:, k])) for name, x in values.items()
            },
            truth={},
            name=f"drawn {k}",
            id=k,
        )
        for k in range(n)
    ]
    normal = all(bool(np.all(x)) for _, _, x in drawn.values())
    return World(tracker, prior, recordings, jax.tree_util.tree_map(np.asarray, states), normal)


def _reading(
    sensor: AbstractSensor, view: Any, inputs: Any, reading: Reading, key: Array
) -> tuple[Float[Array, " m"], Bool[Array, ""], Bool[Array, ""]]:
    """A reading whose whitened residual is unit noise, whether its residual is that, and whether the noise is normal.

    Else it is Student's t. Without noise where it is not seen.
    """
    predicted = jnp.stack([jnp.asarray(z) for z in sensor.measure(view, inputs)])
    exact = reading._replace(values=predicted)

    def whitened(values: Float[Array, " m"]) -> Float[Array, " m"]:
        return jnp.stack(list(sensor.residual(reading._replace(values=values), list(predicted)).whitened))

    jacobian, dof = jax.jacfwd(whitened)(predicted), sensor.residual(exact, list(predicted)).dof
    shape = jacobian.shape[:1]
    unit = jax.random.normal(key, shape) if dof is None else jax.random.t(key, dof, shape)
    offset = jnp.linalg.pinv(jacobian) @ unit
    values = predicted + offset
    fits = jnp.allclose(whitened(values), jacobian @ offset, rtol=1e-6, atol=1e-6)
    return values, fits, jnp.asarray(dof is None)
