"""Checks of geometry: anchors on a line or plane, dilution of precision at the tags' positions, the tags' heights.

Dilution of precision is the standard deviation of a least-squares position per unit of measurement noise, with all
sensors observed: the diagonal of (Jᵀ J)⁻¹, J the Jacobian of the measurements with respect to position (Kaplan and
Hegarty, Understanding GPS, chapter 7).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import SAY_SIDE, THIN, Rig
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.kinds import KINDS, Kind, wrapped
from trackwright.trackers.recordings.truth import TruePaths

WEAK_RANGES = 5.0  # m per m above which a coordinate counts as weakly determined
WEAK_ANGLES = 0.5  # m per degree
POINTS = 400  # positions at which dilution is evaluated, at most
_ONE_DEGREE = np.radians(1.0)
_STEP_M = 1e-4
"""Half the distance over which slopes are taken: third derivatives and rounding are both below 1e-9."""

OFF_M = 0.5
"""Difference of heights, m, from which it counts as a mistake."""

OFFSET_M = 0.1
"""Difference, m and as a share, of distances between tags of a body from which their offsets are wrong."""

FARTHEST_OFFSET_M = 20.0
"""Length of an offset, m, beyond which it is in another unit."""

SHORT = 0.5
"""Share of a tag's ranges shorter than its height above or below the anchors from which the height counts as wrong."""


class Dilution(NamedTuple):
    """At each position (p,): horizontal and vertical dilution with unknown height, and horizontal with known height."""

    horizontal: np.ndarray
    vertical: np.ndarray
    horizontal_at_height: np.ndarray


def information(
    kind: Kind, rig: Rig, ids: Sequence[Sequence[str]], positions: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "p 3 3"]:
    """Inverse covariances, 1/m², of positions, m, from a reading of each of some sensors with noise of 1 m or 1°.

    `ids`: the anchors or stations of each reading; of differences those of one message, whose noise is that of both
    arrivals.
    """
    names = list(dict.fromkeys(name for row in ids for name in row))
    if kind.difference:
        # However they are paired, the anchors of a message tell as much as their differences from one of them.
        ids = [(name, names[0]) for name in names[1:]]
    number = np.array([[names.index(name) for name in row] for row in ids])
    count, columns = len(positions), len(kind.columns)
    sensors = kind.sensors_of(rig, names, np.tile(number, (count, 1)), columns)
    at = np.repeat(positions, len(ids), axis=0)
    sides = [kind.values_at(at + sign * _STEP_M * axis, sensors) for axis in np.eye(3) for sign in (1.0, -1.0)]
    slopes = np.stack(
        [wrapped(up - down, kind.least) for up, down in zip(sides[::2], sides[1::2], strict=True)], axis=-1
    )
    jacobian = slopes.reshape(count, len(ids) * columns, 3) / (2.0 * _STEP_M)
    if kind.difference:
        # Whitened: the arrival at the first anchor gives all differences a correlation of ½.
        shared = (1.0 - len(names) ** -0.5) / len(ids)
        jacobian = math.sqrt(2.0) * (jacobian - shared * jacobian.sum(axis=1, keepdims=True))
    sigma = 1.0 if kind.unit == "m" else _ONE_DEGREE
    return np.asarray(np.einsum("pki,pkj->pij", jacobian, jacobian) / sigma**2)


def dilution(known: Float[np.ndarray, "p 3 3"]) -> Dilution:
    """That of information, or of the sum of several; infinite where it does not determine a coordinate."""
    x, y, z = _variances(known).T
    return Dilution(np.sqrt(x + y), np.sqrt(z), np.sqrt(_variances(known[:, :2, :2]).sum(axis=1)))


def _variances(information: np.ndarray) -> np.ndarray:
    """Diagonal of the inverse, infinite for coordinates with a component in a singular direction."""
    values, vectors = np.linalg.eigh(information)
    share = np.where(vectors**2 > 1e-9, vectors**2, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(values > 1e-9 * values[:, -1:], 1 / values, np.inf)[:, None, :]
        return np.where(share > 0, share * inverse, 0.0).sum(axis=-1)


def shape(positions: np.ndarray) -> tuple[Literal["point", "line", "plane", "solid"], np.ndarray]:
    """Dimension of the set `positions` (n, 3), up to `THIN`, and the unit normal of their best-fit plane."""
    centred = positions - positions.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=True)
    sizes = np.pad(sizes, (0, 3 - len(sizes)))
    filled = int((sizes > THIN * sizes[0]).sum()) if sizes[0] > 1e-6 else 0
    return ("point", "line", "plane", "solid")[filled], axes[2]


def check_geometry(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Sensor geometry and the dilution of precision that follows from it."""
    positions, where = _positions(rig, tables)
    known_height = bool(rig.tags) and all(tag.height is not None for tag in rig.tags.values())
    of_anchors = any(kind.noun == "anchor" and name in tables for name, kind in KINDS.items())
    if "fixes" in tables and rig.anchors and not of_anchors:
        yield from _flat(np.stack(list(rig.anchors.values())), known_height)
    observed = {name: ids for name, kind in KINDS.items() if name in tables and (ids := _observed(tables[name], kind))}
    # An array of phases is as good as the two angles that they give.
    kinds = [KINDS["bearings"] if KINDS[name].numbered else KINDS[name] for name in observed]
    told = [information(kind, rig, ids, positions) for kind, ids in zip(kinds, observed.values(), strict=True)]
    # A distance and a direction are a position, each alone is none.
    together = len(told) > 1 and not _weak(dilution(np.sum(told, axis=0)), WEAK_RANGES, known_height)
    for (name, ids), kind, of_kind in zip(observed.items(), kinds, told, strict=True):
        known = kind.places(rig)
        used = {key: known[key] for row in ids for key in row}
        places = np.stack(list(used.values()))
        for (one, at), (other, there) in combinations(used.items(), 2):
            if np.linalg.norm(at - there) < 1e-3:
                message = f"{one} and {other} have the same position; correct one in rig.toml"
                yield CheckResult("warning", "rig.toml", message)
        if kind.noun == "anchor":
            least = 3 if not kind.difference else 4 if known_height else 5
            yield from () if together and len(used) < least else _flat(places, known_height, least)
        elif len(used) == 1:
            message = f"only station {next(iter(used))} is observed: bearings, no position without a known height"
            yield CheckResult("info", name, message)
            continue
        elif len(used) > 2 and shape(places)[0] == "line":
            message = "the stations are collinear: positions near their line are weakly determined"
            yield CheckResult("warning", "rig.toml", message)
        yield _dilution_result(name, kind, dilution(of_kind), known_height, where, together)


def _observed(table: pl.DataFrame, kind: Kind) -> list[tuple[str, ...]]:
    """The different sensors of readings of a table; none of readings without sensors."""
    if not kind.sensors:
        return []
    seen = table.filter(pl.col(kind.least[0]).is_not_null())
    return seen.select(kind.sensors).unique(maintain_order=True).rows()


def _positions(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> tuple[np.ndarray, str]:
    if "truth" in tables:
        true = tables["truth"].select("x_m", "y_m", "z_m").drop_nulls().to_numpy()
        if len(true):
            chosen = true[np.unique(np.linspace(0, len(true) - 1, POINTS).astype(int))]
            return chosen, f"at {len(chosen)} true positions"
    centre = np.mean(rig.places() or [np.zeros(3)], axis=0)
    heights = [tag.height for tag in rig.tags.values() if tag.height is not None]
    if heights:
        centre[2] = np.median(heights)
    return centre[None, :], "at the centre of the rig" + (" and the height of the tags" if heights else "")


def _flat(places: np.ndarray, known_height: bool, least: int = 3) -> Iterator[CheckResult]:
    """What anchors at these places (n, 3), m, leave undetermined."""
    dimension, normal = shape(places)
    level: Level = "warning"
    if len(places) < least:
        message = f"anchors observed: {len(places)}, expected {least} or more for a position"
    elif dimension in ("point", "line"):
        message = "the anchors are collinear: positions on a circle around their line cannot be distinguished"
    elif dimension == "plane" and abs(normal[2]) > 0.7:
        message = "the anchors are coplanar: the height is weakly determined and may be mirrored at their plane"
        known = "the height of the tags is known" if known_height else SAY_SIDE
        level, message = "info" if known_height else level, f"{message} ({known})"
    elif dimension == "plane":
        message = "the anchors are coplanar in a vertical plane: positions may be mirrored at it"
    else:
        return
    yield CheckResult(level, "rig.toml", message)


def _weak(seen: Dilution, limit: float, known_height: bool) -> bool:
    """Whether the coordinates to be estimated are weakly determined."""
    estimated = (seen.horizontal_at_height, seen.horizontal_at_height if known_height else seen.vertical)
    return any(bool(np.median(values) > limit) for values in estimated)


def _dilution_result(
    table: str, kind: Kind, seen: Dilution, known_height: bool, where: str, together: bool
) -> CheckResult:
    """Median and worst dilution; a warning if weak, unless only all tables `together` determine positions."""
    unit, limit = "m per degree of angle noise", WEAK_ANGLES
    if kind.unit == "m":
        unit, limit = f"m per m of {kind.columns[0].name.removesuffix('_m').replace('_', ' ')} noise", WEAK_RANGES
    weak = _weak(seen, limit, known_height)
    shown = [
        [f"{x:.3g}" if np.isfinite(x) else "undetermined" for x in (np.median(values), np.max(values))]
        for values in seen
    ]
    horizontal, vertical, at_height = (f"{median} ({worst})" for median, worst in shown)
    message = (
        f"dilution of precision, median (worst): horizontal {horizontal}, vertical {vertical}, horizontal at known "
        f"height {at_height} {unit}, {where}"
    )
    if together and np.isinf(np.median(seen.horizontal)):
        return CheckResult("info", table, f"{message}; with the other tables positions are determined")
    if weak:
        remedy = "move or add a sensor" if known_height else "give height_m of the tags, or move or add a sensor"
        message += f"; weakly determined: {remedy}"
    return CheckResult("warning" if weak else "info", table, message)


def check_heights(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for each tag of known height that truth or ranges contradict."""
    heights = {tag: known.height for tag, known in rig.tags.items() if known.height is not None}
    if not heights:
        return
    contrary: dict[str, str] = {}
    for name, kind in KINDS.items():
        if name in tables and kind.distance:
            contrary |= _short_distances(rig, tables[name], kind, heights)
    contrary |= _true_heights(tables["truth"], heights) if "truth" in tables else {}
    for tag, why in contrary.items():
        yield CheckResult("error", "rig.toml", f"height_m of tag {tag} is {heights[tag]:g}, but {why}")


def check_offsets(rig: Rig, paths: TruePaths) -> Iterator[CheckResult]:
    """An error for an `offset_m` too long for a body, and for each body on which the truth has the tags elsewhere."""
    offsets = {tag: np.asarray(known.offset, float) for tag, known in rig.tags.items() if known.offset is not None}
    lengths = {tag: float(np.linalg.norm(offset)) for tag, offset in offsets.items()}
    for tag, length in lengths.items():
        if length > FARTHEST_OFFSET_M:
            unit = "looks like millimetres or centimetres, expected metres"
            yield CheckResult("error", "rig.toml", f"offset_m of tag {tag} is {length:.4g} m long: {unit}")
            return
    for body in dict.fromkeys(map(rig.on_body_of, offsets)):
        tags = [tag for tag in body if tag in paths.number]
        wrong = _wrong_offsets(tags, np.array([offsets[tag] for tag in tags]), paths)
        yield from (CheckResult("error", "rig.toml", f"offset_m of tags {message}") for message in wrong)


def _wrong_offsets(tags: Sequence[str], offsets: Float[np.ndarray, "k 3"], paths: TruePaths) -> list[str]:
    """What contradicts the true paths of tags in their places on a body, m, in words; the first of each kind."""
    if len(tags) < 2:
        return []
    times = paths.of_tag(tags[0])[0]
    times = times[:: -(-len(times) // POINTS)]
    true = np.stack([paths.at([tag], np.array([0, len(times)]), times)[0] for tag in tags])
    for i, j in combinations(range(len(tags)), 2):
        given = float(np.linalg.norm(offsets[i] - offsets[j]))
        apart = float(known_median(np.linalg.norm(true[i] - true[j], axis=1)[:, None])[0])
        if abs(apart - given) > max(OFFSET_M, OFFSET_M * given, OFFSET_M * apart):
            both = f"{tags[i]} and {tags[j]} are {given:.2f} m apart, their true positions typically {apart:.2f} m"
            return [f"{both}; correct them, or list the tags of each body under [bodies]"]
    for three in map(list, combinations(range(len(tags)), 3)):
        given, side = (float(known_median(_areas(p[three])[:, None])[0]) for p in (offsets[:, None], true))
        # A body that tilts, or whose tags are nearly on a line, tells nothing.
        if given * side < 0 and min(abs(given), abs(side)) > max(abs(given), abs(side)) / 2:
            names = listed(tags[k] for k in three)
            return [
                f"{names} are mirrored against their true positions; y is to the left: flip its sign, or correct ids"
            ]
    return []


def _areas(p: Float[np.ndarray, "3 n 3"]) -> Float[np.ndarray, " n"]:
    """Twice the areas of triangles on the floor, m², negative where the corners go round to the right."""
    (a, b), (c, d) = (p[1:, :, :2] - p[0, :, :2]).swapaxes(1, 2)
    return np.asarray(a * d - b * c)


def check_fix_heights(rig: Rig, fixes: TagRows) -> Iterator[CheckResult]:
    """A warning for tags whose fixes trackers refuse."""
    if tags := without_height(rig, fixes):
        message = f"neither z_m nor height_m in rig.toml: {counted(len(tags), 'tag')} ({listed(map(repr, tags))})"
        fix = f"track refuses them: give height_m under [tags.{tags[0]}]"
        yield CheckResult("warning", "fixes", f"{message}; {fix}")


def without_height(rig: Rig, fixes: TagRows) -> list[str]:
    """The tags of fixes without any z and without a known height."""
    if not len(fixes.times):
        return []
    x, z = np.isfinite(fixes.floats(["x_m", "z_m"])).T
    has_x, has_z = (np.logical_or.reduceat(column, fixes.starts[:-1]) for column in (x, z))
    known = {tag for tag, one in rig.tags.items() if one.height is not None}
    return [fixes.tags[k] for k in np.flatnonzero(has_x & ~has_z) if fixes.tags[k] not in known]


def _true_heights(truth: pl.DataFrame, heights: Mapping[str, float]) -> dict[str, str]:
    """For each tag whose true heights are elsewhere: where."""
    typical = truth.filter(pl.col("tag").is_in(list(heights))).group_by("tag", maintain_order=True)
    elsewhere = {}
    for tag, z in typical.agg(pl.col("z_m").median()).iter_rows():
        if z is not None and abs(z - heights[tag]) > OFF_M:
            below = "height_m has the wrong sign" if z > 0 else "z of the truth points down; flip its sign"
            fix = below if abs(z + heights[tag]) <= OFF_M else "one of the two is wrong"
            elsewhere[tag] = f"z of its truth is typically {z:.2f} m: {fix}"
    return elsewhere


def _short_distances(rig: Rig, table: pl.DataFrame, kind: Kind, heights: Mapping[str, float]) -> dict[str, str]:
    """For each tag most of whose distances are too short for its height: how many."""
    distance = kind.columns[0].name
    rows = table.filter(pl.col("tag").is_in(list(heights)) & pl.col(distance).is_not_null())
    z = pl.col(kind.noun).replace_strict({key: float(at[2]) for key, at in rig.anchors.items()}, default=None)
    least = (z - pl.col("tag").replace_strict(dict(heights))).abs() - OFF_M
    shares = rows.group_by("tag", maintain_order=True).agg((pl.col(distance) < least).mean())
    return {
        tag: f"{100 * share:.0f} % of its {kind.name} are shorter than the difference of height to their {kind.noun}s; "
        "correct it"
        for tag, share in shares.iter_rows()
        if share is not None and share > SHORT
    }
