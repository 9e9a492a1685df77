"""How well the places of anchors and stations determine a position: their spread, and dilution of precision.

Dilution is the standard deviation of a least-squares position per unit of measurement noise, all sensors heard:
σ² (Jᵀ J)⁻¹ with J the measurements' derivatives by position (Kaplan and Hegarty, Understanding GPS, chapter 7).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import polars as pl

from trackers.core.rig import Rig, Station
from trackers.recordings.checks.findings import Finding, Level

THIN = 0.1  # of the largest spread: below this, anchors count as being in one plane or on one line
WEAK_RANGES = 5.0  # m per m from which a coordinate counts as weakly determined
WEAK_ANGLES = 0.5  # m per degree
POINTS = 400  # places at which dilution is evaluated, at most
_ONE_DEGREE = np.radians(1.0)


@dataclass(frozen=True)
class Dilution:
    """Per place: horizontal and vertical standard deviation with a free height, and the horizontal with a known one."""

    horizontal: np.ndarray
    vertical: np.ndarray
    horizontal_at_height: np.ndarray


def range_dilution(anchors: np.ndarray, places: np.ndarray) -> Dilution:
    """Metres per metre of range noise at `places` (p, 3), m, from `anchors` (n, 3), m; infinite where undetermined."""
    toward = places[:, None, :] - anchors[None, :, :]
    distance = np.linalg.norm(toward, axis=-1, keepdims=True)
    return _dilution(toward / np.maximum(distance, 1e-9), 1.0)


def bearing_dilution(stations: Sequence[Station], places: np.ndarray) -> Dilution:
    """Metres per degree of azimuth and elevation noise at `places` (p, 3), m; infinite where undetermined."""
    rows = []
    for station in stations:
        x, y, z = station.position_in_array(places).T
        flat = np.maximum(np.hypot(x, z), 1e-6)  # straight above the array's y axis azimuth has no derivative
        square = flat**2 + y**2
        azimuth = np.stack([z, np.zeros_like(x), -x], axis=-1) / flat[:, None] ** 2
        elevation = np.stack([-x * y / flat, flat, -z * y / flat], axis=-1) / square[:, None]
        rows += [azimuth @ station.world_from_array().T, elevation @ station.world_from_array().T]
    return _dilution(np.stack(rows, axis=1), _ONE_DEGREE)


def _dilution(jacobian: np.ndarray, sigma: float) -> Dilution:
    information = np.einsum("pki,pkj->pij", jacobian, jacobian)
    spread = _spread(information)
    return Dilution(
        horizontal=sigma * np.sqrt(spread[:, 0] + spread[:, 1]),
        vertical=sigma * np.sqrt(spread[:, 2]),
        horizontal_at_height=sigma * np.sqrt(_spread(information[:, :2, :2]).sum(axis=1)),
    )


def _spread(information: np.ndarray) -> np.ndarray:
    """The diagonal of the inverse, infinite only for the coordinates that an undetermined direction has a part in."""
    values, vectors = np.linalg.eigh(information)
    share = np.where(vectors**2 > 1e-9, vectors**2, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(values > 1e-9 * values[:, -1:], 1 / values, np.inf)[:, None, :]
        return np.where(share > 0, share * inverse, 0.0).sum(axis=-1)


def shape(places: np.ndarray) -> tuple[Literal["point", "line", "plane", "solid"], np.ndarray]:
    """What `places` (n, 3) fill, thin shapes counting as flat ones, and the unit normal of their best plane."""
    centred = places - places.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=True)
    sizes = np.pad(sizes, (0, 3 - len(sizes)))
    filled = int((sizes > THIN * sizes[0]).sum()) if sizes[0] > 1e-6 else 0
    return ("point", "line", "plane", "solid")[filled], axes[2]


def check_geometry(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> list[Finding]:
    """Findings on how the sensors stand and what that does to a position."""
    findings = []
    places, words = _places(rig, tables)
    known_height = bool(rig.tags) and all(tag.height is not None for tag in rig.tags.values())
    anchors = {key: rig.anchors[key] for key in _heard(tables, "ranges", "anchor", "range_m")}
    if anchors:
        positions = np.stack(list(anchors.values()))
        findings += _twins(anchors) + _flat("anchors", positions, known_height)
        dilution = range_dilution(positions, places)
        findings += _dilution_findings("ranges", dilution, "m per m of range noise", WEAK_RANGES, known_height, words)
    elif "fixes" in tables and rig.anchors:
        findings += _flat("anchors", np.stack(list(rig.anchors.values())), known_height)
    for table, value in (("bearings", "azimuth_rad"), ("phases", "phase_1_rad")):
        stations = {key: rig.stations[key] for key in _heard(tables, table, "station", value)}
        if len(stations) == 1:
            message = f"only station {next(iter(stations))} is heard: a direction, but no position without a height"
            findings.append(Finding("info", table, message))
        elif stations:
            findings += _twins({key: station.position for key, station in stations.items()})
            if len(stations) > 2 and shape(np.stack([s.position for s in stations.values()]))[0] == "line":
                message = "the stations stand on one line: places near that line are weakly determined"
                findings.append(Finding("warning", "rig.toml", message))
            dilution = bearing_dilution(list(stations.values()), places)
            unit = "m per degree of angle noise"
            findings += _dilution_findings(table, dilution, unit, WEAK_ANGLES, known_height, words)
    return findings


def _heard(tables: Mapping[str, pl.DataFrame], name: str, column: str, value: str) -> list[str]:
    if name not in tables:
        return []
    return tables[name].filter(pl.col(value).is_not_null())[column].unique(maintain_order=True).to_list()


def _places(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> tuple[np.ndarray, str]:
    if "truth" in tables:
        true = tables["truth"].select("x_m", "y_m", "z_m").drop_nulls().to_numpy()
        if len(true):
            chosen = true[np.unique(np.linspace(0, len(true) - 1, POINTS).astype(int))]
            return chosen, f"at {len(chosen)} true positions"
    positions = [*rig.anchors.values(), *(station.position for station in rig.stations.values())]
    centre = np.mean(positions, axis=0) if positions else np.zeros(3)
    heights = [tag.height for tag in rig.tags.values() if tag.height is not None]
    if heights:
        centre = np.array([centre[0], centre[1], np.median(heights)])
    return centre[None, :], "at the middle of the rig" + (" on the tags' height" if heights else "")


def _twins(positions: Mapping[str, np.ndarray]) -> list[Finding]:
    keys = list(positions)
    points = np.stack(list(positions.values()))
    pairs = zip(*np.triu_indices(len(keys), 1), strict=True)
    twins = [f"{keys[i]} and {keys[j]}" for i, j in pairs if np.linalg.norm(points[i] - points[j]) < 1e-3]
    return [Finding("warning", "rig.toml", f"{pair} stand at one place; a copied line?") for pair in twins]


def _flat(what: str, positions: np.ndarray, known_height: bool) -> list[Finding]:
    kind, normal = shape(positions)
    level: Level = "info" if known_height else "warning"
    if len(positions) < 3:
        return [Finding("warning", "rig.toml", f"{what} heard: {len(positions)}, a position takes three or more")]
    if kind in ("point", "line"):
        message = f"the {what} stand on one line: all places on a circle round it look the same"
        return [Finding("warning", "rig.toml", message)]
    if kind == "plane" and abs(normal[2]) > 0.7:
        message = f"the {what} lie in one plane: the height is weakly determined and can flip to its mirror image"
        return [Finding(level, "rig.toml", message + (" (the tags' height is given)" if known_height else ""))]
    if kind == "plane":
        message = f"the {what} lie in one upright plane: positions can flip to the other side of it"
        return [Finding("warning", "rig.toml", message)]
    return []


def _dilution_findings(
    table: str, dilution: Dilution, unit: str, limit: float, known_height: bool, words: str
) -> list[Finding]:
    """One finding: median and worst, a warning where the coordinates that have to be found are weak."""
    wanted = dilution.horizontal_at_height if known_height else dilution.vertical
    weak = bool(np.median(wanted) > limit or np.median(dilution.horizontal_at_height) > limit)
    message = (
        f"dilution of precision, median (worst): horizontal {_pair(dilution.horizontal)}, "
        f"vertical {_pair(dilution.vertical)}, horizontal with the height known {_pair(dilution.horizontal_at_height)} "
        f"{unit}, {words}"
    )
    remedy = "move or add a sensor" if known_height else "give the tags' height_m, or move or add a sensor"
    advice = f"; weak: {remedy}" if weak else ""
    return [Finding("warning" if weak else "info", table, message + advice)]


def _pair(values: np.ndarray) -> str:
    shown = [f"{v:.3g}" if np.isfinite(v) else "undetermined" for v in (np.median(values), np.max(values))]
    return f"{shown[0]} ({shown[1]})"
