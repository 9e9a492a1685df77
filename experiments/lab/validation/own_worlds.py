"""Worlds of a tracker's own model: states from its start and motion, readings from the densities of its sensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.aoa.fusion import BearingSensor
from trackwright.trackers.aoa.phases import AbstractPhaseSensor
from trackwright.trackers.core.data.recording import Batch, Readings, Recording, stack
from trackwright.trackers.core.filters.imm import AbstractInteractingModels, AbstractSwitching
from trackwright.trackers.core.model.algebra import Vector, diagonal, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.sensor import AbstractSensor, Row
from trackwright.trackers.core.model.start import AbstractStart
from trackwright.trackers.core.model.state import retract
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.fixes import FloorFixes
from trackwright.trackers.parts.fixes import AbstractFixSensor
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.differences import RangeDifferenceSensor
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter, with_yaw_added

NEVER_LOST = TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf)


class KnownStart(AbstractStart):
    """Start at the first row, with a state made of independent normal numbers of these means and deviations."""

    state: Callable[[Sequence[Any]], Any] = eqx.field(static=True)
    means: tuple[float, ...] = eqx.field(static=True)
    deviations: tuple[float, ...] = eqx.field(static=True)

    def can_start(self, row: Row) -> Any:
        return row.valid

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return row.dt

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        zero = jnp.zeros_like(row.dt)
        return Gaussian(self.state([zero + m for m in self.means]), diagonal([d * d for d in self.deviations], zero))


def own_world(
    tracker: Tracker, recordings: Sequence[Recording], seed: int, narrower: float = 1.0
) -> tuple[list[Recording], list[Gaussian], Any]:
    """The recordings with readings drawn from the tracker's model, the beliefs from which states are drawn, and these.

    Times, inputs and masks stay; states have the leaves (T, …, n). The beliefs are those of the tracker's start, with
    standard deviations `narrower` times as small.
    """
    rng, batch = np.random.default_rng(seed), stack(recordings)
    prior = _priors(tracker, batch)
    prior = prior._replace(cov=tuple(x / narrower**2 for x in prior.cov))
    modes = _Modes(tracker, batch.size, rng)
    state, values = modes.turned(_drawn(prior, rng)), {name: list[np.ndarray]() for name in tracker.sensors}
    steps = modes.each(tracker.motion, _step)
    views = {name: modes.each(sensor, _measurement(tracker)) for name, sensor in tracker.sensors.items()}
    states = []
    for k, dt in enumerate(batch.dt):
        inputs = {name: x[k] for name, x in batch.inputs.items()}
        if k:
            modes.switch(dt)
            w = jnp.asarray(rng.normal(size=(tracker.motion.noise_dimension, batch.size)))
            state = modes.chosen([step(state, inputs, dt, w) for step in steps])
        states.append(state)
        for name, sensor in tracker.sensors.items():
            predicted = np.asarray(modes.chosen([view(state, inputs) for view in views[name]]))
            values[name].append(_read(sensor, predicted, rng))
    drawn = {name: np.stack(rows) for name, rows in values.items()}
    redrawn = [
        _with_readings(recording, {n: x[: len(recording), :, k] for n, x in drawn.items()})
        for k, recording in enumerate(recordings)
    ]
    priors = [jax.tree_util.tree_map(lambda x, k=k: x[..., k], prior) for k in range(batch.size)]
    return redrawn, priors, jax.tree_util.tree_map(lambda *rows: np.stack(rows), *states)


class _Modes:
    """The modes of n tags: of an IMM filter's motion, which switch, or of its sensor, and the yaws of a start."""

    def __init__(self, tracker: Tracker, n: int, rng: np.random.Generator) -> None:
        self.filter, self.rng, self.n, self.rate, self.shares = tracker.filter, rng, n, 0.0, np.ones(1)
        if isinstance(self.filter, AbstractInteractingModels):
            shares = np.array(self.filter.prior(), float)
            self.shares = shares / shares.sum()
            # Modes of a sensor switch near a plane that these tags are far from.
            switches = isinstance(tracker.motion, AbstractSwitching)
            self.rate = float(self.filter.switching_rate.value) if switches else 0.0
        self.mode = self._draws()

    def _draws(self) -> np.ndarray:
        return self.rng.choice(len(self.shares), self.n, p=self.shares)

    def switch(self, dt: np.ndarray) -> None:
        """At the switching rate a mode is drawn again, as `trackers.core.filters.imm` has it."""
        self.mode = np.where(self.rng.random(self.n) < -np.expm1(-self.rate * dt), self._draws(), self.mode)

    def turned(self, state: Any) -> Any:
        """The states at one of the yaws of a `YawMixtureFilter`; as they are for other filters."""
        if not isinstance(self.filter, YawMixtureFilter):
            return state
        yaws = 2 * np.pi / self.filter.count * self.rng.integers(self.filter.count, size=self.n)
        return jax.vmap(with_yaw_added, in_axes=-1, out_axes=-1)(state, jnp.asarray(yaws))

    def each(self, part: Any, function: Callable[[Any], Callable[..., Any]]) -> list[Callable[..., Any]]:
        """The function of the part, or of the part in each mode, over all tags."""
        parts = [part.in_mode(k) for k in range(len(self.shares))] if isinstance(part, AbstractSwitching) else [part]
        return [jax.jit(jax.vmap(function(one), in_axes=-1, out_axes=-1)) for one in parts]

    def chosen(self, of_modes: Sequence[Any]) -> Any:
        """Of the results in each mode those of the tags' modes."""
        if len(of_modes) == 1:
            return of_modes[0]
        is_mode = [self.mode == k for k in range(len(of_modes))]
        return jax.tree_util.tree_map(lambda *x: jnp.select(is_mode, x), *of_modes)


def _step(motion: Any) -> Callable[..., Any]:
    return lambda state, inputs, dt, w: motion.step(state, inputs, dt, Vector.of(w))


def _measurement(tracker: Tracker) -> Callable[[Any], Callable[..., Any]]:
    return lambda sensor: lambda state, inputs: jnp.stack(sensor.measure(tracker.motion.view(state), inputs))


def _priors(tracker: Tracker, batch: Batch) -> Gaussian:
    """The belief of the start at the first row of each trajectory, trajectories last."""

    def first(part: Any) -> Any:
        return jax.tree_util.tree_map(lambda x: x[0], part)

    def belief(row: Row) -> Gaussian:
        return tracker.start.belief(tracker.start.candidate(tracker.sensors, row), row)

    number = jnp.zeros(batch.size, jnp.uint32)
    row = Row(batch.dt[0], batch.valid[0], first(batch.readings), first(dict(batch.inputs)), batch.key, number)
    return jax.vmap(belief, in_axes=-1, out_axes=-1)(row)


def _drawn(prior: Gaussian, rng: np.random.Generator) -> Any:
    """States drawn from Gaussian beliefs, trajectories last."""
    upper = np.stack([np.asarray(x) for x in prior.cov], axis=-1).astype(float)
    size = round((np.sqrt(8 * upper.shape[1] + 1) - 1) / 2)
    cov = np.zeros((len(upper), size, size))
    for k, (i, j) in enumerate(triangle(size)):
        cov[:, i, j] = cov[:, j, i] = upper[:, k]
    # By eigenvalues: a component that is known has the variance zero.
    values, vectors = np.linalg.eigh(cov)
    unit = np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=values.shape)
    steps = jnp.asarray(np.einsum("nij,nj->in", vectors, unit))
    return jax.vmap(lambda mean, step: retract(mean, list(step)), in_axes=-1, out_axes=-1)(prior.mean, steps)


def _read(sensor: AbstractSensor, predicted: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Readings (m, n) from the sensor's density about the predictions (m, n); raises TypeError for an unknown one."""
    shape = predicted.shape
    if isinstance(sensor, RangeSensor):
        skew, size = float(sensor.positive_skew.value), float(sensor.sigma_r.value) * _unit(rng, sensor.dof, shape)
        longer = rng.random(shape) < skew / (1 + skew)
        return predicted + np.abs(size) * np.where(longer, skew, -1.0)
    if isinstance(sensor, AbstractPhaseSensor):
        common = rng.uniform(-np.pi, np.pi, shape[1])
        return predicted + common + float(sensor.sigma_p.value) * rng.normal(size=shape)
    if isinstance(sensor, FloorFixes):
        return predicted + float(sensor.sigma_p.value) * rng.normal(size=shape)
    if isinstance(sensor, BearingSensor):
        sigmas = np.array([[float(sensor.sigma_azimuth.value)], [float(sensor.sigma_elevation.value)]])
        return predicted + sigmas * _unit(rng, sensor.dof, shape)
    if isinstance(sensor, RangeDifferenceSensor):
        return predicted + float(sensor.sigma_d.value) * _unit(rng, sensor.dof, shape)
    if isinstance(sensor, AbstractFixSensor):
        return predicted + np.linalg.cholesky(np.array(sensor.noise(), float)) @ _unit(rng, sensor.dof, shape)
    raise TypeError(f"no draw of the readings of a {type(sensor).__name__}")


def _unit(rng: np.random.Generator, dof: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Draws of unit scale from Student's t, or from the normal distribution where `dof` is None."""
    return rng.normal(size=shape) if dof is None else rng.standard_t(float(dof.value), shape)


def _with_readings(recording: Recording, values: dict[str, np.ndarray]) -> Recording:
    """The recording with other readings, of no reported noise, and without truth."""
    readings = {}
    for name, given in recording.readings.items():
        reported = None if given.reported is None else np.zeros_like(given.reported)
        readings[name] = Readings(values[name], given.seen, reported)
    return dataclasses.replace(recording, readings=readings, truth={})
