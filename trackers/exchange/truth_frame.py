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
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.exchange.trajectories import Similarity
from trackwright.trackers.recordings.checks.changes import about_vertical, transform_text
from trackwright.trackers.recordings.checks.compared import Compared, cauchy_weights, compared, robust_fit
from trackwright.trackers.recordings.checks.imu import between, imu_rows, spaced, true_attitude
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS

LONGEST_S, STEP_S = 10.0, 0.5
"""Differences of the clocks that are searched, and their steps; motion of a few decimetres lies between two."""

LEANING, PUSH_S = 5.0, 0.2
"""Angle of gravity to z, °, from which a truth is levelled, and the time over which an IMU is averaged, s."""

FEW, NEAR = 240, 3
"""Readings of the search, and how many of its 24 turns are refined at each difference of the clocks."""

DETERMINED_M, SURE = 0.05, 3.0
"""Standard error, m, up to which a shift in z is determined, and standard errors from which it is other than zero."""


class Placement(NamedTuple):
    """A turn about z by `yaw`, °, a shift (`x`, `y`, `z`), m, after it, and `later`, s, added to the times."""

    x: float
    y: float
    z: float
    yaw: float
    later: float = 0.0

    def __str__(self) -> str:
        """As `--transform` takes it."""
        return transform_text(*self)

    def of_table(self, truth: pl.DataFrame) -> pl.DataFrame:
        """The truth, positions and attitudes, in the other frame and on the other clock."""
        moved = Similarity(about_vertical(math.radians(self.yaw)), np.array(self[:3])).table(truth)
        return moved.with_columns(pl.col("t_s") + self.later)


def parsed_placement(text: str) -> Placement:
    """The placement of a text X,Y,Z,YAW or X,Y,Z,YAW,S; raises UnusableInput."""
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 5) or not np.isfinite(numbers).all():
        raise UnusableInput(
            f"--transform {text}: expected X,Y,Z,YAW or X,Y,Z,YAW,S: a shift in m after a turn about z in degrees, and "
            "seconds added to the times"
        )
    return Placement(*numbers)


def with_truth_moved(
    imported: RecordingFolder, recording: RecordingFolder, transform: str | None, flat: bool
) -> tuple[RecordingFolder, list[str]]:
    """The imported tables with the truth moved by `transform`, or as readings fit it, and notices.

    `recording`: that to which they are added. `flat`: without a shift in z. Raises UnusableInput.
    """
    truth = imported.tables.get("truth")
    if truth is None:
        raise UnusableInput("--transform and --align-truth: move a truth; expected --table truth")
    notices = []
    if transform is not None:
        placement = parsed_placement(transform)
    else:
        ordered = dict(recording.tables) | {"truth": truth.sort("t_s", maintain_order=True)}
        level, angle = leaning(replace(recording, tables=ordered))
        if angle:
            words = f"truth levelled, which leaned by {angle:.0f}° against the gravity that the IMU measures; then"
            notices, truth = [words], level.table(truth)
        ordered["truth"] = truth.sort("t_s", maintain_order=True)
        placement, words = found_placement(replace(recording, tables=ordered), flat)
        notices.append(f"truth moved by --transform {placement}: {words}")
    return replace(imported, tables=dict(imported.tables) | {"truth": placement.of_table(truth)}), notices


def leaning(recording: RecordingFolder) -> tuple[Similarity, float]:
    """The turn that makes gravity vertical in the truth's frame, and its angle, °: 0 where an IMU does not tell.

    Gravity is the mean of the specific force, which true attitudes take from body axes to the frame of the truth.
    """
    truth = recording.tables["truth"]
    for tag in truth["tag"].unique(maintain_order=True) if "imu" in recording.tables else ():
        rows, attitude = imu_rows(recording.tables["imu"], tag), true_attitude(truth.filter(pl.col("tag") == tag))
        if rows is None or attitude is None:
            continue
        at = spaced(attitude.times, PUSH_S)
        row = np.searchsorted(attitude.times, at).clip(max=len(attitude.times) - 1)
        force = between(rows.times, rows.pushed, at - PUSH_S / 2, at + PUSH_S / 2) / PUSH_S
        force = np.einsum("nij,nj->ni", rotation_matrices(attitude.quaternions[row]), force)
        x, y, z = force[np.isfinite(force).all(axis=1)].sum(axis=0) / max(np.isfinite(force[:, 0]).sum(), 1)
        size = max(math.hypot(x, y, z), 1e-9)
        x, y, z = x / size, y / size, z / size
        if 9.0 < size < 11.0 and LEANING < math.degrees(math.acos(z)) < 180.0 - LEANING:
            K = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
            return Similarity(np.eye(3) + K + K @ K / (1.0 + z), np.zeros(3)), math.degrees(math.acos(z))
    return Similarity(np.eye(3), np.zeros(3)), 0.0


def found_placement(recording: RecordingFolder, flat: bool = False) -> tuple[Placement, str]:
    """The placement of the truth that its readings fit best, and how well, in words, with standard errors.

    Without a shift in z where `flat`, and where the readings determine it neither to `DETERMINED_M` nor as other than
    zero. Raises UnusableInput without readings at the times of the truth, and where no placement explains them.
    """
    views = (compared(recording, table) for table in KINDS)
    view = next((view for view in views if view is not None), None)
    if view is None:
        raise UnusableInput(
            f"--align-truth: {recording.name}: no measurement of a position at the times of the truth; expected some "
            "of the same tag on about the same clock; import them first, or give --transform"
        )
    centre = view.positions.mean(axis=0)
    start = _searched(view.thinned(FEW), centre)

    def errors(x: np.ndarray) -> np.ndarray:
        return _errors(view.later(float(x[4])), centre, x)

    def level(x: np.ndarray) -> np.ndarray:
        return errors(np.array([*x[:3], centre[2], x[3]]))

    x, _ = robust_fit(errors, start)
    std, kept = _standard_errors(view, errors, x), ""
    doubtful = std[3] > DETERMINED_M and abs(x[3] - centre[2]) < SURE * std[3]
    if flat or doubtful:
        if not flat:
            kept = f"z as it was, since its shift of {x[3] - centre[2]:.2f} ± {std[3]:.2f} m may be zero; "
        part, _ = robust_fit(level, np.delete(x, 3))
        x = np.array([*part[:3], centre[2], part[3]])
        std = np.insert(_standard_errors(view, level, part), 3, 0.0)
    certain = (
        f"standard errors {std[1]:.2g}, {std[2]:.2g}, {std[3]:.2g} m in x, y, z at the middle of the truth, "
        f"{math.degrees(std[0]):.2g}°, {std[4]:.2g} s"
    )
    of_groups = view.sizes(errors(x))
    known = np.isfinite(of_groups).any(axis=0)
    sizes = np.nanmedian(of_groups[:, known], axis=0)
    unit = view.kind.unit
    typical = ", ".join(f"{size:.2g} {unit}" for size in sizes)
    if not (sizes <= view.kind.sizes("large", len(known))[known]).all():
        raise UnusableInput(
            f"--align-truth: no turn about z, shift and difference of clocks up to {LONGEST_S:g} s explains the "
            f"{view.kind.name}: errors of {typical} are left; check the rig and the tag, or give --transform"
        )
    east, north, up = x[1:4] - about_vertical(x[0]) @ centre
    yaw = math.degrees(math.remainder(x[0], 2 * math.pi))
    return (
        Placement(east, north, up, yaw, float(x[4])),
        f"{kept}{view.kind.name} then differ by {typical} typically; {certain}",
    )


def _standard_errors(view: Compared, errors: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """The standard errors of numbers fitted to readings, whose errors are white and a bias of each anchor or station.

    The biases have the spread of the groups' median errors, which the fit has taken part of, and of measurements other
    than positions at least the size that cannot be told from none; errors of distances may have one part in common.
    """
    e = errors(x)
    of_groups = np.nan_to_num(view.medians(e))
    groups, n = len(of_groups), len(x)
    spread = 1.4826 * np.median(np.abs(of_groups), axis=0) * math.sqrt(groups / max(groups - n + 1, 1))
    least = 0.0 if view.kind.position else view.kind.sizes("floor", e.shape[1])
    bias = np.maximum(spread * (groups > 1), least)
    size = np.nan_to_num(1.4826 * known_median(np.abs(e)), nan=1.0) + 1e-9
    slopes = np.stack([(errors(x + 1e-6 * unit) - e) / 1e-6 for unit in np.eye(n)], axis=-1)
    known = np.isfinite(e) & np.isfinite(slopes).all(axis=-1)
    weights = np.where(known, cauchy_weights(np.nan_to_num(e), size), 0.0)
    slopes = np.where(known[..., None], slopes, 0.0)
    pulls = np.stack([(weights[..., None] * slopes)[view.group == k].sum(axis=0) for k in range(groups)])
    scatter = np.einsum("gci,gcj,c->ij", pulls, pulls, bias**2)
    if view.kind.distance:
        scatter += np.einsum("ci,cj,c->ij", pulls.sum(axis=0), pulls.sum(axis=0), bias**2)
    scatter += np.einsum("nc,nci,ncj,c->ij", weights**2, slopes, slopes, size**2)
    inverse = np.linalg.pinv(np.einsum("nc,nci,ncj->ij", weights, slopes, slopes))
    return np.asarray(np.sqrt(np.diag(inverse @ scatter @ inverse)))


def _errors(view: Compared, centre: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The errors of the readings with the truth turned by x[0], rad, about `centre`, which goes to x[1:4]."""
    return view._replace(positions=x[1:4] + (view.positions - centre) @ about_vertical(x[0]).T).errors()


def _searched(view: Compared, centre: np.ndarray) -> np.ndarray:
    """The best of some turns at each difference of the clocks, each with the shift that fits it."""
    middle = np.nanmean((view.values if view.kind.position else view.sensors.places)[:, :2], axis=0)
    fits = []
    for later in np.arange(-LONGEST_S, LONGEST_S + STEP_S, STEP_S):
        shifted = view.later(float(later))
        known = np.isfinite(shifted.positions).all(axis=1)
        if 2 * known.sum() < len(known):
            continue
        shifted = shifted.of_rows(known)
        errors = partial(_errors, shifted, centre)
        starts = [np.append(yaw, [*middle, centre[2]]) for yaw in np.arange(24) * np.pi / 12]
        starts.sort(key=lambda x: float(np.nanmean(np.log1p(np.abs(errors(x))))))
        x, size = min((robust_fit(errors, start, 8) for start in starts[:NEAR]), key=lambda fit: fit[1])
        fits.append((size, np.append(x, later)))
    return min(fits, key=lambda fit: fit[0])[1]
