"""Time and memory against the size of a problem: every point in a process of its own.

A point is the first call, which traces and compiles without a cache, medians of warm runs, and the peak of the process
over that before the first call. Versions that are slow run up to the sizes that they finish in seconds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from trackwright.experiments.lab.verify.worlds import NEVER_LOST

from trackwright.experiments.lab.bench import beam, particles
from trackwright.experiments.lab.bench.beam import filtering, finished
from trackwright.experiments.lab.bench.loops import model_of
from trackwright.experiments.lab.bench.timing import apart, cold_and_warm
from trackwright.experiments.lab.benchmark.adapters import with_filterpy
from trackwright.experiments.lab.benchmark.adapters.plain import filtered
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen
from trackwright.experiments.lab.validation.track_loss import kidnapped_walk
from trackwright.sim import worlds
from trackwright.trackers.aoa.fusion import BEARINGS, BearingSensor, bearing_tracker
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.catalogue import TRACKERS, build
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model import covariance
from trackwright.trackers.core.model.motion import ConstantVelocity
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.trackers.parts.start_nearby import NearbyStart
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

Run = tuple[Callable[[], Any], int]
"""What is timed, and its number of rows."""

ROWS, TRAJECTORIES, BEAMS, SMOOTHED_ROWS, INERTIAL_ROWS, EVALUATED_ROWS = 200, 64, 16, 50, 100, 40
ALL = 10**9


def growth(*series: str, output: Output = DEFAULTS) -> int:
    """Time and memory against the size of the problem, beside peers (extra: peers) and NumPy loops.

    Slopes are fitted to the logarithms of processor time and size. 1 if a point fails.

    Args:
        series: rows, trajectories, states, anchors, particles, tunables, which are the default; bearings, inertial,
            form-4, form-12 (states, whose covariances are scalars or matrices), smoothed-TRACKER, evaluated.
    """
    tables = []
    for name in chosen(series, SERIES, USUAL):
        problem = SERIES[name]
        rows = [
            {"size": size, "version": version}
            | apart("bench.growth:point", name, version, size, output.rounds(problem.rounds), limit_s=problem.limit_s)
            for version, largest in problem.versions.items()
            for size in problem.sizes[: 2 if output.small else None]
            if size <= largest
        ]
        tables.append(Table(rows, f"{name}: {problem.about}", slopes(rows, problem.versions)))
    output.publish("bench growth", *tables)
    return int(any("failed" in row for table in tables for row in table.rows))


def point(series: str, version: str, size: int, rounds: int) -> Row:
    """Times and memory of a version of one problem at one size, in this process."""
    run, rows = SERIES[series].build(version, size)
    return cold_and_warm(run, rows, rounds)


def slopes(rows: Sequence[Row], versions: Mapping[str, int]) -> str:
    """The fitted slopes of the logarithm of processor time on that of size, in words."""
    texts = []
    for version in versions:
        points = [(row["size"], row["processor ms"]) for row in rows
                  if row["version"] == version and "failed" not in row]  # fmt: skip
        if len(points) > 1:
            x, y = np.log(np.array(points, float)).T
            texts.append(f"{version} {np.polyfit(x, y, 1)[0]:.2f}")
    return f"Slope of processor time: {', '.join(texts) or 'too few sizes'}."


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
        track_loss=NEVER_LOST,
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
    loop = with_filterpy.filtered if version == "filterpy" else filtered
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


def evaluated(version: str, size: int) -> Run:
    """A named tracker of simulated folders, or one of arrays: its run, or the evaluation of what that estimates."""
    name, _, what = version.partition(" ")
    world = (worlds.ranges if name == "uwb" else worlds.agv)(n=size, rows=EVALUATED_ROWS)
    recordings: Any = world.recordings() if name == "arrays" else world.folder()
    tracker: Any = fix_tracker() if name == "arrays" else build(name, recordings)
    estimates = tracker.run(recordings)
    run = (lambda: evaluate(estimates, recordings)) if what else (lambda: tracker.run(recordings))
    return run, size * EVALUATED_ROWS


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


class Series(NamedTuple):
    """A problem that grows: `versions` with the largest size of each, and `rounds` of warm runs."""

    about: str
    build: Callable[[str, int], Run]
    sizes: tuple[int, ...]
    versions: Mapping[str, int] = {"ours": ALL}
    rounds: int = 3
    limit_s: float = 120.0


SERIES = {
    "rows": Series(
        f"beam tracker, {BEAMS} trajectories", lambda version, size: beam.version(version, BEAMS, size),
        (20, 64, 200, 640, 2000), {"ours": ALL, "textbook": ALL, "dynamax": 200, "cuthbert": 640},
    ),
    "trajectories": Series(
        "beam tracker, 200 rows", lambda version, size: beam.version(version, size, ROWS),
        (32, 128, 512, 2048, 4096), {"ours": ALL, "textbook": 128, "cuthbert": 128},
    ),
    "states": Series(
        "planar ranges, one a row, 64 trajectories of 200 rows; a NumPy loop and filterpy of one",
        lambda version, size: ranges(version, biases=size - 4, slots=1),
        (4, 8, 12, 20, 36), {"ours": ALL, "NumPy": ALL, "filterpy": ALL},
    ),
    "anchors": Series(
        "planar ranges to all anchors in every row, 4 states, 64 trajectories of 200 rows",
        lambda version, size: ranges(version, biases=0, slots=size), (3, 6, 12, 25, 50),
    ),
    "particles": Series(
        "particle filter on a line, 256 trajectories of 200 rows; `particles` of 4", particles.version,
        (100, 300, 1000, 3000, 10_000), {"ours": ALL, "textbook": 1000, "particles": 1000},
    ),
    "tunables": Series(
        "likelihood and gradient of the planar tracker of ranges, 64 trajectories of 200 rows", tunables,
        (1, 4, 8, 16, 64),
    ),
    "bearings": Series(
        "walks seen by four stations, 480 bearings each", bearings, (1, 64, 512),
        {"constant velocity": ALL, "drifting biases": ALL}, 15, 240.0,
    ),
    "inertial": Series(
        "uwb-imu with one heading, 100 rows", inertial, (1, 512), {"filter": ALL, "gradient": ALL}, limit_s=400.0
    ),
    **{
        f"form-{n}": Series(
            f"{n} states, planar ranges", partial(form, n), (1, 8, 64, 512), {"scalars": ALL, "matrices": ALL}, 15, 240
        )
        for n in (4, 12)
    },
    **{
        f"smoothed-{name}": Series(
            f"{name}, {SMOOTHED_ROWS} times, with the call of `run`", partial(smoothed, name),
            (1, 8, 9, 64, 512, 2000), {"filtered": ALL, "smoothed": ALL}, 5, 240.0,
        )
        for name in ("uwb", "fix-kf", "fix-singer", "imm", "uwb-imu")
    },
    "evaluated": Series(
        f"runs over {EVALUATED_ROWS} times of simulated recordings, and their evaluation", evaluated, (500, 5000),
        {f"{name}{what}": ALL for name in ("fix-kf", "uwb", "arrays") for what in ("", " evaluated")}, 5,
    ),
}  # fmt: skip
USUAL = ("rows", "trajectories", "states", "anchors", "particles", "tunables")
