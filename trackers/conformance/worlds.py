"""A world drawn from a tracker's own model, and the covariances of its estimates against their errors."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.conformance.contract import NotApplicable
from trackwright.trackers.core.data.consistency import nees
from trackwright.trackers.core.data.estimates import Estimates, Status
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.filters.imm import InteractingModels
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian, matrix
from trackwright.trackers.core.model.inputs import Need
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import local, retract
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.recordings.trajectories import cut

ROWS, WORLD, TOGETHER = 32, 128, 8  # rows and recordings of a world, and how many run at once
SLACK = 2.0  # the factor by which the mean NEES may be off: filters of nonlinear models are not exact


class World:
    """Recordings drawn from the model of a tracker, which begin with the belief `prior`; in double precision."""

    def __init__(self, tracker: Tracker, recording: Recording, prior: Gaussian, n: int, seed: int) -> None:
        self.tracker, self.prior = tracker, prior
        self.model: Any = freeze(as_dtype(tracker, jnp.zeros(0).dtype))
        batch = stack([recording])
        given = (batch.dt, batch.readings, dict(batch.inputs))
        self.rows: Any = jax.tree_util.tree_map(lambda x: jnp.asarray(x[..., 0]), given)
        self.factor = np.linalg.cholesky(np.asarray(matrix(prior.cov)))
        keys = jax.random.split(jax.random.key(seed), (n, len(batch.dt) + 1))
        self.states, readings = jax.jit(jax.vmap(self._drawn))(keys)
        for name, (_, fits) in readings.items():
            if np.mean(fits) < 0.99:  # angles far out wrap
                raise NotApplicable(f"the whitened residual of '{name}' is not linear in the reading")

        def numbered(k: int) -> Recording:
            own = {s: replace(recording.readings[s], values=np.asarray(x[k])) for s, (x, _) in readings.items()}
            return replace(recording, readings=own, truth={}, name=f"drawn {k}", id=k)

        self.recordings = [numbered(k) for k in range(n)]

    @cached_property
    def estimates(self) -> Estimates:
        """The estimates of the tracker, which begins with the world's belief."""
        return self.tracker.run(self.recordings, TOGETHER, initial=self.prior)

    def _drawn(self, keys: Any) -> tuple[Any, Any]:
        """The states (T,) by keys (1 + T,), and readings."""
        motion, n, (dt, given, inputs) = self.model.motion, len(self.factor), self.rows
        first = retract(self.prior.mean, list(jnp.asarray(self.factor) @ jax.random.normal(keys[0], (n,))))

        def row(state: Any, of: Any) -> Any:
            interval, known, key = of
            state = motion.step(state, known, interval, Vector.of(jax.random.normal(key, (motion.noise_dimension,))))
            return state, state

        def read(sensor: Any, key: Any, state: Any, known: Any, reading: Any) -> tuple[Any, Any]:
            predicted = [jnp.asarray(z) for z in sensor.measure(motion.view(state), known)]

            def whitened(values: Any) -> Any:
                return jnp.stack(list(sensor.residual(reading._replace(values=values), predicted).whitened))

            here, dof = jnp.stack(predicted), sensor.residual(reading, predicted).dof
            slopes = jax.jacfwd(whitened)(here)
            shape = slopes.shape[:1]
            unit = jax.random.normal(key, shape) if dof is None else jax.random.t(key, dof, shape)
            values = here + jnp.linalg.pinv(slopes) @ unit
            return values, jnp.allclose(whitened(values), slopes @ (values - here), rtol=1e-6, atol=1e-6)

        states, found = jax.lax.scan(row, first, (dt, inputs, keys[1:]))[1], {}
        for k, (name, sensor) in enumerate(self.model.sensors.items()):
            own = jax.vmap(partial(jax.random.fold_in, data=k))(keys[1:])
            found[name] = jax.vmap(partial(read, sensor))(own, states, inputs, given[name])
        return states, found


def drawn_world(
    tracker: AbstractTracker, recording: Recording, estimates: Estimates, seed: int, n: int = WORLD
) -> World:
    """A world at the later rows of a recording, which begins with the tracker's estimate in the middle of it.

    Raises NotApplicable for a tracker without a motion and sensors, or without covariances of its whole state.
    """
    if not isinstance(tracker, Tracker):
        raise NotApplicable(f"a {type(tracker).__name__} has no motion and sensors to draw a world from")
    if isinstance(tracker.filter, InteractingModels):
        raise NotApplicable("the filter switches between models, none of which is the world's")
    if tracker.position_alone:
        raise NotApplicable("estimates have the covariance of positions alone: position_alone")
    running = np.flatnonzero(estimates.status == Status.OK)
    row = int(running[len(running) // 2])
    mean = jax.tree_util.tree_map(lambda x: jnp.asarray(x[row], float), estimates.mean)
    try:
        tracker.motion.view(mean)
    except AttributeError as error:  # of a filter on a path: its estimates are positions, its state is not
        raise NotApplicable("estimates are not states of the motion, with which the world could begin") from error
    prior = Gaussian(mean, tuple(jnp.asarray(x, float) for x in estimates.cov_upper[:, row]))
    inert = replace(tracker, track_loss=TrackLossPolicy(np.inf, max_gap=np.inf), latency_of=None)
    return World(inert, cut(recording, row, min(row + ROWS, len(recording))), prior, n, seed)


@jax.enable_x64(True)
def own_recordings(tracker: AbstractTracker, n: int, seed: int) -> list[Recording]:
    """Recordings drawn from the model of a tracker that reads no inputs, from the belief of its start.

    Raises UnusableInput for another tracker, which needs recordings.
    """
    parts: Any = ()
    if isinstance(tracker, Tracker):
        parts = (tracker.motion, tracker.start, tracker.filter, *tracker.sensors.values())
    names = [one.name for part in parts for one in part.inputs if one.need is not Need.IF_GIVEN]
    if not isinstance(tracker, Tracker) or names:
        found = f"a {type(tracker).__name__}{f' of the inputs {listed(names)}' if names else ''}"
        raise UnusableInput(f"check_tracker: found {found}; expected recordings; usual fix: check_tracker(mine, them)")
    times = np.cumsum(np.random.default_rng(seed).uniform(0.05, 0.15, 2 * ROWS))
    zeros = {name: np.zeros((len(times), len(sensor.channels))) for name, sensor in tracker.sensors.items()}
    template = Recording(times, {name: Readings(x, x == 0) for name, x in zeros.items()})
    model, batch = freeze(as_dtype(tracker, jnp.zeros(0).dtype)), stack([template])
    arrays: Any = (batch.dt, batch.valid, batch.readings, dict(batch.inputs))
    dt, valid, readings, known = jax.tree_util.tree_map(lambda x: jnp.asarray(x[0, ..., 0]), arrays)
    first = Row(dt, valid, readings, known, jnp.asarray(batch.key[:, 0]), jnp.asarray(0, jnp.uint32))
    prior = model.start.belief(model.start.candidate(model.sensors, first), first)
    return World(tracker, template, prior, n, seed).recordings


def compare_errors(world: World, estimates: Estimates) -> str:
    """Asserts that covariances are the size of the errors: the mean NEES of the last estimates."""
    last = len(world.recordings[0]) - 1
    estimated = jax.tree_util.tree_map(lambda x: jnp.asarray(x[:, last]), estimates.mean)
    true = jax.tree_util.tree_map(lambda x: x[:, last], world.states)
    errors = np.asarray(jax.vmap(lambda a, b: jnp.stack(local(a, b)))(estimated, true))
    ratio = float(np.mean(nees(errors, np.asarray(estimates.covariance)[:, last]))) / errors.shape[1]
    words, size = f"the mean NEES of a component is {ratio:.2f}", "small" if ratio > 1 else "large"
    assert 1 / SLACK < ratio < SLACK, f"{words}, expected 1 within a factor {SLACK:g}: covariances are too {size}"
    return words
