"""Alignment of an estimated trajectory with the true one: rigid, with scale, in the plane, or at the first pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.exchange.poses import AXES, PoseTrajectory, quaternions_of
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.kinds import QUATERNION

Alignment = Literal["none", "se2", "se3", "sim3", "scale", "origin"]

_STDS = tuple(f"std_{axis}" for axis in AXES)
_COVARIANCES = (("cov_xy_m2", 0, 1), ("cov_xz_m2", 0, 2), ("cov_yz_m2", 1, 2))
_VELOCITY = tuple(f"v{axis}_mps" for axis in "xyz")


@dataclass(frozen=True, eq=False)
class Similarity:
    """A map of space: p → `scale` · `rotation` p + `translation`, m; `flat` where it leaves heights alone."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0
    flat: bool = False

    def points(self, positions: np.ndarray) -> np.ndarray:
        """The images (n, 3) of positions (n, 3), m; an unknown height stays unknown where heights are left alone."""
        if self.flat:
            moved = positions.copy()
            moved[:, :2] = positions[:, :2] @ self.rotation[:2, :2].T + self.translation[:2]
            return moved
        return self.scale * positions @ self.rotation.T + self.translation

    def trajectory(self, poses: PoseTrajectory) -> PoseTrajectory:
        """The image of a trajectory; attitudes are turned with it."""
        quaternions = poses.quaternions
        if quaternions is not None:
            quaternions = quaternions_of(self.rotation @ rotation_matrices(quaternions))
        return replace(poses, positions=self.points(poses.positions), quaternions=quaternions)

    def table(self, tracks: pl.DataFrame) -> pl.DataFrame:
        """The image of a table of estimates: positions, attitudes, velocities and covariances, where it has them."""
        positions = self.points(np.stack([float_column(tracks, axis) for axis in AXES], axis=1))
        columns = dict(zip(AXES, positions.T, strict=True))
        if _VELOCITY[0] in tracks.columns:
            velocity = np.stack([float_column(tracks, axis) for axis in _VELOCITY], axis=1)
            turned = replace(self, translation=np.zeros(3)).points(velocity)
            columns |= dict(zip(_VELOCITY, turned.T, strict=True))
        if _STDS[0] in tracks.columns:
            columns |= self._covariances(tracks)
        if QUATERNION[0] in tracks.columns:
            quaternions = np.stack([float_column(tracks, name) for name in QUATERNION], axis=1)
            known = np.isfinite(quaternions).all(axis=1)
            quaternions[known] = quaternions_of(self.rotation @ rotation_matrices(quaternions[known]))
            columns |= dict(zip(QUATERNION, quaternions.T, strict=True))
        kept = {name: values for name, values in columns.items() if name in tracks.columns}
        return tracks.with_columns(pl.Series(name, values).fill_nan(None) for name, values in kept.items())

    def _covariances(self, tracks: pl.DataFrame) -> dict[str, np.ndarray]:
        covariance, factor = covariances(tracks), self.scale * self.rotation
        if self.flat:
            # An unknown variance of the height, which the map leaves alone, must not reach the other axes.
            turn = factor[:2, :2]
            covariance[:, :2, :2] = turn @ covariance[:, :2, :2] @ turn.T
            covariance[:, :2, 2] = covariance[:, 2, :2] = covariance[:, :2, 2] @ turn.T
        else:
            covariance = factor @ covariance @ factor.T
        stds = {name: np.sqrt(covariance[:, k, k]) for k, name in enumerate(_STDS)}
        return stds | {name: covariance[:, i, j] for name, i, j in _COVARIANCES}


def alignment(kind: Alignment, estimate: PoseTrajectory, truth: PoseTrajectory) -> Similarity:
    """The map that takes the poses of an estimate to those of the truth; row k of one belongs to row k of the other.

    `se3`: rotation and translation of least squares of the positions; `sim3`: with a scale; `scale`: that scale alone,
    about the origin; `se2`: rotation about the vertical axis and translation in x and y; `origin`: the first pose on
    the first true pose. Of Umeyama 1991. Raises UnusableInput where the positions do not determine the rotation.
    """
    if kind not in get_args(Alignment):
        raise UnusableInput(f"align = {kind!r}; expected one of {', '.join(get_args(Alignment))}")
    if kind == "none":
        return Similarity(np.eye(3), np.zeros(3), flat=True)
    if kind == "se2":
        turn, shift, _ = _umeyama(estimate.positions[:, :2], truth.positions[:, :2], estimate.name, kind)
        rotation, translation = np.eye(3), np.zeros(3)
        rotation[:2, :2], translation[:2] = turn, shift
        return Similarity(rotation, translation, flat=True)
    unknown = [t.name for t in (estimate, truth) if not np.isfinite(t.positions).all()]
    if unknown:
        raise UnusableInput(f"{unknown[0]}: has no height; expected x, y, z for --align {kind}; use --align se2")
    if kind == "origin":
        return _origin(estimate, truth)
    rotation, translation, scale = _umeyama(estimate.positions, truth.positions, estimate.name, kind)
    if kind == "scale":
        return Similarity(np.eye(3), np.zeros(3), scale)
    return Similarity(rotation, translation, scale if kind == "sim3" else 1.0)


def _origin(estimate: PoseTrajectory, truth: PoseTrajectory) -> Similarity:
    rotation = np.eye(3)
    if estimate.quaternions is not None and truth.quaternions is not None:
        own, true = rotation_matrices(estimate.quaternions[:1])[0], rotation_matrices(truth.quaternions[:1])[0]
        rotation = true @ own.T
    return Similarity(rotation, truth.positions[0] - rotation @ estimate.positions[0])


def _umeyama(x: np.ndarray, y: np.ndarray, name: str, kind: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation R, translation t and scale c with the least Σ |y − (c R x + t)|²; t is of scale 1 unless `sim3`.

    Umeyama 1991, equations (34) to (43); x, y (n, m).
    """
    n, m = x.shape
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    variance = float(((x - mean_x) ** 2).sum() / n)
    covariance = (y - mean_y).T @ (x - mean_x) / n
    u, d, v = np.linalg.svd(covariance)
    if np.count_nonzero(d > np.finfo(float).eps) < m - 1:
        fix = "" if kind == "se2" else "; use --align se2, or --align none"
        raise UnusableInput(
            f"{name}: its {n} poses with truth lie on a line or at a point, which leaves the rotation of "
            f"--align {kind} undetermined; expected motion in {'a plane' if m == 3 else 'x and y'}{fix}"
        )
    signs = np.ones(m)
    signs[-1] = -1.0 if np.linalg.det(u) * np.linalg.det(v) < 0 else 1.0
    rotation = (u * signs) @ v
    scale = float((d * signs).sum() / variance)
    applied = scale if kind == "sim3" else 1.0
    return rotation, mean_y - applied * rotation @ mean_x, scale
