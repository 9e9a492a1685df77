"""The frame and the clock of an imported truth brought over to a recording's: as given, or as readings tell."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.trajectories import Similarity
from trackwright.trackers.recordings.checks.mistakes import about_vertical
from trackwright.trackers.recordings.checks.readings import Compared, compared, robust_fit
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS

LONGEST_S, STEP_S = 10.0, 0.5  # differences of the clocks that are searched: some decimetres of motion between two
FEW, NEAR = 240, 3  # readings of the search, and how many of its 24 turns are refined at each difference
DETERMINED_M, SURE = 0.05, 3.0  # standard error of z that is determined, and standard errors that are not zero


class Placement(NamedTuple):
    """A turn about z by `yaw`, °, a shift (`x`, `y`, `z`), m, after it, and `later`, s, added to the times."""

    x: float
    y: float
    z: float
    yaw: float
    later: float = 0.0

    def text(self) -> str:
        """As `--transform` takes it: `1.200,-0.300,0.000,37.000,0.350`."""
        return ",".join(f"{round(float(x), 3) + 0.0:.3f}" for x in self)

    def of_table(self, truth: pl.DataFrame) -> pl.DataFrame:
        """The truth, positions and attitudes, in the other frame and on the other clock."""
        moved = Similarity(about_vertical(math.radians(self.yaw)), np.array(self[:3])).table(truth)
        return moved.with_columns(pl.col("t_s") + self.later)


def moved_truth(truth: pl.DataFrame, recording: RecordingFolder, transform: str | None) -> tuple[pl.DataFrame, str]:
    """A truth moved by X,Y,Z,YAW,S, or as the readings of a recording fit it, and how; raises UnusableInput."""
    if transform is None:
        tables = dict(recording.tables) | {"truth": truth.sort("t_s", maintain_order=True)}
        placement, words = found_placement(replace(recording, tables=tables))
        return placement.of_table(truth), f"truth moved by --transform {placement.text()}: {words}"
    try:
        placement = Placement(*map(float, transform.split(",")))
        if np.isfinite(placement).all():
            return placement.of_table(truth), f"truth moved by --transform {transform}"
    except (ValueError, TypeError):
        pass
    expected = "X,Y,Z,YAW or X,Y,Z,YAW,S: a shift in m after a turn about z in degrees, and s added to the times"
    raise UnusableInput(f"--transform {transform}: expected {expected}")


def found_placement(recording: RecordingFolder) -> tuple[Placement, str]:
    """The placement of the truth that its readings fit best, and how well, in words; or UnusableInput.

    Without a shift in z where readings determine it neither to `DETERMINED_M` nor as other than zero.
    """
    view = next((view for table in KINDS if (view := compared(recording, table)) is not None), None)
    if view is None:
        fix = "expected some of the same tag on about the same clock; import them first, or give --transform"
        raise UnusableInput(f"--align-truth: {recording.name}: no measurement at the times of the truth; {fix}")
    centre, kept = view.positions.mean(axis=0), ""

    def errors(x: np.ndarray) -> np.ndarray:
        return _errors(view.later(float(x[4])), centre, x)

    def level(x: np.ndarray) -> np.ndarray:
        return errors(np.insert(x, 3, centre[2]))

    x, _ = robust_fit(errors, _searched(view.thinned(FEW), centre))
    std = _standard_errors(view, errors, x)
    if std[3] > DETERMINED_M and abs(x[3] - centre[2]) < SURE * std[3]:
        kept = f"z as it was, since its shift of {x[3] - centre[2]:.2f} ± {std[3]:.2f} m may be zero; "
        part, _ = robust_fit(level, np.delete(x, 3))
        x, std = np.insert(part, 3, centre[2]), np.insert(_standard_errors(view, level, part), 3, 0.0)
    of_groups = view.sizes(errors(x))
    known = np.isfinite(of_groups).any(axis=0)
    sizes = np.nanmedian(of_groups[:, known], axis=0)
    typical = ", ".join(f"{size:.2g} {view.kind.unit}" for size in sizes)
    if not (sizes <= view.kind.sizes("large", len(known))[known]).all():
        raise UnusableInput(
            f"--align-truth: no turn about z, shift and difference of clocks up to {LONGEST_S:g} s explains the "
            f"{view.kind.name}: errors of {typical} are left; check the rig and the tag, or give --transform"
        )
    shift, yaw = x[1:4] - about_vertical(x[0]) @ centre, math.degrees(math.remainder(x[0], 2 * math.pi))
    certain = f"{std[1]:.2g}, {std[2]:.2g}, {std[3]:.2g} m in x, y, z, {math.degrees(std[0]):.2g}°, {std[4]:.2g} s"
    words = f"{kept}{view.kind.name} then differ by {typical} typically; standard errors at the middle: {certain}"
    return Placement(shift[0], shift[1], shift[2], yaw, x[4]), words


def _standard_errors(view: Compared, errors: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """The standard errors of fitted numbers: a jackknife over anchors or stations, or ten spans of time.

    Distances may have an error in common.
    """
    rows = len(view.group)
    part = view.group if len(view.ids) > 2 else np.argsort(np.argsort(view.times)) * 10 // rows
    parts = part.max() + 1

    def without(k: int, x: np.ndarray) -> np.ndarray:
        return np.where(part[:, None] == k, np.nan, errors(x[:-1]) - view.kind.columns[0].positive * x[-1])

    fits = np.array([robust_fit(partial(without, k), np.append(x, 0.0))[0] for k in range(parts)])
    return np.asarray(np.sqrt((parts - 1) * fits.var(axis=0)))[:-1]


def _errors(view: Compared, centre: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The errors of the readings with the truth turned by x[0], rad, about `centre`, which goes to x[1:4]."""
    return view._replace(positions=x[1:4] + (view.positions - centre) @ about_vertical(x[0]).T).errors()


def _searched(view: Compared, centre: np.ndarray) -> np.ndarray:
    """The best of some turns at each difference of the clocks, each with the shift that fits it."""
    middle = np.nanmean((view.values if view.kind.position else view.sensors.places)[:, :2], axis=0)
    fits = []
    for later in np.arange(-LONGEST_S, LONGEST_S + STEP_S, STEP_S):
        known = np.isfinite((shifted := view.later(float(later))).positions).all(axis=1)
        if 2 * known.sum() >= len(known):
            errors = partial(_errors, shifted.of_rows(known), centre)
            starts = [np.append(yaw, [*middle, centre[2]]) for yaw in np.arange(24) * np.pi / 12]
            starts.sort(key=lambda x: float(np.nanmean(np.log1p(np.abs(errors(x))))))
            x, size = min((robust_fit(errors, start, 8) for start in starts[:NEAR]), key=lambda fit: fit[1])
            fits.append((size, np.append(x, later)))
    return min(fits, key=lambda fit: fit[0])[1]
