"""Checks of geometry: anchors on a line or plane, and dilution of precision at the tags' positions.

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
from trackwright.trackers.recordings.checks.compared import slopes
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.kinds import KINDS, Kind

WEAK, POINTS, ONE_DEGREE = {"m": 5.0, "rad": 0.5}, 400, np.radians(1.0)
"""Dilution above which a coordinate counts as weakly determined, m per m and m per degree; positions at which it is
evaluated, at most."""


class Dilution(NamedTuple):
    """At each position (p,): horizontal and vertical dilution with unknown height, and horizontal with known height."""

    horizontal: np.ndarray
    vertical: np.ndarray
    horizontal_at_height: np.ndarray

    def weak(self, limit: float, known_height: bool) -> bool:
        """Whether the coordinates to be estimated are weakly determined."""
        estimated = (self.horizontal_at_height, self.horizontal_at_height if known_height else self.vertical)
        return any(bool(np.median(values) > limit) for values in estimated)


def information(
    kind: Kind, rig: Rig, ids: Sequence[Sequence[str]], positions: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "p 3 3"]:
    """Inverse covariances, 1/m², of positions, m, from a reading of each of some sensors with noise of 1 m or 1°.

    `ids`: the anchors or stations of each reading; of differences those of one message, whose noise is that of both
    arrivals.
    """
    names = list(dict.fromkeys(name for row in ids for name in row))
    # However they are paired, the anchors of a message tell as much as their differences from one of them.
    ids = [(name, names[0]) for name in names[1:]] if kind.difference else ids
    number = np.array([[names.index(name) for name in row] for row in ids])
    count, columns = len(positions), len(kind.columns)
    sensors = kind.sensors_of(rig, names, np.tile(number, (count, 1)), columns)
    jacobian = slopes(kind, np.repeat(positions, len(ids), axis=0), sensors).reshape(count, len(ids) * columns, 3)
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
    _, sizes, axes = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=True)
    sizes = np.pad(sizes, (0, 3 - len(sizes)))
    return ("point", "line", "plane", "solid")[int((sizes > THIN * sizes[0]).sum()) if sizes[0] > 1e-6 else 0], axes[2]


def check_geometry(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Sensor geometry and the dilution of precision that follows from it."""
    positions, where = _positions(rig, tables)
    known_height = bool(rig.tags) and all(tag.height is not None for tag in rig.tags.values())
    kinds = {name: kind for name, kind in KINDS.items() if name in tables and kind.sensors}
    if "fixes" in tables and rig.anchors and all(kind.noun != "anchor" for kind in kinds.values()):
        yield from _flat(np.stack(list(rig.anchors.values())), known_height)
    seen = {name: tables[name].filter(pl.col(kind.least[0]).is_not_null()) for name, kind in kinds.items()}
    ids = {name: seen[name].select(kind.sensors).unique(maintain_order=True).rows() for name, kind in kinds.items()}
    # An array of phases is as good as the two angles that they give.
    same = {name: KINDS["bearings"] if kinds[name].numbered else kinds[name] for name, rows in ids.items() if rows}
    told = {name: information(kind, rig, ids[name], positions) for name, kind in same.items()}
    # A distance and a direction are a position, each alone is none.
    together = len(told) > 1 and not dilution(np.sum(list(told.values()), axis=0)).weak(WEAK["m"], known_height)
    for name, kind in same.items():
        used = {key: kind.places(rig)[key] for row in ids[name] for key in row}
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
        found = dilution(told[name])
        figure = lambda x: f"{x:.3g}" if np.isfinite(x) else "undetermined"  # noqa: E731
        flat, up, known = (f"{figure(np.median(of))} ({figure(np.max(of))})" for of in found)
        message = (
            f"dilution of precision, median (worst): horizontal {flat}, vertical {up}, horizontal at known height "
        )
        what = f"m of {kind.columns[0].name.removesuffix('_m').replace('_', ' ')} noise"
        message += f"{known} m per {what if kind.unit == 'm' else 'degree of angle noise'}, {where}"
        if together and np.isinf(np.median(found.horizontal)):
            yield CheckResult("info", name, f"{message}; with the other tables positions are determined")
        elif found.weak(WEAK[kind.unit], known_height):
            remedy = "" if known_height else "give height_m of the tags, or "
            yield CheckResult("warning", name, f"{message}; weakly determined: {remedy}move or add a sensor")
        else:
            yield CheckResult("info", name, message)


def _positions(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> tuple[np.ndarray, str]:
    """Where dilution is evaluated, and that place in words."""
    true = (
        tables["truth"].select("x_m", "y_m", "z_m").drop_nulls().to_numpy() if "truth" in tables else np.zeros((0, 3))
    )
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
    level: Level = "info" if known_height and dimension == "plane" and abs(normal[2]) > 0.7 else "warning"
    if len(places) < least:
        message = f"anchors observed: {len(places)}, expected {least} or more for a position"
        yield CheckResult("warning", "rig.toml", message)
    elif dimension in ("point", "line"):
        message = "the anchors are collinear: positions on a circle around their line cannot be distinguished"
        yield CheckResult(level, "rig.toml", message)
    elif dimension == "plane" and abs(normal[2]) > 0.7:
        message = "the anchors are coplanar: the height is weakly determined and may be mirrored at their plane"
        known = "the height of the tags is known" if known_height else SAY_SIDE
        yield CheckResult(level, "rig.toml", f"{message} ({known})")
    elif dimension == "plane":
        message = "the anchors are coplanar in a vertical plane: positions may be mirrored at it"
        yield CheckResult(level, "rig.toml", message)


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
