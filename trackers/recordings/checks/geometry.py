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

WEAK = {"m": 5.0, "rad": 0.5}
"""Dilution above which a coordinate counts as weakly determined, m per m and m per degree."""

POINTS, STEP_M, ONE_DEGREE = 400, 1e-4, np.radians(1.0)
"""Positions at which dilution is evaluated, at most, and half the distance, m, over which slopes are taken: third
derivatives and rounding are both below 1e-9."""

OFF_M, SHORT, OFFSET_M, FARTHEST_OFFSET_M = 0.5, 0.5, 0.1, 20.0
"""What counts as a mistake: of heights, a difference, m, and the share of distances shorter than a height; of tags on a
body, a difference of distances, m and as a share, and the length of an offset, m, which is in another unit."""


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
    sides = [kind.values_at(at + sign * STEP_M * axis, sensors) for axis in np.eye(3) for sign in (1.0, -1.0)]
    slopes = np.stack(
        [wrapped(up - down, kind.least) for up, down in zip(sides[::2], sides[1::2], strict=True)], axis=-1
    )
    jacobian = slopes.reshape(count, len(ids) * columns, 3) / (2.0 * STEP_M)
    if kind.difference:
        # Whitened: the arrival at the first anchor gives all differences a correlation of ½.
        shared = (1.0 - len(names) ** -0.5) / len(ids)
        jacobian = math.sqrt(2.0) * (jacobian - shared * jacobian.sum(axis=1, keepdims=True))
    sigma = 1.0 if kind.unit == "m" else ONE_DEGREE
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
    kinds = {name: kind for name, kind in KINDS.items() if name in tables and kind.sensors}
    if "fixes" in tables and rig.anchors and all(kind.noun != "anchor" for kind in kinds.values()):
        yield from _flat(np.stack(list(rig.anchors.values())), known_height)
    observed = {name: ids for name, kind in kinds.items() if (ids := _observed(tables[name], kind))}
    # An array of phases is as good as the two angles that they give.
    same = {name: KINDS["bearings"] if kinds[name].numbered else kinds[name] for name in observed}
    told = {name: information(same[name], rig, ids, positions) for name, ids in observed.items()}
    # A distance and a direction are a position, each alone is none.
    together = len(told) > 1 and not _weak(dilution(np.sum(list(told.values()), axis=0)), WEAK["m"], known_height)
    for name, ids in observed.items():
        used = {key: kinds[name].places(rig)[key] for row in ids for key in row}
        places = np.stack(list(used.values()))
        for (one, at), (other, there) in combinations(used.items(), 2):
            if np.linalg.norm(at - there) < 1e-3:
                message = f"{one} and {other} have the same position; correct one in rig.toml"
                yield CheckResult("warning", "rig.toml", message)
        if kinds[name].noun == "anchor":
            least = 3 if not kinds[name].difference else 4 if known_height else 5
            yield from () if together and len(used) < least else _flat(places, known_height, least)
        elif len(used) == 1:
            message = f"only station {next(iter(used))} is observed: bearings, no position without a known height"
            yield CheckResult("info", name, message)
            continue
        elif len(used) > 2 and shape(places)[0] == "line":
            message = "the stations are collinear: positions near their line are weakly determined"
            yield CheckResult("warning", "rig.toml", message)
        level, message = _dilution_result(same[name], dilution(told[name]), known_height, where, together)
        yield CheckResult(level, name, message)


def _observed(table: pl.DataFrame, kind: Kind) -> list[tuple[str, ...]]:
    """The different sensors of readings of a table."""
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
    centre[2] = np.median(heights) if heights else centre[2]
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


def _dilution_result(kind: Kind, seen: Dilution, known_height: bool, where: str, together: bool) -> tuple[Level, str]:
    """Median and worst dilution; a warning if weak, unless only all tables `together` determine positions."""
    what = kind.columns[0].name.removesuffix("_m").replace("_", " ")
    unit = f"m per m of {what} noise" if kind.unit == "m" else "m per degree of angle noise"
    horizontal, vertical, at_height = (
        "{} ({})".format(*(f"{x:.3g}" if np.isfinite(x) else "undetermined" for x in (np.median(one), np.max(one))))
        for one in seen
    )
    message = (
        f"dilution of precision, median (worst): horizontal {horizontal}, vertical {vertical}, horizontal at known "
        f"height {at_height} {unit}, {where}"
    )
    if together and np.isinf(np.median(seen.horizontal)):
        return "info", f"{message}; with the other tables positions are determined"
    if not _weak(seen, WEAK[kind.unit], known_height):
        return "info", message
    remedy = "" if known_height else "give height_m of the tags, or "
    return "warning", f"{message}; weakly determined: {remedy}move or add a sensor"


def check_heights(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for each tag of known height that truth or ranges contradict."""
    heights = {tag: known.height for tag, known in rig.tags.items() if known.height is not None}
    height, contrary = pl.col("tag").replace_strict(heights, default=None, return_dtype=pl.Float64), dict[str, str]()
    for name, kind in KINDS.items():
        if heights and name in tables and kind.distance:
            z = pl.col(kind.noun).replace_strict({key: float(at[2]) for key, at in rig.anchors.items()}, default=None)
            short = (pl.col(kind.columns[0].name) < (z - height).abs() - OFF_M).mean().alias("short")
            for tag, share in tables[name].group_by("tag", maintain_order=True).agg(short).iter_rows():
                if share is not None and share > SHORT:
                    contrary[tag] = f"{100 * share:.0f} % of its {kind.name} are shorter than the difference of "
                    contrary[tag] += f"height to their {kind.noun}s; correct it"
    truth = tables["truth"].group_by("tag", maintain_order=True) if heights and "truth" in tables else None
    for tag, z in () if truth is None else truth.agg(pl.col("z_m").median()).iter_rows():
        if z is not None and tag in heights and abs(z - heights[tag]) > OFF_M:
            below = "height_m has the wrong sign" if z > 0 else "z of the truth points down; flip its sign"
            fix = below if abs(z + heights[tag]) <= OFF_M else "one of the two is wrong"
            contrary[tag] = f"z of its truth is typically {z:.2f} m: {fix}"
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
