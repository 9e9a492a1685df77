"""Changes of the readings, the truth or the rig that undo a mistake each.

A change has words, a cause and the fields that it replaces; numbers of its own are fitted to all readings by one robust
least-squares fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.recordings.checks.compared import Compared, robust_fit
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.kinds import Kind, wrapped

LEAST_MOVE_M, LEAST_EXTENT_M, ALIKE = 0.5, 1.0, 1.2
"""Shift of a place that counts, m; extent of positions from which one is fitted, m; ratio of errors up to which two
places do alike, and that nearer to rig.toml's is named."""

LEAST_OFFSET_M, LEAST_SCALE, LEAST_TURN, LEAST_SHIFT_M, LEAST_YAW = 1.0, 0.05, np.radians(15.0), 0.4, np.radians(4.0)
FARTHEST_M = 200.0  # shift up to which phases are compared with the truth: far on the boresight all are equal
COARSE, STARTS, MOST_SWAPPED, CLEAR = 240, 5, 32, 1.5
"""Readings of the first search, starts that go on, anchors compared with each other's places, and the sum of log
ratios from which two count as swapped."""

LONGEST_DELAY_S, LATENCY_S, LEAST_CLOCK_S, LEAST_MOTION_M = 60.0, 1.0, 0.05, 0.5

FACTORS = {0.001: "millimetres", 0.01: "centimetres", 0.3048: "feet", 0.0254: "inches", 1000.0: "kilometres"}
FLIGHT = {0.5: "round-trip distances", 2.0: "halved distances"}
OF_DIFFERENCES = {0.2998: "nanoseconds or feet", 1000.0: "kilometres"}
"""Metres per unit. Some place has all differences nearly zero, so that every small factor makes errors small."""

ANTENNA_SIZES = 0.15, 10.0
"""Smallest and largest plausible distance of an antenna from the station's position, wavelengths."""

ANGLE_CHANGES = (
    ("the sign of the azimuth flipped", "the azimuth is positive to the right, expected to the left seen along the "
     "boresight; flip its sign", lambda x: x * (-1.0, 1.0)),
    ("the sign of the elevation flipped", "the elevation is positive downward, expected upward; flip its sign",
     lambda x: x * (1.0, -1.0)),
    ("the signs of azimuth and elevation flipped", "the station is upside down, or both angles have the opposite sign; "
     "turn it in rig.toml", np.negative),
    ("azimuth and elevation swapped", "azimuth and elevation are swapped; rename both", lambda x: x[..., ::-1]),
)  # fmt: skip


class Change(NamedTuple):
    """`words` follow "with"; `cause`: the mistake and its fix; `fields`: those of `Compared` or its sensors replaced.

    `numbers`: fitted for it. `by_group`: for each group, or for some alone. `groups` (G,): those that it may concern,
    all of them if `together`, few if it changes a `place`. `harmless`: no mistake. `systematic`: a calibration removes
    it. `parts`: what to name of each group. `handicap`: factor of errors by which simpler changes are preferred.
    """

    words: str
    cause: str
    fields: Mapping[str, np.ndarray]
    numbers: int = 0
    by_group: bool = False
    groups: Bool[np.ndarray, " G"] | None = None
    together: bool = False
    place: bool = False
    harmless: bool = False
    systematic: bool = False
    parts: tuple[str, ...] = ()
    handicap: float = 1.0


class ValueChange(NamedTuple):
    """A change of values (…, m), in words, with the mistake; `typical`: between which sizes the values then are."""

    words: str
    cause: str
    of: Callable[[np.ndarray], np.ndarray]
    typical: tuple[float, float] | None = None


def value_changes(kind: Kind, columns: int) -> list[ValueChange]:
    """The changes of the values alone of readings with so many columns."""
    if kind.angles:
        return [ValueChange(*one) for one in ANGLE_CHANGES]
    if kind.numbered:
        return _of_phases(columns)
    if not kind.position and not (kind.sensors and kind.unit == "m"):
        return []
    result, verb = list[ValueChange](), "in" if kind.position else "are"
    units = FACTORS if kind.position else {**(OF_DIFFERENCES if kind.difference else FACTORS), **FLIGHT}
    for factor, unit in units.items():
        words, cause = f"the {kind.name} multiplied by {factor:.4g}", f"{kind.name} {verb} {unit}"
        result.append(ValueChange(words, f"{cause}, expected metres; convert them", partial(np.multiply, factor)))
    flipped = f"the sign of the {kind.name} flipped", f"{kind.name} with the wrong sign; flip it"
    return result if kind.position else [*result, ValueChange(*flipped, np.negative)]


def _of_phases(columns: int) -> list[ValueChange]:
    cause = "phases that grow with the distance, or with the opposite sign; flip it"
    result = [ValueChange("the sign of the phases flipped", cause, np.negative)]
    for factor, unit, typical in ((2 * np.pi, "turns", (0.1, 0.5)), (np.radians(1.0), "degrees", (np.pi, 360.0))):
        words, cause = f"the phases multiplied by {factor:.4g}", f"phases in {unit}, expected radians; convert them"
        result.append(ValueChange(words, cause, partial(np.multiply, factor), typical))
    orders = [("the antennas in reverse order", "the order of the antennas is reversed", np.arange(columns)[::-1])]
    for k in range(1, columns):
        words, order = f"phase_1_rad as that of antenna {k + 1}", np.roll(np.arange(columns), k)
        orders.append((words, "the numbering of the antennas starts at another one", order))
    for i, j in combinations(range(columns), 2):
        orders.append((f"phases {i + 1} and {j + 1} exchanged", "two antennas are swapped", exchanged(columns, i, j)))
    fix = "correct rig.toml or the columns"
    return result + [ValueChange(a, f"{b}; {fix}", partial(np.take, indices=c, axis=-1)) for a, b, c in orders]


def exchanged(count: int, i: int, j: int) -> np.ndarray:
    """The numbers below `count` in their order, but for two that are exchanged."""
    order = np.arange(count)
    order[[i, j]] = j, i
    return order


def changes(view: Compared) -> Iterator[Change]:
    """The changes of readings, truth and rig without fitted numbers."""
    kind, sensors, noun, correct = view.kind, view.sensors, view.kind.noun, "; correct rig.toml"
    for words, cause, of, typical in value_changes(kind, len(view.columns)):
        groups = None
        if typical is not None:
            sizes = view.sizes(view.values, bias=False)
            groups = (np.nanmedian(sizes, axis=1) > typical[0]) & (np.nanmedian(sizes, axis=1) < typical[1])
        # The unit of a difference is a message.
        by_group = bool(kind.sensors) and not kind.difference
        yield Change(words, cause, {"values": of(view.values)}, by_group=by_group, groups=groups)
    for words, cause, other in _other_places(sensors.places) if kind.sensors else ():
        moved = np.linalg.norm(other - sensors.places, axis=1) > LEAST_MOVE_M
        yield Change(words, cause, {"places": other}, 1, True, moved, place=True)
    for words, cause, other in _other_rotations(view.rotations) if noun == "station" else ():
        axes = rotation_matrices(other / np.linalg.norm(other, axis=1, keepdims=True))
        differs = np.abs(np.abs(np.einsum("gi,gi->g", other, view.rotations)) - 1.0) > 1e-3
        yield Change(words, cause, {"axes": axes}, by_group=True, groups=differs)
    if kind.numbered:
        at, behind = sensors.antennas, "antennas seen from behind, or {} with the wrong sign" + correct
        for words, cause, other in (
            ("x of antennas_m flipped", behind.format("x"), at * [-1.0, 1.0]),
            ("y of antennas_m flipped", behind.format("y"), at * [1.0, -1.0]),
            ("x and y of antennas_m swapped", f"x and y of antennas_m are swapped{correct}", at[..., ::-1]),
        ):
            yield Change(words, cause, {"antennas": other}, by_group=True)
        for f, (name, column) in product((0.001, 0.01), (("antennas", "antennas_m"), ("wavelengths", "wavelength_m"))):
            cause = f"{column} in {FACTORS[f]}, expected metres; convert {'them' if name == 'antennas' else 'it'}"
            groups = _resolving(view, f if name == "antennas" else 1 / f)
            fields = {name: f * getattr(sensors, name)}
            yield Change(f"{column} multiplied by {f:g}", cause, fields, by_group=True, groups=groups)
    for f, unit in FACTORS.items():
        cause = f"truth in {unit}, expected metres; convert it"
        yield Change(f"the truth multiplied by {f:g}", cause, {"positions": f * view.positions})
        if kind.sensors:
            cause = f"positions in rig.toml in {unit}, expected metres; convert them"
            yield Change(f"the positions of the {noun}s multiplied by {f:g}", cause, {"places": f * sensors.places})
    _, *others = signed_axes("the truth")
    for one in others:
        # The maker's height is often of no use, or mirrored in the plane of the anchors.
        harmless = kind.position and one.words == "the sign of z of the truth flipped"
        fields, cause = {"positions": view.positions @ one.matrix.T}, _frame(view, "has other axes than")
        yield Change(one.words, cause, fields, harmless=harmless, handicap=1.0 + 0.01 * one.changes)


def _other_places(places: np.ndarray) -> Iterator[tuple[str, str, np.ndarray]]:
    for k, x in enumerate("xyz"):
        signs = np.where(np.arange(3) == k, -1.0, 1.0)
        yield f"the sign of {x} of the position flipped", f"{x} in rig.toml has the wrong sign; flip it", places * signs
    yield "x and y of the position swapped", "x and y in rig.toml are swapped", places[:, [1, 0, 2]]


def _other_rotations(q: np.ndarray) -> Iterator[tuple[str, str, np.ndarray]]:
    cause = "the quaternion is written x, y, z, w; reorder it"
    yield "rotation_wxyz read as x, y, z, w", cause, np.roll(q, 1, 1)
    cause = "the quaternion takes world vectors to array vectors; invert it (negate x, y, z)"
    yield "rotation_wxyz inverted", cause, q * [1.0, -1.0, -1.0, -1.0]


def _resolving(view: Compared, factor: float | np.ndarray) -> np.ndarray:
    """Whether each array (G,), so many times as large, resolves directions: else phases are equal, or fit many."""
    size = factor * np.nanmax(np.abs(view.sensors.antennas), axis=(1, 2)) / view.sensors.wavelengths
    return (size > ANTENNA_SIZES[0]) & (size < ANTENNA_SIZES[1])


def _frame(view: Compared, what: str, placement: Sequence[float] = ()) -> str:
    """The cause of another frame, and the fix: where a shift, m, a turn, °, and seconds, if any, do, by import."""
    other = f"the {view.kind.name}" if view.kind.position else "rig.toml"
    again = "import it again with --align-truth, which fits the clock as well, or --transform "
    fix = again if len(placement) else "bring both into one frame"
    return f"the truth {what} {other}; {fix}{transform_text(*placement)}"


def transform_text(*numbers: float) -> str:
    """Shift, m, turn about z, °, and seconds as `import --transform` takes them: `1.200,-0.300,0.000,37.000`."""
    return ",".join(f"{round(float(x), 3) + 0.0:.3f}" for x in numbers)


class SignedAxes(NamedTuple):
    """Axes exchanged or with another sign: `matrix` takes vectors to the new ones; `changes`: how many in `words`."""

    matrix: Float[np.ndarray, "3 3"]
    words: str
    changes: int


def signed_axes(of: str) -> Iterator[SignedAxes]:
    """All 48 axes, as they are first; the words name the changes of what they are `of`."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        flipped = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
        turned, words = [k for k in range(3) if order[k] != k], []
        if len(turned) == 2:
            words.append(f"{'xyz'[turned[0]]} and {'xyz'[turned[1]]} of {of} swapped")
        elif turned:
            words.append(f"x, y, z of {of} read as {', '.join('xyz'[k] for k in order)}")
        if flipped:
            sign = "the sign of" if len(flipped) == 1 else "the signs of"
            words.append(f"{sign} {', '.join(flipped)}{'' if words else f' of {of}'} flipped")
        matrix = np.array(signs)[:, None] * np.eye(3)[list(order)]
        yield SignedAxes(matrix, " and ".join(words), len(words + flipped))


class Each(NamedTuple):
    """A change with numbers (G, p) of each anchor or station: `fields(view, numbers)`, fitted from `starts(view, k)`.

    `given`: the numbers without it, or the fitted ones where there are no `starts`. `counts(numbers)` (G,): which are a
    mistake. `part`: one of them in words.
    """

    words: str
    cause: str
    fields: Callable[[Compared, np.ndarray], dict[str, np.ndarray]]
    given: np.ndarray
    starts: Callable[[Compared, int], Sequence[np.ndarray]] | None
    counts: Callable[[np.ndarray], np.ndarray]
    part: Callable[[np.ndarray], str]
    systematic: bool = False
    place: bool = False


def _grid(low: float, high: float, step: float) -> Callable[[Compared, int], Sequence[np.ndarray]]:
    return lambda part, k: list(np.arange(low, high, step)[:, None])


def _less_offsets(view: Compared, x: np.ndarray) -> dict[str, np.ndarray]:
    """The readings without the offsets of their anchors, which the two of a difference have in it."""
    other = x[view.sensors.number[:, 1]] if view.kind.difference else 0.0
    return {"values": view.values - (x[view.group] - other)}


def _by_each(view: Compared) -> Iterator[Each]:
    kind, sensors, zero = view.kind, view.sensors, np.zeros((len(view.ids), 1))
    turn, degrees = _grid(-np.pi, np.pi, np.radians(5.0)), lambda x: f"by {np.degrees(half_turns(x))[0]:.0f}°"
    turned = lambda x: np.abs(half_turns(x[:, 0])) >= LEAST_TURN  # noqa: E731
    other = "another orientation than rig.toml's"
    if kind.sensors and kind.unit == "m":
        # Many tags see an anchor in the corner from one side, so that its place is an offset to them.
        place = ", or of another position" if kind.difference else ""
        yield Each(
            f"a constant subtracted from the {kind.name}",
            f"an offset of the {kind.name}, as of an uncalibrated antenna delay{place}; calibrate the anchors",
            _less_offsets, view.medians(view.errors()), None,
            lambda x: np.abs(x[:, 0]) >= LEAST_OFFSET_M, lambda x: f"{x[0]:+.2f} m", systematic=True,
        )  # fmt: skip
    # An azimuth of a compass counts from north, clockwise.
    for sign, name in ((1.0, "turned"), (-1.0, "turned and its sign flipped")) if kind.angles else ():

        def azimuths(view: Compared, x: np.ndarray, sign: float = sign) -> dict[str, np.ndarray]:
            return {"values": view.values * [sign, 1.0] - x[view.group] * [1.0, 0.0]}

        cause = f"{other}, or another zero of the azimuth; correct rotation_wxyz"
        yield Each(f"the azimuth {name}", cause, azimuths, zero, turn, turned, degrees, sign > 0)
    if kind.numbered:
        yield Each(
            "another wavelength", "a wrong wavelength_m, or antennas_m in another scale; correct rig.toml",
            lambda view, x: {"wavelengths": sensors.wavelengths * np.exp(x[:, 0])}, zero, _grid(-1.386, 1.4, 0.02),
            lambda x: (np.abs(x[:, 0]) >= LEAST_SCALE) & _resolving(view, np.exp(-x[:, 0])),
            lambda x: f"{np.exp(x[0]):.4g} times rig.toml's",
        )  # fmt: skip
        yield Each(
            "the station turned about the vertical", f"{other}; correct rotation_wxyz or yaw_deg",
            lambda view, x: {"axes": about_vertical(x[:, 0]) @ sensors.axes}, zero, turn, turned, degrees,
        )  # fmt: skip
    if kind.sensors:
        yield Each(
            "another position", "a wrong position in rig.toml; measure it again",
            lambda view, x: {"places": x}, sensors.places,
            lambda part, k: [sensors.places[k], sensors.places.mean(0), 2 * part.positions.mean(0) - sensors.places[k]],
            lambda x: np.linalg.norm(x - sensors.places, axis=1) > LEAST_MOVE_M, lambda x: f"at {_metres(x)}",
            place=True,
        )  # fmt: skip


def fitted_changes(view: Compared, large: Bool[np.ndarray, " G"]) -> Iterator[Change]:
    """The changes with numbers fitted to the readings; `large` (G,): the groups whose errors need an explanation."""
    for one in _by_each(view):
        numbers, fitted = np.array(one.given, float), []
        for k in np.flatnonzero(large).tolist():
            part = view.of_rows(view.group == k)
            if len(part.group) and (not one.place or _extent(part) >= LEAST_EXTENT_M):
                numbers[k] = _of_one(part, one, k)
                fitted.append(k)
        # Of differences one place at a time: a wrong one shows in the readings of others, too.
        for chosen in [[k] for k in fitted] if one.place and view.kind.difference else [fitted] if fitted else []:
            x = np.array(one.given, float)
            x[chosen] = numbers[chosen]
            yield Change(
                one.words, one.cause, one.fields(view, x), x.shape[1], True, one.counts(x), place=one.place,
                systematic=one.systematic, parts=tuple(map(one.part, x)),
            )  # fmt: skip
    yield from _placed(view)
    yield from _delayed(view)
    yield from _swapped(view)


def _of_one(part: Compared, one: Each, k: int) -> np.ndarray:
    """The numbers of group k alone; of two places that do alike, on either side of a plane, that nearer to rig.toml."""

    def fields(some: Compared, x: np.ndarray) -> dict[str, np.ndarray]:
        numbers = np.array(one.given, float)
        numbers[k] = x
        return one.fields(some, numbers)

    if one.starts is None:
        return np.asarray(one.given[k])
    best = _fitted(part, fields, one.starts(part, k))
    if one.place:
        centre = part.positions.mean(axis=0)
        normal = np.linalg.svd(part.positions - centre, full_matrices=False)[2][2]
        other = best - 2.0 * float((best - centre) @ normal) * normal
        left = [float(np.nanmedian(np.abs(part.changed(**fields(part, x)).errors()))) for x in (best, other)]
        nearer = np.linalg.norm(other - one.given[k]) < np.linalg.norm(best - one.given[k])
        best = other if nearer and left[1] <= ALIKE * left[0] else best
    return best


def _fitted(
    view: Compared, fields: Callable[[Compared, np.ndarray], dict[str, np.ndarray]], starts: Sequence[np.ndarray]
) -> np.ndarray:
    """The numbers that fit the readings best: of the best starts on few readings the best, then on all of them."""

    def errors(x: np.ndarray, part: Compared = view) -> np.ndarray:
        return part.changed(**fields(part, x)).errors()

    few = view.thinned(COARSE)
    starts = sorted(starts, key=lambda x: float(np.nanmean(np.log1p(np.abs(errors(x, few))))))[:STARTS]
    rough = min((robust_fit(lambda x: errors(x, few), start, 8) for start in starts), key=lambda fit: fit[1])[0]
    return robust_fit(errors, rough, 4)[0]


def half_turns(angles: np.ndarray) -> np.ndarray:
    """Angles in [−π, π)."""
    return wrapped(angles[:, None], ("turn_rad",))[:, 0]


def about_vertical(yaw: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n 3 3"]:
    """The matrices of turns about z, rad."""
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(np.shape(yaw))
    return np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]]), (0, 1), (-2, -1))


def _extent(view: Compared) -> float:
    """How far the true positions reach, m."""
    return float(np.linalg.norm(np.ptp(view.positions, axis=0)))


def _metres(vector: np.ndarray) -> str:
    return f"({', '.join(f'{x + 0.0:.2f}' for x in np.round(vector, 2))}) m"


def _placed(view: Compared) -> Iterator[Change]:
    """The truth shifted, or turned about z, mirrored or not, and shifted; with the clock, where that is off too."""
    kind, centre = view.kind, view.positions.mean(axis=0)
    target = view.sensors.places.mean(axis=0) if kind.sensors else known_median(view.values)
    target = np.where(np.isfinite(target), target, centre)
    level, most = np.append(target[:2], centre[2]), FARTHEST_M if kind.numbered else np.inf
    yaws = [np.append(yaw, c) for yaw in np.arange(24) * np.pi / 12 for c in (centre, level)]
    for words, starts in (("shifted", [centre, target, level]), ("turned", yaws), ("mirrored", yaws)):

        def placed(x: np.ndarray, positions: np.ndarray, mirror: float = -1.0 if words == "mirrored" else 1.0):  # type: ignore[no-untyped-def]
            away = (positions - centre) * np.array([1.0, mirror, 1.0])
            return x[-3:] + (away if len(x) == 3 else away @ about_vertical(x[0]).T)

        x = _fitted(view, lambda part, x, at=placed: {"positions": at(x, part.positions)}, starts)  # type: ignore[misc]
        yaw, shift = 0.0 if len(x) == 3 else float(half_turns(x[:1])[0]), x[-3:] - centre
        small = abs(yaw) < LEAST_YAW if words == "turned" else np.linalg.norm(shift) < LEAST_SHIFT_M
        if (small and words != "mirrored") or np.linalg.norm(shift) > most:
            continue

        def later(x: np.ndarray, at=placed) -> np.ndarray:  # type: ignore[no-untyped-def]
            return at(x[:-1], view.later(float(x[-1])).positions)

        x, _ = robust_fit(lambda x, at=later: view.changed(positions=at(x)).errors(), np.append(x, 0.0), 8)  # type: ignore[misc]
        # Fixes come late by the delay of the filter that made them.
        if abs(x[-1]) < LEAST_CLOCK_S or (kind.position and 0.0 < x[-1] <= LATENCY_S):
            x[-1] = 0.0
        delay, origin = x[-1:][x[-1:] != 0.0], placed(x[:-1], np.zeros((1, 3)))[0]
        yaw = 0.0 if len(x) == 4 else float(half_turns(x[:1])[0])
        numbers = np.concatenate([origin, [np.degrees(yaw)], delay]).tolist()
        text = f"the truth shifted by {_metres(origin)}"
        harmless = kind.position and bool(np.linalg.norm(origin[:2]) < LEAST_SHIFT_M) and words == "shifted"
        cause = _frame(view, "has another origin than", numbers)
        if words != "shifted":
            text = f"the truth {'mirrored (y flipped), then ' if words == 'mirrored' else ''}turned by "
            text += f"{np.degrees(yaw):.1f}° about z"
            text += f" and shifted by {_metres(origin)}" if np.linalg.norm(origin) >= LEAST_SHIFT_M else ""
            turned = _frame(view, "is turned against", numbers)
            cause = _frame(view, "is mirrored against") if words == "mirrored" else turned
        text += "".join(f" and {abs(x):.2f} s {'later' if x > 0 else 'earlier'}" for x in delay)
        count = {"shifted": 3, "turned": 4, "mirrored": 5}[words] + len(delay)
        yield Change(text, cause, {"positions": later(x)}, count, harmless=harmless)


def _delayed(view: Compared) -> Iterator[Change]:
    """The truth of some seconds before or after."""
    extent, span = max(_extent(view.of_rows(view.tag == k)) for k in np.unique(view.tag)), float(np.ptp(view.times))
    if extent < LEAST_MOTION_M or span < 2.0:
        return
    longest, few, step = min(LONGEST_DELAY_S, 0.45 * span), view.thinned(2 * COARSE), 1.0
    grid = np.arange(-longest, longest + 1.0, 1.0)
    while step > 0.02:
        part = few if step > 0.1 else view
        # A path that repeats itself has several, of which the right one need not be that nearest to the grid.
        nearest = sorted(grid, key=lambda delay: float(_logs(part.later(delay).sizes()).sum()))[:3]
        grid, step = np.unique(np.add.outer(nearest, step * np.arange(-1.0, 1.01, 0.25))), step / 4
    yield delayed_by(view, float(nearest[0]))


def delayed_by(view: Compared, delay: float) -> Change:
    """The truth of `delay` s before."""
    earlier, late = ("earlier", "late") if delay > 0 else ("later", "early")
    cause = f"the {view.kind.name} come {abs(delay):.2f} s {late}: their clock and that of the truth differ; import "
    cause += f"the truth again with --align-truth, or --transform {transform_text(0.0, 0.0, 0.0, 0.0, delay)}"
    words, harmless = f"the measurements taken {abs(delay):.2f} s {earlier}", -LATENCY_S / 2 < delay <= LATENCY_S
    return Change(words, cause, {"positions": view.later(delay).positions}, 1, harmless=harmless)


def _swapped(view: Compared) -> Iterator[Change]:
    """Each anchor or station at the place of another, and each tag on the path of another."""
    count, sensors, noun = len(view.ids), view.sensors, view.kind.noun
    if view.kind.sensors and 2 <= count <= MOST_SWAPPED:
        few = view.thinned(max(COARSE, 60 * count))

        def sizes(order: Sequence[int] | np.ndarray) -> np.ndarray:
            return _logs(few.changed(places=sensors.places[order], axes=sensors.axes[order]).sizes())

        if view.kind.difference:  # it has two anchors, each of which may be another
            orders = [exchanged(count, i, j) for i, j in combinations(range(count), 2)]
            order = min(orders, key=lambda order: float(sizes(order).sum()))
        else:
            order = _assignment(np.stack([sizes([k] * count) for k in range(count)], axis=1))
        if (moved := order != np.arange(count)).any():
            cause = f"the ids of {noun}s are mixed up; correct rig.toml or the table"
            fields = {"places": sensors.places[order], "axes": sensors.axes[order]}
            yield Change(_exchange(noun, view.ids, order), cause, fields, 0, True, moved, together=True)
    used = np.array([k for k in np.unique(view.tag) if view.tags[k] in view.paths.number])
    if 2 <= len(used) <= MOST_SWAPPED:
        few, of = view.thinned(max(COARSE, 60 * len(used))), np.arange(len(view.tags))
        errors = [np.abs(few.later(0.0, np.full(len(of), other)).errors()) for other in used]
        order = _assignment(np.array([[_logs(known_median(e[few.tag == k])[None])[0] for e in errors] for k in used]))
        if (order != np.arange(len(used))).any():
            of[used] = used[order]
            cause = "the ids of tags are mixed up between truth and measurements; correct one table"
            words = _exchange("tag", [view.tags[k] for k in used], order)
            yield Change(words, cause, {"positions": view.later(0.0, of).positions}, 1)


def _logs(sizes: np.ndarray) -> np.ndarray:
    """The sum over columns (G,) of the logarithms of sizes, large where one is unknown."""
    return np.asarray(np.log(np.where(np.isfinite(sizes), np.maximum(sizes, 1e-3), 1e3)).sum(axis=1))


def _assignment(costs: np.ndarray) -> np.ndarray:
    """The column of each row (n,), no two equal, that makes the sum small: only exchanges that clearly do."""
    from scipy.optimize import linear_sum_assignment  # a quarter of a second, and few recordings come here

    order = linear_sum_assignment(costs)[1]
    assigned = np.arange(len(costs))
    for first in assigned.tolist():
        cycle, last = [first], first
        while (last := int(order[last])) != first:
            cycle.append(last)
        if costs[cycle, cycle].sum() - costs[cycle, order[cycle]].sum() > CLEAR:
            assigned[cycle] = order[cycle]
    return assigned


def _exchange(noun: str, ids: Sequence[str], order: np.ndarray) -> str:
    moved = np.flatnonzero(order != np.arange(len(ids))).tolist()
    if len(moved) == 2:
        return f"{noun}s {ids[moved[0]]} and {ids[moved[1]]} swapped"
    return f"{noun}s exchanged ({', '.join(f'{ids[k]} for {ids[order[k]]}' for k in moved)})"
