"""Bearings of stations on a walk: their derivatives by positions, rotations and gains of stations, and by the path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from trackwright.trackers.core.model.rig import angle_slopes, angles_in_array
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.survey.walks import AVERAGE, Walk, pieces

UNKNOWNS = 8
"""Of a station: its position, m, its turn from a reference as a rotation vector in the array frame, and two gains."""

POSITION, TURN, GAINS = slice(0, 3), slice(3, 6), slice(6, 8)


@dataclass(frozen=True, eq=False)
class BearingWalk(Walk):
    """Azimuths and elevations, rad, each as a reading of its own.

    `station` (n,): its number. `angle` (n,): 0 of azimuths, 1 of elevations. `references` (S, 3, 3): rotations, array
    frame to world frame, from which turns count. A station measures an angle as that angle times its gain.
    """

    station: Int[np.ndarray, " n"]
    angle: Int[np.ndarray, " n"]
    references: Float[np.ndarray, "S 3 3"]

    least_scale = 2e-3

    @property
    def levels(self) -> Int[np.ndarray, "n 1"]:
        """Twice the station's number, and one more for elevations."""
        return (2 * self.station + self.angle)[:, None]

    def residuals(self, sensors: Float[np.ndarray, "S 8"], path: Float[np.ndarray, "knots d"]) -> np.ndarray:
        predicted = self._angles(self._in_arrays(sensors, path)) * self._gains(sensors)
        # An error of more than half a turn is one the other way round.
        return np.mod(self.values - predicted + np.pi, 2.0 * np.pi) - np.pi

    def linearised(
        self, sensors: Float[np.ndarray, "S 8"], path: Float[np.ndarray, "knots d"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n U"]]:
        local, gain = self._in_arrays(sensors, path), self._gains(sensors)
        slope = gain[:, None] * angle_slopes(local.T)[np.arange(len(local)), self.angle]
        units = np.einsum("nij,nj->ni", rotations(sensors, self.references)[self.station], slope)
        turned = np.einsum("nji,nj->ni", right_jacobians(sensors[:, TURN])[self.station], np.cross(slope, local))
        partial = np.zeros((len(local), len(sensors), UNKNOWNS))
        rows = np.arange(len(local))
        partial[rows, self.station, POSITION], partial[rows, self.station, TURN] = -units, turned
        partial[rows, self.station, GAINS.start + self.angle] = self._angles(local)
        return self.residuals(sensors, path), units, partial.reshape(len(local), -1)

    def _gains(self, sensors: np.ndarray) -> np.ndarray:
        return sensors[self.station, GAINS.start + self.angle]

    def _in_arrays(self, sensors: np.ndarray, path: np.ndarray) -> np.ndarray:
        """The tag (n, 3), m, in the frame of the array of each reading."""
        offset = self.positions(path) - sensors[self.station, POSITION]
        return np.einsum("nji,nj->ni", rotations(sensors, self.references)[self.station], offset)

    def _angles(self, local: np.ndarray) -> np.ndarray:
        """The azimuth or elevation (n,), rad, of points (n, 3) in array frames."""
        return angles_in_array(local.T)[np.arange(len(local)), self.angle]


def rotations(sensors: Float[np.ndarray, "S 8"], references: Float[np.ndarray, "S 3 3"]) -> Float[np.ndarray, "S 3 3"]:
    """The rotations of stations, array frame to world frame."""
    return references @ Rotation.from_rotvec(sensors[:, TURN]).as_matrix()


def right_jacobians(turns: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 3 3"]:
    """The derivatives of small turns after rotation vectors by these vectors (Chirikjian 2011)."""
    size = np.maximum(np.linalg.norm(turns, axis=1), 1e-6)[:, None, None]
    x, y, z = turns.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.eye(3) - (1.0 - np.cos(size)) / size**2 * cross + (size - np.sin(size)) / size**3 * cross @ cross


def bearing_walks(
    folders: Sequence[RecordingFolder], stations: Sequence[str], height: float | None
) -> list[BearingWalk]:
    """The walks of all tags before stations of these ids; `height`: of all tags, m, else those in rigs."""
    walks = []
    references = np.stack([folders[0].rig.stations[name].world_from_array() for name in stations])
    for folder in folders:
        rows = folder.rows("bearings", AVERAGE)
        angles, number = rows.floats(["azimuth_rad", "elevation_rad"]), rows.codes("station", stations)
        for tag, known, piece in pieces(folder, rows, np.isfinite(angles).any(axis=1), height):
            row, angle = np.nonzero(np.isfinite(angles[piece]))
            walks.append(
                BearingWalk(folder.name, tag, rows.times[piece[row]], angles[piece[row], angle], known,
                            number[piece[row]], angle, references)
            )  # fmt: skip
    return walks
