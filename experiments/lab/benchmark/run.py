"""Side by side: ours and other estimators on recordings and worlds, each with its own best levels.

Levels of an estimator (table `peer-levels`) have the least geometric mean of the horizontal RMSE over the development
recordings, those on which our defaults were set, on a grid; then both are scaled so that the geometric mean of NEES per
degree of freedom is 1 there. Peers run in processes that never import trackwright.
"""

import pickle
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.benchmark import problems as data
from trackwright.experiments.lab.runner import EVIDENCE, Case, Figures, measure, new_interpreter, read
from trackwright.experiments.lab.validation.levels import TRACKERS
from trackwright.experiments.lab.validation.sites import paths
from trackwright.experiments.text.tables import markdown, replace_tables
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.evaluation.comparison import paired_differences
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.rows import scored_rows

PEERS, PAGE = Path(__file__).with_name("peers"), Path("docs/side-by-side.md")
OURS, SMOOTHED, OPTIMUM = "trackwright", "trackwright-smoothed", "optimum"
ESTIMATORS = {
    "numpy-ekf": "model:numpy_ekf", "filterpy": "with_filterpy:estimate", "stonesoup": "with_stonesoup:estimate",
    "cuthbert": "with_cuthbert:prepared", "dynamax": "with_dynamax:prepared", "gtsam-lag": "with_gtsam:incremental",
    "gtsam": "with_gtsam:estimate",
}  # fmt: skip
"""The function in `peers` of each."""
LATER = ("dynamax", "gtsam")  # those that use later readings
DEVELOPMENT = {
    "ranges": TRACKERS["uwb"].recordings, "bearings": TRACKERS["bearings"].recordings, "fixes": ("tiers-1tag-01",),
    "tdoa": ("util-c1-t1-tdoa2", "util-c1-t1-tdoa3", "util-c4-t5-tdoa2"),
}  # fmt: skip
GRIDS = {"fixes": ((0.3, 2.4, 24.0), (0.013, 0.05, 0.2))}
USUAL = ((0.033, 0.1, 0.3, 0.9), (0.1, 0.2, 0.4, 0.8))  # m/s² per √Hz, and m or rad, of which all pairs are tried
SEARCHED, LIMIT_S, GROUPS = 600, 900.0, ("development", "unseen", "worlds")
"""Readings of a tag of a development recording that the search uses; the longest run of a peer for a pair of levels."""


def peer(name: str, recording: str, levels: Sequence[tuple[float, float]], most: int) -> Iterator[tuple[Figures, Any]]:
    """For each of the levels, figures and errors by track of an estimator, run in a fresh process."""
    folder = data.folder_of(recording, most)
    given = list(data.problems(folder, most))
    with tempfile.TemporaryDirectory() as place:
        file = Path(place, "problems")
        file.write_bytes(pickle.dumps((levels, [asdict(problem) for _, problem in given])))
        new_interpreter(["-E", str(PEERS / "run_peer.py"), ESTIMATORS[name], str(file)], LIMIT_S * len(levels))
        seconds, estimates = pickle.loads(file.read_bytes())
    for found in zip(*estimates, strict=True):
        tables = (_table(folder.name, *one, *path) for one, path in zip(given, found, strict=True))
        figures, errors = scored(pl.concat(tables), folder)
        yield {**figures, "cpu_us": 1e6 * seconds / sum(len(p.times) for _, p in given)}, errors


def _table(recording: str, tag: str, p: Any, positions: np.ndarray, P: np.ndarray | None) -> pl.DataFrame:
    """The last estimate of each time, with the columns of `track`."""
    last = np.flatnonzero(np.append(np.diff(p.times) > 0, True))
    cov = np.full((len(last), 3, 3), np.nan)
    cov[:, 2, 2] = 0.0  # That of a known height.
    cov[:, : p.d, : p.d] = np.nan if P is None else P[last]
    columns: dict[str, Any] = {"recording": recording, "t_s": p.times[last], "tag": tag}
    for i, a in enumerate("xyz"):
        columns |= {f"{a}_m": p.place(positions)[last, i], f"std_{a}_m": np.sqrt(cov[:, i, i])}
        columns |= {f"cov_{b}{a}_m2": cov[:, j, i] for j, b in enumerate("xyz"[:i])}
    return pl.DataFrame(columns)


def scored(table: pl.DataFrame, folder: Any) -> tuple[dict[str, Any], Any]:
    """RMSE and 95th percentile, m or rad, share inside 95 %, NEES/dof, rows with an estimate; the scored rows."""
    rows = scored_rows(table, {folder.name: folder.tables["truth"]}, {folder.name: folder.rig.stations})
    found = Evaluation.of(rows).overall
    error = "rmse_m" if found.get("rmse_m") is not None else "rmse_direction_rad"
    figures = {"rmse": found[error], "p95": found.get(error.replace("rmse", "p95")), "inside": found["coverage_95"],
               "nees": found["nees_ratio"], "estimated": found["n"] / found["n_rows"]}  # fmt: skip
    return figures, rows


@cache
def ours(name: str, recording: str) -> tuple[Figures, Any]:
    """Figures and errors by track of our tracker as a user gets it; the time is a second run's."""
    folder = data.folder_of(recording)
    tracker = build(fitting(folder), folder)
    tracker = tracker.smoothing() if name == SMOOTHED else tracker
    tracker.run(folder)
    began, table = time.process_time(), tracker.run(folder).to_polars()
    seconds, (figures, errors) = time.process_time() - began, scored(table, folder)
    given = sum(len(p.times) for _, p in data.problems(folder)) or len(table)
    return {**figures, "cpu_us": 1e6 * seconds / given}, errors


def levels_of(name: str, kind: str) -> Figures:
    """The levels of an estimator by the search."""
    grid = list(product(*GRIDS.get(kind, USUAL)))
    names = [recording for recording in DEVELOPMENT[kind] if recording in paths()]
    runs = [[figures for figures, _ in peer(name, recording, grid, SEARCHED)] for recording in names]
    logs = np.log([[[r["rmse"] or np.inf, r["nees"] or np.nan] for r in each] for each in runs])
    best = int(np.nanargmin(np.mean(logs[..., 0], axis=0)))
    nees = logs[np.isfinite(logs[:, best, 1]), best, 1]
    scale = float(np.exp(0.5 * np.mean(nees))) if len(nees) else 1.0  # 1: the estimator gave no covariances.
    motion, reading = scale * np.array(grid[best])
    return {"acceleration": motion, "reading": reading, "scale": scale, "pairs": len(grid), "recordings": len(names)}


def beside(name: str, recording: str) -> Figures:
    """An estimator's figures, and the 95 % interval of its RMSE less ours, paired over pieces of time."""
    if name in (OURS, SMOOTHED):
        return ours(name, recording)[0]
    kind = next(data.problems(data.folder_of(recording)))[1].kind
    if name == OPTIMUM:
        levels = data.WORLDS[recording][2:]
    else:
        row = next(r for r in read(EVIDENCE / "peer-levels.csv") if (r["recording"], r["tracker"]) == (kind, name))
        levels = float(row["acceleration"]), float(row["reading"])
    figures, errors = next(peer("numpy-ekf" if name == OPTIMUM else name, recording, [levels], data.MOST_READINGS))
    mine = ours(SMOOTHED if name in LATER else OURS, recording)[1]
    paired = next(iter(paired_differences(mine, errors, ["rmse_m", "rmse_direction_rad"]).values()), None)
    return {**figures, "low": paired and paired.low, "high": paired and paired.high}


def cases() -> Iterator[Case]:
    """Every estimator on every data set; `setting`: development, unseen, or worlds."""
    seen = {recording for names in DEVELOPMENT.values() for recording in names}
    for recording in (*paths(), *data.WORLDS):
        group = "worlds" if recording in data.WORLDS else "development" if recording in seen else "unseen"
        others = [] if recording.startswith("ble51-uca") else list(ESTIMATORS)
        for name in (OURS, SMOOTHED, *others, *[OPTIMUM] * (group == "worlds")):
            yield Case(recording, name, group, partial(beside, name, recording))


def headline(rows: Sequence[dict[str, str]]) -> list[tuple[str, ...]]:
    """By group of data sets: on how many ours is better than an estimator, not told apart, and worse."""
    lines = [("estimator", *(f"{g}: better, equal, worse" for g in GROUPS), "NEES/dof, unseen", "µs a reading")]
    for name in (OURS, SMOOTHED, *ESTIMATORS):
        mine, told = [row for row in rows if row["tracker"] == name], []
        for group in GROUPS if name in ESTIMATORS else ():
            part = [row for row in mine if row["setting"] == group]
            better = sum(bool(r["error"]) or float(r["low"] or "nan") > 0 for r in part)
            worse = sum(float(r["high"] or "nan") < 0 for r in part)
            told.append(f"{better}, {len(part) - better - worse}, {worse}")
        logs = [np.log(float(r["nees"])) for r in mine if r["setting"] == "unseen" and r["nees"]]
        times, nees = [float(r["cpu_us"]) for r in mine if r["cpu_us"]], f"{np.exp(np.mean(logs)):.2f}" if logs else ""
        lines.append((name, *(told or ("",) * 3), nees, f"{np.median(times):.1f}" if times else ""))
    return lines


def main() -> int:
    """Measure what docs/evidence lacks, and write the table of the page; 1 if a row has an error."""
    pairs = product(DEVELOPMENT, ESTIMATORS)
    levels = (Case(kind, name, "development", partial(levels_of, name, kind)) for kind, name in pairs)
    failed = measure(levels, EVIDENCE / "peer-levels.csv", report=notice)
    failed += measure(cases(), EVIDENCE / "side-by-side.csv", report=notice)
    replace_tables(PAGE, "make benchmark", markdown(headline(read(EVIDENCE / "side-by-side.csv"))))
    print(f"wrote {PAGE}; {failed} rows have an error")
    return int(bool(failed))


if __name__ == "__main__":
    run_alone(main, "make benchmark")
