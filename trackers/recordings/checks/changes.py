"""Changes of the readings, the rig or the truth, each of which undoes a likely mistake: one list.

A change of `each` sensor is tried on the readings of each alone. Its numbers, if any, are those of one robust fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations, permutations, product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.recordings.checks.compared import Compared, robust_fit
from trackwright.trackers.recordings.checks.readings import known_median

LEAST_OFFSET_M, LEAST_SCALE, LEAST_FACTOR, LEAST_TURN, LEAST_SHIFT_M, LEAST_YAW = 1.0, 0.05, 0.22, 0.26, 0.4, 0.07
"""What counts as a mistake: an offset, m; logs of the factors of a wavelength and of a unit; turn of a station, rad;
shift, m, and turn, rad, of the truth."""

COARSE, STARTS, ALIKE, MOST_SWAPPED, CLEAR, FARTHEST_M = 240, 5, 1.2, 32, 1.5, 200.0
"""Readings of the first search, starts that go on, ratio of errors up to which fits do alike; sensors that are compared
with each other's places, the sum of log ratios from which two count as swapped; shift, m, up to which phases tell."""

LONGEST_DELAY_S, LATENCY_S, LEAST_CLOCK_S, LEAST_MOTION_M = 60.0, 1.0, 0.05, 0.5

FACTORS = {0.001: "millimetres", 0.01: "centimetres", 0.3048: "feet", 0.0254: "inches", 1000.0: "kilometres"}
UNITS = {
    "range_m": FACTORS | {0.5: "round-trip distances", 2.0: "halved distances"},
    # Some place has all differences nearly zero, so that every small factor makes errors small.
    "range_difference_m": {0.2998: "nanoseconds or feet", 1e3: "kilometres", 0.5: "doubled", 2.0: "halved distances"},
    "x_m": FACTORS,
}
"""By the first column of a table, factors to its unit and the units that they undo."""

_ANGLES: tuple[tuple[str, str, Callable[[np.ndarray], np.ndarray]], ...] = (
    ("the sign of the azimuth flipped", "the azimuth is positive to the right, expected to the left seen along the "
     "boresight; flip its sign", lambda x: x * (-1.0, 1.0)),
    ("the sign of the elevation flipped", "the elevation is positive downward, expected upward; flip its sign",
     lambda x: x * (1.0, -1.0)),
    ("the signs of azimuth and elevation flipped", "the station is upside down, or both angles have the opposite sign; "
     "turn it in rig.toml", np.negative),
    ("azimuth and elevation swapped", "azimuth and elevation are swapped; rename both", lambda x: x[:, ::-1]),
    ("the azimuth turned by 180°", "another zero of the azimuth, or stations that face the other way in rig.toml; turn "
     "one of both", lambda x: x + np.array([np.pi, 0.0])),
)  # fmt: skip
FRAMES = {"shifted": (1.0, [1, 2, 3]), "turned": (1.0, [0, 1, 2, 3]), "mirrored": (-1.0, [0, 1, 2, 3])}
"""How the truth may be placed: the factor of y, and which of yaw, x, y, z and delay are fitted."""

Numbers = Float[np.ndarray, " p"]


class Change(NamedTuple):
    """`words` follow "with"; `cause`: the mistake and its fix; `apply`: the readings with it and its numbers.

    `each`: of a sensor alone. `starts`: from which numbers are fitted, those that are `free`, then with the `clock`.
    `wrong`: whether they are a mistake. `shown`: in words, of a sensor; `told`: words and cause with them. `of`: a
    "place", which few sensors may have wrong; an "offset", which a calibration removes; a "mounting", which is a
    warning; "harmless" ones are no mistake.
    """

    words: str
    cause: str
    apply: Callable[..., Compared]
    each: bool = False
    starts: Callable[[Compared], Any] | None = None
    wrong: Callable[[Numbers], Any] = lambda _: True
    shown: Callable[[Numbers], str] = lambda _: ""
    of: str = ""
    free: Sequence[int] = ()
    clock: bool = False
    told: Callable[[Numbers], tuple[str, str]] | None = None


def changes(view: Compared) -> Iterator[Change]:
    """All changes of the readings of a table; without a truth those of values and ids."""
    for words, cause, of in _of_values(view):
        # The unit of a difference is a message.
        each = bool(view.kind.sensors) and not view.kind.difference
        yield Change(words, cause, partial(_with_values, of=of), each)
    yield from _swapped(view)
    if not len(view.moment):
        yield from _of_rig(view) if view.kind.sensors else ()
        yield from _of_truth(view)


def _with_values(view: Compared, x: Numbers, of: Callable[..., np.ndarray]) -> Compared:
    return view._replace(values=of(view.values, *x))


def _with_fields(view: Compared, x: Numbers, **fields: Any) -> Compared:
    """The readings with other fields, or with those of a function of them and the numbers."""
    return view.changed(**{name: of(view, x) if callable(of) else of for name, of in fields.items()})


def _of_values(view: Compared) -> Iterator[tuple[str, str, Callable[..., np.ndarray]]]:
    kind, what, many = view.kind, view.kind.name, range(len(view.columns))
    for factor, unit in UNITS.get(view.columns[0], {}).items():
        cause = f"{what} {'are' if kind.sensors else 'in'} {unit}; convert them"
        yield f"the {what} multiplied by {factor:.4g}", cause, partial(np.multiply, factor)
    if len(many) == 1:
        yield f"the sign of the {what} flipped", f"{what} with the wrong sign; flip it", np.negative
    yield from _ANGLES if kind.angles else ()
    if kind.numbered:
        cause = "phases that grow with the distance, or with the opposite sign; flip it"
        yield "the sign of the phases flipped", cause, np.negative
        cause = "phases in turns, expected radians; convert them"
        yield (
            "the phases multiplied by 6.283",
            cause,
            lambda x: np.where(np.nanmax(np.abs(x)) < 0.51, 6.283185 * x, np.nan),
        )
        orders = [("the antennas in reverse order", np.array(many)[::-1])]
        orders += [(f"phase_1_rad as that of antenna {k + 1}", np.roll(many, k)) for k in many[1:]]
        orders += [(f"phases {i + 1} and {j + 1} exchanged", exchanged(many, i, j)) for i, j in combinations(many, 2)]
        cause = "another order of the antennas; correct rig.toml or the columns"
        yield from ((words, cause, partial(np.take, indices=order, axis=1)) for words, order in orders)


def _of_rig(view: Compared) -> Iterator[Change]:
    """Changes of positions, orientations and arrays of anchors or stations, and offsets of their readings."""
    kind, sensors, antennas = view.kind, view.sensors, view.sensors.antennas
    fixed, turned = list[tuple[str, str, dict[str, Any]]](), list[tuple[str, Any, str]]()
    if kind.noun == "station":
        from scipy.spatial.transform import Rotation  # a tenth of a second, and few recordings come here

        q = np.roll(Rotation.from_matrix(sensors.axes).as_quat(scalar_first=True), 1, axis=1)
        other = Rotation.from_quat(q, scalar_first=True).as_matrix()
        order = "rotation_wxyz read as x, y, z, w", "the quaternion is written x, y, z, w; reorder it"
        cause = "the quaternion takes world vectors to array vectors; invert it (negate x, y, z)"
        inverted = "rotation_wxyz inverted", cause, {"axes": np.swapaxes(sensors.axes, 1, 2)}
        fixed += [(*order, {"axes": other}), inverted]
    if kind.angles:
        turned += [("the azimuth turned", partial(_with_values, of=lambda v, turn: v - [turn, 0.0]), "offset")]
        # An azimuth of a compass counts from north, clockwise.
        compass = partial(_with_values, of=lambda v, turn: v * [-1.0, 1.0] - [turn, 0.0])
        turned += [("the azimuth turned and its sign flipped", compass, "")]
    if kind.numbered:
        axes = partial(_with_fields, axes=lambda v, x: about_vertical(x[0]) @ v.sensors.axes)
        turned += [("the station turned about the vertical", axes, "")]
        cause = "antennas seen from behind, or x with the wrong sign; correct rig.toml"
        fixed += [("x of antennas_m flipped", cause, {"antennas": antennas * [-1.0, 1.0]})]
        for f in (0.001, 0.01):  # an array as small does not resolve directions: all phases are equal
            small = f * np.nanmax(np.abs(antennas), axis=(1, 2)) < 0.15 * sensors.wavelengths
            other = np.where(small[:, None, None], np.nan, f * antennas)
            words, cause = f"antennas_m multiplied by {f:g}", f"antennas_m in {FACTORS[f]}; convert it"
            fixed += [(words, cause, {"antennas": other})]
        scales = np.append(np.arange(-1.386, 1.4, 0.02), np.log([1e-3, 1e-2]))[:, None]
        cause = "wavelength_m or antennas_m in another unit or scale; correct rig.toml"
        wrong, shown = lambda x: abs(x[0]) >= LEAST_SCALE, lambda x: f"{np.exp(x[0]):.4g} times rig.toml's"
        yield Change("another wavelength", cause, _rescaled, True, lambda _: scales, wrong, shown)
    if kind.unit == "m":
        # Many tags see an anchor in the corner from one side, so that its place is an offset to them.
        cause = f"an offset of the {kind.name}, as of an uncalibrated antenna delay; calibrate the anchors"
        less, medians = partial(_with_values, of=np.subtract), lambda v: [known_median(v.errors())]
        wrong, shown = lambda x: abs(x[0]) >= LEAST_OFFSET_M, lambda x: f"{x[0]:+.2f} m"
        yield Change(f"a constant subtracted from the {kind.name}", cause, less, True, medians, wrong, shown, "offset")
    cause = "another orientation than rig.toml's, or another zero of the azimuth; correct rotation_wxyz or yaw_deg"
    turns, wrong = np.radians(np.arange(-180.0, 180.0, 5.0))[:, None], lambda x: abs(half_turn(x[0])) >= LEAST_TURN
    shown = lambda x: f"by {np.degrees(half_turn(x[0])):.0f}°"  # noqa: E731
    for words, apply, of in turned:
        yield Change(words, cause, apply, True, lambda _: turns, wrong, shown, of)
    yield from (Change(words, cause, partial(_with_fields, **fields), True) for words, cause, fields in fixed)
    for f, unit in FACTORS.items():
        cause = f"positions in rig.toml in {unit}, expected metres; convert them"
        scaled = partial(_with_fields, places=f * sensors.places)
        yield Change(f"the positions of the {kind.noun}s multiplied by {f:g}", cause, scaled)

    own = lambda v: v.sensors.places[v.group[0]]  # noqa: E731
    around = lambda v: [own(v), v.sensors.places.mean(axis=0), 2 * v.positions.mean(axis=0) - own(v)]  # noqa: E731
    moved = lambda v, x: np.where(np.arange(len(v.ids))[:, None] == v.group[0], x, v.sensors.places)  # noqa: E731
    place, shown = partial(_with_fields, places=moved), lambda x: f"at {_metres(x)}"
    cause = "a wrong position in rig.toml; measure it again"
    yield Change("another position", cause, place, True, around, shown=shown, of="place")


def _rescaled(view: Compared, x: Numbers) -> Compared:
    """Another wavelength; NaN where an array is too small or large for it: phases are equal, or fit many directions."""
    wavelengths = view.sensors.wavelengths * np.exp(x[0])
    size = np.nanmax(np.abs(view.sensors.antennas), axis=(1, 2)) / wavelengths
    return view.changed(wavelengths=np.where((size > 0.15) & (size < 10.0), wavelengths, np.nan))


def _of_truth(view: Compared) -> Iterator[Change]:
    """Changes of the unit, the axes, the place and the clock of the truth, or of the scale of what is no place."""
    kind, centre = view.kind, np.nanmean(view.positions, axis=0)
    if kind.sensors or kind.position:
        for f, unit in FACTORS.items():
            scaled = partial(_with_fields, positions=f * view.positions)
            yield Change(f"the truth multiplied by {f:g}", f"truth in {unit}, expected metres; convert it", scaled)
        for axes in [*signed_axes("the truth")][1:]:
            # The maker's height is often of no use, or mirrored in the plane of the anchors.
            of = "harmless" if kind.position and axes.words == "the sign of z of the truth flipped" else ""
            moved = partial(_with_fields, positions=view.positions @ axes.matrix.T)
            other = "the fixes" if kind.position else "rig.toml"
            cause = f"the truth has other axes than {other}; bring both into one frame"
            yield Change(axes.words, cause, moved, of=of)
        target = view.sensors.places.mean(axis=0) if kind.sensors else known_median(view.values)
        target = np.where(np.isfinite(target), target, centre)
        middles = (centre, target, np.append(target[:2], centre[2]))
        for what, (mirror, free) in FRAMES.items():
            yaws = np.arange(24) * np.pi / 12 if 0 in free else [0.0]
            yield _placed(
                view, centre, what, mirror, free, [np.array([yaw, *at, 0.0]) for yaw in yaws for at in middles]
            )
    else:
        cause, scales = f"{kind.name} in another unit or with another full scale; convert it", np.arange(-7.0, 4.0, 0.4)
        wrong, shown = lambda x: abs(x[0]) > LEAST_FACTOR, lambda x: f"times {np.exp(x[0]):.3g}"
        times = partial(_with_values, of=lambda v, factor: v * np.exp(factor))
        yield Change("another unit or scale", cause, times, False, lambda _: scales[:, None], wrong, shown)
    yield from [delayed(view)] if moves(view) else []


def delayed(view: Compared) -> Change:
    """The truth of some seconds before or after."""
    longest, centre = min(LONGEST_DELAY_S, 0.45 * float(np.ptp(view.times))), np.nanmean(view.positions, axis=0)
    delays = sorted(np.arange(-longest, longest, 0.5), key=abs)
    return _placed(view, centre, "delayed", 1.0, [4], [np.array([0.0, *centre, delay]) for delay in delays])


def _placed(
    view: Compared, centre: np.ndarray, what: str, mirror: float, free: Sequence[int], starts: list[np.ndarray]
) -> Change:
    """The truth turned by x[0] about its `centre`, which goes to x[1:4], of x[4] s before; mirrored in y or not."""

    def apply(v: Compared, x: Numbers) -> Compared:
        away = ((v.later(float(x[4])) if x[4] else v).positions - centre) * [1.0, mirror, 1.0]
        return v._replace(positions=x[1:4] + away @ about_vertical(x[0]).T)

    def told(x: Numbers) -> tuple[str, str]:
        origin, yaw = x[1:4] - about_vertical(x[0]) @ (centre * [1.0, mirror, 1.0]), np.degrees(half_turn(x[0]))
        again = "import the truth again with --align-truth, which fits the clock as well, or --transform "
        again += transform_text(*origin, yaw, *[x[4]] * int(x[4] != 0.0))
        earlier = f"{abs(x[4]):.2f} s {'earlier' if x[4] > 0 else 'later'}"
        if what == "delayed":
            late = f"the {view.kind.name} come {abs(x[4]):.2f} s {'late' if x[4] > 0 else 'early'}"
            return f"the measurements taken {earlier}", f"{late}: clocks differ; {again}"
        words = (
            f"the truth {'mirrored (y flipped), ' * (mirror < 0)}{f'turned by {yaw:.1f}° and ' * (what != 'shifted')}"
        )
        words += f"shifted by {_metres(origin)}" + (f", and the measurements taken {earlier}" if x[4] else "")
        other = "the fixes" if view.kind.position else "rig.toml"
        fix = "bring both into one frame" if mirror < 0 else again
        return words, f"the truth has another origin or axes than {other}; {fix}"

    def wrong(x: Numbers) -> bool:
        shift, yaw = float(np.linalg.norm(x[1:4] - centre)), abs(half_turn(x[0]))
        enough = {"shifted": shift >= LEAST_SHIFT_M, "turned": yaw >= LEAST_YAW}.get(what, True)
        return enough and not (view.kind.numbered and shift > FARTHEST_M)

    clock = what != "delayed" and moves(view)
    return Change("", "", apply, False, lambda _: starts, wrong, of=what, free=free, clock=clock, told=told)


def moves(view: Compared) -> bool:
    """Whether the truth moves by so much for so long that a clock shows."""
    extent = max(float(np.linalg.norm(np.ptp(view.positions[view.tag == k], axis=0))) for k in np.unique(view.tag))
    return extent >= LEAST_MOTION_M and float(np.ptp(view.times)) >= 2.0


def _swapped(view: Compared) -> Iterator[Change]:
    """Anchors or stations at the places of others, and tags on the paths of others: exchanges that clearly gain."""

    def places(v: Compared, _: Any, order: np.ndarray) -> Compared:
        return v.changed(places=view.sensors.places[order], axes=view.sensors.axes[order])

    def paths(v: Compared, _: Any, order: np.ndarray) -> Compared:
        return v.later(0.0, order)

    tried = [(view.kind.noun, view.ids, places)] if view.kind.sensors else []
    for what, ids, apply in tried if len(view.moment) else [*tried, ("tag", view.tags, paths)]:
        order, few = np.arange(len(ids)), view if len(view.moment) else view.thinned(max(COARSE, 60 * len(ids)))
        cost, pairs = _cost(few), [*combinations(range(len(ids)), 2)] if len(ids) <= MOST_SWAPPED else []
        orders = list[np.ndarray]()
        for _ in range(len(ids)):
            costs = [_cost(apply(few, 0, exchanged(order, *pair))) for pair in pairs]
            if not min(costs, default=np.inf) < cost - CLEAR:
                break
            if len(view.moment):
                # Contradictions fall with any further exchange, and in a symmetric hall alike with other pairs.
                most = min(cost - CLEAR, min(costs) + len(ids) * np.log(ALIKE))
                orders = [exchanged(order, *pair) for pair, one in zip(pairs, costs, strict=True) if one <= most]
                break
            cost, order = min(costs), exchanged(order, *pairs[int(np.argmin(costs))])
            orders = [order]
        for order in orders:
            moved = np.flatnonzero(order != np.arange(len(ids))).tolist()
            words = f"{what}s exchanged ({', '.join(f'{ids[k]} for {ids[order[k]]}' for k in moved)})"
            words = f"{what}s {ids[moved[0]]} and {ids[moved[1]]} swapped" if len(moved) == 2 else words
            cause = f"the ids of {what}s are mixed up; correct rig.toml or the table"
            yield Change(words, cause, partial(apply, order=order))


def _cost(view: Compared) -> float:
    """The sum of the logarithms of the sizes of the errors of groups, or of moments as many times."""
    if len(view.moment):
        return len(view.ids) * float(np.log(view.closing()))
    sizes = view.sizes()
    return float(np.log(np.where(np.isfinite(sizes), np.maximum(sizes, 1e-3), 1e3)).sum())


def fitted(view: Compared, change: Change) -> Numbers:
    """The numbers that fit the readings best: of the best starts on few readings the best, then on all of them.

    Of several places that do alike, on either side of a plane, the nearest to the first start.
    """
    if change.starts is None:
        return np.zeros(0)
    starts, few = [np.array(x, float) for x in change.starts(view)], view.thinned(COARSE)
    free, least = list(change.free) or list(range(len(starts[0]))), np.isfinite(few.values).mean() / 2

    def cost(x: Numbers) -> float:
        e = change.apply(few, x).errors()
        return float(np.nanmean(np.log1p(np.abs(e)))) if np.isfinite(e).mean() > least else np.inf

    def fit(part: Compared, x: Numbers, free: list[int], steps: int) -> tuple[float, Numbers]:
        found, size = robust_fit(lambda n: change.apply(part, _with(x, free, n)).errors(), x[free], steps)
        return size, _with(x, free, found)

    costs = np.array([cost(x) for x in starts])
    found = [fit(few, starts[k], free, 8) for k in np.argsort(costs, kind="stable")[:STARTS] if costs[k] < np.inf]
    if not found:
        return starts[0]
    best = min(size for size, _ in found)
    alike = [x for size, x in found if size <= (ALIKE * best if change.of == "place" else best)]
    x = min(alike, key=lambda x: float(np.linalg.norm(x - starts[0])))
    x = fit(view, x, free + [4] * change.clock, 4)[1]
    # Fixes come late by the delay of the filter that made them.
    if change.clock and (abs(x[4]) < LEAST_CLOCK_S or (view.kind.position and 0.0 < x[4] <= LATENCY_S)):
        x[4] = 0.0
    return x


def _with(x: Numbers, free: Sequence[int], numbers: Numbers) -> Numbers:
    other = np.array(x)
    other[list(free)] = numbers
    return other


class SignedAxes(NamedTuple):
    """Axes exchanged or with another sign: `matrix` takes vectors to the new ones; `changes`: how many in `words`."""

    matrix: Float[np.ndarray, "3 3"]
    words: str
    changes: int


def signed_axes(of: str) -> Iterator[SignedAxes]:
    """All 48 axes, as they are first; the words name the changes of what they are `of`."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        flipped = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
        moved = ["xyz"[k] for k in range(3) if order[k] != k]
        words = [f"{' and '.join(moved)} of {of} swapped"] if len(moved) == 2 else []
        words += [f"x, y, z of {of} read as {', '.join('xyz'[k] for k in order)}"] if len(moved) == 3 else []
        if flipped:
            sign = "the sign" if len(flipped) == 1 else "the signs"
            words.append(f"{sign} of {', '.join(flipped)}{'' if words else f' of {of}'} flipped")
        yield SignedAxes(np.array(signs)[:, None] * np.eye(3)[list(order)], " and ".join(words), len(words + flipped))


def exchanged(order: Sequence[int] | np.ndarray, i: int, j: int) -> np.ndarray:
    """The order with two of it exchanged."""
    other = np.array(order)
    other[[i, j]] = other[[j, i]]
    return other


def half_turn(angle: float) -> float:
    """The angle in [−π, π)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def about_vertical(yaw: float) -> Float[np.ndarray, "3 3"]:
    """The matrix of a turn about z, rad."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def transform_text(*numbers: float) -> str:
    """Shift, m, turn about z, °, and seconds as `import --transform` takes them: `1.200,-0.300,0.000,37.000`."""
    return ",".join(f"{round(float(x), 3) + 0.0:.3f}" for x in numbers)


def _metres(vector: Numbers) -> str:
    return f"({', '.join(f'{x + 0.0:.2f}' for x in np.round(vector, 2))}) m"
