"""`make benchmark`: ours and other estimators on public recordings and worlds, each at its own best levels.

Levels of an estimator have the least geometric mean of the horizontal RMSE over the development recordings on a grid,
and then one common scale with which the geometric mean of NEES per degree of freedom is 1 there. Levels are kept in
docs/evidence/peer-levels.csv, all figures in docs/evidence/side-by-side.csv; what is there is not computed again.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.benchmark import problems as data
from trackwright.experiments.lab.validation.sites import SEEN_BY_DEFAULTS
from trackwright.experiments.text.tables import markdown, replace_tables
from trackwright.experiments.text.terminal import notice, progress
from trackwright.trackers.evaluation.association import associate_truth
from trackwright.trackers.evaluation.comparison import errors_by_track, paired_differences
from trackwright.trackers.evaluation.evaluate import evaluate_association
from trackwright.trackers.evaluation.scoring import score
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder

PEERS, EVIDENCE, PAGE = Path(__file__).with_name("peers"), Path("docs/evidence"), Path("docs/side-by-side.md")
OURS, SMOOTHED, OPTIMUM = "trackwright", "trackwright-smoothed", "optimum"
SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=3000000"
"""The options of XLA with which cuthbert and dynamax run fastest here."""


class Peer(NamedTuple):
    """An estimator: module and function in `peers`, its library, and whether it uses later readings."""

    run: str
    library: str = ""
    later: bool = False


ESTIMATORS = {
    "numpy-ekf": Peer("plain:estimate"),
    "filterpy": Peer("with_filterpy:estimate", "filterpy"),
    "stonesoup": Peer("with_stonesoup:estimate", "stonesoup"),
    "cuthbert": Peer("with_cuthbert:prepared", "cuthbert"),
    "dynamax": Peer("with_dynamax:prepared", "dynamax", later=True),
    "gtsam-lag": Peer("with_gtsam:fixed_lag", "gtsam"),
    "gtsam": Peer("with_gtsam:batch", "gtsam", later=True),
}
DEVELOPMENT = {
    kind: SEEN_BY_DEFAULTS[tracker]
    for kind, tracker in (("ranges", "uwb"), ("tdoa", "tdoa"), ("bearings", "bearings"), ("fixes", "fix-mirror"))
}
GRID = {"fixes": product((0.3, 2.4, 24.0), (0.013, 0.05, 0.2))}
USUAL = tuple(product((0.033, 0.1, 0.3, 0.9), (0.1, 0.2, 0.4, 0.8)))
"""Pairs of m/s² per √Hz, and m or rad, that are tried."""

SEARCHED = 1_500
"""Readings of a development recording that the search uses."""

LIMIT_S = 900.0
Levels = tuple[float, float]


def peer(name: str, folder: RecordingFolder, levels: Sequence[Levels]) -> Iterator[tuple[pl.DataFrame, float]]:
    """The estimates at each of the levels, and the processor time of a reading, µs, of the last; in a fresh process."""
    given = list(data.problems(folder))
    with tempfile.TemporaryDirectory() as place:
        source, target = Path(place, "problems.npz"), Path(place, "estimates.npz")
        arrays = {f"{f}_{k}": getattr(p, f) for k, (_, p) in enumerate(given)
                  for f in ("times", "values", "seen", "geometry", "height")}  # fmt: skip
        np.savez(source, kind=given[0][1].kind, prior=given[0][1].prior, **arrays)
        flags = {"XLA_FLAGS": SMALL_LOOPS} if ESTIMATORS[name].library in ("cuthbert", "dynamax") else {}
        done = subprocess.run(
            [sys.executable, str(PEERS / "run_peer.py"), ESTIMATORS[name].run, str(source), str(target),
             *(f"{a},{r}" for a, r in levels)],
            env={k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "PYTHONPATH")} | flags,
            capture_output=True, text=True, check=False, timeout=LIMIT_S * len(levels),
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
        with np.load(target) as kept:
            cpu = 1e6 * float(kept["seconds"]) / sum(len(p.times) for _, p in given)
            for number in range(len(levels)):
                yield pl.concat(
                    _table(folder.name, tag, p, kept[f"positions_{number}_{k}"],
                           kept.get(f"covariances_{number}_{k}"))
                    for k, (tag, p) in enumerate(given)
                ), cpu  # fmt: skip


def _table(recording: str, tag: str, p: Any, positions: np.ndarray, P: np.ndarray | None) -> pl.DataFrame:
    """The last estimate of each time, with the columns of `track`."""
    last, d = np.flatnonzero(np.append(np.diff(p.times) > 0, True)), p.d
    columns: dict[str, Any] = {"recording": recording, "t_s": p.times[last], "tag": tag}
    columns |= dict(zip(("x_m", "y_m", "z_m"), p.place(positions)[last].T, strict=True))
    nothing = np.full((len(last), d, d), np.nan)
    P = nothing if P is None else P[last]
    columns |= {f"std_{a}_m": np.sqrt(P[:, k, k]) if k < d else np.zeros(len(last)) for k, a in enumerate("xyz")}
    pairs = (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
    columns |= {f"cov_{ab}_m2": P[:, i, j] if j < d else np.full(len(last), np.nan) for ab, i, j in pairs}
    return pl.DataFrame(columns)


def scored(table: pl.DataFrame, folder: RecordingFolder) -> tuple[dict[str, Any], Any]:
    """RMSE, m or rad, share inside 95 %, NEES/dof and share of rows with an estimate; and the errors by track."""
    association = associate_truth(table, {folder.name: folder.tables["truth"]})
    stations = {folder.name: folder.rig.stations}
    metrics = evaluate_association(association, stations).overall
    error = "rmse_m" if "rmse_m" in metrics else "rmse_direction_rad"
    row = {"rmse": metrics[error], "p95": metrics[error.replace("rmse", "p95")], "inside": metrics["coverage_95"],
           "nees": metrics["nees_ratio"], "estimated": metrics["n"] / metrics["n_rows"]}  # fmt: skip
    return row, errors_by_track(association, score(association, stations))


@cache
def levels_of(name: str, kind: str) -> Levels:
    """The levels of an estimator, from the file or by the search."""
    file = EVIDENCE / "peer-levels.csv"
    known = pl.read_csv(file) if file.exists() else pl.DataFrame()
    if len(known) and len(found := known.filter(estimator=name, kind=kind)):
        return float(found["acceleration"][0]), float(found["reading"][0])
    grid, names = list(GRID.get(kind, USUAL)), [x for x in DEVELOPMENT[kind] if x in data.places()]

    def logs(pairs: Sequence[Levels]) -> np.ndarray:
        """Mean logarithms (pairs, 2) of RMSE and NEES/dof over the development recordings."""
        sums = []
        for recording in names:
            folder = data.folder_of(recording, SEARCHED)
            rows = [scored(table, folder)[0] for table, _ in peer(name, folder, pairs)]
            sums.append([[np.log(r["rmse"] or np.inf), np.log(r["nees"] or np.nan)] for r in rows])
        return np.asarray(np.mean(sums, axis=0))

    of_grid = logs(grid)
    best = int(np.nanargmin(of_grid[:, 0]))
    scale = float(np.exp(0.5 * of_grid[best, 1]))
    pair = (grid[best][0] * scale, grid[best][1] * scale)
    row = {"estimator": name, "kind": kind, "acceleration": pair[0], "reading": pair[1], "scale": scale,
           "tried": len(grid), "recordings": len(names)}  # fmt: skip
    _write(file, pl.concat([known, pl.DataFrame([row])], how="diagonal"))
    return pair


def estimated(name: str, folder: RecordingFolder) -> tuple[pl.DataFrame, float]:
    """The estimates of an estimator, and the processor time of a reading, µs; ours of a second run."""
    if name in (OURS, SMOOTHED):
        tracker = data.tracker_of(folder)
        tracker = tracker.smoothing() if name == SMOOTHED else tracker
        tracker.run(folder)
        began = time.process_time()
        table = tracker.run(folder).to_polars()
        given = sum(len(p.times) for _, p in data.problems(folder)) or len(table)
        return table, 1e6 * (time.process_time() - began) / given
    kind = next(data.problems(folder))[1].kind
    if name == OPTIMUM:
        _, _, acceleration, reading = data.WORLDS[folder.name]
        return next(peer("numpy-ekf", folder, [(acceleration, reading)]))
    return next(peer(name, folder, [levels_of(name, kind)]))


def rows_of(recording: str) -> Iterator[dict[str, Any]]:
    """A row for each estimator on one data set."""
    folder = data.folder_of(recording)
    seen = {x for names in DEVELOPMENT.values() for x in names}
    group = "worlds" if recording in data.WORLDS else "development" if recording in seen else "unseen"
    mine: dict[str, Any] = {}
    with_peers = next(data.problems(folder), None) is not None
    for name in (OURS, SMOOTHED, *(ESTIMATORS if with_peers else ()), *((OPTIMUM,) if group == "worlds" else ())):
        library = ESTIMATORS[name].library if name in ESTIMATORS else ""
        if library and find_spec(library) is None:
            notice(f"notice: {name}: {library} is not installed; left out; pip install 'trackwright[peers]'")
            continue
        row: dict[str, Any] = {"data set": recording, "group": group, "estimator": name}
        try:
            table, cpu = estimated(name, folder)
            figures, mine[name] = scored(table, folder)
            row |= figures | {"cpu_us": cpu, "failed": ""}
            ours = SMOOTHED if name in ESTIMATORS and ESTIMATORS[name].later else OURS
            if name not in (OURS, SMOOTHED) and (paired := paired_differences(mine[ours], mine[name], ["rmse_m"])):
                row |= {"less_ours_low": paired["rmse_m"].low, "less_ours_high": paired["rmse_m"].high}
        except Exception as error:  # A library may raise anything.
            row["failed"] = f"{type(error).__name__}: {error}"
        yield row


def main(*, page: Path = PAGE) -> int:
    """Run what is not in docs/evidence yet, and write the tables of the page.

    Args:
        page: the page whose tables are replaced.
    """
    file, names = EVIDENCE / "side-by-side.csv", [*data.places(), *data.WORLDS]
    table = pl.read_csv(file) if file.exists() else pl.DataFrame()
    missing = [x for x in names if not len(table) or x not in table["data set"]]
    with progress("benchmark", len(missing)) as advance:
        for name in missing:
            table = pl.concat([table, pl.DataFrame(list(rows_of(name)))], how="diagonal_relaxed")
            _write(file, table)
            advance(1, name)
    replace_tables(page, "make benchmark", "\n".join(markdown(t) for t in (headline(table), errors(table))))
    print(f"wrote {file} and {page}")
    return 0


def headline(table: pl.DataFrame) -> list[tuple[str, ...]]:
    """For each group of data sets, how often every estimator is worse than ours, not told apart, or better."""
    groups = ("development", "unseen", "worlds")
    lines = [("estimator", *(f"{g}: ours better, equal, worse" for g in groups), "NEES/dof on unseen", "µs a reading")]
    for name in [OURS, SMOOTHED, *ESTIMATORS]:
        mine = table.filter(estimator=name)
        told = []
        for group in groups if name in ESTIMATORS else ():
            part = mine.filter(group=group)
            better = part.filter((pl.col("less_ours_low") > 0) | (pl.col("failed") != "")).height
            worse = part.filter(pl.col("less_ours_high") < 0).height
            told.append(f"{better}, {part.height - better - worse}, {worse}")
        nees = mine.filter(pl.col("group") == "unseen")["nees"].drop_nulls().log().mean()
        median = mine["cpu_us"].median()
        lines.append((name, *(told or ("",) * 3), "" if nees is None else f"{np.exp(nees):.2f}", f"{median:.1f}"))
    return lines


def errors(table: pl.DataFrame) -> list[tuple[str, ...]]:
    """The RMSE of every estimator, m or rad; with NEES per degree of freedom in brackets."""
    names = [n for n in (OURS, SMOOTHED, *ESTIMATORS, OPTIMUM) if n in table["estimator"]]
    lines = [("data set", "group", *names)]
    for (recording, group), part in table.group_by("data set", "group", maintain_order=True):
        of = {r["estimator"]: r for r in part.to_dicts()}
        cells = (_cell(of.get(n)) for n in names)
        lines.append((str(recording), str(group), *cells))
    return lines


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    if row["failed"] or row["rmse"] is None:
        return "failed"
    return f"{row['rmse']:.3f}" + ("" if row["nees"] is None else f" ({row['nees']:.2f})")


def _write(file: Path, table: pl.DataFrame) -> None:
    file.parent.mkdir(exist_ok=True)
    atomic_write(file, lambda path: path.write_bytes(table.write_csv(float_precision=6).encode()))


if __name__ == "__main__":
    run_alone(main, "make benchmark")
