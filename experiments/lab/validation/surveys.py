"""Surveys of anchors: simulated ones against truth and the bound, and those of real recordings without their truth.

Simulated: rooms with 4 to 12 anchors on the walls, errors of Student's t of 10 cm, delays of 30 cm in common and 10 cm
each; half of the surveys with errors of 5 cm that last for 3 s, too. Walks: through space, at one known height or two.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import polars as pl
from scipy.signal import lfilter
from scipy.stats import binom, norm

import trackwright as tw
from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen
from trackwright.experiments.lab.validation.sites import recorded
from trackwright.experiments.text.terminal import progress
from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.tuning.survey.frames import aligned, frame_of
from trackwright.tuning.survey.result import Survey
from trackwright.tuning.survey.solving import FISHER
from trackwright.tuning.survey.surveying import delays_before, survey
from trackwright.tuning.survey.walks import walks_of

SURVEYS = 200
COVERED, ERRORS, CHANCE = (90.0, 98.0), 1.3, 0.99
"""Accepted coverage of 95 % intervals, error over bound, and probability of as few determined numbers beyond 3 σ."""

SCALE, DOF, LASTING, LASTS = 0.1, 4.0, 0.05, 3.0
HEIGHTS: Mapping[str, tuple[float | None, ...]] = {"space": (None,), "one height": (1.2,), "two heights": (0.5, 1.9)}
SECONDS, RATE = 90.0, 4.0
"""Duration of all walks of a survey, and epochs a second."""

REAL = {
    "starloc-fast": (("starloc-fast-s1",), 1.7),
    "rcv-drone": (("rcv-drone-3", "rcv-drone-6"), None),
    "iasl-drone": (("iasl-drone-1", "iasl-drone-2"), None),
    "lias": (("lias-planar-fast",), None),
}
"""Recordings of an installation, and the height of the tags, m, where their carrier would know it."""


def surveys(*, output: Output = DEFAULTS) -> int:
    """Simulated surveys of anchors against truth and the bound; 1 if a criterion fails."""
    kinds = [(walk, lasting) for lasting in (0.0, LASTING) for walk in HEIGHTS]
    numbers = range(3 if output.small else SURVEYS)
    results: dict[tuple[str, float], list[Row]] = {kind: [] for kind in kinds}
    with progress("surveys", len(numbers)) as advance, ProcessPoolExecutor(2, get_context("spawn")) as pool:
        of_kinds = [kinds[number % len(kinds)] for number in numbers]
        for kind, row in zip(of_kinds, pool.map(simulated_survey, numbers, *zip(*of_kinds, strict=True)), strict=False):
            results[kind].append(row)
            advance(1)
    rows = [_row(*kind, of_kind) for kind, of_kind in results.items() if of_kind]
    output.publish("validation surveys", Table(rows, note="Errors and bounds: root mean squares; s: processor time."))
    return int(any(row["good"] == "no" for row in rows))


def real_surveys(*sites: str, output: Output = DEFAULTS) -> int:
    """Surveys of the anchors of real recordings, without their truth, against the published positions.

    Args:
        sites: these alone.
    """
    keep_programs()
    rows = [real_survey(name) for name in chosen(sites, REAL, ("starloc-fast",) if output.small else ())]
    note = "Median errors of anchors after alignment; RMSE: horizontal, of uwb with the published and the surveyed rig."
    output.publish("validation real-surveys", Table(rows, note=note))
    return 0


def _row(walk: str, lasting: float, rows: Sequence[Row]) -> Row:
    z, bound = (np.concatenate([row[key] for row in rows]) for key in ("z", "over bound"))
    covered = 100.0 * float(np.mean(np.abs(z) < NORMAL)) if len(z) else np.nan
    ratio = float(np.sqrt(np.mean(bound**2))) if len(bound) else np.nan
    stated = np.concatenate([row["determined"] for row in rows])
    wrong, most = sum(row["wrong"] for row in rows), binom.ppf(CHANCE, stated.sum(), 2.0 * norm.sf(3.0))
    good = COVERED[0] <= covered <= COVERED[1] and wrong <= most and ratio <= ERRORS
    return {
        "walk": walk, "errors that last, cm": 100 * lasting, "surveys": len(rows), "inside 95 %": covered,
        "error / bound": ratio, "median error, cm": 100 * float(np.median(np.concatenate([r["error"] for r in rows]))),
        "determined %": 100.0 * float(stated.mean()), "wrong": wrong,
        "s": float(np.median([row["s"] for row in rows])), "good": "yes" if good else "no",
    }  # fmt: skip


def simulated_survey(seed: int, walk: str, lasting: float) -> Row:
    """The errors of one survey in units of its standard deviations and of the bound, of coordinates not mirrored."""
    folders, anchors, paths = simulated_site(seed, HEIGHTS[walk], lasting)
    began = time.process_time()
    found = survey(folders)
    seconds = time.process_time() - began
    turn, shift = frame_of(anchors[:3], np.concatenate(paths), walk != "space")
    true = anchors @ turn.T + shift
    if walk == "space" and np.abs(found.positions - true * [1, 1, -1]).sum() < np.abs(found.positions - true).sum():
        # Which side the tags are on is an assumption of the frame.
        true, turn = true * [1, 1, -1], turn * [[1], [1], [-1]]
        shift = shift * [1, 1, -1]
    error = found.positions - true
    # An image on the other side of the walk is stated as such, and not an error of the interval.
    counted = (found.half_widths[:, :3] > 0) & ~(found.mirrored[:, None] & (np.arange(3) == 2))
    sigma = found.half_widths[:, :3] / NORMAL
    stated = np.array([[over, over, height] for over, height in map(found.determined, found.names)])
    bound = _bound(found, folders, [path @ turn.T + shift for path in paths], true, lasting)
    return {
        "z": (error / np.where(counted, sigma, 1.0))[counted], "over bound": (error / bound)[counted & (bound < 1.0)],
        "error": np.linalg.norm(error[:, :2], axis=1), "determined": stated[counted],
        "wrong": int((np.abs(error) > 3.0 * sigma)[counted & stated].sum()), "s": seconds, "effect": found.effect,
    }  # fmt: skip


def _bound(
    found: Survey,
    folders: Sequence[tw.RecordingFolder],
    paths: Sequence[np.ndarray],
    true: np.ndarray,
    lasting: float,
) -> np.ndarray:
    """The bound (A, 3), m, of the coordinates that the survey estimates: dense, with the covariance of the errors.

    Errors that last are normal and unknown beside anchors and paths: of the readings of an anchor, those of Student's t
    count as normal ones of the same Fisher information.
    """
    precision = delays_before(len(true)).precision
    for walk, path, density in zip(walks_of(folders, found.names, None), paths, found.densities, strict=True):
        times = np.arange(len(path)) / RATE
        offset = np.column_stack([np.interp(walk.times, times, column) for column in path.T]) - true[walk.anchor]
        units = offset / np.linalg.norm(offset, axis=1)[:, None]
        along, partial = walk.along(units).toarray(), np.zeros((len(units), len(true), 4))
        partial[np.arange(len(units)), walk.anchor] = np.column_stack([-units, np.ones(len(units))])
        derivatives = np.column_stack([along, partial.reshape(len(units), -1)])
        information = np.zeros((derivatives.shape[1],) * 2)
        for k in range(len(true)):
            own = walk.anchor == k
            apart = np.abs(np.subtract.outer(walk.times[own], walk.times[own]))
            covariance = lasting**2 * np.exp(-apart / LASTS) + SCALE**2 / FISHER * np.eye(own.sum())
            information += derivatives[own].T @ np.linalg.solve(covariance, derivatives[own])
        size = along.shape[1]
        information[:size, :size] += walk.roughness.toarray() / density + 1e-6 * np.eye(size)
        cross = information[:size, size:]
        precision = precision + information[size:, size:] - cross.T @ np.linalg.solve(information[:size, :size], cross)
    free = np.diag(found.covariance) > 0
    bound = np.full(len(free), np.inf)
    bound[free] = np.sqrt(np.diag(np.linalg.inv(precision[np.ix_(free, free)] + 1e-6 * np.eye(free.sum()))))
    return bound.reshape(-1, 4)[:, :3]


def on_walls(size: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """The places (n, 2), m, on the walls of a room of this size (2,) at shares of the way around it."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * size
    along = np.cumsum(np.append(0.0, np.abs(np.diff(corners, axis=0)).sum(axis=1)))
    return np.column_stack([np.interp(shares * along[-1], along, column) for column in corners.T])


def simulated_site(
    seed: int, heights: Sequence[float | None], lasting: float, seconds: float = SECONDS
) -> tuple[list[tw.RecordingFolder], np.ndarray, list[np.ndarray]]:
    """Recordings of a room, `seconds` in all, true anchors (A, 3) and true positions (n, 3) of each epoch, m."""
    random = np.random.default_rng([seed, 35])
    size, count = random.uniform([5.0, 4.0], [12.0, 10.0]), int(random.integers(4, 13))
    walls = on_walls(size, (np.arange(count) + random.uniform(0.0, 0.6, count)) / count)
    anchors = np.column_stack([walls, random.uniform(0.3, 2.8, count)])[random.permutation(count)]
    # Three anchors in a line make no frame.
    ahead, asides = (anchors[1] - anchors[0])[:2], (anchors[2:] - anchors[0])[:, :2]
    third = 2 + int(np.argmax(np.abs(asides @ [-ahead[1], ahead[0]])))
    anchors[[2, third]] = anchors[[third, 2]]
    delays = 0.3 * random.standard_normal() + 0.1 * random.standard_normal(count)
    names = [f"A{k:02d}" for k in range(count)]
    folders, paths = [], []
    for number, height in enumerate(heights):
        times = np.arange(int(seconds / len(heights) * RATE)) / RATE
        path = smooth_path(times, np.append(size, 2.5), random)
        if height is not None:
            path[:, 2] = height
        ranges = np.linalg.norm(path[:, None] - anchors, axis=2) + delays
        ranges += SCALE * random.standard_t(DOF, ranges.shape) + lasting * lasting_errors(times, count, random)
        row, anchor = np.nonzero((random.random(ranges.shape) < 0.9) & (ranges > 0.05))
        table = pl.DataFrame({
            "t_s": times[row], "tag": ["0"] * len(row), "anchor": [names[k] for k in anchor],
            "range_m": ranges[row, anchor],
        })  # fmt: skip
        rig = tw.Rig(f"survey {seed}-{number}", tags={"0": tw.Tag(height=height)})
        folders.append(tw.RecordingFolder(rig.name, None, rig, {"ranges": table}))
        paths.append(path)
    return folders, anchors, paths


def smooth_path(times: np.ndarray, size: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A smooth path (n, 3), m, through a room of this size, half a metre from its walls and floor."""
    frequency, phase = random.uniform(0.01, 0.1, (3, 6, 1)), random.uniform(0.0, 2.0 * np.pi, (3, 6, 1))
    waves = np.sin(2.0 * np.pi * frequency * times + phase).sum(axis=1)
    share = 0.5 + 0.5 * waves / np.abs(waves).max(axis=1, keepdims=True)
    return np.asarray(0.5 + share.T * (size - 1.0))


def lasting_errors(times: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Errors (n, count) of unit variance with an exponential correlation over `LASTS` s."""
    keep = np.exp(-1.0 / (RATE * LASTS))
    steps = random.standard_normal((len(times), count)) * np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], steps, axis=0))


def real_survey(name: str) -> Row:
    """Anchors of real recordings, aligned with the published ones, and tracking with either."""
    patterns, height = REAL[name]
    folders = recorded(patterns)
    began = time.process_time()
    # The published positions are no start, and do not say on which side of a walk an anchor is.
    found = survey([replace(f, rig=replace(f.rig, anchors={})) for f in folders], height=height)
    seconds = time.process_time() - began
    published = np.array([folders[0].rig.anchors[anchor] for anchor in found.names])
    heights = [rig_tag.height for rig_tag in folders[0].rig.tags.values()]
    flat = height is not None or (bool(heights) and None not in heights)
    (turn, shift), *_ = aligned(found.positions, published, 2 if flat else 3)
    moved = found.positions @ turn.T + shift
    error = moved - published
    sigma = _turned_sigmas(found, turn)
    surveyed = dict(zip(found.names, moved, strict=True))
    errors = [_rmse(folders), _rmse([replace(f, rig=replace(f.rig, anchors=surveyed)) for f in folders])]
    return {
        "site": name, "anchors": len(found.names), "ranges": int(found.readings.sum()), "effect": float(found.effect),
        "horizontal, cm": 100.0 * float(np.median(np.linalg.norm(error[:, :2], axis=1))),
        "vertical, cm": 100.0 * float(np.median(np.abs(error[:, 2]))),
        "interval, cm": 100.0 * float(np.median(NORMAL * sigma[:, :2])),
        "RMSE published, cm": 100.0 * errors[0], "surveyed, cm": 100.0 * errors[1],
        "ratio": errors[1] / errors[0], "s": seconds,
    }  # fmt: skip


def _turned_sigmas(found: Survey, turn: np.ndarray) -> np.ndarray:
    """The standard deviations (A, 3), m, of positions turned by a matrix (3, 3)."""
    blocks = [found.block(k)[:3, :3] for k in range(len(found.names))]
    return np.sqrt([np.diag(turn @ block @ turn.T) for block in blocks])


def _rmse(folders: Sequence[tw.RecordingFolder]) -> float:
    """The horizontal RMSE, m, of `uwb` on recordings with truth."""
    tracker = tw.build("uwb", folders)
    return float(tw.evaluate(tracker.run(folders), folders)["rmse_m"])
