"""A world drawn from a tracker's own model, the joint distribution of a linear one, and covariances against errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from trackwright.trackers.core.model.state import AbstractCurved, component_names, coordinates, local, retract
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.recordings.trajectories import cut

ROWS, WORLD, TOGETHER = 32, 128, 8
"""Rows and recordings of a world (the mean NEES scatters by 9 % in a plane), and how many run at once."""

SLACK, SLACK_STUDENT_T = 1.5, 2.0
"""Factors by which the mean NEES may be off: filters of nonlinear models and of Student's t are not exact."""


class World:
    """Recordings drawn from the model of a tracker, which begin with the belief `prior`; in double precision."""

    def __init__(self, tracker: Tracker, recording: Recording, prior: Gaussian, n: int, seed: int) -> None:
        self.tracker, self.prior, self.names = tracker, prior, component_names(prior.mean)
        self.model: Any = freeze(as_dtype(tracker, jnp.zeros(0).dtype))
        batch = stack([recording])
        given = (batch.dt, batch.readings, dict(batch.inputs))
        self.rows: Any = jax.tree_util.tree_map(lambda x: jnp.asarray(x[..., 0]), given)
        self.factor = np.linalg.cholesky(np.asarray(matrix(prior.cov)) + 1e-12 * np.eye(len(self.names)))
        q, keys = self.model.motion.noise_dimension, jax.random.split(jax.random.key(seed), (n, len(batch.dt) + 1))
        self.size = len(self.names) + q * len(batch.dt)

        def drawn(keys: Any) -> tuple[Any, Any]:
            noise = jax.vmap(lambda key: jax.random.normal(key, (q,)))(keys[1:])
            states = self.path(jnp.concatenate([jax.random.normal(keys[0], (len(self.names),)), jnp.ravel(noise)]))
            return states, self._read(states, keys[1:])

        self.states, readings = jax.jit(jax.vmap(drawn))(keys)
        for name, (_, fits, _) in readings.items():
            if np.mean(fits) < 0.99:  # angles far out wrap
                raise NotApplicable(f"the whitened residual of '{name}' is not linear in the reading")
        self.normal = all(bool(np.all(normal)) for *_, normal in readings.values())
        each = [
            {name: replace(recording.readings[name], values=np.asarray(x[k])) for name, (x, *_) in readings.items()}
            for k in range(n)
        ]
        self.recordings = [
            replace(recording, readings=r, truth={}, name=f"drawn {k}", id=k) for k, r in enumerate(each)
        ]

    @cached_property
    def estimates(self) -> Estimates:
        """The estimates of the tracker, which begins with the world's belief."""
        return self.tracker.run(self.recordings, TOGETHER, initial=self.prior)

    def path(self, source: Any) -> Any:
        """The states (T,) by standard normal numbers: of the first state, then of the noise of each row."""
        n, (dt, _, inputs) = len(self.names), self.rows
        first = retract(self.prior.mean, list(jnp.asarray(self.factor) @ source[:n]))

        def row(state: Any, given: Any) -> Any:
            interval, known, w = given
            state = self.model.motion.step(state, known, interval, Vector.of(w))
            return state, state

        noise = source[n:].reshape(len(dt), self.model.motion.noise_dimension)
        return jax.lax.scan(row, first, (dt, inputs, noise))[1]

    def reader(self, sensor: Any, state: Any, inputs: Any, reading: Any) -> tuple[Any, Callable[[Any], Any], Any]:
        """What a sensor predicts of a state, its whitened residual by the values of a reading, and `dof`."""
        predicted = [jnp.asarray(z) for z in sensor.measure(self.model.motion.view(state), inputs)]

        def whitened(values: Any) -> Any:
            return jnp.stack(list(sensor.residual(reading._replace(values=values), predicted).whitened))

        return jnp.stack(predicted), whitened, sensor.residual(reading, predicted).dof

    def whitened(self, states: Any, readings: Any) -> dict[str, tuple[Any, Any]]:
        """By sensor, the whitened residuals (T, m) of readings and their derivatives by the readings (T, m, m)."""

        def of(sensor: Any, *given: Any) -> tuple[Any, Any]:
            whitened, values = self.reader(sensor, *given)[1], given[2].values
            return whitened(values), jax.jacfwd(whitened)(values)

        each = self.model.sensors.items()
        return {name: jax.vmap(partial(of, sensor))(states, self.rows[2], readings[name]) for name, sensor in each}

    def _read(self, states: Any, keys: Any) -> dict[str, tuple[Any, Any, Any]]:
        """Readings whose whitened residual is unit noise, whether it is, and whether that noise is normal."""

        def one(sensor: Any, key: Any, *given: Any) -> tuple[Any, Any, Any]:
            predicted, whitened, dof = self.reader(sensor, *given)
            slopes = jax.jacfwd(whitened)(predicted)
            shape = slopes.shape[:1]
            unit = jax.random.normal(key, shape) if dof is None else jax.random.t(key, dof, shape)
            values = predicted + jnp.linalg.pinv(slopes) @ unit
            fits = jnp.allclose(whitened(values), slopes @ (values - predicted), rtol=1e-6, atol=1e-6)
            return values, fits, jnp.asarray(dof is None)

        found = {}
        for k, (name, sensor) in enumerate(self.model.sensors.items()):
            own = jax.vmap(partial(jax.random.fold_in, data=k))(keys)
            found[name] = jax.vmap(partial(one, sensor))(own, states, self.rows[2], self.rows[1][name])
        return found


def drawn_world(
    tracker: AbstractTracker, recording: Recording, estimates: Estimates, seed: int, n: int = WORLD
) -> World:
    """A world at the later rows of a recording, which begins with the tracker's estimate in the middle of it.

    Raises NotApplicable for a tracker without a motion and sensors, or without covariances of its whole state.
    """
    if not isinstance(tracker, Tracker):
        raise NotApplicable(f"a {type(tracker).__name__} has no motion and sensors to draw a world from")
    if isinstance(tracker.filter, InteractingModels):
        raise NotApplicable("the filter switches between models, none of which is that of the world")
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
    fix = "usual fix: check_tracker(mine, recordings)"
    if not isinstance(tracker, Tracker):
        raise UnusableInput(f"check_tracker: found a {type(tracker).__name__}; expected recordings with it; {fix}")
    parts: Sequence[Any] = (tracker.motion, tracker.start, tracker.filter, *tracker.sensors.values())
    if names := dict.fromkeys(one.name for part in parts for one in part.inputs if one.need is not Need.IF_GIVEN):
        found = f"the tracker reads the inputs {listed(names)}"
        raise UnusableInput(f"check_tracker: {found}; expected recordings with them; {fix}")
    times = np.cumsum(np.random.default_rng(seed).uniform(0.05, 0.15, 2 * ROWS))
    zeros = {name: np.zeros((len(times), len(sensor.channels))) for name, sensor in tracker.sensors.items()}
    template = Recording(times, {name: Readings(x, x == 0) for name, x in zeros.items()})
    model, batch = freeze(as_dtype(tracker, jnp.zeros(0).dtype)), stack([template])
    arrays: Any = (batch.dt, batch.valid, batch.readings, dict(batch.inputs))
    given = jax.tree_util.tree_map(lambda x: jnp.asarray(x[0, ..., 0]), arrays)
    dt, valid, readings, known = given
    first = Row(dt, valid, readings, known, jnp.asarray(batch.key[:, 0]), jnp.asarray(0, jnp.uint32))
    prior = model.start.belief(model.start.candidate(model.sensors, first), first)
    return World(tracker, template, prior, n, seed).recordings


def conditioned(world: World) -> tuple[float, np.ndarray, np.ndarray]:
    """The log density of all readings of the first recording, and mean and covariance of the last state given them.

    Without recursion; raises NotApplicable unless the model is linear.

        s  all sources: the first state and all noises, N(0, 1)        r + A s  all whitened residuals
        x + X s  the last state                                        W  ∂whitened/∂reading

    A and X are differences of the whole path, exact for a linear model, in place of the filter's derivatives.
    """
    leaves = jax.tree_util.tree_leaves(world.prior.mean, is_leaf=lambda x: isinstance(x, AbstractCurved))
    if any(isinstance(x, AbstractCurved) for x in leaves):
        raise NotApplicable("the state has a curved field, so that the model is not linear")
    if not world.normal:
        raise NotApplicable("the noise of a reading is Student's t, so that the readings are not jointly normal")
    batch = stack(world.recordings[:1])
    readings = jax.tree_util.tree_map(lambda x: jnp.asarray(x[..., 0]), batch.readings)

    @jax.jit
    @jax.vmap
    def numbers(source: Any) -> tuple[Any, Any]:
        states = world.path(source)
        last = jnp.stack(coordinates(jax.tree_util.tree_map(lambda x: x[-1], states))[0])
        return last, jnp.concatenate([jnp.ravel(x) for x, _ in world.whitened(states, readings).values()])

    away = np.cos(np.arange(world.size))
    points = np.concatenate([np.zeros((1, world.size)), np.eye(world.size), [away]])
    last, residuals = (np.asarray(x) for x in numbers(jnp.asarray(points)))
    (x, X), (r, A) = ((values[0], (values[1:-1] - values[0]).T) for values in (last, residuals))
    for value, slopes, elsewhere in ((x, X, last[-1]), (r, A, residuals[-1])):
        if np.abs(value + slopes @ away - elsewhere).max() > max(1e-7 * np.abs(slopes).max(), 1e-9):
            raise NotApplicable("the model is not linear: derivatives depend on the state")
    log_likelihood = 0.0
    for name, (_, slopes) in world.whitened(world.path(jnp.zeros(world.size)), readings).items():
        for W, seen in zip(np.asarray(slopes), np.asarray(readings[name].seen), strict=True):
            W = W[:, seen & W.any(axis=0)]
            log_likelihood += 0.5 * np.linalg.slogdet(W.T @ W)[1] - 0.5 * W.shape[1] * np.log(2 * np.pi)
    information = np.eye(world.size) + A.T @ A
    mean = -np.linalg.solve(information, A.T @ r)
    log_likelihood -= 0.5 * (r @ (r + A @ mean) + np.linalg.slogdet(information)[1])
    return float(log_likelihood), x + X @ mean, X @ np.linalg.solve(information, X.T)


def compare_conditioned(world: World, estimates: Estimates) -> str:
    """Asserts that likelihood and last estimate of the first recording are those of the joint normal distribution."""
    if not isinstance(world.tracker.filter.init(world.prior, np.zeros(2, np.uint32)), Gaussian):
        raise NotApplicable(f"the belief of a {type(world.tracker.filter).__name__} is not normal")
    (joint, expected, spreads), last = conditioned(world), len(world.recordings[0]) - 1
    mean = np.array([float(x) for x in coordinates(jax.tree_util.tree_map(lambda x: x[0, last], estimates.mean))[0]])
    cov, sigmas = np.asarray(estimates.covariance)[0, last], np.sqrt(np.diagonal(spreads))
    spread = np.abs(cov - spreads) / np.outer(sigmas, sigmas)
    i, j = np.unravel_index(int(np.argmax(spread)), spread.shape)
    assert spread.max() <= 1e-5, (
        f"the last covariance of {world.names[i]} and {world.names[j]} is {cov[i, j]:.6g}, given all readings "
        f"{spreads[i, j]:.6g}; usual fix: (I − K H) P after an update, F P Fᵀ + G Gᵀ after a step"
    )
    off = np.abs(mean - expected) / sigmas
    assert off.max() <= 1e-5, (
        f"the last estimate of {world.names[int(off.argmax())]} is off the mean given all readings by {off.max():.3g} "
        "standard deviations; usual fix: the gain is P Hᵀ S⁻¹, and the mean moves by it times the innovation"
    )
    apart = float(np.sum(estimates.log_likelihood[0])) - joint
    n_seen = sum(int(np.sum(r.seen)) for r in world.recordings[0].readings.values())
    assert abs(apart) <= 1e-6 * abs(joint) + 1e-6, (
        f"the log-likelihood is {joint + apart:.8g}, of the joint distribution of all readings "
        f"{joint:.8g}, off by {apart / n_seen:.3g} for each number; usual fix: log_scale is "
        "−½ log 2π − log sigma for each channel seen, of the sigma that whitens"
    )
    return "likelihood, mean and covariance are those of the joint distribution"


def compare_errors(world: World, estimates: Estimates) -> str:
    """Asserts that covariances are the size of the errors: the mean NEES of the last estimates."""
    last = len(world.recordings[0]) - 1
    estimated = jax.tree_util.tree_map(lambda x: jnp.asarray(x[:, last]), estimates.mean)
    true = jax.tree_util.tree_map(lambda x: x[:, last], world.states)
    errors = np.asarray(jax.vmap(lambda a, b: jnp.stack(local(a, b)))(estimated, true))
    ratio = float(np.mean(nees(errors, np.asarray(estimates.covariance)[:, last]))) / errors.shape[1]
    words = f"the mean NEES of {len(errors)} tracks of a world drawn from the model is {ratio:.2f} for each component"
    slack, size = SLACK if world.normal else SLACK_STUDENT_T, "small" if ratio > 1 else "large"
    assert 1 / slack < ratio < slack, (
        f"{words}, expected 1 within a factor {slack:g}: covariances are too {size}; usual fix: the filter adds all "
        "noise of the motion and of the residual once, and uses every reading that is seen once"
    )
    return words
