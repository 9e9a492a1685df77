"""Changes of the readings, the truth or the rig that undo a mistake each: of units, signs, axes, order and names.

They have no number of their own; those that are fitted to the readings are in `fitted_changes`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.recordings.checks.compared import Compared
from trackwright.trackers.recordings.kinds import Kind

FACTORS = (
    (0.001, "millimetres"), (0.01, "centimetres"), (0.3048, "feet"), (0.0254, "inches"), (1000.0, "kilometres"),
)  # fmt: skip
"""Metres per unit."""

OF_DIFFERENCES = ((0.2998, "nanoseconds or feet"), (1000.0, "kilometres"))
"""Metres per unit of differences; in smaller ones they exceed the distance of the anchors (`check_units`).

Some place has all differences nearly zero, so that every small factor makes errors small.
"""

FLIGHT = ((0.5, "round-trip distances"), (2.0, "halved distances"))

ANTENNA_SIZES = (0.15, 10.0)
"""Smallest and largest plausible distance of an antenna from the station's position, wavelengths."""

LEAST_MOVE_M = 0.5
"""Shift of a place that counts as a mistake."""


@dataclass(frozen=True)
class Change:
    """`words`: what makes the errors small, to follow "with"; `cause`: the most likely mistake, and its fix.

    `fields`: those of `Compared`, or of its sensors, that the change replaces. `parameters`: how many numbers were
    fitted for it. `by_group`: each group has numbers of its own, or the change may concern some groups alone. `groups`
    (G,): those that it may concern, all of them or none if `together`, and few of them if it changes a `place`: of many
    it is the frame. `harmless`: a property of the sensor and no mistake. `systematic`: one that a calibration removes.
    `parts`: what to name of each group, if anything. `handicap`: the factor of the errors with it by which simpler
    changes are preferred.
    """

    words: str
    cause: str
    fields: Mapping[str, np.ndarray]
    parameters: int = 0
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
        return [
            ValueChange(
                "the sign of the azimuth flipped",
                "the azimuth is positive to the right, expected to the left seen along the boresight; flip its sign",
                partial(np.multiply, (-1.0, 1.0)),
            ),
            ValueChange(
                "the sign of the elevation flipped",
                "the elevation is positive downward, expected upward; flip its sign", partial(np.multiply, (1.0, -1.0)),
            ),
            ValueChange(
                "the signs of azimuth and elevation flipped",
                "the station is upside down, or both angles have the opposite sign; turn it in rig.toml", np.negative,
            ),
            ValueChange(
                "azimuth and elevation swapped", "azimuth and elevation are swapped; rename both",
                lambda values: values[..., ::-1],
            ),
        ]  # fmt: skip
    if kind.numbered:
        return _of_phases(columns)
    if kind.position:
        return [_scaled(kind, factor, f"{kind.name} in {unit}") for factor, unit in FACTORS]
    if kind.sensors and kind.unit == "m":
        units = OF_DIFFERENCES if kind.difference else FACTORS
        scaled = [_scaled(kind, factor, f"{kind.name} are {unit}") for factor, unit in (*units, *FLIGHT)]
        cause = f"{kind.name} with the wrong sign; flip it"
        return [*scaled, ValueChange(f"the sign of the {kind.name} flipped", cause, np.negative)]
    return []


def _scaled(kind: Kind, factor: float, what: str) -> ValueChange:
    cause = f"{what}, expected metres; convert them"
    return ValueChange(f"the {kind.name} multiplied by {factor:.4g}", cause, partial(np.multiply, factor))


def _of_phases(columns: int) -> list[ValueChange]:
    cause = "phases that grow with the distance, or with the opposite sign; flip it"
    result = [ValueChange("the sign of the phases flipped", cause, np.negative)]
    for factor, unit, typical in ((2 * np.pi, "turns", (0.1, 0.5)), (np.radians(1.0), "degrees", (np.pi, 360.0))):
        words, cause = f"the phases multiplied by {factor:.4g}", f"phases in {unit}, expected radians; convert them"
        result.append(ValueChange(words, cause, partial(np.multiply, factor), typical))
    correct = "correct rig.toml or the columns"
    orders = [("the antennas in reverse order", "the order of the antennas is reversed", np.arange(columns)[::-1])]
    for shift in range(1, columns):
        words, order = f"phase_1_rad as that of antenna {shift + 1}", np.roll(np.arange(columns), shift)
        orders.append((words, "the numbering of the antennas starts at another one", order))
    for i, j in combinations(range(columns), 2):
        orders.append((f"phases {i + 1} and {j + 1} exchanged", "two antennas are swapped", exchanged(columns, i, j)))
    for words, cause, order in orders:
        result.append(ValueChange(words, f"{cause}; {correct}", partial(np.take, indices=order, axis=-1)))
    return result


def exchanged(count: int, i: int, j: int) -> np.ndarray:
    """The numbers below `count` in their order, but for two that are exchanged."""
    order = np.arange(count)
    order[[i, j]] = j, i
    return order


def changes(view: Compared) -> Iterator[Change]:
    """The changes of readings, truth and rig that may explain their errors; none of them has fitted numbers."""
    kind, sensors = view.kind, view.sensors
    for change in value_changes(kind, len(view.columns)):
        groups = None
        if change.typical is not None:
            sizes = np.array([np.nanmedian(np.abs(view.values[view.group == k])) for k in range(len(view.ids))])
            groups = (sizes > change.typical[0]) & (sizes < change.typical[1])
        by_group = bool(kind.sensors) and not kind.difference  # the unit of a difference is that of a message
        yield Change(change.words, change.cause, {"values": change.of(view.values)}, by_group=by_group, groups=groups)
    if kind.sensors:
        yield from _of_places(view)
    if kind.noun == "station":
        yield from _of_rotations(view)
    if kind.numbered:
        yield from _of_antennas(view)
    for factor, unit in FACTORS:
        words, cause = f"the truth multiplied by {factor:g}", f"truth in {unit}, expected metres; convert it"
        yield Change(words, cause, {"positions": factor * view.positions})
        if kind.sensors:
            words = f"the positions of the {view.kind.noun}s multiplied by {factor:g}"
            cause = f"positions in rig.toml in {unit}, expected metres; convert them"
            yield Change(words, cause, {"places": factor * sensors.places})
    for axes in signed_axes("the truth"):
        if axes.changes:
            # The maker's height is often of no use, or mirrored in the plane of the anchors.
            harmless = kind.position and axes.words == "the sign of z of the truth flipped"
            cause = frame_cause(view, "has other axes than")
            fields = {"positions": view.positions @ axes.matrix.T}
            yield Change(axes.words, cause, fields, harmless=harmless, handicap=1.0 + 0.01 * axes.changes)


def _of_places(view: Compared) -> Iterator[Change]:
    places = view.sensors.places
    for k, axis in enumerate("xyz"):
        yield Change(
            f"the sign of {axis} of the position flipped", f"{axis} in rig.toml has the wrong sign; flip it",
            {"places": places * np.where(np.arange(3) == k, -1.0, 1.0)}, 1, True,
            np.abs(places[:, k]) > LEAST_MOVE_M / 2, place=True,
        )  # fmt: skip
    swapped = places[:, [1, 0, 2]]
    yield Change(
        "x and y of the position swapped", "x and y in rig.toml are swapped", {"places": swapped}, 1, True,
        np.linalg.norm(swapped - places, axis=1) > LEAST_MOVE_M, place=True,
    )  # fmt: skip


def _of_rotations(view: Compared) -> Iterator[Change]:
    q = view.rotations
    changed = {
        "rotation_wxyz read as x, y, z, w": (np.roll(q, 1, axis=1), "the quaternion is written x, y, z, w; reorder it"),
        "rotation_wxyz inverted": (
            q * np.array([1.0, -1.0, -1.0, -1.0]),
            "the quaternion takes world vectors to array vectors; invert it (negate x, y, z)",
        ),
    }  # fmt: skip
    for words, (rotations, cause) in changed.items():
        other = np.abs(np.abs(np.einsum("gi,gi->g", rotations, q)) - 1.0) > 1e-3
        axes = rotation_matrices(rotations / np.linalg.norm(rotations, axis=1, keepdims=True))
        yield Change(words, cause, {"axes": axes}, by_group=True, groups=other)


def _of_antennas(view: Compared) -> Iterator[Change]:
    """Other places of the antennas, mirrored or in another unit, and the wavelength in another unit."""
    antennas, wavelengths = view.sensors.antennas, view.sensors.wavelengths
    behind = "antennas seen from behind, or {} with the wrong sign"
    changed = {
        "x of antennas_m flipped": (antennas * [-1.0, 1.0], behind.format("x")),
        "y of antennas_m flipped": (antennas * [1.0, -1.0], behind.format("y")),
        "x and y of antennas_m swapped": (antennas[..., ::-1], "x and y of antennas_m are swapped"),
    }
    for words, (other, cause) in changed.items():
        yield Change(words, f"{cause}; correct rig.toml", {"antennas": other}, by_group=True)
    for factor, unit in FACTORS[:2]:
        yield Change(
            f"antennas_m multiplied by {factor:g}", f"antennas_m in {unit}, expected metres; convert them",
            {"antennas": factor * antennas}, by_group=True, groups=resolving(view, factor),
        )  # fmt: skip
        yield Change(
            f"wavelength_m multiplied by {factor:g}", f"wavelength_m in {unit}, expected metres; convert it",
            {"wavelengths": factor * wavelengths}, by_group=True, groups=resolving(view, 1 / factor),
        )  # fmt: skip


def resolving(view: Compared, factor: float | np.ndarray) -> np.ndarray:
    """Whether each array (G,), so many times as large, resolves directions: else phases are equal, or fit many."""
    size = factor * np.nanmax(np.abs(view.sensors.antennas), axis=(1, 2)) / view.sensors.wavelengths
    return (size > ANTENNA_SIZES[0]) & (size < ANTENNA_SIZES[1])


def frame_cause(view: Compared, what: str, placement: Float[np.ndarray, " n"] | None = None) -> str:
    """The cause of another frame, and the fix: where a shift, m, a turn, °, and seconds, if any, do, by import."""
    other = f"the {view.kind.name}" if view.kind.position else "rig.toml"
    if placement is None:
        return f"the truth {what} {other}; bring both into one frame"
    moving = f"--align-truth, which fits the clock as well, or --transform {transform_text(*placement)}"
    return f"the truth {what} {other}; import it again with {moving}"


def transform_text(*numbers: float) -> str:
    """Shift, m, turn about z, °, and seconds as `import --transform` takes them: `1.200,-0.300,0.000,37.000`."""
    return ",".join(f"{round(float(x), 3) + 0.0:.3f}" for x in numbers)


class SignedAxes(NamedTuple):
    """Axes exchanged or with another sign: new axis k is `signs[k]` times axis `order[k]`; `changes`: how many."""

    order: tuple[int, ...]
    signs: Float[np.ndarray, " 3"]
    words: str
    changes: int

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The matrix that takes vectors to the new axes."""
        matrix: np.ndarray = self.signs[:, None] * np.eye(3)[list(self.order)]
        return matrix


def signed_axes(of: str) -> Iterator[SignedAxes]:
    """All 48 axes, as they are first; the words name the changes of what they are `of`."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            flipped = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
            turned = [k for k in range(3) if order[k] != k]
            words = []
            if len(turned) == 2:
                words.append(f"{'xyz'[turned[0]]} and {'xyz'[turned[1]]} of {of} swapped")
            elif turned:
                words.append(f"x, y, z of {of} read as {', '.join('xyz'[k] for k in order)}")
            if flipped:
                signs_of = "the sign of" if len(flipped) == 1 else "the signs of"
                words.append(f"{signs_of} {', '.join(flipped)}{'' if words else f' of {of}'} flipped")
            yield SignedAxes(order, np.array(signs), " and ".join(words), len(words + flipped))
