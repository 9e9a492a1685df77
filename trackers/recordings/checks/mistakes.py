"""The most likely mistakes in a table: one list of changes of readings, rig or truth, ranked by the errors they leave.

A change is named only where it explains nearly all rows, down to errors that need no explanation. Errors are against
truth, or without one against the positions that fit the readings of each moment best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations, permutations, product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.readings import Compared, known_median, robust_fit
from trackwright.trackers.recordings.kinds import unit_of

# Log ratios of errors: price of a change and of each number, least gain, and that of numbers for one sensor.
PENALTY, GAIN, FITTED_GAIN = 0.06, 0.65, 1.0
# Errors left, in those that need no explanation; share of rows that a change brings below three of these; ratio to the
# others' errors from which a sensor is broken, and share of sensors that may be broken or misplaced.
EXPLAINED, NEARLY, BROKEN, FEW = 2.0, 0.75, 10.0, 0.34
# Readings of the first search, starts that go on, ratio of errors of fits that do alike; most sensors that are
# exchanged, and the sum of log ratios from which two are.
COARSE, STARTS, ALIKE, MOST_SWAPPED, CLEAR = 240, 5, 1.2, 32, 1.5
# Delays: least beside a frame, least alone, most that is tracked, most that is tried; share to which errors fall.
LEAST_CLOCK_S, LEAST_DELAY_S, LATENCY_S, LONGEST_DELAY_S, DELAY_GAIN = 0.05, 0.1, 1.0, 60.0, 2 / 3

FACTORS = {0.001: "millimetres", 0.01: "centimetres", 0.3048: "feet", 0.0254: "inches", 1000.0: "kilometres"}
UNITS = {
    "range_m": FACTORS | {0.5: "round-trip distances", 2.0: "halved distances"},
    # Some place has all differences nearly zero, so that every small factor makes errors small.
    "range_difference_m": {-1.0: "of the wrong sign", 0.2998: "nanoseconds or feet", 0.5: "doubled", 2.0: "halved"},
    "x_m": FACTORS,
}
"""By the first column of a table, factors to its unit and what they undo."""

ANGLES = (
    ("the sign of the azimuth flipped", [0, 1], [-1, 1]),
    ("the sign of the elevation flipped", [0, 1], [1, -1]),
    ("azimuth and elevation swapped", [1, 0], [1, 1]),
)
"""Orders and factors of the columns."""

Numbers = Float[np.ndarray, " p"]


class Change(NamedTuple):
    """What would explain errors: `words`, after "with", and `cause`, the mistake and its fix, may have `shown` numbers.

    `apply`: the readings with it and its numbers, fitted from `starts` (s, p); `each`: of one sensor alone. `least`:
    sizes of numbers from which one is a mistake. `free`: the numbers that are fitted. `of`: "offset" (which a
    calibration removes), "place", "frame" (whose last number is a delay), "delay" or "height".
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
    """A change, its cost, the groups (G,) that it is for, its numbers by group, and the sizes (G, m) that it leaves."""

    cost: float
    change: Change
    groups: np.ndarray
    numbers: list[np.ndarray]
    after: np.ndarray


def changes(view: Compared) -> Iterator[Change]:
    """All changes of the readings of a table; without a truth those of values, ids and heights."""
    kind, what, noun, true = view.kind, view.kind.name, view.kind.noun, view.moment is None
    order, xyz, other = list(range(len(view.columns))), [0, 1, 2], "the fixes" if view.kind.position else "rig.toml"
    units = UNITS.get(view.columns[0], {-1.0: "of the wrong sign"}).items()
    tried: list[tuple[str, str, str, list[int], Any]] = [
        (f"the {what} multiplied by {f:g}", f"{what} are {u}; convert them", "values", order, f) for f, u in units
    ]
    cause = "angles of another convention, or the station turned; correct them"
    tried += [(words, cause, "values", columns, factors) for words, columns, factors in ANGLES if kind.angles]
    for f, unit in FACTORS.items() if true else ():
        cause = f"positions in rig.toml in {unit}; convert them"
        tried += [(f"the positions of the {noun}s multiplied by {f:g}", cause, "places", xyz, f)] * bool(kind.sensors)
        tried += [(f"the truth multiplied by {f:g}", f"truth in {unit}; convert it", "positions", xyz, f)]
    for axes, signs in product(permutations(xyz), product((1, -1), repeat=3)) if true else ():
        read = ", ".join("-" * (sign < 0) + "xyz"[k] for k, sign in zip(axes, signs, strict=True))
        cause = f"the truth has other axes than {other}; bring both into one frame"
        tried += [(f"x, y, z of the truth read as {read}", cause, "positions", list(axes), signs)]
    # Without a truth one sensor has no errors of its own; the unit of a difference is a message.
    each = bool(kind.sensors) and not kind.difference and true
    for words, cause, field, columns, factors in tried:
        apply = partial(_linear, field=field, order=columns, factors=factors)
        yield Change(words, cause, apply, each and field == "values", "height" if words.endswith(" x, y, -z") else "")
    yield from _exchanged(view) if kind.sensors and len(view.ids) <= MOST_SWAPPED else ()
    yield from [*(_of_rig(view) if kind.sensors else ()), *_of_truth(view)] if true else ()
    if np.isfinite(view.heights).any() and kind.columns[0].positive:
        cause, free = "height_m, or z of the anchors, in rig.toml is wrong; measure again", np.nan * view.heights
        yield Change("the height of the tags left free", cause, lambda v, _: v._replace(heights=free))


def _linear(view: Compared, _: Any, field: str, order: list[int], factors: Any) -> Compared:
    of = view if field in view._fields else view.sensors
    return view.changed(**{field: getattr(of, field)[:, order] * factors})


def _of_rig(view: Compared) -> Iterator[Change]:
    """Orientations and positions of stations and anchors, and offsets of their readings."""
    kind, sensors = view.kind, view.sensors
    if kind.angles:
        from scipy.spatial.transform import Rotation  # a tenth of a second, and few recordings come here

        q = np.roll(Rotation.from_matrix(sensors.axes).as_quat(scalar_first=True), 1, axis=1)
        read = Rotation.from_quat(q, scalar_first=True).as_matrix()
        for how, axes in (("read as x, y, z, w", read), ("inverted", np.swapaxes(sensors.axes, 1, 2))):
            apply = lambda v, _, axes=axes: v.changed(axes=axes)  # noqa: E731
            yield Change(f"rotation_wxyz {how}", "the quaternion is written otherwise; correct it", apply, True)
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

    def apply(v: Compared, x: Numbers, mirror: int) -> Compared:
        away = ((v.later(float(x[4])) if x[4] else v).positions - centre) * [1, mirror, 1]
        return v._replace(positions=centre + x[1:4] + away @ about_vertical(x[0]).T)

    def shown(x: Numbers, mirror: int) -> np.ndarray:
        origin = centre + x[1:4] - about_vertical(x[0]) @ (centre * [1, mirror, 1])
        return np.round([np.degrees(np.remainder(x[0] + np.pi, 2 * np.pi) - np.pi), *origin, x[4]], 3) + 0.0

    target = view.sensors.places.mean(axis=0) if view.kind.sensors else known_median(view.values)
    away, turns = np.nan_to_num(target - centre), np.radians(range(0, 360, 15))
    longest = min(LONGEST_DELAY_S, 0.45 * float(np.ptp(view.times)))
    places = [[yaw, *at, 0.0] for at in (0 * away, away, away * [1, 1, 0]) for yaw in turns]
    delays = [[0.0, 0.0, 0.0, 0.0, delay] for delay in sorted(np.arange(-longest, longest, 0.5), key=abs)]
    shifted, turned, large = "shifted by ({1:.2f}, {2:.2f}, {3:.2f}) m and ", "turned by {0:.1f}°, ", [np.inf] * 4
    fix = "import it again with --align-truth, or --transform {1:.3f},{2:.3f},{3:.3f},{0:.3f},{4:.3f}"
    tried: list[tuple[str, Any, list[float], list[int], int]] = [
        (shifted, places[::24], [np.inf, 0.4, 0.4, 0.4, np.inf], [1, 2, 3], 1),
        (turned + shifted, places, [0.07, *large], [0, 1, 2, 3], 1),
        ("mirrored in y, " + turned + shifted, places, [0.0, *large], [0, 1, 2, 3], -1),
        *([("", delays, [0.0] * 5, [4], 1)] if _moves(view) else []),
    ]
    for how, starts, least, free, mirror in tried:
        cause = "the truth has another frame than the measurements, or another clock; "
        cause += fix if mirror > 0 else "bring both into one frame"
        moved, told = partial(apply, mirror=mirror), partial(shown, mirror=mirror)
        words = f"the truth {how}{{4:.2f}} s later"
        of = "frame" if how else "delay"
        yield Change(words, cause, moved, False, of, lambda _, s=starts: s, least, free, told)  # type: ignore[misc]


def _moves(view: Compared) -> bool:
    """Whether the truth moves by so much for so long that a clock shows."""
    extent = max(float(np.linalg.norm(np.ptp(view.positions[view.tag == k], axis=0))) for k in np.unique(view.tag))
    return extent >= 0.5 and float(np.ptp(view.times)) >= 2.0


def _exchanged(view: Compared) -> Iterator[Change]:
    """Anchors or stations at the places of others: exchanges of two that clearly gain, one after another."""
    few = view.thinned(max(COARSE, 60 * len(view.ids))) if view.moment is None else view

    def apply(v: Compared, _: Any, order: np.ndarray) -> Compared:
        return v.changed(places=view.sensors.places[order], axes=view.sensors.axes[order])

    def cost(order: np.ndarray) -> float:
        sizes = apply(few, (), order).sizes()
        return float(np.log(np.where(np.isfinite(sizes), np.maximum(sizes, 1e-3), 1e3)).sum())

    ids, order = np.array(view.ids), np.arange(len(view.ids))
    for _ in ids:
        others = [order[[{i: j, j: i}.get(k, k) for k in range(len(ids))]] for i, j in combinations(range(len(ids)), 2)]
        best = min(others, key=cost, default=order)
        if not cost(best) < cost(order) - CLEAR:
            break
        order = best
    if len(moved := np.flatnonzero(order != np.arange(len(ids)))):
        words = f"{view.kind.noun}s {listed(ids[moved])} swapped for {listed(ids[order[moved]])}"
        cause = f"the ids of {view.kind.noun}s are mixed up; correct rig.toml or the table"
        cause += ", of these or of their mirror images in the rig" * (view.moment is not None)
        yield Change(words, cause, partial(apply, order=order))


def about_vertical(yaw: float) -> Float[np.ndarray, "3 3"]:
    """The matrix of a turn about z, rad."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _fitted(view: Compared, change: Change) -> Numbers:
    """The numbers that fit the readings best: of the best starts on few readings the best, then on all of them.

    Of places and frames that do alike, on either side of a plane, the nearest to the first start.
    """
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
    if not found:
        return starts[0]
    most = min(size for size, _ in found) * (ALIKE if change.of == "place" else 1.0)
    x = min((x for size, x in found if size <= most), key=lambda x: float(np.linalg.norm(x - starts[0])))
    clock = change.of == "frame" and _moves(view)
    x = fit(view, x, free + [4] * clock, 4)[1]
    # Fixes come late by the delay of the filter that made them.
    if clock and (abs(x[4]) < LEAST_CLOCK_S or (view.kind.position and 0.0 < x[4] <= LATENCY_S)):
        x[4] = 0.0
    return x


def check_mistakes(view: Compared, calibrated: bool = False) -> Iterator[CheckResult]:
    """An error for each likely mistake; a warning of a broken anchor, or where nothing is large, of the clocks.

    `calibrated`: what a calibration of anchors and stations removes is no mistake.
    """
    kind, before, limit, named = view.kind, view.sizes(), _limit(view), False
    large = np.asarray((before > limit).any(axis=1))
    unknown = large
    while unknown.any():
        found = _found(view, [one for one in changes(view) if one.each or not named], before, unknown, ~large)
        best = min(found, key=lambda one: one.cost, default=None)
        if best is None:
            break
        named, unknown, x = True, unknown & ~best.groups, best.numbers[0]
        late = best.change.of == "delay" and -LATENCY_S / 2 < x[4] <= LATENCY_S
        # The height of fixes is often of no use, or mirrored in the plane of the anchors.
        flat = best.change.of == "frame" and np.abs(x[[0, 1, 2, 4]]).max() < 0.4
        harmless = kind.position and (best.change.of == "height" or flat or (late and x[4] > 0))
        if not harmless and not (calibrated and best.change.of == "offset"):
            yield CheckResult("warning" if late else "error", kind.name, _sentence(view, best))
    if kind.sensors and not named and 0 < unknown.sum() <= max(FEW * len(unknown), 1) < len(unknown):
        one, others = (float(np.nanmedian((before / limit)[part])) for part in (unknown, ~large))
        if one > BROKEN * others:
            typical, rest = (_typical(view, before[part]) for part in (unknown, ~large))
            what = f"{_whose(view, unknown)} are typically {typical}, of the others {rest}, and no change explains them"
            fix = "wild or blocked readings, or a wrong place; measure there again"
            yield CheckResult("warning", kind.name, f"{what}: {fix}")
    if not large.any() and kind.averaged and view.moment is None and _moves(view):
        yield from _late(view, before)


def _found(
    view: Compared, tried: Sequence[Change], before: np.ndarray, unknown: np.ndarray, sound: np.ndarray
) -> Iterator[Found]:
    """The changes that explain the errors of all readings, or those of some of the groups that are `unknown`."""
    usual = _share(view.of_rows(sound[view.group])) if sound.any() else 1.0
    floor, limit = view.kind.sizes("floor", before.shape[1]), _limit(view)
    for change in tried:
        groups, gains, numbers, after = np.zeros(len(unknown), bool), 0.0, list[np.ndarray](), np.array(before)
        for of in np.eye(len(unknown), dtype=bool)[unknown] if change.each else [~groups]:
            part = view.of_rows(of[view.group])
            x = _fitted(part, change)
            other = change.apply(part, x)
            left, known = other.sizes()[of], np.isfinite(before[of])
            # A change with which the errors are unknown improves nothing.
            left = np.where(np.isfinite(left), left, np.fmax(before[of], 1e3))
            fall = np.where(known, np.log(np.maximum(before[of], floor) / np.maximum(left, floor)), 0.0)
            matters = known & ((before[of] > limit) | (left > limit))
            # Places of anchors and of tags have enough freedom to take up a part of any error.
            most = limit if change.of == "place" or view.moment is not None else EXPLAINED * limit
            least = FITTED_GAIN if change.each and len(x) else GAIN
            enough = matters.any() and fall[matters].mean() >= least and (left <= most)[known].mean() >= NEARLY
            if (
                enough
                and (np.abs(x) >= change.least).any() | (not len(x))
                and _share(other) >= min(NEARLY, 0.9 * usual)
            ):
                groups, gains, after[of] = groups | of, gains + fall.sum() / known.sum() * of.sum(), left
                numbers.append(x)
        if groups.any() and not (change.of == "place" and groups.sum() > max(FEW * len(groups), 1)):
            cost = PENALTY * (1 + sum(map(np.count_nonzero, numbers))) - gains / len(unknown)
            yield Found(cost, change, groups, numbers, after)


def _limit(view: Compared) -> np.ndarray:
    """Errors (m,) that need no explanation; half of them against positions that take up a part of the errors."""
    return view.kind.sizes("large", len(view.columns)) * (1.0 if view.moment is None else 0.5)


def _share(view: Compared) -> float:
    """The share of the readings whose errors need no explanation."""
    errors = view.errors()
    most = 3 * view.kind.sizes("large", errors.shape[1]) + view.kind.sizes("bias", errors.shape[1])
    known = np.isfinite(errors)
    return float((np.abs(errors) <= most)[known].mean()) if known.any() else 0.0


def _late(view: Compared, before: np.ndarray) -> Iterator[CheckResult]:
    """A warning of clocks that differ by little, where errors less their medians are clearly smaller without it."""

    def errors(x: Numbers) -> np.ndarray:
        e = view.later(float(x[0])).errors()
        return np.asarray(e - view.medians(e)[view.group])

    delay = float(robust_fit(errors, np.zeros(1))[0][0])
    after, floor = view.later(delay).sizes(), view.kind.sizes("floor", before.shape[1])
    worst, left = (np.nanmedian(np.nanmax(sizes / floor, axis=1)) for sizes in (before, after))
    # Fixes come late by the delay of the filter that made them.
    if (
        abs(delay) >= LEAST_DELAY_S
        and not (view.kind.position and delay > 0)
        and left < DELAY_GAIN * worst > DELAY_GAIN
    ):
        (change,) = (one for one in _of_truth(view) if one.of == "delay")
        found = Found(0.0, change, np.ones(len(view.ids), bool), [np.array([0.0, 0.0, 0.0, 0.0, delay])], after)
        yield CheckResult("warning", view.kind.name, _sentence(view, found))


def _sentence(view: Compared, found: Found) -> str:
    change, sizes = found.change, view.sizes()
    words = listed(dict.fromkeys(_told(change, change.words, x) for x in found.numbers))
    large = found.groups & (sizes > _limit(view)).any(axis=1)
    before, after = (_typical(view, one[large if large.any() else found.groups]) for one in (sizes, found.after))
    whose = _whose(view, found.groups if change.each else ~found.groups)
    return f"{whose} are typically {before}, and {after} with {words}: {_told(change, change.cause, found.numbers[0])}"


def _told(change: Change, text: str, x: Numbers) -> str:
    return text.format(*change.shown(x)) if len(x) else text


def _typical(view: Compared, sizes: np.ndarray) -> str:
    """The typical size of the largest errors of groups."""
    unit, factor = ("°", np.degrees(1.0)) if view.kind.angles else (f" {unit_of(view.columns[0])}", 1.0)
    largest = np.nanmax(sizes[np.isfinite(sizes).any(axis=1)], axis=1)
    return f"{significant(factor * float(np.median(largest)), 2)}{unit}"


def _whose(view: Compared, groups: np.ndarray) -> str:
    """The errors of some of the groups, or of all readings where none is chosen."""
    noun, names = view.kind.noun, [name for name, chosen in zip(view.ids, groups, strict=True) if chosen]
    of = f" of {noun}{'s' if len(names) > 1 else ''} {listed(names)}" if names else ""
    return f"errors against {'truth' if view.moment is None else 'the positions that fit best'}{of}"
