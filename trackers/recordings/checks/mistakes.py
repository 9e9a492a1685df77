"""The most likely mistakes in a table: changes of readings, rig or truth that explain nearly all rows, ranked once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations, permutations, product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.errors import listed, significant
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.readings import Compared, known_median, robust_fit

# Log ratios of errors: price of a change and of each number, least gain, and that of numbers for one sensor. Errors
# left, in those that need no explanation, and share of rows below three of these; ratio of errors from which a sensor
# is broken, share of sensors that may be broken or misplaced.
PENALTY, GAIN, FITTED_GAIN, EXPLAINED, NEARLY, BROKEN, FEW = 0.06, 0.65, 1.0, 2.0, 0.75, 10.0, 0.34
# Readings of the first search, starts that go on, ratio of errors of fits that do alike; most sensors, and the sum of
# log ratios, of an exchange. Delays: least beside a frame, most that is tracked, most that is tried.
COARSE, STARTS, ALIKE, MOST_SWAPPED, CLEAR, LEAST_CLOCK_S, LATENCY_S, LONGEST_S = 240, 5, 1.2, 32, 1.5, 0.05, 1.0, 60.0

FACTORS = {0.001: "millimetres", 0.01: "centimetres", 0.3048: "feet", 0.0254: "inches", 1e3: "kilometres"}
# By the first column of a table, factors to its unit and what they undo.
UNITS = {
    "range_m": FACTORS | {0.5: "round-trip distances", 2.0: "halved distances"},
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


def changes(view: Compared) -> Iterator[Change]:
    """All changes of the readings of a table."""
    kind, what, noun = view.kind, view.kind.name, view.kind.noun
    order, xyz, other = list(range(len(view.columns))), [0, 1, 2], "the fixes" if view.kind.position else "rig.toml"
    tried, default = (
        list[tuple[str, str, str, list[int], Any]](),
        {-1.0: "of the wrong sign"} if len(order) == 1 else {},
    )
    for f, unit in UNITS.get(view.columns[0], default).items():
        tried += [(f"the {what} multiplied by {f:g}", f"{what} are {unit}; convert them", "values", order, f)]
    cause = "angles of another convention, or the station turned; correct them"
    tried += [(words, cause, "values", axes, signs) for words, axes, signs in ANGLES if kind.angles]
    for f, unit in FACTORS.items():
        cause = f"positions in rig.toml in {unit}; convert them"
        tried += [(f"the positions of the {noun}s multiplied by {f:g}", cause, "places", xyz, f)] * bool(kind.sensors)
        tried += [(f"the truth multiplied by {f:g}", f"truth in {unit}; convert it", "positions", xyz, f)]
    for axes, signs in product(permutations(xyz), product((1, -1), repeat=3)):
        read = ", ".join("-" * (sign < 0) + "xyz"[k] for k, sign in zip(axes, signs, strict=True))
        cause = f"the truth has other axes than {other}; bring both into one frame"
        tried += [(f"x, y, z of the truth read as {read}", cause, "positions", list(axes), signs)]
    each = bool(kind.sensors) and not kind.difference  # the unit of a difference is a message
    for words, cause, field, columns, factors in tried:
        apply = partial(_linear, field=field, order=columns, factors=factors)
        yield Change(words, cause, apply, each and field == "values", "height" if words.endswith(" x, y, -z") else "")
    yield from _exchanged(view) if kind.sensors and len(view.ids) <= MOST_SWAPPED else ()
    yield from _of_rig(view) if kind.sensors else ()
    yield from _of_truth(view)


def _linear(view: Compared, _: Any, field: str, order: list[int], factors: Any) -> Compared:
    of = view if field in view._fields else view.sensors
    return view.changed(**{field: getattr(of, field)[:, order] * factors})


def _of_rig(view: Compared) -> Iterator[Change]:
    """Orientations and positions of stations and anchors, and offsets of their readings."""
    kind = view.kind
    if kind.angles:
        cause = "another orientation than rig.toml's, or another zero of the azimuth; correct rotation_wxyz or yaw_deg"
        for sign, words, of in ((1.0, "", "offset"), (-1.0, "its sign flipped and ", "")):
            apply = lambda v, x, s=sign: v.changed(values=v.values * [s, 1.0] - [np.radians(x[0]), 0.0])  # noqa: E731
            turns = lambda _: np.arange(-180.0, 180.0, 5.0)[:, None]  # noqa: E731
            yield Change(f"the azimuth {words}turned by {{:.0f}}°", cause, apply, True, of, turns, 15.0)
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
        positions = (v.later(float(x[4])) if x[4] else v).positions
        return v._replace(positions=centre + x[1:4] + (positions - centre) @ about_vertical(x[0]).T)

    def shown(x: Numbers) -> np.ndarray:
        origin = centre + x[1:4] - about_vertical(x[0]) @ centre
        return np.round([np.degrees(np.remainder(x[0] + np.pi, 2 * np.pi) - np.pi), *origin, x[4]], 3) + 0.0

    target = view.sensors.places.mean(axis=0) if view.kind.sensors else known_median(view.values)
    away, inf = np.nan_to_num(target - centre), np.inf
    longest = min(LONGEST_S, 0.45 * float(np.ptp(view.times))) * _moves(view)
    places = [[yaw, *at, 0.0] for at in (0 * away, away, away * [1, 1, 0]) for yaw in np.radians(range(0, 360, 15))]
    delays = [[0.0, 0.0, 0.0, 0.0, delay] for delay in sorted(np.arange(-longest, longest + 0.1, 0.5), key=abs)]
    shifted = "shifted by ({1:.2f}, {2:.2f}, {3:.2f}) m and "
    cause = (
        "the truth has another frame than the measurements, or another clock; import it again with --align-truth, or "
    )
    cause += "--transform {1:.3f},{2:.3f},{3:.3f},{0:.3f},{4:.3f}"
    for how, of, starts, least, free in (
        (shifted, "frame", places[::24], (inf, 0.4, 0.4, 0.4, inf), [1, 2, 3]),
        ("turned by {0:.1f}°, " + shifted, "frame", places, (0.07, inf, inf, inf, inf), [0, 1, 2, 3]),
        ("", "delay", delays, 0.1, [4]),
    ):
        begun = partial(lambda _, starts: starts, starts=starts)
        yield Change(f"the truth {how}{{4:.2f}} s later", cause, apply, False, of, begun, least, free, shown)


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


def about_vertical(yaw: float) -> Float[np.ndarray, "3 3"]:
    """The matrix of a turn about z, rad."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


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
    large = unknown = np.asarray((before > limit).any(axis=1))
    while unknown.any():
        found = _found(view, [one for one in changes(view) if one.each or not named], before, unknown, ~large)
        best = min(found, key=lambda one: one.cost, default=None)
        if best is None:
            break
        named, unknown, x, of = True, unknown & ~best.groups, best.numbers[0], best.change.of
        late = of == "delay" and -LATENCY_S / 2 < x[4] <= LATENCY_S
        # Heights of fixes are often of no use, or mirrored in the plane of the anchors; their filter makes them late.
        flat = of == "height" or (of == "frame" and np.abs(x[[0, 1, 2, 4]]).max() < 0.4) or (late and x[4] > 0)
        if not (kind.position and flat) and not (calibrated and of == "offset"):
            yield CheckResult("warning" if late else "error", kind.name, _sentence(view, best))
    few = not named and 0 < unknown.sum() <= max(FEW * len(unknown), 1) < len(unknown)
    one, others = (float(np.nanmedian((before / limit)[part])) if few else 0.0 for part in (unknown, ~large))
    if kind.sensors and one > BROKEN * others:
        what = f"{_errors_of(view, unknown, before)}, of the others {_typical(view, before[~large])}"
        fix = "and no change explains them: wild or blocked readings, or a wrong place; measure there again"
        yield CheckResult("warning", kind.name, f"{what}, {fix}")


def _found(
    view: Compared, tried: Sequence[Change], before: np.ndarray, unknown: np.ndarray, sound: np.ndarray
) -> Iterator[Found]:
    """The changes that explain the errors of all readings, or those of some of the groups that are `unknown`."""
    usual = _share(view.of_rows(sound[view.group])) if sound.any() else 1.0
    floor, limit = view.kind.sizes("floor", before.shape[1]), view.kind.sizes("large", len(view.columns))
    for change in tried:
        groups, gains, numbers, after = np.zeros(len(unknown), bool), 0.0, list[np.ndarray](), np.array(before)
        # Places of anchors and of tags have enough freedom to take up a part of any error.
        most = limit if change.of == "place" else EXPLAINED * limit
        for of in np.eye(len(unknown), dtype=bool)[unknown] if change.each else [~groups]:
            part, known = view.of_rows(of[view.group]), np.isfinite(before[of])
            x = _fitted(part, change)
            other = change.apply(part, x)
            # A change with which the errors are unknown improves nothing.
            left = np.nan_to_num(other.sizes()[of], nan=1e9)
            fall = np.where(known, np.log(np.maximum(before[of], floor) / np.maximum(left, floor)), 0.0)
            matters, least = (
                known & (np.fmax(before[of], left) > limit),
                FITTED_GAIN if change.each and len(x) else GAIN,
            )
            enough = matters.any() and fall[matters].mean() >= least and (left <= most)[known].mean() >= NEARLY
            mistaken = not len(x) or (np.abs(x) >= change.least).any()
            if enough and mistaken and _share(other) >= min(NEARLY, 0.9 * usual):
                groups, gains = groups | of, gains + fall.sum() / known.sum() * of.sum()
                after[of] = np.where(known, left, np.nan)
                numbers.append(x)
        if groups.any() and not (change.of == "place" and groups.sum() > max(FEW * len(groups), 1)):
            cost = PENALTY * (1 + sum(map(np.count_nonzero, numbers))) - gains / len(unknown)
            yield Found(cost, change, groups, numbers, after)


def _share(view: Compared) -> float:
    """The share of the readings whose errors need no explanation."""
    large, bias = (view.kind.sizes(which, len(view.columns)) for which in ("large", "bias"))
    over = np.abs(view.errors()) / (3 * large + bias)
    return float((over <= 1.0).sum() / max(np.isfinite(over).sum(), 1))


def _sentence(view: Compared, found: Found) -> str:
    change, sizes, numbers = found.change, view.sizes(), [found.change.shown(x) for x in found.numbers]
    large = found.groups & (sizes > view.kind.sizes("large", len(view.columns))).any(axis=1)
    words = listed(dict.fromkeys(change.words.format(*x) if len(x) else change.words for x in numbers))
    cause = change.cause.format(*numbers[0]) if len(numbers[0]) else change.cause
    whose = _errors_of(view, large, sizes, change.each)
    return f"{whose}, and {_typical(view, found.after[large])} with {words}: {cause}"


def _typical(view: Compared, sizes: np.ndarray) -> str:
    """The typical size of the largest errors of groups."""
    unit, factor = view.kind.shown
    return f"{significant(factor * float(np.nanmedian(np.fmax.reduce(sizes, axis=1))), 2)}{unit}"


def _errors_of(view: Compared, groups: np.ndarray, sizes: np.ndarray, named: bool = True) -> str:
    """The errors of some of the groups, whose names are told."""
    names = [name for name, chosen in zip(view.ids, groups, strict=True) if chosen]
    of = f" of {view.kind.noun}{'s' if len(names) > 1 else ''} {listed(names)}" if named else ""
    return f"errors against truth{of} are typically {_typical(view, sizes[groups])}"
