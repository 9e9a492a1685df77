"""The most likely mistakes in a table: changes of readings, rig or truth that explain nearly all rows, ranked once.

Without truth: changes that make the readings of one moment agree, each at the position that fits them best with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations, compress, permutations, product
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.errors import listed, significant
from trackwright.trackers.recordings.checks.readings import (
    Compared,
    about_vertical,
    known_median,
    readings_of,
    robust_fit,
)
from trackwright.trackers.recordings.checks.rules import CheckResult, Level
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS

# Log ratios of errors: price of a change and of each number, least gain, and that of numbers for one sensor. Errors
# left, in those that need no explanation, and share of rows below three of these; ratio of errors from which a sensor
# is broken, share of sensors that may be broken or misplaced; errors of all that are told without an explanation.
PENALTY, GAIN, FITTED_GAIN, EXPLAINED, NEARLY, BROKEN, FEW, UNEXPLAINED = 0.06, 0.65, 1.0, 2.0, 0.75, 10.0, 0.34, 3.0
# Readings of the first search, starts that go on, ratio of errors of fits that do alike; most sensors, and the sum of
# log ratios, of an exchange. Delays: least beside a frame, most that is tracked, most that is tried.
COARSE, STARTS, ALIKE, MOST_SWAPPED, CLEAR, LEAST_CLOCK_S, LATENCY_S, LONGEST_S = 240, 5, 1.2, 32, 1.5, 0.05, 1.0, 60.0
# Without truth: moments compared, numbers of one beyond its unknowns, errors that contradict, m, by how much a change
# lowers them, how many may stay, steps to a position, anchors of which two may be swapped, and a small way, m.
MOMENTS, SPARE, CONTRADICTED, FALL, FEW_LEFT, STEPS, MOST_PAIRED, NEAR = 60, 2, 0.5, 4.0, 0.25, 12, 12, 1e-4

FACTORS = {0.001: "millimetres", 0.01: "centimetres", 0.3048: "feet", 0.0254: "inches", 1e3: "kilometres"}
# By the first column of a table, factors to its unit and what they undo.
UNITS = {
    "range_m": FACTORS | {0.3048: "feet, or nanoseconds (0.2998)", 0.5: "round-trip distances", 2.0: "halved"},
    # Some place has all differences nearly zero, so that every small factor makes errors small.
    "range_difference_m": {-1.0: "of the wrong sign", 0.2998: "nanoseconds or feet", 0.5: "doubled", 2.0: "halved"},
    "x_m": FACTORS,
}
# Orders and factors of azimuth and elevation.
ANGLES = (
    ("the sign of the azimuth flipped", [0, 1], [-1, 1]),
    ("the sign of the elevation flipped", [0, 1], [1, -1]),
    ("azimuth and elevation swapped", [1, 0], [1, 1]),
)
Numbers = Float[np.ndarray, " p"]


class Change(NamedTuple):
    """What would explain errors: `words`, after "with", and `cause`, the mistake and its fix, may have `shown` numbers.

    `apply`: the readings with it and its numbers, fitted from `starts`, those that are `free`; `each`: of one sensor.
    `least`: sizes from which one is a mistake. `of`: "offset", "place", "frame", "delay" or "height".
    """

    words: str
    cause: str
    apply: Callable[[Compared, Numbers], Compared]
    each: bool = False
    of: str = ""
    starts: Callable[[Compared], Any] = lambda _: np.zeros((1, 0))
    least: float | Sequence[float] = 0.0
    free: Sequence[int] | None = None
    shown: Callable[[Numbers], Any] = lambda x: x


class Found(NamedTuple):
    """A change, its cost, the groups (G,) that it is for, its numbers, and the sizes (G, m) that it leaves."""

    cost: float
    change: Change
    groups: np.ndarray
    numbers: list[np.ndarray]
    after: np.ndarray


def _linear(
    words: str, cause: str, field: str, factors: Any, order: Any = slice(None), of: str = "", each: bool = False
) -> Change:
    """A change of the columns of a field, in another order and multiplied."""

    def apply(v: Compared, _: Any) -> Compared:
        return v.changed(**{field: getattr(v if field in v._fields else v.sensors, field)[:, order] * factors})

    return Change(words, cause, apply, each, of)


def _conventions(view: Compared) -> Iterator[Change]:
    """Other units, signs and orders of the readings, and units of the places of their sensors."""
    kind, default = view.kind, {-1.0: "of the wrong sign"} if len(view.columns) == 1 else {}
    each = bool(kind.sensors) and not kind.difference  # the unit of a difference is a message
    for f, unit in UNITS.get(view.columns[0], default).items():
        cause = f"{kind.name} are {unit}; convert them"
        yield _linear(f"the {kind.name} multiplied by {f:g}", cause, "values", f, each=each)
    for f, unit in FACTORS.items() if kind.sensors else ():
        cause = f"rig.toml is in {unit}; convert it"
        yield _linear(f"the positions of the {kind.noun}s multiplied by {f:g}", cause, "places", f)
    cause = "angles of another convention, or the station turned; correct them"
    yield from (_linear(words, cause, "values", signs, axes, "", each) for words, axes, signs in ANGLES if kind.angles)


def _changes(view: Compared) -> Iterator[Change]:
    """All changes of the readings of a table."""
    kind = view.kind
    yield from _conventions(view)
    for f, unit in FACTORS.items():
        yield _linear(f"the truth multiplied by {f:g}", f"truth in {unit}; convert it", "positions", f)
    cause = f"the truth has other axes than {'the fixes' if kind.position else 'rig.toml'}; bring both into one frame"
    for axes, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        read = ", ".join("-" * (sign < 0) + "xyz"[k] for k, sign in zip(axes, signs, strict=True))
        of = "height" if read == "x, y, -z" else ""
        yield _linear(f"x, y, z of the truth read as {read}", cause, "positions", signs, list(axes), of)
    for one, other in combinations(sorted(view.tags) if len(view.tags) <= MOST_PAIRED else (), 2):
        words, cause = f"the truth of tags {one} and {other} exchanged", "their ids are mixed up; correct one table"
        tags = tuple({one: other, other: one}.get(tag, tag) for tag in view.tags)
        yield Change(words, cause, lambda v, _, to=tags: v._replace(tags=to).later(0.0))  # type: ignore[misc]
    yield from _exchanged(view) if kind.sensors and len(view.ids) <= MOST_SWAPPED else ()
    yield from _of_rig(view) if kind.sensors else ()
    yield from _of_truth(view)


def _of_rig(view: Compared) -> Iterator[Change]:
    """Orientations and positions of stations and anchors, and offsets of their readings."""
    from scipy.spatial.transform import Rotation

    kind = view.kind
    if kind.angles:
        cause = "another orientation than rig.toml's, or another zero of the azimuth; correct rotation_wxyz or yaw_deg"
        yaws = np.arange(-180.0, 180.0, 5.0)

        def turned(v: Compared, x: Numbers) -> Compared:
            return v.changed(axes=Rotation.from_rotvec(np.radians(x)).as_matrix() @ v.sensors.axes)

        def flipped(v: Compared, x: Numbers) -> Compared:
            return v.changed(values=v.values * [-1.0, 1.0] - [np.radians(x[0]), 0.0])

        tilts = [[x, y, yaw] for yaw in yaws for x, y in ((0, 0), (30, 0), (-30, 0), (0, 30), (0, -30))]
        words, whole = "the station turned by ({:.0f}, {:.0f}, {:.0f})° about x, y, z", lambda x: np.round(x) + 0.0
        yield Change(words, cause, turned, True, "offset", lambda _: tilts, 15.0, shown=whole)
        words = "the azimuth its sign flipped and turned by {:.0f}°"
        yield Change(words, cause, flipped, True, "", lambda _: yaws[:, None], 15.0)
    if kind.unit == "m":
        cause = f"an offset of the {kind.name}, as of an uncalibrated antenna delay; calibrate the anchors"
        words, less = f"{{:+.2f}} m subtracted from the {kind.name}", lambda v, x: v.changed(values=v.values - x)
        yield Change(words, cause, less, True, "offset", lambda v: [known_median(v.errors())], 1.0)

    def around(v: Compared) -> list[np.ndarray]:
        own = v.sensors.places[v.group[0]]
        return [own, np.median(v.sensors.places, axis=0), 2 * v.positions.mean(axis=0) - own]

    def moved(v: Compared, x: Numbers) -> Compared:
        return v.changed(places=np.where(np.arange(len(v.ids))[:, None] == v.group[0], x, v.sensors.places))

    words, cause = "its position at ({:.2f}, {:.2f}, {:.2f}) m", "a wrong position in rig.toml; measure it again"
    yield Change(words, cause, moved, True, "place", around)


def _of_truth(view: Compared) -> Iterator[Change]:
    """The place and the clock of the truth: turned by x[0] about its centre, shifted by x[1:4], and x[4] s later."""
    centre = np.nanmean(view.positions, axis=0)

    def apply(v: Compared, x: Numbers) -> Compared:
        return (v.later(float(x[4])) if x[4] else v).turned(float(x[0]), centre, centre + x[1:4])

    def shown(x: Numbers) -> np.ndarray:
        origin = centre + x[1:4] - about_vertical(x[0]) @ centre
        return np.round([np.degrees(np.remainder(x[0] + np.pi, 2 * np.pi) - np.pi), *origin, x[4]], 3) + 0.0

    target = view.sensors.places.mean(axis=0) if view.kind.sensors else known_median(view.values)
    away, inf = np.nan_to_num(target - centre), np.inf
    longest = min(LONGEST_S, 0.45 * float(np.ptp(view.times))) * _moves(view)
    places = [[yaw, *at, 0.0] for at in (0 * away, away, away * [1, 1, 0]) for yaw in np.radians(range(0, 360, 15))]
    delays = [[0.0, 0.0, 0.0, 0.0, delay] for delay in sorted(np.arange(-longest, longest + 0.1, 0.5), key=abs)]
    shifted = "shifted by ({1:.2f}, {2:.2f}, {3:.2f}) m and "
    cause = "the truth has another frame than the measurements, or another clock; import it again with --align-truth, "
    cause += "or --transform {1:.3f},{2:.3f},{3:.3f},{0:.3f},{4:.3f}"
    for how, of, starts, least, free in (
        (shifted, "frame", places[::24], (inf, 0.4, 0.4, 0.4, inf), [1, 2, 3]),
        ("turned by {0:.1f}°, " + shifted, "frame", places, (0.07, inf, inf, inf, inf), [0, 1, 2, 3]),
        ("", "delay", delays, 0.1, [4]),
    ):
        words = f"the truth {how}{{4:.2f}} s later"
        yield Change(words, cause, apply, False, of, lambda _, x=starts: x, least, free, shown)  # type: ignore[misc]


def _moves(view: Compared) -> bool:
    """Whether the truth of a tag moves by so much that a clock shows."""
    return any(np.ptp(view.positions[view.tag == k], axis=0).max() >= 0.5 for k in np.unique(view.tag))


def _exchanged(view: Compared) -> Iterator[Change]:
    """Anchors or stations at the places of others: exchanges of two that clearly gain, one after another."""
    few, ids, n = view.thinned(max(COARSE, 60 * len(view.ids))), np.array(view.ids), len(view.ids)

    def apply(v: Compared, _: Any, order: np.ndarray) -> Compared:
        return v.changed(places=view.sensors.places[order], axes=view.sensors.axes[order])

    def cost(order: np.ndarray) -> float:
        return float(np.log(np.fmin(np.maximum(apply(few, (), order).sizes(), 1e-3), 1e3)).sum())

    order = best = np.arange(n)
    while best is order or cost(best) < cost(order) - CLEAR:
        order = best
        others = (order[[{i: j, j: i}.get(k, k) for k in range(n)]] for i, j in combinations(range(n), 2))
        best = min(others, key=cost, default=order + 0)
    if len(moved := np.flatnonzero(order != np.arange(n))):
        words = f"{view.kind.noun}s {listed(ids[moved])} swapped for {listed(ids[order[moved]])}"
        cause = f"the ids of {view.kind.noun}s are mixed up; correct rig.toml or the table"
        yield Change(words, cause, partial(apply, order=order))


def _fitted(view: Compared, change: Change) -> Numbers:
    """The numbers that fit best: from the best starts on few readings, then on all; of like places the nearest one."""
    starts, few = np.array(change.starts(view), float), view.thinned(COARSE)
    if not starts.size:
        return starts[0]
    free, known = list(change.free or range(starts.shape[1])), np.isfinite(few.values).mean() / 2

    def cost(x: Numbers) -> float:
        e = change.apply(few, x).errors()
        return float(np.nanmean(np.log1p(np.abs(e)))) if np.isfinite(e).mean() > known else np.inf

    def fit(part: Compared, x: Numbers, free: list[int], steps: int) -> tuple[float, Numbers]:
        put = lambda n: x + np.bincount(free, n - x[free], len(x))  # noqa: E731
        found, size = robust_fit(lambda n: change.apply(part, put(n)).errors(), x[free], steps)
        return size, put(found)

    costs = np.array([cost(x) for x in starts])
    found = [fit(few, starts[k], free, 8) for k in np.argsort(costs, kind="stable")[:STARTS] if costs[k] < np.inf]
    found = found or [(np.inf, starts[0])]
    most = min(size for size, _ in found) * (ALIKE if change.of == "place" else 1.0)
    x = min((x for size, x in found if size <= most), key=lambda x: float(np.linalg.norm(x - starts[0])))
    clock = change.of == "frame" and _moves(view)
    x = fit(view, x, free + [4] * clock, 4)[1]
    # Fixes come late by the delay of the filter that made them.
    if clock and (abs(x[4]) < LEAST_CLOCK_S or (view.kind.position and 0.0 < x[4] <= LATENCY_S)):
        x[4] = 0.0
    return x


def check_mistakes(view: Compared, calibrated: bool = False) -> Iterator[CheckResult]:
    """An error for each likely mistake that is not `calibrated` away; a warning of a broken anchor or a small delay."""
    kind, before, limit, named = view.kind, view.sizes(), view.kind.sizes("large", len(view.columns)), False
    whole = view.sizes(bias=False)
    large = unknown = view.large()
    while unknown.any():
        found = _found(view, [one for one in _changes(view) if one.each or not named], before, unknown, ~large)
        best = min(found, key=lambda one: one.cost, default=None)
        if best is None:
            break
        named, unknown, x, of = True, unknown & ~best.groups, best.numbers[0], best.change.of
        late = of == "delay" and -LATENCY_S / 2 < x[4] <= LATENCY_S
        # Heights of fixes are often of no use, or mirrored in the plane of the anchors; their filter makes them late.
        flat = of == "height" or (of == "frame" and np.abs(x[[0, 1, 2, 4]]).max() < 0.4) or (late and x[4] > 0)
        if not (kind.position and flat) and not (calibrated and of == "offset"):
            change, numbers = best.change, [best.change.shown(x) for x in best.numbers]
            worst = best.groups & large if change.each else best.groups
            words = listed(dict.fromkeys(change.words.format(*x) if len(x) else change.words for x in numbers))
            cause = change.cause.format(*numbers[0]) if len(numbers[0]) else change.cause
            what = f"{_errors_of(view, worst, whole, change.each)}, and {_typical(view, best.after[worst])}"
            yield CheckResult("warning" if late else "error", kind.name, f"{what} with {words}: {cause}")
    over, few = np.fmax.reduce(before / limit, axis=1), unknown.sum() <= max(FEW * len(unknown), 1) < len(unknown)
    if named or not unknown.any():
        return
    if unknown.all() and np.nanmedian(over) > UNEXPLAINED:
        what = f"{_errors_of(view, unknown, whole, False)}, and no change explains them"
        yield CheckResult("warning", kind.name, f"{what}: compare places, frames, units, times and tags")
    elif kind.sensors and few and np.nanmedian(over[unknown]) > BROKEN * np.nanmedian(over[~large]):
        what = f"{_errors_of(view, unknown, whole)}, of the others {_typical(view, whole[~large])}"
        fix = "and no change explains them: wild or blocked readings, or a wrong place; measure there again"
        yield CheckResult("warning", kind.name, f"{what}, {fix}")


def _found(
    view: Compared, tried: Sequence[Change], before: np.ndarray, unknown: np.ndarray, sound: np.ndarray
) -> Iterator[Found]:
    """The changes that explain the errors of all readings, or those of some of the groups that are `unknown`."""
    usual, whole = _share(view.of_rows(sound[view.group])) if sound.any() else 1.0, view.sizes(bias=False)
    floor, limit = view.kind.sizes("floor", before.shape[1]), view.kind.sizes("large", len(view.columns))
    for change in tried:
        groups, gains, numbers, after = np.zeros(len(unknown), bool), 0.0, list[np.ndarray](), np.array(whole)
        # Places of anchors and of tags have enough freedom to take up a part of any error.
        most = limit if change.of == "place" else EXPLAINED * limit
        for of in np.eye(len(unknown), dtype=bool)[unknown] if change.each else [~groups]:
            part, known = view.of_rows(of[view.group]), np.isfinite(before[of])
            x = _fitted(part, change)
            other = change.apply(part, x)
            # A change with which the errors are unknown improves nothing, nor a place where one value does as well.
            left = np.nan_to_num(other.sizes()[of], nan=1e9)
            if change.of == "place":
                left[:, left[0] > known_median(np.abs(part.values - known_median(part.values))) / 2] = 1e9
            fall = np.where(known, np.log(np.maximum(before[of], floor) / np.maximum(left, floor)), 0.0)
            matters = known & (np.fmax(before[of], left) > limit)
            least = FITTED_GAIN if change.each and len(x) else GAIN
            enough = matters.any() and fall[matters].mean() >= least and (left <= most)[known].mean() >= NEARLY
            mistaken = not len(x) or (np.abs(x) >= change.least).any()
            if enough and mistaken and _share(other) >= min(NEARLY, 0.9 * usual):
                # The more errors fall that a sensor may have of its own, the better is the change, too.
                groups, after[of] = groups | of, other.sizes(bias=False)[of]
                fall = np.log(np.maximum(whole[of], floor) / np.maximum(after[of], floor))
                gains += np.nansum(fall) / known.sum() * of.sum()
                numbers.append(x)
        # Single sensors are wrong where most are right: few have a wrong place.
        alone = not change.each or 2 * (unknown & ~groups).sum() <= len(groups)
        if groups.any() and alone and not (change.of == "place" and groups.sum() > max(FEW * len(groups), 1)):
            cost = PENALTY * (1 + sum(map(np.count_nonzero, numbers))) - gains / len(unknown)
            yield Found(cost, change, groups, numbers, after)


def _share(view: Compared) -> float:
    """The share of the readings whose errors need no explanation."""
    large, bias = (view.kind.sizes(which, len(view.columns)) for which in ("large", "bias"))
    over = np.abs(view.errors()) / (3 * large + bias)
    return float((over <= 1.0).sum() / max(np.isfinite(over).sum(), 1))


def _typical(view: Compared, sizes: np.ndarray) -> str:
    """The typical size of the largest errors of groups, of positions also over the floor."""
    (unit, factor), over = view.kind.shown, np.hypot(*sizes.T[:2]) if view.kind.position else np.nan
    return f"{significant(factor * float(np.nanmedian(np.fmax(np.fmax.reduce(sizes, axis=1), over))), 2)}{unit}"


def _errors_of(view: Compared, groups: np.ndarray, sizes: np.ndarray, named: bool = True) -> str:
    """The errors of some of the groups, whose names are told."""
    names = [name for name, chosen in zip(view.ids, groups, strict=True) if chosen]
    of = f" of {view.kind.noun}{'s' if len(names) > 1 else ''} {listed(names)}" if named else ""
    return f"errors against truth{of} are typically {_typical(view, sizes[groups])}"


class Moments(NamedTuple):
    """Readings of M moments of tags, as many of each, NaN where fewer; their known heights (M,), m, else NaN.

    `unit`: the error of a reading that counts as much as one of a range by 1 m.
    """

    view: Compared
    heights: Float[np.ndarray, " M"]
    unit: float

    def errors(self) -> Float[np.ndarray, "N m"]:
        """What readings differ from those of the position that fits most of each moment, in units."""
        places, known, M = self.view.sensors.places, np.isfinite(self.heights), len(self.heights)
        x = np.repeat(places.mean(axis=0)[None], M, axis=0)
        x[:, 2] = np.where(known, self.heights, places[:, 2].min() - 1.0)
        free, most = np.where(known[:, None], [1.0, 1.0, 0.0], 1.0), 1.0 + np.linalg.norm(np.ptp(places, axis=0))

        def at(x: np.ndarray) -> np.ndarray:
            positions = np.repeat(x, len(self.view.tag) // M, axis=0)
            return self.view._replace(positions=positions).errors().reshape(M, -1) / self.unit

        for _ in range(STEPS):
            error = at(x)
            slope = np.stack([at(x + by) - error for by in NEAR * np.eye(3)], axis=-1) / NEAR * free[:, None]
            heard = np.isfinite(error)
            sizes = np.where(heard.any(axis=1, keepdims=True), np.abs(error), 0.0)
            scale = np.maximum(np.take_along_axis(np.sort(sizes), heard.sum(axis=1, keepdims=True) // 2, 1), 0.05)
            weight = heard / (1.0 + np.nan_to_num(error / (2.0 * scale)) ** 2)
            error, slope = np.nan_to_num(error), np.nan_to_num(slope)
            normal = np.einsum("ma,mai,maj->mij", weight, slope, slope) + 0.02 * np.eye(3)
            step = np.linalg.solve(normal, np.einsum("ma,ma,mai->mi", weight, error, slope)[..., None])[..., 0]
            x -= step * np.minimum(1.0, most / np.maximum(np.linalg.norm(step, axis=1), NEAR))[:, None]
        return at(x).reshape(self.view.values.shape)

    def typical(self, errors: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " G"]:
        """The typical size of the errors of each anchor or station, of the column with the largest ones."""
        of = [(self.view.sensors.number == k).any(axis=1) for k in range(len(self.view.ids))]
        return np.nan_to_num(np.stack([known_median(np.abs(errors[part])) for part in of])).max(axis=1)


def _moments(recording: RecordingFolder, table: str) -> Moments:
    """Moments of tags in which so many anchors or stations are heard that they can contradict each other."""
    view = readings_of(recording, table)
    number, of_tags = view.sensors.number, np.split(view.times, np.flatnonzero(np.diff(view.tag)) + 1)
    window = 1.5 * len(view.ids) * float(np.median([np.ptp(t) / len(t) for t in of_tags]))
    values = np.where(view.kind.columns[0].positive & ~(view.values > 0.0), np.nan, view.values)
    at = {"at": np.floor(view.times / min(max(window, 0.1), 1.0)), "tag": view.tag, "height": view.heights[view.tag]}
    at |= {"pair": number @ len(view.ids) ** np.arange(number.shape[1]), "row": np.arange(len(number))}
    # One reading of each anchor, station or pair.
    each = pl.DataFrame(at)[np.flatnonzero(np.isfinite(values).any(axis=1))].unique(["tag", "at", "pair"])
    groups = each.sort("row").group_by("tag", "at", maintain_order=True).agg("row", pl.col("height").first())
    unknowns = 3 - pl.col("height").is_finite().cast(pl.Int64)
    groups = groups.filter(pl.col("row").list.len() * len(view.columns) >= unknowns + SPARE)
    groups = groups.gather_every(-(-len(groups) // MOMENTS) or 1)
    most = groups["row"].list.len().max() or 1
    rows = groups["row"].list.gather(range(most), null_on_oob=True).explode()  # type: ignore[arg-type]
    part = view._replace(values=values).of_rows(rows.fill_null(0).to_numpy())
    filled = np.where(rows.is_null().to_numpy()[:, None], np.nan, part.values)
    unit = view.kind.columns[0].large / KINDS["ranges"].columns[0].large
    return Moments(part._replace(values=filled), groups["height"].to_numpy(), unit)


def _explanations(given: Moments, typical: np.ndarray) -> Iterator[tuple[str, list[int], Moments]]:
    """What would explain contradictions: its words, the anchors whose errors it lowers, and the moments with it."""
    view, everyone, noun = given.view, [*range(len(given.view.ids))], given.view.kind.noun
    for change in _conventions(view):
        yield f"with {change.words}: {change.cause}", everyone, given._replace(view=change.apply(view, np.zeros(0)))
    if view.kind.unit == "m" and not view.kind.difference:
        less = lambda x: given._replace(view=view._replace(values=view.values - x))  # noqa: E731
        beyond = float(np.nanmedian(view.values) - np.ptp(view.sensors.places, axis=0).max() / 2)
        x, _ = robust_fit(lambda x: less(x).errors(), np.array([beyond if beyond > np.ptp(view.values) else 0.0]), 4)
        cause = f"an offset of the {view.kind.name}, as of an uncalibrated antenna delay; calibrate the anchors"
        yield f"with {x[0]:+.2f} m subtracted: {cause}", everyone, less(x)
    words = "with other heights of the tags: correct height_m in rig.toml"
    yield words, everyone, given._replace(heights=np.full(len(given.heights), np.nan))
    for k, name in enumerate(view.ids):
        values = np.where((view.sensors.number == k).any(axis=1)[:, None], np.nan, view.values)
        words = f"without {noun} {name}: its id, place or unit is wrong, or it is broken"
        yield words, [k], given._replace(view=view._replace(values=values))
    worst = sorted(np.argsort(-typical)[:MOST_PAIRED].tolist())
    for i, j in combinations([k for k in worst if typical[k] > CONTRADICTED / 5], 2):
        order, names = [{i: j, j: i}.get(k, k) for k in everyone], f"{noun}s {view.ids[i]} and {view.ids[j]}"
        words = f"with {names} swapped: their ids are mixed up; correct rig.toml or the table"
        swapped = view.changed(places=view.sensors.places[order], axes=view.sensors.axes[order])
        yield words, [i, j], given._replace(view=swapped)


def check_contradictions(recording: RecordingFolder, table: str) -> Iterator[CheckResult]:
    """An error for the change with which readings agree best; a warning of one sensor that contradicts the others."""
    given, found = _moments(recording, table), list[tuple[float, int, Level, str]]()
    if len(given.heights) < 5:
        return
    errors, (unit, factor) = given.errors(), given.view.kind.shown
    typical, heard, factor = given.typical(errors), np.isfinite(errors), factor * given.unit
    least = CONTRADICTED / (4.0 if given.view.kind.angles else 1.0)  # angles of another convention may nearly agree
    for words, of, changed in _explanations(given, typical) if (typical > least).any() else ():
        after, alone = np.abs(changed.errors()), words.startswith("without")
        left, was = changed.typical(after), typical[of].max()
        most = (left if alone else left[of]).max()
        if was > least and most < was / FALL and (after > CONTRADICTED).sum() < FEW_LEFT * np.isfinite(after).sum():
            # A reading without its sensor remains unexplained; of changes that do alike the first one is meant.
            cost = float(np.mean(np.log(np.where(np.isfinite(after), after, CONTRADICTED)[heard] + 0.05)))
            words = f"contradict each other by {factor * was:.2g}{unit}, and by {factor * most:.2g}{unit} {words}"
            found.append((round(cost, 2), len(found), "warning" if alone else "error", words))
    if (large := typical > 2.0 * CONTRADICTED).any() and not found:  # with no change to confirm it
        names = listed(compress(given.view.ids, large))
        words = f"of {names} contradict others of the same moment by {factor * typical.max():.3g}{unit}"
        found.append((0.0, 0, "warning", words))
    yield from (CheckResult(level, table, words) for *_, level, words in sorted(found)[:1])
