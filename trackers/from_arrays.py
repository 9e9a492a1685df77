"""Recordings from NumPy arrays that a user holds: fixes, ranges, bearings and phases, for trackers that run on arrays.

Everywhere: `times` (T,) s in ascending order, or time stamps in any unit, as of pandas; NaN marks a missing value;
`height` m is the tag's constant height, which trackers over the floor (`planar=True`) need; `truth` (T, 3) m, or (T, 2)
over the floor, is the true position, NaN where it is unknown. All raise UnusableInput, a ValueError, for arrays that do
not fit, and warn of coordinates as of a map, which single precision resolves to millimetres or less.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import jax
import numpy as np
import polars as pl

from trackwright.trackers.aoa.fusion import BEARINGS, bearing_inputs
from trackwright.trackers.aoa.rays import recent_points
from trackwright.trackers.core.data.recording import Readings, Recording, check_times, known_rows, masked, variances
from trackwright.trackers.core.errors import UnusableInput, floats, require, seconds
from trackwright.trackers.core.model.rig import Rig, Station, room_rows
from trackwright.trackers.core.run.track_loss import ROOM
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.parts.ranges import RANGES, range_inputs
from trackwright.trackers.recordings.checks import rules

COARSE_M = 1e-3  # spacing of single precision, m, from which coordinates are far from their origin: as of 8 km


def fix_recording(
    times: np.ndarray, positions: np.ndarray, *, std: np.ndarray | None = None, height: float | None = None,
    truth: np.ndarray | None = None, name: str = "recording",
) -> Recording:  # fmt: skip
    """Position fixes, `positions` (T, 2 or 3) m, as `fix_tracker` and its kin read them; `std`: of the same shape, m.

    With a `height`, for trackers over the floor (`planar=True`), z is masked.
    """
    values, seen = masked("positions", positions, len(times))
    reported = variances(std, values)
    if values.shape[1] == 2:
        values, seen, reported = (np.pad(x, ((0, 0), (0, 1))) for x in (values, seen, reported))
    if values.shape[1] != 3:
        raise UnusableInput(f"positions have {values.shape[1]} columns; expected x, y or x, y, z")
    if not seen[:, :2].any():
        raise UnusableInput(f"positions of shape {values.shape} are all NaN; expected one or more, m")
    check_times(name, seconds(times))
    # Coordinate by coordinate, so that a single wild fix counts little.
    whole = values[seen[:, :2].all(axis=1), :2]
    sizes = np.median(np.abs(whole - np.median(whole, axis=0)), axis=0) if len(whole) else np.zeros(2)
    about = {"x_m": sizes[:1], "y_m": sizes[1:]}
    _refuse_other_units("fix_recording", seconds(times), Rig("arrays"), "fixes", about)
    _warn_of_map("fix_recording", values[seen[:, 0]])
    if height is not None:
        seen[:, 2] = False
    elif not seen[:, 2].any():
        # A tracker over the floor predicts z from the height; without any z the prediction is compared with nothing.
        height = 0.0
    readings = {FIXES: Readings(values, seen, reported)}
    return Recording(times, readings, _height(times, height), _truth(truth, len(times)), name)


def range_recording(
    times: np.ndarray, ranges: np.ndarray, anchors: np.ndarray, *, anchor: np.ndarray | None = None,
    std: np.ndarray | None = None, height: float | None = None, side: str | None = None,
    truth: np.ndarray | None = None, name: str = "recording",
) -> Recording:  # fmt: skip
    """Ranges to `anchors` (A, 3) m, one per row, as `range_tracker` reads them; `std`: of the shape of `ranges`, m.

    `ranges`: (T, A) m, one column per anchor, each of which becomes a row of its own; or (T,) with the number `anchor`
    (T,) of the anchor of each. Ranges that are not positive are masked. `side`: above or below, where the tag is of
    anchors in one plane.
    """
    anchors, heights = floats("anchors", anchors), _heights(height)
    if anchors.ndim != 2 or anchors.shape[1] != 3:
        raise UnusableInput(f"anchors have shape {anchors.shape}; expected (A, 3), m")
    _warn_of_map("range_recording", anchors)
    check_times(name, seconds(times))
    table, truths = floats("ranges", ranges), _truth(truth, len(times))
    reported = variances(std, table)
    if anchor is None:
        if table.ndim != 2 or table.shape[1] != len(anchors):
            raise UnusableInput(
                f"ranges have shape {table.shape}; expected (T, {len(anchors)}), one per anchor, or (T,) and anchor="
            )
        kept = masked("ranges", table, len(times))[1]
        if not kept.any():
            raise UnusableInput(f"ranges of shape {table.shape} are all NaN; expected one or more, m")
        row, number = np.nonzero(kept)
        times, table, reported = seconds(times)[row], table[kept], reported[kept]
        truths = {key: (values[row], known[row]) for key, (values, known) in truths.items()}
    else:
        number = floats("anchor", anchor)
        if table.ndim != 1 or number.shape != table.shape or not np.isin(number, np.arange(len(anchors))).all():
            found = f"ranges have shape {table.shape} and anchor {number.shape}"
            raise UnusableInput(f"{found}; expected (T,) both, with anchors 0 to {len(anchors) - 1}")
    values, seen = masked("ranges", table[:, None], len(times))
    seen &= values > 0.0
    rig = Rig("arrays", anchors={str(number): place for number, place in enumerate(anchors)}, side=side)
    _refuse_other_units("range_recording", seconds(times), rig, "ranges", {"range_m": values[seen]})
    readings, ends = Readings(values, seen, reported[:, None]), np.array([0, len(values)])
    inputs = range_inputs(ends, seconds(times), readings, number.astype(int), anchors, heights, rig)
    inputs[ROOM.name] = room_rows(anchors, None, len(values))
    return Recording(times, {RANGES: readings}, inputs | _height(times, height), truths, name)


def bearing_recording(
    times: np.ndarray, bearings: np.ndarray, station: Sequence[str], stations: Mapping[str, Station], *,
    std: np.ndarray | None = None, height: float | None = None, truth: np.ndarray | None = None,
    name: str = "recording",
) -> Recording:  # fmt: skip
    """Azimuth and elevation, `bearings` (T, 2) rad, one pair per row, for `bearing_tracker`.

    `station`: (T,) the name of each row's station. `std`: (T, 2) rad. In the array's frame, z ahead, y up, the tag is
    in the direction (sin az cos el, sin el, cos az cos el): zero is straight ahead.
    """
    require(isinstance(stations, Mapping), "bearing_recording", stations, "stations by name, as {'west': Station(…)}")
    require(np.ndim(station) == 1, "bearing_recording", station, "the name of each row's station")
    unknown = sorted({str(s) for s in station if s not in stations})
    if unknown or len(station) != len(times):
        raise UnusableInput(
            f"station has {len(station)} names, unknown among them: {', '.join(unknown) or 'none'}; expected "
            f"{len(times)} of {', '.join(stations)}"
        )
    values, seen = masked("bearings", bearings, len(times))
    if values.shape[1] != 2:
        raise UnusableInput(f"bearings have {values.shape[1]} columns; expected azimuth and elevation, rad")
    # Of azimuths alone: below a station, noise takes many elevations beyond a right angle.
    angles = {"azimuth_rad": np.where(seen, values, np.nan)[:, 0], "elevation_rad": np.full(len(values), np.nan)}
    _refuse_other_units("bearing_recording", seconds(times), Rig("arrays"), "bearings", angles)
    geometry = {key: bearing_inputs(s) for key, s in stations.items()}
    where = np.stack([geometry[s] for s in station])
    _warn_of_map("bearing_recording", where[:, :3])
    reported = np.insert(variances(std, values), 1, 0.0, axis=1)
    starts = np.array([0, len(times)])
    nearby = recent_points(starts, seconds(times), where[:, :3], where[:, 3:], values, seen, _heights(height))
    number = np.array([list(stations).index(s) for s in station], float)
    inputs = {"origin": where[:, :3], "axes": where[:, 3:], "station": number, "nearby": nearby}
    inputs[ROOM.name] = room_rows(np.stack([s.position for s in stations.values()]), None, len(values))
    readings = {BEARINGS: Readings(values, seen, reported)}
    return Recording(times, readings, inputs | _height(times, height), _truth(truth, len(times)), name)


def phase_recording(
    times: np.ndarray, phases: Mapping[str, np.ndarray], *, height: float | None = None,
    truth: np.ndarray | None = None, name: str = "recording",
) -> Recording:  # fmt: skip
    """Phases (T, n) rad of the antennas of each station by name, for `direct_tracker` and `cascade_tracker`.

    One station under the name that `beam_tracker` was given suits that one.
    """
    expected = "phases (T, n) by the name of their station, as {'phases': phases}"
    require(isinstance(phases, Mapping), "phase_recording", phases, expected)
    readings = {key: Readings(*masked(f"phases['{key}']", values, len(times))) for key, values in phases.items()}
    for given in readings.values():
        columns = {f"phase_{n}_rad": x for n, x in enumerate(np.where(given.seen, given.values, np.nan).T)}
        _refuse_other_units("phase_recording", seconds(times), Rig("arrays"), "phases", columns)
    return Recording(times, readings, _height(times, height), _truth(truth, len(times)), name)


def _refuse_other_units(
    function: str, times: np.ndarray, rig: Rig, name: str, columns: Mapping[str, np.ndarray]
) -> None:
    """Raises UnusableInput for values, and times, s, of a size that suggests another unit, as `check` does.

    Warns of times that may be in milliseconds.
    """
    for result in rules.check_units(rig, {name: pl.DataFrame(columns).fill_nan(None)}):
        raise UnusableInput(f"{function}: {result.message.replace('from the rig', 'from their middle')}")
    for result in rules.check_times({name: pl.DataFrame({"t_s": times})}, base=False):
        if result.level == "error":
            raise UnusableInput(f"{function}: times: {result.message}")
        warnings.warn(f"{function}: times: {result.message}", stacklevel=3)


def _warn_of_map(function: str, points: np.ndarray) -> None:
    """Warns where half of the points (n, d), m, are so far from their origin that single precision is coarse there."""
    far = float(np.median(np.abs(points), axis=0).max()) if len(points) else 0.0
    step = np.spacing(np.asarray(far, jax.dtypes.canonicalize_dtype(float)))
    if step >= COARSE_M:
        warnings.warn(
            f"{function}: coordinates reach {far:.3g} m, where single precision, in which trackers compute, resolves "
            f"{step:.2g} m; subtract an origin near the tags from all of them and add it to the estimates",
            stacklevel=3,
        )


def _height(times: np.ndarray, height: float | None) -> dict[str, np.ndarray]:
    return {} if height is None else {"height": np.full(len(times), *_heights(height))}


def _heights(height: float | None) -> np.ndarray:
    """The constant height of the one tag (1,), m; NaN where it is unknown."""
    heights = floats("height", [np.nan if height is None else height])
    if heights.shape != (1,):
        raise UnusableInput(f"height has shape {heights.shape[1:]}; expected one number, m, at all times")
    return heights


def _truth(truth: np.ndarray | None, rows: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    if truth is None:
        return {}
    values, known = known_rows("truth", truth, rows)
    if values.shape[1] not in (2, 3):
        raise UnusableInput(f"truth has shape {values.shape}; expected ({rows}, 3), or ({rows}, 2) over the floor")
    return {"position": (values, known)}
