"""Trajectories as tables of poses: files, alignment, and errors as evo defines them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from trackwright.trackers.core.errors import UnusableInput, counted, listed, require, span
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.evaluate import Evaluation, evaluate
from trackwright.trackers.evaluation.rows import AXES
from trackwright.trackers.exchange.mapping import refuse_lost_digits, without_identities
from trackwright.trackers.exchange.text_tables import Reading, numbers_of, read_rows
from trackwright.trackers.recordings import tables as table_times
from trackwright.trackers.recordings.columns import QUATERNION, float_column
from trackwright.trackers.recordings.files import write_whole
from trackwright.trackers.recordings.folder import RecordingFolder, Selection, read_recording, read_recordings
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.tables import SUFFIXES, TableFile, check_stds, first_row, read_table_file
from trackwright.trackers.recordings.tracks_table import is_bearing, read_tracks

TUM = ("t_s", *AXES, *QUATERNION[1:], QUATERNION[0])
_TEXT = ("recording", "tag", "station", "status", "wrapped")
_NUMBER = re.compile(r"t_s|q[wxyz]|nis(_dof)?|log_likelihood|v[xyz]_mps|(std_)?([xyz]_m|\w+_rad)|cov_(xy|xz|yz)_m2")


class Poses(NamedTuple):
    """`times` (n,) s, in order, `positions` (n, 3) m, the height NaN where unknown, and attitudes, or None."""

    times: np.ndarray
    positions: np.ndarray
    attitudes: Rotation | None

    def at(self, rows: np.ndarray) -> Poses:
        """The poses of these rows."""
        return Poses(self.times[rows], self.positions[rows], None if self.attitudes is None else self.attitudes[rows])


def usable_rows(table: pl.DataFrame) -> pl.DataFrame:
    """The rows with a time and a position over the floor, in the order of time."""
    return table.filter(pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite())).sort("t_s", maintain_order=True)


def poses_of(table: pl.DataFrame, name: str) -> Poses:
    """The usable poses of a table of one tag, with attitudes where all rows have one; raises UnusableInput for none."""
    rows = usable_rows(table)
    if rows.is_empty():
        raise UnusableInput(f"{name}: no pose; expected rows with t_s, x_m, y_m and, where known, z_m, qw … qz")
    q = stacked(rows, QUATERNION)
    if (wrong := np.abs((q**2).sum(axis=1) - 1) > 0.1).any():
        raise UnusableInput(f"{name}: pose {np.argmax(wrong) + 1} has no quaternion of length 1; leave it out")
    attitudes = Rotation.from_quat(q, scalar_first=True) if np.isfinite(q).all() else None
    return Poses(float_column(rows, "t_s"), stacked(rows, AXES), attitudes)


def stacked(table: pl.DataFrame, names: Sequence[str]) -> np.ndarray:
    """Columns as an array (n, m), NaN where a value or a column is missing."""
    return np.stack([float_column(table, name) for name in names], axis=1)


@dataclass(frozen=True, eq=False)
class Similarity:
    """A map of space: p → `scale` · `rotation` p + `translation`, m."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def table(self, tracks: pl.DataFrame) -> pl.DataFrame:
        """The image of a table of poses; unknown heights stay so. A move leaves velocities and covariances out."""
        if np.array_equal(self.scale * self.rotation, np.eye(3)) and not self.translation.any():
            return tracks
        p, q = stacked(tracks, AXES), stacked(tracks, QUATERNION)
        moved = np.where(np.isnan(p), p, self.scale * np.nan_to_num(p) @ self.rotation.T + self.translation)
        known = np.isfinite(q).all(axis=1)
        turned = Rotation.from_matrix(self.rotation) * Rotation.from_quat(q[known], scalar_first=True)
        q[known] = turned.as_quat(canonical=True, scalar_first=True)
        kept = tracks.select(pl.exclude("^(std_.*|cov_.*|v[xyz]_mps|heading_rad)$"))
        columns = zip((*AXES, *QUATERNION), (*moved.T, *q.T), strict=True)
        return kept.with_columns(pl.Series(n, x).fill_nan(None) for n, x in columns if n in kept.columns)


def read_tum(path: Path) -> TableFile:
    """The columns of a TUM file as texts; # begins a comment. Raises UnusableInput with file and line."""
    file, _ = read_rows(path, Reading(separator=" ", header="none"))
    counts = file.frame.select(pl.sum_horizontal(pl.all().is_not_null())).to_series()
    if (counts != len(TUM)).any():
        row = first_row(counts != len(TUM))
        where = file.location(row, f"column{counts[row]}")
        raise UnusableInput(f"{where}, the last; expected 8 numbers: time, s, x, y, z, m, quaternion x, y, z, w")
    return replace(file, frame=file.frame.rename(dict(zip(file.frame.columns, TUM, strict=True))))


def read_trajectory(path: Path | str) -> tuple[pl.DataFrame, list[str]]:
    """The poses in a TUM file, or a table with columns that `track` writes, by time, and notices; or UnusableInput."""
    is_table = Path(path).name.lower().endswith(SUFFIXES)
    file = read_table_file(Path(path)) if is_table else read_tum(Path(path))
    columns = file.frame.columns
    if missing := {"t_s", "x_m", "y_m", *({"std_x_m", "std_y_m"} if "std_x_m" in columns else ())} - {*columns}:
        fix = "expected also z_m, std_x_m …, qw … qz where known; bring it into this form by `trackwright import`"
        raise UnusableInput(f"{path}: no column {listed(sorted(missing))}; found {listed(columns, 12)}; {fix}")
    used = [name for name in columns if name in _TEXT or _NUMBER.fullmatch(name)]
    if spreads := [name for name in columns if name not in used and re.search("std|sigma|cov|var", name.lower())]:
        expected = "expected std_x_m, std_y_m, std_z_m and cov_xy_m2, cov_xz_m2, cov_yz_m2; rename or remove it"
        raise UnusableInput(f"{path}: unknown column {spreads[0][:40]!r}, {expected}")
    table = file.frame.select(pl.col(n).cast(pl.String) if n in _TEXT else numbers_of(file, n) for n in used)
    file.refuse(table["t_s"].is_null(), "t_s", "seconds; remove the row")
    # The standard deviation of a known height is 0.
    reported = table.select(pl.col("^std_.*$").replace(0.0, None))
    check_stds(file, reported, reported.columns)
    table, notices = without_identities(table)
    notices += [f"columns not used: {listed(sorted({*columns} - {*used}), 12)}"] * (len(used) < len(columns))
    keys, tracks = [name for name in ("recording", "tag", "station") if name in columns], list[pl.DataFrame]()
    for rows in table.partition_by(keys, maintain_order=True) if keys else [table]:
        straight, said = table_times.unwrapped(rows, keys)
        times = straight["t_s"].to_numpy()
        tracks.append(straight.sort("t_s", maintain_order=True))
        refuse_lost_digits(f"{path}", tracks[-1])
        if (at := table_times.restarted_at(times)) is not None:
            found = f"pose {at + 1}: {times[at]:.3f} s after {times[:at].max():.3f} s: the clock went back"
            raise UnusableInput(f"{path}: {found}; expected times that increase; make two files of it")
        late, again = int((np.diff(times) < 0).sum()), rows.height - straight["t_s"].n_unique()
        notices += said + [f"rows earlier than the previous row: {late}; sorted"] * bool(late)
        notices += [f"rows with the time of another row: {again}; remove repeats"] * bool(again)
    return pl.concat(tracks), notices


def write_trajectory(table: pl.DataFrame, path: Path | str) -> Path:
    """Writes the usable poses of one tag as TUM; an unknown height is 0, an unknown attitude the identity."""
    numbers = np.nan_to_num(stacked(usable_rows(table), TUM))
    numbers[:, 7] = np.where(numbers[:, 4:].any(axis=1), numbers[:, 7], 1.0)
    return write_whole(Path(path), "".join(" ".join(map(repr, row)) + "\n" for row in numbers.tolist()))


def export_tracks(
    run: Path, format: Literal["tum", "csv"], out: Path, tag: str | None = None, force: bool = False
) -> str:
    """Exports the tracks in a folder of `track`, or the truth of a recording, in TUM one alone; what it wrote."""
    recording = read_recording(run) if (run / RIG_FILE).is_file() else None
    table = read_tracks(run) if recording is None else recording.tables.get("truth")
    if table is None:
        raise UnusableInput(f"{run}: has no truth table; expected a folder of `track`, or a recording with truth")
    table = Selection(() if tag is None else (tag,)).of_estimates(table)
    table = table if recording is None else table.with_columns(recording=pl.lit(recording.name))
    if out.exists() and not force:
        raise UnusableInput(f"--out {out}: exists; expected a new file; --force replaces it")
    if format == "csv":
        return f"wrote {write_whole(out, table.write_csv())}: {counted(len(table), 'row')}"
    if is_bearing(table) or (tracks := usable_rows(table)).select("recording", "tag").n_unique() != 1:
        raise UnusableInput(f"{run}: expected the positions of one track; choose it by --tag, or --format csv")
    return f"wrote {write_trajectory(tracks, out)}: {counted(len(tracks), 'pose')}"


Alignment = Literal["none", "se2", "se3", "sim3", "scale", "origin"]
Statistics = dict[str, float]
# The least correlation of positions with the true ones from which an alignment is taken; steps of relative errors.
ALIKE, STEPS = 0.3, ("1m", "1s")


def alignment(kind: Alignment, estimate: Poses, truth: Poses, name: str = "estimate") -> Similarity:
    """The map of least squares from poses to true ones, row by row (Umeyama 1991), as evo's; `se2`: in the plane."""
    require(kind in get_args(Alignment), "align", kind, f"one of {', '.join(get_args(Alignment))}")
    x, y, rotation, translation = estimate.positions, truth.positions, np.eye(3), np.zeros(3)
    axes, n = (2 if kind == "se2" else 3), len(x)
    if kind == "none":
        return Similarity(rotation, translation)
    if axes == 3 and not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise UnusableInput(f"{name}: it or its truth has no height; expected x, y, z for --align {kind}; use se2")
    if kind == "origin":
        if estimate.attitudes is not None and truth.attitudes is not None:
            rotation = (truth.attitudes[0] * estimate.attitudes[0].inv()).as_matrix()
        return Similarity(rotation, y[0] - rotation @ x[0])
    x, y = x[:, :axes], y[:, :axes]
    from_x, from_y = x - x.mean(axis=0), y - y.mean(axis=0)
    u, d, v = np.linalg.svd(from_y.T @ from_x / n)
    signs = np.append(np.ones(axes - 1), -1.0 if np.linalg.det(u) * np.linalg.det(v) < 0 else 1.0)
    # A tag at rest turns as the noise of its positions does, which does not follow the truth.
    still = n * (d * signs).sum() <= ALIKE * np.linalg.norm(from_x) * np.linalg.norm(from_y)
    if still or np.count_nonzero(d > np.finfo(float).eps) < axes - 1:
        found = f"{name}: its {n} poses lie on a line, or do not move with the truth, so that --align {kind} finds no"
        raise UnusableInput(f"{found} rotation; expected motion; use --align none, or origin where heights are known")
    scale = float((d * signs).sum() / ((from_x**2).sum() / n)) if kind in ("sim3", "scale") else 1.0
    if kind != "scale":
        rotation[:axes, :axes] = (u * signs) @ v
        translation[:axes] = y.mean(axis=0) - scale * rotation[:axes, :axes] @ x.mean(axis=0)
    return Similarity(rotation, translation, scale)


def associate(estimate: np.ndarray, truth: np.ndarray, tolerance: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """The rows whose times belong together: for each of the fewer the nearest of the others within `tolerance`, s."""
    longer = len(estimate) > len(truth)
    ordered, wanted = (estimate, truth) if longer else (truth, estimate)
    after = np.searchsorted(ordered, wanted)
    rows = np.clip(np.stack([after - 1, after]), 0, len(ordered) - 1)
    rows = np.searchsorted(ordered, ordered[rows])  # the first of equal times
    apart = np.abs(ordered[rows] - wanted)
    nearest, kept = np.where(apart[0] <= apart[1], *rows), np.flatnonzero(apart.min(axis=0) <= tolerance)
    return (nearest[kept], kept) if longer else (kept, nearest[kept])


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
    """Statistics of absolute errors (`ape`) and of relative ones by step (`rpe`) of `pairs` of `possible` poses.

    `planar`: a height is unknown, so that errors are horizontal. `aligned`: the table of estimates as compared.
    """

    pairs: int
    possible: int
    planar: bool
    time_offset_s: float
    time_tolerance_s: float
    alignment: Similarity
    aligned: pl.DataFrame
    ape_m: Statistics
    ape_rad: Statistics | None
    rpe_m: Mapping[str, Statistics]
    rpe_rad: Mapping[str, Statistics]
    recording: str = ""
    tag: str = ""

    def to_dict(self) -> dict[str, Any]:
        """All of it in plain numbers, for JSON; the angles in rad."""
        return {name: value for name, value in asdict(self).items() if name != "aligned"}


def compare_trajectories(
    estimate: pl.DataFrame, truth: pl.DataFrame, align: Alignment = "none", time_offset: float = 0.0,
    tolerance: float = 0.01, rpe: Sequence[str] = STEPS, *, name: str = "estimate",
) -> TrajectoryErrors:  # fmt: skip
    """The errors of an estimated trajectory, as evo defines them: of poses at most `tolerance`, s, apart.

    Where none are, at most half a step of the finer times. Tables of one tag with t_s, x_m, y_m and, where known, z_m,
    qw … qz. `align`: see `alignment`. `time_offset`: s, added to the times of the estimate. `rpe`: steps as 1m, 1s or
    10f (rows); relative errors are of displacements in the frame of the truth, with attitudes in the body's. Raises
    UnusableInput where nothing fits.
    """
    steps = [step_of(text) for text in rpe]
    require(tolerance >= 0, "tolerance", tolerance, "a time of zero or more, s")
    own, true = (poses_of(table, what) for table, what in ((estimate, name), (truth, f"truth of {name}")))
    times = own.times + time_offset
    rows, true_rows = associate(times, true.times, tolerance)
    if not len(rows):
        finer = min(float(np.median(np.diff(x))) if len(x) > 1 else 0.0 for x in (times, true.times))
        rows, true_rows = associate(times, true.times, tolerance := round(finer / 2 + 6e-4, 3))
    if not len(rows):
        spans = f"estimates from {span(*times[[0, -1]])}, truth from {span(*true.times[[0, -1]])}"
        alike = 0.02 < (np.ptp(times) + 1e-3) / (np.ptp(true.times) + 1e-3) < 50.0
        fix = f"give a --time-offset: with {round(true.times[0] - own.times[0], 6):.16g} both begin together"
        fix = fix if alike else "one of them looks like another unit of time; convert it to seconds"
        raise UnusableInput(f"{name}: no pose lies near in time to a true one: {spans}; {fix}")
    similarity = alignment(align, own.at(rows), true.at(true_rows), name)
    aligned = similarity.table(estimate).with_columns(pl.col("t_s") + time_offset)
    pair = [poses_of(aligned, name).at(rows), true.at(true_rows)]
    planar = not (np.isfinite(own.positions).all() and np.isfinite(true.positions).all())
    if planar:
        pair = [one._replace(positions=np.nan_to_num(one.positions) * [1, 1, 0]) for one in pair]
    turns = [one.attitudes for one in pair if one.attitudes is not None]
    rpe_m, rpe_rad = dict[str, Statistics](), dict[str, Statistics]()
    of_steps = [(step, *_pairs(pair[0], size, unit)) for step, size, unit in steps]
    for step, first, last in (one for one in of_steps if len(one[1])):
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


def read_poses(
    source: Path, truth: Sequence[Path], part: Selection, say: Callable[[str], None]
) -> tuple[pl.DataFrame, list[RecordingFolder]]:
    """Estimates of a file or a folder of `track`, and recordings with truth, or one of a trajectory file of one tag."""
    if not truth or not (all(path.is_dir() for path in truth) or [path.is_file() for path in truth] == [True]):
        found, expected = listed(truth) or "none", "recording folders, or one trajectory file, that exist"
        raise UnusableInput(f"--truth: found {found}; expected {expected}")
    tracks, lines = (read_tracks(source), []) if source.is_dir() else read_trajectory(source)
    tag = part.tags[0] if len(part.tags) == 1 else None
    if truth[0].is_dir():
        folders = read_recordings(truth)
    else:
        # The truth in a file has the names of the one track that it belongs to.
        keys = [name for name in ("recording", "tag") if name in tracks.columns]
        one = part.of_estimates(tracks).select(keys).unique().rows(named=True) if "tag" in keys else [{}]
        names = {"recording": truth[0].stem, "tag": tag or "1"} | (one[0] if len(one) == 1 else {})
        table, said = read_trajectory(truth[0])
        table = table if "tag" in table.columns else table.with_columns(tag=pl.lit(names["tag"]))
        tables, rig = {"truth": table.select("^(t_s|tag|[xyz]_m|q[wxyz])$")}, Rig(names["recording"])
        folders = [RecordingFolder(rig.name, truth[0], rig, tables, tuple(said))]
    truths = {folder.name: folder.tables["truth"] for folder in folders if "truth" in folder.tables}
    tags = sorted({str(one) for table in truths.values() for one in table["tag"].unique()})
    for name, known, option in (("recording", [*truths], "--truth"), ("tag", [tag] * (tag in tags) or tags, "--tag")):
        if name not in tracks.columns:
            if len(known) != 1:
                raise UnusableInput(f"{source}: names no {name}; the truth has {listed(known)}; give one by {option}")
            tracks = tracks.with_columns(pl.lit(known[0]).alias(name))
    for path, notices in ((source, lines), *zip(truth, (folder.notices for folder in folders), strict=True)):
        for line in notices:
            say(f"{path}: {line}")
    return part.of_estimates(tracks), folders


def compare_tracks(
    tracks: pl.DataFrame, folders: Sequence[RecordingFolder], *options: Any
) -> tuple[pl.DataFrame, list[TrajectoryErrors], Evaluation]:
    """The tracks as compared by options of `compare_trajectories`, the errors of each that has a truth, and metrics."""
    if is_bearing(tracks):
        raise UnusableInput("the tracks hold bearings; expected positions; leave the trajectory options out")
    none, compared, without = pl.DataFrame(schema={"tag": pl.String}), list[TrajectoryErrors](), list[pl.DataFrame]()
    truths = {folder.name: folder.tables.get("truth", none) for folder in folders}
    by_track = tracks.partition_by(["recording", "tag"], as_dict=True, maintain_order=True)
    for (recording, tag), rows in by_track.items():
        truth = truths.get(str(recording), none).filter(pl.col("tag").cast(pl.String) == str(tag))
        if not truth.is_empty():
            errors = compare_trajectories(rows, truth, *options, name=f"track of tag {tag} in '{recording}'")
            compared.append(replace(errors, recording=str(recording), tag=str(tag)))
        else:
            without.append(rows)
    if not compared:
        found = f"tracks of {listed(f'{name}, tag {tag}' for name, tag in by_track)}; truths of {listed(truths)}"
        raise UnusableInput(f"no track has a truth: {found}; give the --truth of the same recording, or its --tag")
    # A track that no alignment moves keeps its covariances, and one without a truth is counted.
    kept = [name for name in tracks.columns if all(name in errors.aligned.columns for errors in compared)]
    moved = pl.concat([table.select(kept) for table in (*(errors.aligned for errors in compared), *without)])
    return moved, compared, evaluate(moved, folders)
