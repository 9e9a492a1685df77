"""NIS per degree of freedom in worlds of each tracker's own model, 1 expected whatever the noise.

Five worlds of each tracker, by `own_world` with the times and the geometry of a simulated recording; beside it the
share of the means over `WINDOW` rows inside the 95 % band of `nis_band`. Rows count from `SETTLED` s on: the prior of a
start is wider than a linearisation is exact, and of phases it is drawn within one lobe of the array.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.sim import SimulatedWorld, worlds
from trackwright.trackers.aoa.fusion import BearingSensor
from trackwright.trackers.aoa.phases import AbstractPhaseSensor
from trackwright.trackers.core.data.consistency import nis_band, student_t_dof_of
from trackwright.trackers.core.data.recording import Batch, Readings, Recording, stack
from trackwright.trackers.core.model.algebra import Vector, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.sensor import AbstractSensor, Row
from trackwright.trackers.core.model.state import retract
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.tracker import FloorFixes
from trackwright.trackers.parts.fixes import AbstractFixSensor
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.fusion import RangeDifferenceSensor
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter, with_yaw_added

TAGS, SEEDS, SETTLED, WINDOW, NARROWER = 24, 5, 5.0, 50, 30.0
WORLDS: Mapping[str, Callable[..., SimulatedWorld]] = {
    "direct": worlds.station,
    "beam": worlds.station,
    "bearings": worlds.fusion,
    "line-grid": worlds.line,
    "line-pf": worlds.line,
    "uwb": worlds.ranges,
    "uwb-imu": worlds.tool,
    "tdoa": worlds.tdoa,
    "tdoa-imu": partial(worlds.tdoa, imu=True),
    "fix-kf": partial(worlds.agv, rows=500),
    "fix-singer": partial(worlds.agv, rows=500),
}
"""Recordings for their times and geometry; of phases with priors `NARROWER` times as small, as of `own_world`."""


def cases() -> Iterator[Case]:
    """Five worlds of each tracker."""
    for name in WORLDS:
        yield from (Case("own model", name, "defaults", partial(figures, name, seed), seed) for seed in range(SEEDS))


def figures(name: str, seed: int) -> Figures:
    """NIS per degree of freedom of all settled rows, and the share of the means over `WINDOW` rows inside the band."""
    batch = tw.TRACKERS[name].batches([WORLDS[name](n=TAGS, seed=seed).folder()], name, False)[0]
    made: Any = batch.tracker
    tracker = dataclasses.replace(made, track_loss=NEVER_LOST)
    narrower = NARROWER if WORLDS[name] is worlds.station else 1.0
    drawn, priors, _ = own_world(tracker, [t.recording for t in batch.trajectories], seed, narrower)
    run = tracker.run(drawn, initial=priors)
    used = np.isfinite(run.nis) & (run.nis_dof > 0) & (run.times >= run.times[:, :1] + SETTLED)
    inside: list[bool] = []
    for nis, dof, rows in zip(run.nis, run.nis_dof, used, strict=True):
        whole = rows.sum() // WINDOW * WINDOW
        total, freedom = (x[rows][:whole].astype(float).reshape(-1, WINDOW).sum(axis=1) for x in (nis, dof))
        nu = student_t_dof_of(tracker.nis_sensors)
        low, high = nis_band(freedom, None if nu is None else float(np.asarray(nu)))
        inside += ((low <= total / freedom) & (total / freedom <= high)).tolist()
    ratio = float(run.nis[used].sum(dtype=float) / run.nis_dof[used].sum(dtype=float))
    return {"nis_per_dof": ratio, "means_in_band": float(np.mean(inside))}


NEVER_LOST = TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf)


def own_world(
    tracker: Tracker, recordings: Sequence[Recording], seed: int, narrower: float = 1.0
) -> tuple[list[Recording], list[Gaussian], Any]:
    """The recordings with readings drawn from the tracker's model, the beliefs from which states are drawn, and these.

    Times, inputs and masks stay; states have the leaves (T, …, n). The beliefs are the tracker's start's, with
    standard deviations `narrower` times as small. Trackers whose motion switches have no such world.
    """
    rng, batch, motion = np.random.default_rng(seed), stack(recordings), tracker.motion
    prior = _priors(tracker, batch)
    prior = prior._replace(cov=tuple(x / narrower**2 for x in prior.cov))
    state, states = _turned(tracker, _drawn(prior, rng), rng), []
    values = {name: list[np.ndarray]() for name in tracker.sensors}
    step = _for_all(lambda state, inputs, dt, w: motion.step(state, inputs, dt, Vector.of(w)))
    views = {
        name: _for_all(lambda state, inputs, sensor=sensor: jnp.stack(sensor.measure(motion.view(state), inputs)))
        for name, sensor in tracker.sensors.items()
    }
    for k, dt in enumerate(batch.dt):
        inputs = {name: x[k] for name, x in batch.inputs.items()}
        if k:
            state = step(state, inputs, dt, jnp.asarray(rng.normal(size=(motion.noise_dimension, batch.size))))
        states.append(state)
        for name, sensor in tracker.sensors.items():
            values[name].append(_read(sensor, np.asarray(views[name](state, inputs)), rng))
    drawn = {name: np.stack(rows) for name, rows in values.items()}
    redrawn = [
        _with_readings(recording, {n: x[: len(recording), :, k] for n, x in drawn.items()})
        for k, recording in enumerate(recordings)
    ]
    priors = [jax.tree_util.tree_map(lambda x, k=k: x[..., k], prior) for k in range(batch.size)]
    return redrawn, priors, jax.tree_util.tree_map(lambda *rows: np.stack(rows), *states)


def _for_all(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function over all tags."""
    return jax.jit(jax.vmap(function, in_axes=-1, out_axes=-1))


def _priors(tracker: Tracker, batch: Batch) -> Gaussian:
    """The belief of the start at the first row of each trajectory, trajectories last."""

    def belief(row: Row) -> Gaussian:
        return tracker.start.belief(tracker.start.candidate(tracker.sensors, row), row)

    readings, inputs = jax.tree_util.tree_map(lambda x: x[0], (batch.readings, dict(batch.inputs)))
    row = Row(batch.dt[0], batch.valid[0], readings, inputs, batch.key, jnp.zeros(batch.size, jnp.uint32))
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


def _turned(tracker: Tracker, state: Any, rng: np.random.Generator) -> Any:
    """The states at one of the yaws of a `YawMixtureFilter`; as they are for other filters."""
    if not isinstance(tracker.filter, YawMixtureFilter):
        return state
    count, tags = tracker.filter.count, jax.tree_util.tree_leaves(state)[0].shape[-1]
    yaws = 2 * np.pi / count * rng.integers(count, size=tags)
    return jax.vmap(with_yaw_added, in_axes=-1, out_axes=-1)(state, jnp.asarray(yaws))


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
        return predicted + float(sensor.sigma_p.value) * _unit(rng, sensor.dof, shape)
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
