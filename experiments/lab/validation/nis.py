"""NIS per degree of freedom in worlds of each tracker's own model, 1 expected whatever the noise.

Five worlds of each tracker of the catalogue with a NIS, by `own_worlds.py` with the times and the geometry of a
simulated recording; beside it the share of the means over `WINDOW` rows inside the 95 % band of `nis_band`. Rows count
from `SETTLED` s on: the prior of a start is wider than a linearisation is exact, and that of phases is drawn within one
lobe of the array. `cascade` and `mhk` read what other estimators make of the readings, errors that no model of their
own has, and the motion of `imm` switches: they run on simulated worlds as these are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.experiments.lab.validation.own_worlds import NEVER_LOST, own_world
from trackwright.sim import SimulatedWorld, work_station, worlds
from trackwright.tuning.diagnostics import nis_band, student_t_dof_of

TAGS, SEEDS, SETTLED, WINDOW = 24, 5, 5.0, 50


World = tuple[tw.AbstractTracker, list[tw.Recording], float | None]
"""A tracker with recordings, for their times and geometry, and `narrower` of `own_world`, None for no own world."""


def simulated(
    name: str, make: Callable[..., SimulatedWorld], seed: int, narrower: float | None = 1.0, **options: Any
) -> World:
    """A tracker of the catalogue with the recordings of a simulated world."""
    batch = tw.TRACKERS[name].batches([make(n=TAGS, seed=seed, **options).folder()], name, False)[0]
    return batch.tracker, [trajectory.recording for trajectory in batch.trajectories], narrower


def bearings(seed: int) -> World:
    """Tags amid the stations of the work station, which hear them in turn."""
    stations, times = work_station().stations, np.arange(240) / 10.0
    turn = [list(stations)[k % len(stations)] for k in range(len(times))]
    recording = tw.bearing_recording(times, np.zeros((len(times), 2)), turn, stations)
    return tw.bearing_tracker(len(stations)), [recording] * TAGS, 1.0


WORLDS: Mapping[str, Callable[[int], World]] = {
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
    **{
        name: partial(simulated, name, worlds.agv, narrower=narrower, rows=500)
        for name, narrower in {
            "fix-kf": 1.0, "fix-singer": 1.0, "imm": None, "mhk": None,
        }.items()
    },
}  # fmt: skip


def cases() -> Iterator[Case]:
    """Five worlds of each tracker."""
    for name in WORLDS:
        world = "simulated" if name in ("cascade", "imm", "mhk") else "own model"
        yield from (Case(world, name, "defaults", partial(figures, name, seed), seed) for seed in range(SEEDS))


def figures(name: str, seed: int) -> Figures:
    """NIS per degree of freedom of all settled rows, and the share of the means over `WINDOW` rows inside the band."""
    made: Any
    made, recordings, narrower = WORLDS[name](seed)
    tracker = made if narrower is None else dataclasses.replace(made, track_loss=NEVER_LOST)
    if narrower is None:
        run = tracker.run(recordings)
    else:
        drawn, priors, _ = own_world(tracker, recordings, seed, narrower)
        run = tracker.run(drawn, initial=priors)
    used = np.isfinite(run.nis) & (run.nis_dof > 0) & (run.times >= run.times[:, :1] + SETTLED)
    inside: list[bool] = []
    for nis, dof, rows in zip(run.nis, run.nis_dof, used, strict=True):
        whole = rows.sum() // WINDOW * WINDOW
        total, freedom = (x[rows][:whole].astype(float).reshape(-1, WINDOW).sum(axis=1) for x in (nis, dof))
        nu = student_t_dof_of(tracker)
        low, high = nis_band(freedom, None if nu is None else float(np.asarray(nu)))
        inside += ((low <= total / freedom) & (total / freedom <= high)).tolist()
    ratio = float(run.nis[used].sum(dtype=float) / run.nis_dof[used].sum(dtype=float))
    return {"nis_per_dof": ratio, "means_in_band": float(np.mean(inside))}
