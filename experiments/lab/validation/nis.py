"""NIS per degree of freedom in worlds of each tracker's own model, 1 expected whatever the noise.

Five worlds of each tracker, by `own_worlds.py` with the times and the geometry of a simulated recording; beside it the
share of the means over `WINDOW` rows inside the 95 % band of `nis_band`. Rows count from `SETTLED` s on: the prior of a
start is wider than a linearisation is exact, and that of phases is drawn within one lobe of the array.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.experiments.lab.validation.own_worlds import NEVER_LOST, own_world
from trackwright.sim import SimulatedWorld, worlds
from trackwright.tuning.diagnostics import nis_band, student_t_dof_of

TAGS, SEEDS, SETTLED, WINDOW = 24, 5, 5.0, 50


class World(NamedTuple):
    """Recordings for their times and geometry; `narrower`: as of `own_world`."""

    make: Callable[..., SimulatedWorld]
    narrower: float = 1.0


WORLDS: Mapping[str, World] = {
    "direct": World(worlds.station, 30.0),
    "beam": World(worlds.station, 30.0),
    "bearings": World(worlds.fusion),
    "line-grid": World(worlds.line),
    "line-pf": World(worlds.line),
    "uwb": World(worlds.ranges),
    "uwb-imu": World(worlds.tool),
    "tdoa": World(worlds.tdoa),
    "tdoa-imu": World(partial(worlds.tdoa, imu=True)),
    "fix-kf": World(partial(worlds.agv, rows=500)),
    "fix-singer": World(partial(worlds.agv, rows=500)),
}


def cases() -> Iterator[Case]:
    """Five worlds of each tracker."""
    for name in WORLDS:
        yield from (Case("own model", name, "defaults", partial(figures, name, seed), seed) for seed in range(SEEDS))


def figures(name: str, seed: int) -> Figures:
    """NIS per degree of freedom of all settled rows, and the share of the means over `WINDOW` rows inside the band."""
    batch = tw.TRACKERS[name].batches([WORLDS[name].make(n=TAGS, seed=seed).folder()], name, False)[0]
    made: Any = batch.tracker
    tracker = dataclasses.replace(made, track_loss=NEVER_LOST)
    drawn, priors, _ = own_world(tracker, [t.recording for t in batch.trajectories], seed, WORLDS[name].narrower)
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
