"""Made-up data of a tuning report, with everything that the report shows; and recordings to tune on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from trackwright.experiments.pages.reports.before_after import ErrorTrack, TrackChanges
from trackwright.experiments.pages.reports.tuning import (
    OptimiserTrace,
    TunedParameter,
    TuningReportData,
)
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.diagnostics import Innovations


def innovations(scale: float, seed: int = 0, rows: int = 1200) -> Innovations:
    """χ² values with two and three degrees of freedom by turns, times `scale`."""
    rng = np.random.default_rng(seed)
    dof = np.tile([2.0, 3.0], rows // 2)
    return Innovations(scale * rng.chisquare(dof), dof)


def report_data(**changes) -> TuningReportData:
    """A run that tuned three numbers from three starts, by likelihood, on two recordings, with two held out."""
    rng = np.random.default_rng(1)
    numbers = (
        TunedParameter("motion.sigma_a", "m/s/sqrt(s)", 0.05, 0.1371, 0.121, 0.155, True),
        TunedParameter("sensors.fixes.sigma_p", "m", 0.3, 0.2203, 0.2151, 0.2258, True),
        TunedParameter("start.sigma_start", "m", 0.5, 0.9, float("nan"), float("nan"), False),
    )
    end = np.array([n.after for n in numbers])
    steps = np.arange(25)[:, None]
    ways = [end * np.exp(np.log(factor / end) * 0.8**steps) for factor in
            (np.array([0.05, 0.3, 0.5]), np.array([0.5, 0.06, 0.3]), np.array([0.02, 1.2, 0.8]))]  # fmt: skip
    away = [((np.log(w / end)) ** 2).sum(axis=1) for w in ways]
    times = np.arange(400) * 0.2
    tracks = tuple(
        ErrorTrack(f"line-{k}, tag {k}", times, 0.3 * np.abs(rng.normal(size=400)) + 0.02 * k,
                   0.22 * np.abs(rng.normal(size=400)) + 0.03 * k)
        for k in range(5)
    )  # fmt: skip
    made = TuningReportData(
        commands=("trackwright track RECORDING --noise tuned/tuned.toml --out tracked",
               "trackwright tune line-a line-b --held-out line-c line-d --out tuned"),
        tracker="line-grid",
        tracker_about="position on a known path, by a grid of arclength and speed",
        objective="nll",
        objective_about="negative log-likelihood per measured number (nats)",
        training=("line-a", "line-b"),
        held_out=("line-c", "line-d"),
        parameters=numbers,
        values=(0.4812, 0.1327),
        traces=tuple(OptimiserTrace(0.1327 + a, w) for a, w in zip(away, ways, strict=True)),
        innovations=(innovations(0.55), innovations(1.0, 7)),
        plans=TrackChanges((), 0, tracks),
        error_unit="m",
        filter_runs=4321,
        seconds=47.3,
    )  # fmt: skip
    return TuningReportData(**(vars(made) | changes))


def walk(
    name: str, seed: int, rows: int = 60, sigmas: Sequence[float] = (0.25,), truth: bool = True, hole: float = 0.0
) -> RecordingFolder:
    """Fixes of tags t0, t1, … that walk at random at a known height, with errors `sigmas`, m, and a hole, s, half-way."""
    rng = np.random.default_rng(seed)
    tables: dict[str, list[pl.DataFrame]] = {"fixes": [], "truth": []}
    times = np.arange(rows) * 0.2 + hole * (np.arange(rows) >= rows // 2)
    for tag, sigma in enumerate(sigmas):
        place = np.cumsum(0.1 * rng.normal(size=(rows, 3)), axis=0) + [2.0, 3.0, 1.0]
        for kind, values in (("fixes", place + sigma * rng.normal(size=place.shape)), ("truth", place)):
            columns = {"t_s": times, "tag": f"t{tag}"} | {f"{a}_m": values[:, k] for k, a in enumerate("xyz")}
            tables[kind].append(pl.DataFrame(columns))
    kept = {kind: pl.concat(parts).sort("t_s", "tag") for kind, parts in tables.items() if truth or kind == "fixes"}
    return RecordingFolder(name, None, Rig(name, anchors={"A": np.array([0.0, 0.0, 2.0])}), kept)
