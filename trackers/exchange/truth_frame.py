"""The frame and the clock of an imported truth brought over to a recording's: as given, or as readings tell."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.exchange.trajectories import Similarity
from trackwright.trackers.recordings.checks.changes import about_vertical, transform_text
from trackwright.trackers.recordings.checks.compared import Compared, cauchy_weights, compared, derivatives, robust_fit
from trackwright.trackers.recordings.checks.imu import between, imu_rows, spaced, true_attitude
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS

LONGEST_S, STEP_S = 10.0, 0.5  # differences of the clocks that are searched: some decimetres of motion between two
LEANING, PUSH_S = 5.0, 0.2  # angle of gravity to z, °, from which a truth is levelled; time of an IMU's averages, s
FEW, NEAR = 240, 3  # readings of the search, and how many of its 24 turns are refined at each difference
DETERMINED_M, SURE = 0.05, 3.0  # standard error of z that is determined, and standard errors that are not zero


class Placement(NamedTuple):
    """A turn about z by `yaw`, °, a shift (`x`, `y`, `z`), m, after it, and `later`, s, added to the times."""

    x: float
    y: float
    z: float
    yaw: float
    later: float = 0.0

    def of_table(self, truth: pl.DataFrame) -> pl.DataFrame:
        """The truth, positions and attitudes, in the other frame and on the other clock."""
        moved = Similarity(about_vertical(math.radians(self.yaw)), np.array(self[:3])).table(truth)
        return moved.with_columns(pl.col("t_s") + self.later)


def parsed_placement(text: str) -> Placement:
    """The placement of a text X,Y,Z,YAW or X,Y,Z,YAW,S; raises UnusableInput."""
    try:
        placement = Placement(*map(float, text.split(",")))
    except (ValueError, TypeError):
        placement = Placement(*[math.nan] * 5)
    if not np.isfinite(placement).all():
        expected = "X,Y,Z,YAW or X,Y,Z,YAW,S: a shift in m after a turn about z in degrees, and s added to the times"
        raise UnusableInput(f"--transform {text}: expected {expected}")
    return placement


def with_truth_moved(
    imported: RecordingFolder, recording: RecordingFolder, transform: str | None, flat: bool
) -> tuple[RecordingFolder, list[str]]:
    """The imported tables with the truth moved by `transform`, or as readings of the recording fit it, and notices."""
    truth, notices = imported.tables.get("truth"), list[str]()
    if truth is None:
        raise UnusableInput("--transform and --align-truth: move a truth; expected --table truth")
    if transform is not None:
        placement = parsed_placement(transform)
    else:

        def beside(truth: pl.DataFrame) -> RecordingFolder:
            return replace(recording, tables=dict(recording.tables) | {"truth": truth.sort("t_s", maintain_order=True)})

        level, angle = leaning(beside(truth))
        if angle:
            truth = level.table(truth)
            notices.append(
                f"truth levelled, which leaned by {angle:.0f}° against the gravity that the IMU measures; then"
            )
        placement, words = found_placement(beside(truth), flat)
        notices.append(f"truth moved by --transform {transform_text(*placement)}: {words}")
    return replace(imported, tables=dict(imported.tables) | {"truth": placement.of_table(truth)}), notices


def leaning(recording: RecordingFolder) -> tuple[Similarity, float]:
    """The turn that makes gravity, as an IMU measures it, vertical in the truth's frame; its angle, ° or 0."""
    truth = recording.tables["truth"]
    for tag in truth["tag"].unique(maintain_order=True) if "imu" in recording.tables else ():
        rows, attitude = imu_rows(recording.tables["imu"], tag), true_attitude(truth.filter(pl.col("tag") == tag))
        if rows is None or attitude is None:
            continue
        at = spaced(attitude.times, PUSH_S)
        row = np.searchsorted(attitude.times, at).clip(max=len(attitude.times) - 1)
        force = between(rows.times, rows.pushed, at - PUSH_S / 2, at + PUSH_S / 2) / PUSH_S
        force = np.einsum("nij,nj->ni", rotation_matrices(attitude.quaternions[row]), force)
        gravity = np.nan_to_num(force).sum(axis=0) / max(np.isfinite(force[:, 0]).sum(), 1)
        size = max(float(np.linalg.norm(gravity)), 1e-9)
        angle = math.degrees(math.acos(gravity[2] / size))
        if 9.0 < size < 11.0 and LEANING < angle < 180.0 - LEANING:
            axis = np.cross(gravity, [0.0, 0.0, 1.0])
            turn = Rotation.from_rotvec(math.radians(angle) * axis / np.linalg.norm(axis))
            return Similarity(turn.as_matrix(), np.zeros(3)), angle
    return Similarity(np.eye(3), np.zeros(3)), 0.0


def found_placement(recording: RecordingFolder, flat: bool = False) -> tuple[Placement, str]:
    """The placement of the truth that its readings fit best, and how well, in words; or UnusableInput.

    Without a shift in z where `flat`, and where readings determine it neither to `DETERMINED_M` nor as other than zero.
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
    if flat or (std[3] > DETERMINED_M and abs(x[3] - centre[2]) < SURE * std[3]):
        if not flat:
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
    return Placement(float(shift[0]), float(shift[1]), float(shift[2]), yaw, float(x[4])), words


def _standard_errors(view: Compared, errors: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """The standard errors of numbers fitted to readings with white errors and a bias of each anchor or station.

    Biases have the spread of the groups' median errors, at least the size that cannot be told from none; distances may
    have one in common.
    """
    e, n = errors(x), len(x)
    of_groups = np.nan_to_num(view.medians(e))
    groups = len(of_groups)
    spread = 1.4826 * np.median(np.abs(of_groups), axis=0) * math.sqrt(groups / max(groups - n + 1, 1)) * (groups > 1)
    bias = np.maximum(spread, 0.0 if view.kind.position else view.kind.sizes("floor", e.shape[1]))
    size = np.nan_to_num(1.4826 * known_median(np.abs(e)), nan=1.0) + 1e-9
    slopes = derivatives(errors, x, e)
    known = np.isfinite(e) & np.isfinite(slopes).all(axis=-1)
    weights = np.where(known, cauchy_weights(np.nan_to_num(e), size), 0.0)
    slopes = np.where(known[..., None], slopes, 0.0)
    pulls = np.stack([(weights[..., None] * slopes)[view.group == k].sum(axis=0) for k in range(groups)])
    pulls = np.concatenate([pulls, pulls.sum(axis=0, keepdims=True)]) if view.kind.columns[0].positive else pulls
    scatter = np.einsum("gci,gcj,c->ij", pulls, pulls, bias**2)
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
        known = np.isfinite((shifted := view.later(float(later))).positions).all(axis=1)
        if 2 * known.sum() >= len(known):
            errors = partial(_errors, shifted.of_rows(known), centre)
            starts = [np.append(yaw, [*middle, centre[2]]) for yaw in np.arange(24) * np.pi / 12]
            starts.sort(key=lambda x: float(np.nanmean(np.log1p(np.abs(errors(x))))))
            x, size = min((robust_fit(errors, start, 8) for start in starts[:NEAR]), key=lambda fit: fit[1])
            fits.append((size, np.append(x, later)))
    return min(fits, key=lambda fit: fit[0])[1]
