"""The problems of `growth.py`: functions of a version and a size, which return a run and its number of rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from trackwright.experiments.lab.bench import beam, particles
from trackwright.experiments.lab.bench.beam import filtering, finished
from trackwright.experiments.lab.bench.loops import filtered, model_of, with_filterpy
from trackwright.experiments.lab.bench.timing import Row, cold_and_warm
from trackwright.experiments.lab.validation.track_loss import kidnapped_walk
from trackwright.sim import worlds
from trackwright.trackers.aoa.fusion import BEARINGS, BearingSensor, bearing_tracker
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model import covariance
from trackwright.trackers.core.model.motion import ConstantVelocity
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.trackers.parts.start_nearby import NearbyStart
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

Run = tuple[Callable[[], Any], int]
ROWS, TRAJECTORIES, BEAMS, SMOOTHED_ROWS, INERTIAL_ROWS = 200, 64, 16, 50, 100


def point(build: Sequence[Any], version: str, size: int, rounds: int) -> Row:
    """Times and memory of a version of one problem at one size, in this process."""
    name, *first = build
    run, rows = BUILDERS[name](*first, version, size)
    return cold_and_warm(run, rows, rounds)


def ranging(anchors: int, slots: int, biases: int, trajectories: int) -> tuple[Tracker, list[Recording]]:
    """A planar tracker of ranges and its recordings: circles of 3 m among anchors on a circle of 8 m."""
    rng = np.random.default_rng(0)
    around = np.arange(anchors) * (2 * np.pi / anchors)
    places = np.stack([8 * np.cos(around), 8 * np.sin(around), np.full(anchors, 2.0)], axis=1)
    times = 0.05 * np.arange(ROWS)
    number = (np.arange(ROWS)[:, None] * slots + np.arange(slots)) % anchors
    recordings = []
    for k in range(trajectories):
        angle = times + rng.uniform(0, 2 * np.pi)
        position = np.stack([3 * np.cos(angle), 3 * np.sin(angle), np.ones(ROWS)], axis=1)
        distance = np.sqrt(((places[number] - position[:, None]) ** 2).sum(axis=-1))
        values = distance + 0.1 * rng.normal(size=distance.shape)
        inputs = {
            "anchors": places[number].reshape(ROWS, -1),
            "anchor": number.astype(float),
            "height": np.ones(ROWS),
            "nearby": np.column_stack([position, np.ones(ROWS)]),
        }
        readings = {RANGES: Readings(values, np.ones(values.shape, bool))}
        recordings.append(Recording(times, readings, inputs, name=str(k)))
    tracker = Tracker(
        DriftingBiases(biases, 1.0, 1.0, 5.0, 0.03, 1000.0, 100.0),
        {RANGES: RangeSensor(slots, anchors, 0.1, 3.0, 3.0)},
        BiasedStart(Scale(1.0, "m"), Scale(1.0, "m/s"), Scale(0.03, "m"), True, biases),
        track_loss=TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf),
    )
    return tracker, recordings


def ranges(version: str, biases: int, slots: int) -> Run:
    """The tracker of ranges with a bias per anchor, or the loop of one trajectory in NumPy or with filterpy."""
    tracker, recordings = ranging(max(biases, slots, 4), slots, biases, TRAJECTORIES if version == "ours" else 1)
    if version == "ours":
        return filtering(tracker, stack(recordings)), TRAJECTORIES * ROWS
    model = model_of(tracker, recordings[0], planar=True)
    assert model is not None
    state = np.zeros(4 + biases)
    state[:2] = recordings[0].inputs["nearby"][0, :2]
    P = np.diag([1.0] * 4 + [0.03**2] * biases)
    dts = np.diff(recordings[0].times, prepend=0.0)
    loop = with_filterpy if version == "filterpy" else filtered
    return (lambda: loop(model, state, P, dts, 1)), ROWS - 1


def form(states: int, version: str, size: int) -> Run:
    """The tracker of ranges with so many states, its covariances as scalars or as matrices."""
    covariance.FEW = size if version == "matrices" else 0
    tracker, recordings = ranging(max(states - 4, 4), 1, states - 4, size)
    return filtering(tracker, stack(recordings)), size * ROWS


def smoothed(name: str, version: str, size: int) -> Run:
    """A tracker of simulated recordings, filtered, or smoothed once it was filtered; calls of `run` included."""
    simulate: Any = {"uwb": worlds.ranges, "uwb-imu": worlds.tool}.get(name, worlds.agv)
    (batch,) = TRACKERS[name].batches([simulate(n=size, rows=SMOOTHED_ROWS).folder()], name)
    recordings = [t.recording for t in batch.trajectories]
    tracker: Any = batch.tracker
    if version == "smoothed":
        tracker.run(recordings)
        tracker = Smoothed(tracker)
    return (lambda: tracker.run(recordings)), sum(map(len, recordings))


def gradient(tracker: Any, recordings: Sequence[Recording], tune: Sequence[str]) -> Callable[[], Any]:
    """A run of likelihood and gradient of the numbers that these patterns name."""
    parameters = select_parameters(tracker, tune)
    problem = Problem(tracker, [stack(recordings)], NegativeLogLikelihood(), parameters, CHUNK)
    vector = flatten(parameters)
    return lambda: problem.evaluate(vector)[:2]


def tunables(version: str, size: int) -> Run:
    """Likelihood and gradient of so many sensor biases."""
    return gradient(*ranging(size, 1, 0, TRAJECTORIES), ("sensors.*.bias",)), TRAJECTORIES * ROWS


def inertial(version: str, size: int) -> Run:
    """One of the filters of the mixture `uwb-imu`, or its likelihood and gradient of two noise levels."""
    (batch,) = TRACKERS["uwb-imu"].batches([worlds.tool(n=size, rows=INERTIAL_ROWS).folder()], "uwb-imu")
    recordings = [t.recording for t in batch.trajectories]
    tracker: Any = batch.tracker
    tracker = dataclasses.replace(tracker, filter=tracker.filter.kalman)
    if version == "gradient":
        run = gradient(tracker, recordings, ("motion.noise.sigma_accel", "sensors.*.sigma_r"))
    else:
        run = finished(filtering(tracker, stack(recordings)))
    return run, sum(map(len, recordings))


def bearings(version: str, size: int) -> Run:
    """Walks as `experiments.lab.validation.track_loss` simulates them, with drifting biases in the state or without."""
    batch = stack([kidnapped_walk(seed, "bearings").recording for seed in range(size)])
    tracker = bearing_tracker(4, planar=True)
    if version == "constant velocity":
        start = NearbyStart(Scale(1.5, "m"), Scale(1.0, "m/s"), planar=True, velocities=2)
        sensors = {BEARINGS: BearingSensor(0.1, 0.1, 4.0)}
        tracker = Tracker(ConstantVelocity(0.5, 2), sensors, start, track_loss=tracker.track_loss)
    return finished(filtering(tracker, batch)), batch.dt.size


BUILDERS: dict[str, Callable[..., Run]] = {
    "rows": lambda version, size: beam.version(version, BEAMS, size),
    "trajectories": lambda version, size: beam.version(version, size, ROWS),
    "states": lambda version, size: ranges(version, biases=size - 4, slots=1),
    "anchors": lambda version, size: ranges(version, biases=0, slots=size),
    "particles": particles.version,
    "tunables": tunables,
    "form": form,
    "smoothed": smoothed,
    "inertial": inertial,
    "bearings": bearings,
}
