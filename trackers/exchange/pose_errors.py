"""Estimates of any program against true paths: alignment, association, APE and RPE as evo defines them, and metrics."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import span
from trackwright.trackers.core.errors import UnusableInput, listed, require
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.evaluate import Evaluation, evaluate
from trackwright.trackers.exchange.trajectories import Poses, Similarity, poses_of, read_trajectory
from trackwright.trackers.recordings.checks.rules import check_units
from trackwright.trackers.recordings.folder import RecordingFolder, Selection, read_recordings
from trackwright.trackers.recordings.tracks_table import is_bearing, read_tracks

Alignment = Literal["none", "se2", "se3", "sim3", "scale", "origin"]
Statistics = dict[str, float]
ALIKE = 0.3  # the least correlation of aligned positions with the true ones from which an alignment is taken
STEPS = ("1m", "1s")


def alignment(kind: Alignment, estimate: Poses, truth: Poses, name: str = "estimate") -> Similarity:
    """The map of least squares from poses to true ones, row k to row k (Umeyama 1991); or UnusableInput.

    `se2`: in the plane; `scale`: the scale of `sim3` alone; `origin`: the first pose on the first true pose.
    """
    require(kind in get_args(Alignment), "align", kind, f"one of {', '.join(get_args(Alignment))}")
    x, y, rotation, translation = estimate.positions, truth.positions, np.eye(3), np.zeros(3)
    axes, n = (2 if kind == "se2" else 3), len(x)
    if kind == "none":
        return Similarity(rotation, translation, flat=True)
    if axes == 3 and not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise UnusableInput(f"{name}: it or its truth has no height; expected x, y, z for --align {kind}; use se2")
    if kind == "origin":
        if estimate.attitudes is not None and truth.attitudes is not None:
            rotation = (truth.attitudes[0] * estimate.attitudes[0].inv()).as_matrix()
        return Similarity(rotation, y[0] - rotation @ x[0])
    x, y = x[:, :axes], y[:, :axes]
    from_x, from_y = x - x.mean(axis=0), y - y.mean(axis=0)
    u, d, v = np.linalg.svd(from_y.T @ from_x / n)
    signs = np.ones(axes)
    signs[-1] = -1.0 if np.linalg.det(u) * np.linalg.det(v) < 0 else 1.0
    # A tag at rest turns as the noise of its positions does, which does not follow the truth.
    still = n * (d * signs).sum() <= ALIKE * np.linalg.norm(from_x) * np.linalg.norm(from_y)
    if still or np.count_nonzero(d > np.finfo(float).eps) < axes - 1:
        found = f"{name}: its {n} poses lie on a line, or do not move with the truth"
        fix = "use --align none, or origin where heights are known"
        raise UnusableInput(f"{found}, so that --align {kind} finds no rotation; expected motion; {fix}")
    scale = float((d * signs).sum() / ((from_x**2).sum() / n)) if kind in ("sim3", "scale") else 1.0
    if kind != "scale":
        rotation[:axes, :axes] = (u * signs) @ v
        translation[:axes] = y.mean(axis=0) - scale * rotation[:axes, :axes] @ x.mean(axis=0)
    return Similarity(rotation, translation, scale, flat=kind == "se2")


def associate(estimate: np.ndarray, truth: np.ndarray, tolerance: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """The rows whose times belong together: for each of the fewer the nearest of the others within `tolerance`, s."""
    longer = len(estimate) > len(truth)
    nearest, apart = _nearest(*((estimate, truth) if longer else (truth, estimate)))
    kept = np.flatnonzero(apart <= tolerance)
    return (nearest[kept], kept) if longer else (kept, nearest[kept])


def _nearest(ordered: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The row of the nearest of sorted numbers to each wanted one, the first of equal ones; and how far it is."""
    after = np.searchsorted(ordered, wanted)
    rows = np.clip(np.stack([after - 1, after]), 0, len(ordered) - 1)
    rows = np.searchsorted(ordered, ordered[rows])
    apart = np.abs(ordered[rows] - wanted)
    return np.where(apart[0] <= apart[1], rows[0], rows[1]), apart.min(axis=0)


def step_of(text: str) -> tuple[str, float, str]:
    """The name, size and unit of a step as `1m` (along the path), `0.5s` or `10f` (rows); else raises UnusableInput."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*([msf])", text.strip())
    if match is None or float(match[1]) == 0 or (match[2] == "f" and float(match[1]) % 1):
        raise UnusableInput(f"--rpe {text!r}; expected a step such as 1m, 0.5s or 10f (rows), above zero")
    return f"{float(match[1]):g}{match[2]}", float(match[1]), match[2]


def _pairs(poses: Poses, size: float, unit: str) -> tuple[np.ndarray, np.ndarray]:
    """First and last rows of the relative errors, each from the end of the one before."""
    metres, seconds = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1), np.diff(poses.times)
    # Ten times 0.1 s, rounded, are a second.
    ends, since, wanted = [0], 0.0, size * (1 - 1e-9) if unit == "s" else size
    for row, length in enumerate({"m": metres, "s": seconds, "f": np.ones_like(seconds)}[unit].tolist(), 1):
        since += length
        if since >= wanted:
            ends.append(row)
            since = 0.0
    return np.array(ends[:-1], int), np.array(ends[1:], int)


def statistics(errors: np.ndarray) -> Statistics:
    """The statistics of errors (n,), n > 0, under the names that evo gives them."""
    squares = float(np.sum(errors**2))
    named = {name: float(getattr(np, name)(errors)) for name in ("mean", "median", "std", "min", "max")}
    return {"n": len(errors), "rmse": math.sqrt(squares / len(errors))} | named | {"sse": squares}


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Statistics of absolute errors (`ape`) and of relative ones by step (`rpe`) of a track.

    `pairs`: poses with a true one, of `possible`, the length of the shorter trajectory. `planar`: a height is unknown,
    so that errors are horizontal. `time_offset`, s, and `similarity` lead from the estimate to the table `aligned`.
    """

    pairs: int
    possible: int
    planar: bool
    time_offset_s: float
    time_tolerance_s: float
    similarity: Similarity
    aligned: pl.DataFrame
    ape_m: Statistics
    ape_rad: Statistics | None
    rpe_m: Mapping[str, Statistics]
    rpe_rad: Mapping[str, Statistics]
    recording: str = ""
    tag: str = ""

    def to_dict(self) -> dict[str, Any]:
        """All of it in plain numbers, for JSON; the angles in rad."""
        s, plain = self.similarity, {k: v for k, v in vars(self).items() if k not in ("similarity", "aligned")}
        return plain | {"alignment": {"rotation": s.rotation, "translation_m": s.translation, "scale": s.scale}}


def compare_trajectories(
    estimate: pl.DataFrame,
    truth: pl.DataFrame,
    align: Alignment = "none",
    time_offset: float = 0.0,
    tolerance: float = 0.01,
    rpe: Sequence[str] = STEPS,
    *,
    name: str = "estimate",
) -> TrajectoryErrors:
    """The errors of an estimated trajectory, as evo defines them: of poses at most `tolerance`, s, apart.

    Tables of one tag with t_s, x_m, y_m and, where known, z_m, qw … qz. `align`: see `alignment`. `time_offset`: s,
    added to the times of the estimate. `rpe`: steps as 1m, 1s or 10f (rows). Relative errors are of displacements in
    the frame of the truth, with attitudes in the body's.
    Raises UnusableInput where nothing fits.
    """
    steps = [step_of(text) for text in rpe]
    require(tolerance >= 0, "tolerance", tolerance, "a time of zero or more, s")
    own, true = (poses_of(table, what) for table, what in ((estimate, name), (truth, f"truth of {name}")))
    times = own.times + time_offset
    rows, true_rows = associate(times, true.times, tolerance)
    if not len(rows):
        apart = np.median(_nearest(true.times, times)[1])
        found = f"no pose lies within {tolerance:g} s of a true pose: estimates from {span(*times[[0, -1]])}"
        begins = f"a --time-offset: with {round(true.times[0] - own.times[0], 6):.16g} both begin together"
        fix = f"{begins}; or a larger --time-tolerance: half of the poses have a true one within {apart:.3g} s"
        raise UnusableInput(f"{name}: {found}, truth from {span(*true.times[[0, -1]])}; give {fix}")
    similarity = alignment(align, own.at(rows), true.at(true_rows), name)
    aligned = similarity.table(estimate).with_columns(pl.col("t_s") + time_offset)
    pair = [poses_of(aligned, name).at(rows), true.at(true_rows)]
    planar = not (np.isfinite(own.positions).all() and np.isfinite(true.positions).all())
    if planar:
        pair = [one._replace(positions=np.nan_to_num(one.positions) * [1, 1, 0]) for one in pair]
    turns = [one.attitudes for one in pair if one.attitudes is not None]
    rpe_m, rpe_rad = dict[str, Statistics](), dict[str, Statistics]()
    for step, size, unit in steps:
        first, last = _pairs(pair[0], size, unit)
        if not len(first):
            continue
        moved = [one.positions[last] - one.positions[first] for one in pair]
        if len(turns) == 2:
            moved = [turn[first].inv().apply(way) for turn, way in zip(turns, moved, strict=True)]
            estimated, of_truth = (turn[first].inv() * turn[last] for turn in turns)
            rpe_rad[step] = statistics((of_truth.inv() * estimated).magnitude())
        rpe_m[step] = statistics(np.linalg.norm(moved[0] - moved[1], axis=1))
    return TrajectoryErrors(
        len(rows), min(len(times), len(true.times)), planar, time_offset, tolerance, similarity, aligned,
        ape_m=statistics(np.linalg.norm(pair[0].positions - pair[1].positions, axis=1)),
        ape_rad=statistics((turns[0].inv() * turns[1]).magnitude()) if len(turns) == 2 else None,
        rpe_m=rpe_m, rpe_rad=rpe_rad,
    )  # fmt: skip


def pooled_names(steps: Iterable[str]) -> list[str]:
    """The names of pooled errors with relative ones over these steps."""
    return ["ape_m", *(f"rpe_{step_of(step)[0]}_m" for step in steps)]


def _pooled(errors: Sequence[TrajectoryErrors]) -> dict[str, float]:
    """Root mean squares over all tracks, for `--fail-if`: ape_m, rpe_STEP_m."""
    rows = [("ape_m", e.ape_m) for e in errors] + [(f"rpe_{s}_m", x) for e in errors for s, x in e.rpe_m.items()]
    by_name = {name: [x for n, x in rows if n == name] for name, _ in rows}
    return {name: math.sqrt(sum(x["sse"] for x in all_) / sum(x["n"] for x in all_)) for name, all_ in by_name.items()}


def read_poses(
    source: Path, truth: Sequence[Path], part: Selection, check: bool, say: Callable[[str], None]
) -> tuple[pl.DataFrame, list[RecordingFolder]]:
    """Estimates of a file or a folder of `track`, and the recordings with their truths.

    `truth`: recordings, or a trajectory file of the one tag that the estimates follow. `check`: the units of a file.
    `say` gets each notice. Raises UnusableInput.
    """
    if not truth or not (all(path.is_dir() for path in truth) or [path.is_file() for path in truth] == [True]):
        expected = "expected recording folders, or one trajectory file, that exist"
        raise UnusableInput(f"--truth: found {listed(truth) or 'none'}; {expected}")
    tracks, lines = (read_tracks(source), []) if source.is_dir() else read_trajectory(source)
    tag = part.tags[0] if len(part.tags) == 1 else None
    if truth[0].is_dir():
        folders = read_recordings(truth)
    else:
        # The truth in a file has the names of the one track that it belongs to.
        keys = [name for name in ("recording", "tag") if name in tracks.columns]
        one = part.of_estimates(tracks).select(keys).unique().rows(named=True) if "tag" in keys else [{}]
        names = {"recording": truth[0].stem, "tag": tag or "1"} | (one[0] if len(one) == 1 else {})
        table, notices = read_trajectory(truth[0])
        table = table if "tag" in table.columns else table.with_columns(tag=pl.lit(names["tag"]))
        table = table.select("^(t_s|tag|[xyz]_m|q[wxyz])$")
        rig = Rig(names["recording"])
        folders = [RecordingFolder(rig.name, truth[0], rig, {"truth": table}, tuple(notices))]
    truths = {folder.name: folder.tables["truth"] for folder in folders if "truth" in folder.tables}
    if not truths:
        raise UnusableInput(f"{truth[0]}: no truth table; expected a recording with truth, or a trajectory file")
    tags = sorted({str(one) for table in truths.values() for one in table["tag"].unique()})
    for name, known, option in (("recording", [*truths], "--truth"), ("tag", [tag] * (tag in tags) or tags, "--tag")):
        if name not in tracks.columns:
            if len(known) != 1:
                fix = f"give one of these that it follows by {option}"
                raise UnusableInput(f"{source}: names no {name}; the truth has {listed(known)}; {fix}")
            tracks = tracks.with_columns(pl.lit(known[0]).alias(name))
    tracks = part.of_estimates(tracks)
    # Beside a truth in a file there is no geometry by which estimates may be large.
    for folder in (folder for folder in folders if folder.rig.places() and check and not source.is_dir()):
        own = {"fixes": tracks.filter(pl.col("recording") == folder.name)}
        lines += [result.message for result in check_units(folder.rig, own)]
    said = [(path, line) for path, folder in zip(truth, folders, strict=True) for line in folder.notices]
    for path, line in (*said, *((source, line) for line in lines)):
        say(f"{path}: {line}")
    return tracks, folders


def compare_tracks(
    tracks: pl.DataFrame, folders: Sequence[RecordingFolder], *options: Any
) -> tuple[pl.DataFrame, list[TrajectoryErrors], Evaluation]:
    """The tracks as they are compared, the errors of each that has a truth, and the metrics with pooled errors.

    `options`: those of `compare_trajectories`. Raises UnusableInput.
    """
    if is_bearing(tracks):
        raise UnusableInput("the tracks hold bearings; expected positions; leave the trajectory options out")
    none, compared = pl.DataFrame(schema={"tag": pl.String}), list[TrajectoryErrors]()
    truths = {folder.name: folder.tables.get("truth", none) for folder in folders}
    by_track = tracks.partition_by(["recording", "tag"], as_dict=True, maintain_order=True)
    for (recording, tag), rows in by_track.items():
        truth = truths.get(str(recording), none).filter(pl.col("tag").cast(pl.String) == str(tag))
        if not truth.is_empty():
            errors = compare_trajectories(rows, truth, *options, name=f"track of tag {tag} in '{recording}'")
            compared.append(replace(errors, recording=str(recording), tag=str(tag)))
    if not compared:
        known = [f"{n}: {listed(sorted(t['tag'].unique().cast(pl.String)))}" for n, t in truths.items()]
        found = f"tracks of {listed(f'{name}, tag {tag}' for name, tag in by_track)}; truth of {listed(known)}"
        raise UnusableInput(f"no track has a truth: {found}; give the --truth of the same recording and tag")
    moved = pl.concat([errors.aligned for errors in compared])
    evaluation = evaluate(moved, folders)
    return moved, compared, replace(evaluation, overall=evaluation.overall | _pooled(compared))
