"""Surveys of stations with bearings: simulated ones against truth and the bound, and those of Bluetooth walks.

Simulated: rooms with 4 to 8 stations on the walls, tilted and turned, angles with gains that scatter by 0.1 and errors
of Student's t of 3°; half of the surveys with errors of 2° that last for 3 s, too. Walks: through space, or at one
known height.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import numpy as np
import polars as pl
import scipy.sparse as sparse
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import trackwright as tw
from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen
from trackwright.experiments.lab.validation.sites import recorded
from trackwright.experiments.lab.validation.surveys import (
    COVERED,
    DOF,
    ERRORS,
    LASTS,
    RATE,
    SECONDS,
    lasting_errors,
    on_walls,
    smooth_path,
)
from trackwright.experiments.text.terminal import progress
from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.tuning.survey.bearings import POSITION, bearing_walks
from trackwright.tuning.survey.site import Site
from trackwright.tuning.survey.solving import FISHER
from trackwright.tuning.survey.station_result import StationSurvey
from trackwright.tuning.survey.stations import UNKNOWNS, prior_of
from trackwright.tuning.survey.surveying import survey

SURVEYS = 42
SCALE, LASTING, GAIN = np.deg2rad(3.0), np.deg2rad(2.0), 0.1
TAPE, TURNED = 0.1, 5.0
"""Standard deviations of positions, m, and rotations, °, that are refined."""

CASES: Mapping[str, dict[str, Any]] = {
    "positions given": {"given": "all"},
    "all given roughly": {"given": "all", "sigma": TAPE, "sigma_deg": TURNED},
    "two positions given": {"given": ("S0", "S1")},
}
HEIGHTS = (None, 1.2)
"""Of the tag, m; None: through space."""

WALKS, ROUGHLY = [f"ble51-walk-u{use}-r{run}" for use in (1, 2, 3) for run in (1, 2)], 10.0
"""Recordings, and the standard deviation, °, about each axis of rotations that are refined in them."""


def bearing_surveys(*, output: Output = DEFAULTS) -> int:
    """Simulated surveys of stations against truth and the bound; 1 if a criterion fails."""
    kinds = [(case, lasting) for lasting in (0.0, LASTING) for case in CASES]
    numbers = range(2 if output.small else SURVEYS)
    of_kinds = [kinds[number % len(kinds)] for number in numbers]
    results: dict[tuple[str, float], list[Row]] = {kind: [] for kind in kinds}
    with progress("surveys", len(numbers)) as advance, ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for kind, row in zip(of_kinds, pool.map(simulated_survey, numbers, *zip(*of_kinds, strict=True)), strict=True):
            results[kind].append(row)
            advance(1)
    rows = [_row(case, f"{np.rad2deg(of):g}", found) for (case, of), found in results.items() if found]
    rows.append(_row("all", "", [row for found in results.values() for row in found]))
    note = "Errors and bounds: root mean squares; medians of the errors of a position and of a turn; s: processor time."
    output.publish("validation bearing-surveys", Table(rows, note=note))
    return int(not output.small and rows[-1]["good"] == "no")


def real_bearing_surveys(*walks: str, output: Output = DEFAULTS) -> int:
    """Rotations of the stations of Bluetooth walks, without their truth, against the published ones, and tracking.

    Args:
        walks: these alone.
    """
    keep_programs()
    rows = []
    for name in chosen(walks, WALKS, WALKS[:1] if output.small else ()):
        for folder in recorded((name,)):
            published = _rmse(folder)
            rows += [real_survey(folder, WALKS.index(name), sigma, published) for sigma in (None, ROUGHLY)]
    note = (
        "Turns: medians of the angles between rotations and the published ones; wrong: determined and off by more than "
        "three standard deviations; RMSE: horizontal, of bearings with the rig as published, as given, and as surveyed."
    )
    output.publish("validation real-bearing-surveys", Table(rows, note=note))
    return int(any(row["wrong"] for row in rows))


def real_survey(folder: tw.RecordingFolder, seed: int, sigma: float | None, published: float) -> Row:
    """Rotations found from published positions alone, or given ones off by `sigma` degrees about each axis refined.

    `published`: the RMSE of tracking with the published rig, m.
    """
    random, true = np.random.default_rng([seed, 39]), folder.rig.stations
    # Unknown ones are all the same in the file.
    rough = {
        name: replace(
            station,
            rotation=np.eye(4)[0]
            if sigma is None
            else turned(station.rotation, np.deg2rad(sigma) * random.standard_normal(3)),
        )
        for name, station in true.items()
    }
    given = replace(folder, rig=replace(folder.rig, stations=rough))
    began = time.process_time()
    found = survey([given], given="all", sigma_deg=sigma)
    seconds = time.process_time() - began
    assert isinstance(found, StationSurvey)
    errors = errors_of(found, folder.rig)[:, 3:]
    before = errors_of(replace(found, rotations=np.array([rough[name].rotation for name in found.names])), folder.rig)
    sigmas = found.half_widths[:, 3:6] / NORMAL
    stated = np.array([[heading and tilt] * 3 for *_, heading, tilt in map(found.determined, found.names)])
    return {
        "recording": folder.name, "rotations given": "no" if sigma is None else f"to {sigma:g}°",
        "effect": float(found.effect), "given, °": _median_turn(before[:, 3:]) if sigma else "",
        "surveyed, °": _median_turn(errors), "inside 95 %": 100.0 * float(np.mean(np.abs(errors) < NORMAL * sigmas)),
        "determined %": 100.0 * float(np.mean(stated)), "wrong": int((np.abs(errors) > 3.0 * sigmas)[stated].sum()),
        "RMSE published, m": published, "given, m": _rmse(given) if sigma else "",
        "surveyed, m": _rmse(replace(folder, rig=found.rig)), "s": seconds,
    }  # fmt: skip


def _median_turn(turns: Float[np.ndarray, "S 3"]) -> float:
    return float(np.rad2deg(np.median(np.linalg.norm(turns, axis=1))))


def _rmse(folder: tw.RecordingFolder) -> float:
    """The horizontal RMSE, m, of `bearings` on a recording with truth."""
    return float(tw.evaluate(tw.build("bearings", [folder]).run([folder]), [folder])["rmse_m"])


def _row(case: str, lasting: str, rows: Sequence[Row]) -> Row:
    z, bound, stated = (np.concatenate([row[key] for row in rows]) for key in ("z", "over bound", "determined"))
    covered, ratio = 100.0 * float(np.mean(np.abs(z) < NORMAL)), float(np.sqrt(np.mean(bound**2)))
    wrong = sum(row["wrong"] for row in rows)
    good = COVERED[0] <= covered <= COVERED[1] and wrong == 0 and ratio <= ERRORS
    moved, turned = (np.concatenate([row[key] for row in rows]) for key in ("moved", "turned"))
    return {
        "known": case, "errors that last, °": lasting, "surveys": len(rows), "inside 95 %": covered,
        "error / bound": ratio, "position, cm": 100.0 * float(np.median(moved)) if len(moved) else "",
        "turn, °": float(np.rad2deg(np.median(turned))), "determined %": 100.0 * float(np.mean(stated)),
        "wrong": wrong, "s": float(np.median([row["s"] for row in rows])), "good": "yes" if good else "no",
    }  # fmt: skip


def simulated_survey(seed: int, case: str, lasting: float) -> Row:
    """The errors of one survey in units of its standard deviations and of the bound."""
    folder, truth, path = simulated_stations(seed, HEIGHTS[seed // (2 * len(CASES)) % 2], lasting)
    random = np.random.default_rng([seed, 37])
    known = CASES[case]
    rough = {
        name: replace(
            station,
            position=station.position + known.get("sigma", 0.0) * random.standard_normal(3),
            rotation=turned(station.rotation, np.deg2rad(known["sigma_deg"]) * random.standard_normal(3))
            if "sigma_deg" in known
            else np.eye(4)[0],
        )
        for name, station in folder.rig.stations.items()
    }
    began = time.process_time()
    found = survey([replace(folder, rig=replace(folder.rig, stations=rough))], **known)
    seconds = time.process_time() - began
    assert isinstance(found, StationSurvey)
    errors = errors_of(found, folder.rig)
    sigma = np.sqrt(np.diag(found.covariance)).reshape(-1, UNKNOWNS)[:, :6]
    free = sigma > 0.0
    stated = np.array(
        [
            [over, over, high, *[heading and tilt] * 3]
            for over, high, heading, tilt in map(found.determined, found.names)
        ]
    )
    bound = bound_of(found, folder, truth, path, lasting, known)[:, :6]
    finite = free & (bound < [1.0] * 3 + [0.3] * 3)
    return {
        "z": (errors / np.where(free, sigma, 1.0))[free], "over bound": (errors / bound)[finite],
        "moved": np.linalg.norm(errors[:, :3], axis=1)[free[:, 0]], "turned": np.linalg.norm(errors[:, 3:], axis=1),
        "determined": stated[free], "wrong": int((np.abs(errors) > 3.0 * sigma)[free & stated].sum()), "s": seconds,
    }  # fmt: skip


def errors_of(found: StationSurvey, true: tw.Rig) -> Float[np.ndarray, "S 6"]:
    """The errors of positions, m, and of turns about the array's axes, rad."""
    stations = [true.stations[name] for name in found.names]
    turns = Rotation.from_quat([s.rotation for s in stations], scalar_first=True).inv()
    turned = (turns * Rotation.from_quat(found.rotations, scalar_first=True)).as_rotvec()
    return np.column_stack([found.positions - [s.position for s in stations], turned])


def turned(rotation: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """A quaternion w, x, y, z turned about its own axes by a rotation vector, rad."""
    whole = Rotation.from_quat(rotation, scalar_first=True) * Rotation.from_rotvec(turn)
    return whole.as_quat(scalar_first=True)


def bound_of(
    found: StationSurvey, folder: tw.RecordingFolder, truth: Float[np.ndarray, "S 8"], path: Float[np.ndarray, "n 3"],
    lasting: float, known: Mapping[str, Any],
) -> Float[np.ndarray, "S 8"]:  # fmt: skip
    """The bound of the unknowns at the truth, with errors that last as unknowns that are eliminated like the path."""
    names = found.names
    (walk,) = bearing_walks([folder], names, None)
    times = np.arange(len(path)) / RATE
    at = np.column_stack([np.interp(walk.times, times, column) for column in path.T])
    _, units, partial = walk.linearised(truth, walk.fitted(at))
    weight, rough = FISHER / SCALE**2, walk.rough(found.densities[0])
    along, errors = walk.along(units), sparse.eye_array(len(walk.times))
    blocks = [rough + 1e-6 * sparse.eye_array(rough.shape[0])]
    if lasting > 0.0:
        along = sparse.hstack([along, errors])
        blocks.append(_markov(walk.levels[:, 0], walk.times) / lasting**2)
    eliminated = sparse.csc_array(sparse.block_diag(blocks) + weight * (along.T @ along))
    cross = weight * (along.T @ partial)
    given = (names if known["given"] == "all" else known["given"], known.get("sigma", 0.0))
    turn = np.deg2rad(known["sigma_deg"]) if "sigma_deg" in known else None
    prior = prior_of(Site([folder], names, [walk], truth[:, POSITION], *given, (), turn))
    whole = prior.precision + weight * partial.T @ partial - cross.T @ sparse.linalg.splu(eliminated).solve(cross)
    bound = np.full(len(whole), np.inf)
    bound[prior.free] = np.sqrt(np.diag(np.linalg.inv(whole[np.ix_(prior.free, prior.free)])))
    return bound.reshape(-1, UNKNOWNS)


def _markov(levels: np.ndarray, times: np.ndarray) -> sparse.csr_array:
    """The precision (n, n) of errors of unit variance, of several levels, that are correlated over `LASTS` s."""
    order = np.lexsort((times, levels))
    same = np.diff(levels[order]) == 0
    keep = np.where(same, np.exp(-np.diff(times[order]) / LASTS), 0.0)
    step = np.append(1.0, 1.0 / np.sqrt(1.0 - keep**2))
    # Each error less what is kept of the one before, over the standard deviation of what is new.
    whiten = sparse.diags_array([step, -keep * step[1:]], offsets=[0, -1])
    placed = sparse.csr_array(whiten)[:, np.argsort(order)]
    return sparse.csr_array(placed.T @ placed)


def simulated_stations(
    seed: int, height: float | None, lasting: float
) -> tuple[tw.RecordingFolder, Float[np.ndarray, "S 8"], Float[np.ndarray, "n 3"]]:
    """A recording of a room with its true rig, the stations' unknowns there, and the true path, m."""
    random = np.random.default_rng([seed, 38])
    size, count = random.uniform([5.0, 4.0], [12.0, 10.0]), int(random.integers(4, 9))
    walls = on_walls(size, (np.arange(count) + random.uniform(0.2, 0.8, count)) / count)
    positions = np.column_stack([walls, random.uniform(1.8, 2.8, count)])[random.permutation(count)]
    stations = {}
    for k, position in enumerate(positions):
        towards = tw.sim.facing(position, np.append(0.5 * size, 1.0), (0.0, 0.0, 1.0))
        stations[f"S{k}"] = tw.Station(position, turned(towards, 0.15 * random.standard_normal(3)))
    gains = 1.0 + GAIN * random.standard_normal((count, 2))
    times = np.arange(int(SECONDS * RATE)) / RATE
    path = smooth_path(times, np.append(size, 2.5), random)
    if height is not None:
        path[:, 2] = height
    angles = gains * np.stack([station.angles(path) for station in stations.values()], axis=1)
    errors = SCALE * random.standard_t(DOF, angles.shape)
    for k in range(2):
        errors[..., k] += lasting * lasting_errors(times, count, random)
    angles = angles + errors
    row, station = np.nonzero(random.random(angles.shape[:2]) < 0.9)
    table = pl.DataFrame({
        "t_s": times[row], "tag": ["0"] * len(row), "station": [f"S{k}" for k in station],
        "azimuth_rad": angles[row, station, 0], "elevation_rad": angles[row, station, 1],
    })  # fmt: skip
    rig = tw.Rig(f"stations {seed}", stations=stations, tags={"0": tw.Tag(height=height)})
    truth = np.column_stack([positions, np.zeros((count, 3)), gains])
    return tw.RecordingFolder(rig.name, None, rig, {"bearings": table}), truth, path
