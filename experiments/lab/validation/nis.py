"""NIS per degree of freedom in worlds of each tracker's own model, 1 expected whatever the noise.

Five worlds of each tracker, by `own_worlds.py` with the times and the geometry of a simulated recording; beside it the
share of the means over `WINDOW` rows inside the 95 % band of `nis_band`. Rows count from `SETTLED` s on: the prior of a
start is wider than a linearisation is exact, and of phases it is drawn within one lobe of the array.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.experiments.lab.validation.own_worlds import NEVER_LOST, own_world
from trackwright.sim import SimulatedWorld, worlds
from trackwright.tuning.diagnostics import nis_band, student_t_dof_of

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
        nu = student_t_dof_of(tracker)
        low, high = nis_band(freedom, None if nu is None else float(np.asarray(nu)))
        inside += ((low <= total / freedom) & (total / freedom <= high)).tolist()
    ratio = float(run.nis[used].sum(dtype=float) / run.nis_dof[used].sum(dtype=float))
    return {"nis_per_dof": ratio, "means_in_band": float(np.mean(inside))}
