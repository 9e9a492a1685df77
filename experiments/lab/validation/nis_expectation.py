"""NIS against its expectation in worlds of each tracker's own model.

Five worlds of each tracker of the catalogue with a NIS, `TAGS` tags each, by `own_worlds.py` with the times and the
geometry of a simulated recording: NIS per degree of freedom in each world, 1 expected whatever the noise, and the share
of the means over `WINDOW` rows inside the 95 % band of `tuning.diagnostics.nis_band`. Rows count from `SETTLED` s on:
the prior of a start is wider than a linearisation is exact, and that of phases is drawn within one lobe of the array.
`cascade`, `mhk` and `mhk-stamped` read what other estimators make of the readings, errors that no model of their own
has: they run on simulated worlds as these are. Trackers without covariance have no NIS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from trackwright.experiments.lab.verify.worlds import NEVER_LOST

import trackwright as tw
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.experiments.lab.validation.own_worlds import own_world
from trackwright.sim import SimulatedWorld, work_station, worlds
from trackwright.trackers.baselines.fixes import floor_tracker
from trackwright.trackers.parts.walls import Walls
from trackwright.tuning.diagnostics import nis_band, student_t_dof_of

TAGS, WORLDS, SETTLED, WINDOW = 24, 5, 5.0, 50
FAR = 200.0 * np.array([[-1, -1, 1, -1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, 1, -1, -1]])
"""Walls that no tag reaches, m."""


class Case(NamedTuple):
    """A tracker with recordings, for their times and geometry; `narrower`: as of `own_world`, None for no own world."""

    tracker: tw.AbstractTracker
    recordings: list[tw.Recording]
    narrower: float | None


def simulated(
    name: str, make: Callable[..., SimulatedWorld], seed: int, narrower: float | None = 1.0, **options: Any
) -> Case:
    """A tracker of the catalogue with the recordings of a simulated world."""
    batch = tw.TRACKERS[name].batches([make(n=TAGS, seed=seed, **options).folder()], name, False)[0]
    return Case(batch.tracker, [trajectory.recording for trajectory in batch.trajectories], narrower)


def bearings(seed: int) -> Case:
    """Tags amid the stations of the work station, which hear them in turn."""
    stations, times = work_station().stations, np.arange(240) / 10.0
    turn = [list(stations)[k % len(stations)] for k in range(len(times))]
    recording = tw.bearing_recording(times, np.zeros((len(times), 2)), turn, stations)
    return Case(tw.bearing_tracker(len(stations)), [recording] * TAGS, 1.0)


def floor(seed: int) -> Case:
    """Tags on a wide floor."""
    recording = tw.fix_recording(np.arange(200) / 10.0, np.zeros((200, 3)), height=1.0)
    return Case(floor_tracker(Walls(FAR)), [recording] * TAGS, 1.0)


CASES: Mapping[str, Callable[[int], Case]] = {
    "direct": partial(simulated, "direct", worlds.station, narrower=30.0),
    "cascade": partial(simulated, "cascade", worlds.station, narrower=None),
    "beam": partial(simulated, "beam", worlds.station, narrower=30.0),
    "bearings": bearings,
    "line-grid": partial(simulated, "line-grid", worlds.line),
    "line-pf": partial(simulated, "line-pf", worlds.line),
    "uwb": partial(simulated, "uwb", worlds.ranges),
    "uwb-imu": partial(simulated, "uwb-imu", worlds.tool),
    "tdoa": partial(simulated, "tdoa", worlds.tdoa),
    "tdoa-imu": partial(simulated, "tdoa-imu", partial(worlds.tdoa, imu=True)),
    "floor-pf": floor,
    "fix-kf": partial(simulated, "fix-kf", worlds.agv, rows=500),
    "fix-singer": partial(simulated, "fix-singer", worlds.agv, rows=500),
    "imm": partial(simulated, "imm", worlds.agv, rows=500),
    "fix-mirror": partial(simulated, "fix-mirror", worlds.agv, rows=500),
    "mhk": partial(simulated, "mhk", worlds.agv, narrower=None, rows=500),
    "mhk-stamped": partial(simulated, "mhk-stamped", worlds.agv, narrower=None, rows=500),
}


def estimates(name: str, seed: int) -> tuple[tw.AbstractTracker, tw.Estimates]:
    """The tracker and its estimates in a world of its own model, or in a simulated one."""
    tracker, recordings, narrower = CASES[name](seed)
    if narrower is None:
        return tracker, tracker.run(recordings)
    assert isinstance(tracker, tw.Tracker)
    tracker = dataclasses.replace(tracker, track_loss=NEVER_LOST)
    drawn, priors, _ = own_world(tracker, recordings, seed, narrower)
    return tracker, tracker.run(drawn, initial=priors)


def means(run: tw.Estimates, tracker: tw.AbstractTracker) -> tuple[float, float]:
    """NIS per degree of freedom of all settled rows, and the share of the means over `WINDOW` rows inside the band."""
    assert run.times is not None
    used = np.isfinite(run.nis) & (run.nis_dof > 0) & (run.times >= run.times[:, :1] + SETTLED)
    ratio = float(run.nis[used].sum(dtype=float) / run.nis_dof[used].sum(dtype=float))
    inside = []
    for nis, dof, rows in zip(run.nis, run.nis_dof, used, strict=True):
        whole = rows.sum() // WINDOW * WINDOW
        total, freedom = (x[rows][:whole].astype(float).reshape(-1, WINDOW).sum(axis=1) for x in (nis, dof))
        nu = student_t_dof_of(tracker)
        low, high = nis_band(freedom, None if nu is None else float(np.asarray(nu)))
        inside += ((low <= total / freedom) & (total / freedom <= high)).tolist()
    return ratio, float(np.mean(inside))


def nis_expectation(*trackers: str, output: Output = DEFAULTS) -> int:
    """NIS per degree of freedom in five worlds of each tracker's own model, 1 expected.

    Args:
        trackers: names of the catalogue; all with a NIS where none is named.
    """
    rows = shown(of_a_tracker(name, output.rounds(WORLDS)) for name in chosen(trackers, CASES))
    output.publish("validation nis-expectation", Table(rows))
    return 0


def of_a_tracker(name: str, worlds: int) -> Row:
    """The row of a tracker over so many worlds."""
    by_world = [means(run, tracker) for tracker, run in (estimates(name, seed) for seed in range(worlds))]
    return {
        "tracker": f"`{name}`",
        "world": "simulated" if CASES[name](0).narrower is None else "own model",
        "NIS/dof in five worlds": ", ".join(f"{ratio:.2f}" for ratio, _ in by_world),
        "means inside the 95 % band": f"{100 * np.mean([share for _, share in by_world]):.0f} %",
    }
