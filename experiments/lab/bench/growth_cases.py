"""The problems of `growth.py`: a function of size and version that returns a run and its number of rows.

Rows and trajectories: the beam tracker of `measure.py`, beside its textbook form, dynamax, cuthbert and filterpy.
States and anchors: a planar tracker of ranges with a bias per anchor in the state, beside a NumPy loop and filterpy.
Particles: the tracker of `particles.py`, beside its textbook form and the library `particles`. Tunables: likelihood and
gradient of the range tracker.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Run = tuple[Callable[[], Any], int]

ALL = 10**9


class Series(NamedTuple):
    """`versions`: the largest size of each."""

    about: str
    sizes: tuple[int, ...]
    versions: dict[str, int]


SERIES = {
    "rows": Series(
        "beam tracker, 16 trajectories",
        (20, 64, 200, 640, 2000),
        {"ours": ALL, "textbook": ALL, "dynamax": 200, "cuthbert": 640, "filterpy": 64},
    ),
    "trajectories": Series(
        "beam tracker, 200 rows",
        (32, 128, 512, 2048, 4096),
        {"ours": ALL, "textbook": 128, "cuthbert": 128},
    ),
    "states": Series(
        "planar ranges, one a row, 64 trajectories of 200 rows; a NumPy loop and filterpy of one",
        (4, 8, 12, 20, 36),
        {"ours": ALL, "NumPy": ALL, "filterpy": ALL},
    ),
    "anchors": Series(
        "planar ranges to all anchors in every row, 4 states, 64 trajectories of 200 rows",
        (3, 6, 12, 25, 50),
        {"ours": ALL},
    ),
    "particles": Series(
        "particle filter on a line, 256 trajectories of 200 rows; `particles` of 4",
        (100, 300, 1000, 3000, 10_000),
        {"ours": ALL, "textbook": 1000, "particles": 1000},
    ),
    "tunables": Series(
        "likelihood and gradient of the planar tracker of ranges, 64 trajectories of 200 rows",
        (1, 4, 8, 16, 64),
        {"ours": ALL},
    ),
}

ROWS, TRAJECTORIES, BEAMS = 200, 64, 16


def build(series: str, version: str, size: int) -> Run:
    """The run of a version of a series at one size, and its number of rows."""
    if series == "rows":
        return beam(version, BEAMS, size)
    if series == "trajectories":
        return beam(version, size, ROWS)
    if series == "particles":
        return particle_filter(version, size)
    if series == "states":
        return ranges(version, biases=size - 4, slots=1)
    return ranges(version, biases=0, slots=size) if series == "anchors" else gradient(size)


def beam(version: str, trajectories: int, rows: int) -> Run:
    """The beam tracker with a given start."""
    from experiments.lab.bench import measure
    from experiments.lab.bench.textbook import all_pairs, textbook
    from trackers.aoa.layout import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH

    world = measure.simulate(trajectories, rows)
    if version == "ours":
        tracker = measure.trackers()[1]
        return filtering(tracker, world.batch), trajectories * rows
    if version == "textbook":
        build: Any = textbook
    else:
        from experiments.lab.bench import peers

        build = getattr(peers, f"with_{version}")
    run = build(all_pairs(DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH), measure.SIGMA_A, measure.SIGMA_P)
    part = world.part(trajectories, rows)
    return finished(lambda: run(*part)), trajectories * rows


def filtering(tracker: Any, batch: Any) -> Callable[[], Any]:
    """A run of the tracker over a batch."""
    from trackers.core.chunks import CHUNK, as_dtype, chunks, run_chunks
    from trackers.core.tracker import filter_batch

    model = as_dtype(tracker, batch.dt.dtype)
    return lambda: run_chunks(filter_batch, [(model, part) for part in chunks(batch, CHUNK)])


def finished(run: Callable[[], Any]) -> Callable[[], Any]:
    """The run, until its computation is finished."""
    import jax

    return lambda: jax.block_until_ready(run())


def ranging(anchors: int, slots: int, biases: int, trajectories: int) -> tuple[Any, list[Any]]:
    """A planar tracker of ranges and its recordings: circles of 3 m among anchors on a circle of 8 m."""
    from trackers.core.recording import Readings, Recording
    from trackers.core.track_loss import TrackLossPolicy
    from trackers.core.tracker import Tracker
    from trackers.core.tunable import Scale
    from trackers.parts.drifting_biases import BiasedStart, DriftingBiases
    from trackers.parts.ranges import RANGES, RangeSensor

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
    """The tracker of ranges, or the loop of one trajectory in NumPy or with filterpy."""
    from trackers.core.recording import stack

    tracker, recordings = ranging(max(biases, slots, 4), slots, biases, TRAJECTORIES if version == "ours" else 1)
    if version == "ours":
        return filtering(tracker, stack(recordings)), TRAJECTORIES * ROWS
    from experiments.lab.bench.loops import filtered, model_of, with_filterpy

    model = model_of(tracker, recordings[0], planar=True)
    assert model is not None
    state = np.zeros(4 + biases)
    state[:2] = recordings[0].inputs["nearby"][0, :2]
    P = np.diag([1.0] * 4 + [0.03**2] * biases)
    dts = np.diff(recordings[0].times, prepend=0.0)
    loop = with_filterpy if version == "filterpy" else filtered
    return (lambda: loop(model, state, P, dts, 1)), ROWS - 1


def gradient(tunables: int) -> Run:
    """Likelihood and gradient of that many sensor biases."""
    from trackers.core.chunks import CHUNK
    from trackers.core.recording import stack
    from tuning.objectives import NegativeLogLikelihood
    from tuning.parameters import flatten, select_parameters
    from tuning.problem import Problem

    tracker, recordings = ranging(tunables, 1, 0, TRAJECTORIES)
    parameters = select_parameters(tracker, ("sensors.*.bias",))
    problem = Problem(tracker, [stack(recordings)], NegativeLogLikelihood(), parameters, CHUNK)
    vector = flatten(parameters)
    return (lambda: problem.evaluate(vector)[:2]), TRAJECTORIES * ROWS


def particle_filter(version: str, count: int) -> Run:
    """The particle filter on a line."""
    from experiments.lab.bench import particles
    from sim.line import THESIS_KNOTS

    particles.PARTICLES = count
    fixes, times, _ = particles.task()
    if version == "particles":
        from experiments.lab.bench import particle_peers

        particle_peers.PARTICLES = count
        fixes = fixes[: particle_peers.SLICES["particles"]]
        run = particle_peers.with_particles(fixes, float(times[1] - times[0]), THESIS_KNOTS)
    elif version == "textbook":
        run = particles.textbook(fixes, times, THESIS_KNOTS)
    else:
        run = particles.ours(fixes, times)
    return run, fixes.shape[0] * fixes.shape[1]
