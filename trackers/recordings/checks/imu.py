"""An IMU beside gravity and the true attitude, and odometry beside the true motion: axes, signs, units and clocks.

Gravity turns in body axes by du/dt = -ω × u, whatever the heading, so that the specific force tests the axes of the
turn rates without truth. With truth, turn rates, ways and turns are readings as others, and what is true stands for
positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.changes import Change, signed_axes
from trackwright.trackers.recordings.checks.compared import MOST_OF_GROUP, Compared
from trackwright.trackers.recordings.checks.mistakes import check_against_truth
from trackwright.trackers.recordings.columns import QUATERNION, TruePaths
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import Column, Kind, Sensors, table_kinds

MOST_TAGS, MOST_ROWS, LEAST_WINDOWS, LEAST_TURN = 12, 30_000, 20, 0.05
"""Tags whose IMU is checked, and rows of each, the first ones; windows, and root mean square turn, rad, that tell."""

WINDOW_S, RATE_S, GAP_S, LEAST = 1.0, 0.1, 0.25, 0.1
"""Times, s: over which gravity turns, and ways and turns are compared; half of that of a turn rate; and between two
rows from where on no window lies across them. Least way, m, and turn, rad, of odometry that is compared."""

READ_AS = {"x, y, z, w": (3, 0, 1, 2), "z, w, x, y": (1, 2, 3, 0)}
"""How the quaternions of a truth may be written, and where their w, x, y, z stand then."""


def check_imu(recording: RecordingFolder) -> Iterator[CheckResult]:
    """Axes, units, mounting and clock of the IMU of the first tags; an attitude of the sensor's own excuses it."""
    table, truth = recording.tables["imu"], recording.tables.get("truth")
    for tag in () if {*QUATERNION} <= {*table.columns} else table["tag"].unique(maintain_order=True).head(MOST_TAGS):
        if (rows := imu_rows(table, tag)) is not None:
            known = None if truth is None else true_attitude(truth.filter(pl.col("tag") == tag))
            found = [] if known is None else [*_against_attitude(tag, rows, known)]
            for one in found or [*_by_gravity(rows), *_mounting(rows)]:
                yield CheckResult(one.level, one.where, f"tag {tag}: {one.message}")


def _by_gravity(rows: ImuRows) -> Iterator[CheckResult]:
    """An error where gravity turns in body axes otherwise than the turn rates have it, and as others would."""
    t, half, quarter = spaced(rows.times, WINDOW_S / 4), WINDOW_S / 2, WINDOW_S / 4
    before, middle, after = (
        between(rows.times, rows.pushed, at - quarter, at + quarter) / half for at in (t - half, t, t + half)
    )
    turned, change = between(rows.times, rows.turned, t - half, t + half), after - before
    # Longer turns are no longer small, and knocks are no gravity; what is unknown is neither.
    known = (np.linalg.norm(turned, axis=1) < 2.0) & (np.linalg.norm(change, axis=1) < 5.0)
    change, middle, turned = change[known], middle[known], turned[known]
    if len(turned) < LEAST_WINDOWS or np.sqrt(np.mean(turned**2)) < LEAST_TURN:
        return
    every, fits = [*signed_axes("the turn rates")], []
    for axes in every:
        x = -np.cross(turned @ axes.matrix.T, middle)
        fits.append(float(np.sum(change * x)) / max(float(np.sqrt(np.sum(change**2) * np.sum(x**2))), 1e-12))
    k = max(range(len(every)), key=lambda k: fits[k] - 0.02 * every[k].changes)  # simpler ones first
    if fits[k] >= 0.5 and fits[k] - fits[0] >= 0.4:
        also = ", or two axes of both sensors swapped" if np.array_equal(every[k].matrix, -np.eye(3)) else ""
        fit = f"{every[k].words}{also} (correlation {fits[k]:.2f}, {fits[0]:.2f} as they are)"
        message = (
            f"turn rates fit the turn of gravity in the acceleration only with {fit}; correct the axes of the gyro"
        )
        yield CheckResult("error", "imu", f"{message} or of the accelerometer")


def _mounting(rows: ImuRows) -> Iterator[CheckResult]:
    """A warning where the mean specific force does not point along z, as a level IMU's does."""
    mean = rows.pushed[-1] / (rows.times[-1] - rows.times[0])
    size = np.linalg.norm(mean)
    if size >= 1.0 and mean[2] <= 0.5 * size:
        how = "upside down" if -mean[2] > 0.5 * size else "on its side"
        x, y, z = (f"{c + 0.0:.1f}" for c in np.round(mean, 1))
        message = f"mean acceleration is ({x}, {y}, {z}) m/s²: the IMU is {how}, expected z up; turn its axes"
        yield CheckResult("warning", "imu", message)


def _against_attitude(tag: str, rows: ImuRows, attitude: Attitude) -> Iterator[CheckResult]:
    """The mistakes that the true turn rates show."""
    times, rates = attitude.rates()
    if len(times) < LEAST_WINDOWS or np.sqrt(np.mean(rates**2)) < LEAST_TURN:
        return
    from scipy.spatial.transform import Rotation

    at = rows.times[:: -(-len(rows.times) // MOST_OF_GROUP)]
    values = between(rows.times, rows.turned, at - RATE_S, at + RATE_S) / (2 * RATE_S)
    view = _view("imu", tag, [f"gyro_{axis}_radps" for axis in "xyz"], at, values, times, rates)

    def read_as(q: np.ndarray) -> TruePaths:
        return TruePaths([tag], np.array([0, len(times)]), *attitude._replace(quaternions=q).rates())

    q, turned = attitude.quaternions, lambda v, x: v._replace(positions=Rotation.from_rotvec(x).apply(v.positions))
    others = [(f"its quaternions read as {words}", read_as(q[:, order])) for words, order in READ_AS.items()]
    others += [("its quaternions inverted", read_as(q * [1.0, -1.0, -1.0, -1.0]))]
    fix = "quaternions of the truth are written or meant otherwise; correct its columns qw, qx, qy, qz"
    more = [Change(words, fix, lambda v, _, p=p: v._replace(paths=p).later(0.0)) for words, p in others]  # type: ignore[misc]
    fix = "axes of the gyro, and of the accelerometer where both share one chip; correct them"
    for axes in [*signed_axes("the turn rates")][1:]:
        of = "mounting" if np.linalg.det(axes.matrix) > 0 else ""
        more.append(Change(axes.words, fix, lambda v, _, m=axes.matrix: v._replace(positions=v.positions @ m.T), of=of))  # type: ignore[misc]
    fix = "the IMU is mounted at an angle to the body axes of the truth's attitude"
    small, large = lambda _: [1e-3 * np.ones(3)], lambda x: np.linalg.norm(x) > 0.35
    more.append(Change("the body axes turned", fix, turned, False, small, large, of="mounting"))
    yield from check_against_truth(view, more=more)


def _view(
    name: str, tag: str, columns: list[str], at: np.ndarray, values: np.ndarray, times: np.ndarray, true: np.ndarray
) -> Compared:
    """Readings at times `at` beside true values, which stand for positions."""
    paths = TruePaths([tag], np.array([0, len(times)]), times, np.pad(true, ((0, 0), (0, 3 - true.shape[1]))))
    known = np.isfinite(values).all(axis=1)
    at, values, count = at[known], values[known], len(columns)
    large = 0.15 * float(np.nanmedian(np.linalg.norm(true, axis=1))) / np.sqrt(count)
    kind = Kind(
        name, tuple(Column(c, 0.0, large, large / 8) for c in columns), (), lambda p, _: p[:, :count], averaged=True
    )
    none = Sensors(
        np.zeros((len(at), 0), int), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, count, 2)), np.zeros(0)
    )
    zero = np.zeros(len(at), int)
    view = Compared(
        kind, (f"{tag}",), (tag,), tuple(columns), zero, zero, at, values, np.zeros((len(at), 3)), none, paths
    )
    return (found := view.later(0.0)).of_rows(np.isfinite(found.positions).all(axis=1))


def between(
    times: Float[np.ndarray, " N"], x: Float[np.ndarray, "N k"], start: Float[np.ndarray, " n"], end: np.ndarray
) -> Float[np.ndarray, "n k"]:
    """The changes of a series `x` from `start` to `end` (n,) s; NaN outside its times and across gaps."""
    changes = np.stack([np.interp(end, times, c) - np.interp(start, times, c) for c in x.T], axis=1)
    gaps = np.concatenate([[0], np.cumsum(np.diff(times) > GAP_S)])
    first, last = np.searchsorted(times, start, side="right") - 1, np.searchsorted(times, end)
    inside = (first >= 0) & (last < len(times))
    inside &= gaps[np.maximum(first, 0)] == gaps[np.minimum(last, len(gaps) - 1)]
    changes[~inside] = np.nan
    return changes


def spaced(times: Float[np.ndarray, " N"], step: float) -> Float[np.ndarray, " n"]:
    """Times, s, that are a multiple of `step` apart, near those given: no more than these, however long the gaps."""
    return np.unique(np.floor(times / step)) * step


class ImuRows(NamedTuple):
    """`times` (N,) s, and integrals over time: of specific force (N, 3) m/s and of the turn rate (N, 3) rad."""

    times: Float[np.ndarray, " N"]
    pushed: Float[np.ndarray, "N 3"]
    turned: Float[np.ndarray, "N 3"]


def imu_rows(table: pl.DataFrame, tag: str) -> ImuRows | None:
    """The whole rows of a tag; None with fewer than ten."""
    columns = table_kinds()["imu"].layout(table.columns).values
    rows = table.filter(pl.col("tag") == tag).select("t_s", *columns).drop_nulls().unique("t_s", keep="first")
    rows = rows.sort("t_s").head(MOST_ROWS)
    if len(rows) < 10:
        return None
    t, x = rows["t_s"].to_numpy(), rows.select(columns).to_numpy()
    areas = (x[1:] + x[:-1]) / 2 * np.diff(t)[:, None]
    sums = np.concatenate([np.zeros((1, 6)), np.cumsum(areas, axis=0)])
    return ImuRows(t, sums[:, :3], sums[:, 3:])


class Attitude(NamedTuple):
    """The true attitude of a tag: `times` (N,) s, `quaternions` (N, 4) w, x, y, z, from body to world."""

    times: Float[np.ndarray, " N"]
    quaternions: Float[np.ndarray, "N 4"]

    def rates(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Turn rates (n, 3), rad/s in body axes, and the times (n,), s, about which they are taken."""
        from scipy.spatial.transform import Rotation  # a tenth of a second, and few recordings have attitudes

        after = np.minimum(np.searchsorted(self.times, self.times + 2 * RATE_S * 0.999), len(self.times) - 1)
        span = self.times[after] - self.times
        known = (span > 0) & (span < GAP_S)
        a, b = (Rotation.from_quat(q[known], scalar_first=True) for q in (self.quaternions, self.quaternions[after]))
        return (self.times + span / 2)[known], (a.inv() * b).as_rotvec() / span[known, None]


def true_attitude(truth: pl.DataFrame) -> Attitude | None:
    """The attitude in the truth of one tag; None without quaternions."""
    if "qw" not in truth.columns:
        return None
    rows = truth.select("t_s", *QUATERNION).drop_nulls().unique("t_s", keep="first").sort("t_s").head(MOST_ROWS)
    q = rows.select(QUATERNION).to_numpy()
    return Attitude(rows["t_s"].to_numpy(), q / np.linalg.norm(q, axis=1, keepdims=True)) if len(rows) > 10 else None


def check_odometry(recording: RecordingFolder) -> Iterator[CheckResult]:
    """Mistakes that the true ways and turns of a second show, of tags on the axle; turns are those of the motion.

    Where the truth has headings, the ways are along them and have a sign.
    """
    rows, paths, columns, half = (
        recording.rows("odometry"),
        recording.paths,
        table_kinds()["odometry"].layout(()).values,
        WINDOW_S / 2,
    )
    values = rows.floats(columns)
    for tag, first, end in zip(rows.tags, rows.starts[:-1], rows.starts[1:], strict=True):
        known, whole = recording.rig.tags.get(tag), first + np.flatnonzero(np.isfinite(values[first:end]).all(axis=1))
        aside = 0.0 if known is None or known.offset is None else float(np.hypot(*known.offset[:2]))
        if tag not in paths.number or aside > LEAST or len(whole) < LEAST_WINDOWS:
            continue
        begin, end = paths.of_tag(tag)[0][[0, -1]].tolist()
        times, at = rows.times[whole], np.arange(begin, end, half / 2)
        sums = np.cumsum(values[whole] * np.append(0.0, np.minimum(np.diff(times), 1.0))[:, None], axis=0)
        after, before = ([np.interp(at + h, times, s, np.nan, np.nan) for s in sums.T] for h in (half, -half))
        x, every = np.subtract(after, before), np.array([0, len(at)])
        places = [paths.at([tag], every, at + half * k)[0].T for k in range(-2, 3)]
        east, north, _ = np.stack(places, axis=1)
        steps = np.diff(east + 1j * north, axis=0)
        heading = np.exp(1j * paths.headings_at([tag], every, at))
        way, turn = steps[1] + steps[2], np.angle((steps[2] + steps[3]) * (steps[0] + steps[1]).conj())
        along = (way * heading.conj()).real
        signed = bool(np.nansum(np.abs(along)) > 0.7 * np.nansum(np.abs(way))) and np.isfinite(along).any()
        y = [along if signed else np.abs(way), np.where((np.abs(turn) < 1.0) & (np.abs(way) > LEAST), turn, np.nan)]
        for column, measured, true in zip(columns, x if signed else [np.abs(x[0]), x[1]], y, strict=True):
            part = np.isfinite(true) & (np.abs(true) > LEAST)
            if part.sum() >= LEAST_WINDOWS:
                view = _view("odometry", tag, [column], at[part], measured[part, None], at[part], true[part, None])
                for found in check_against_truth(view):
                    yield CheckResult(found.level, found.where, f"tag {tag}, {column}: {found.message}")
